"""Frame to Track."""

from flowrec.vision.tracker import Tracker

__all__ = ["Tracker"]
