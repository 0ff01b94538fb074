"""Pure functions of messages, (own previous message, inputs) to message, with their settings; `step` calls all.

No stage uses a clock, a disk or chance. The slow ones (solve, refine, plan) run in a worker.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
