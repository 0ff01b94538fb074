"""Images of other programs' files: movies, stacks, folders; their times and what they state of themselves."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
