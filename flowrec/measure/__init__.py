"""A picture or a recording in, settings with their errors out: chip, image, coils, motion."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
