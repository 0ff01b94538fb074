"""Verbs, as commands `flowrec VERB` and as Python functions: arguments in, lines or JSON and an exit status out."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
