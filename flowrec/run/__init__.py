"""The loop: a tick a frame from rig and pipeline to sinks, with workers, watchdog, operator, signals, disk.

The only room with threads and signals of a run.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
