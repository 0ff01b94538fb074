"""Ticks to an MCAP file and back: `SessionWriter`, `Session`, recovery, tables, sessions at URLs."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
