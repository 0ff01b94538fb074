"""The words of the house: messages, topics, errors, units, ranges, tables of methods; files, processes, clocks.

Knows no other room.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
