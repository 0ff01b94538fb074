"""The page of `flowrec record --console`: shows a run and hands on what is asked there."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
