"""A Session to files of other programs, a format each, and to the page of `flowrec report`."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
