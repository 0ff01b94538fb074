"""Frame to Track."""

from flowrec.vision.tracker import Sight, Tracker

__all__ = ["Sight", "Tracker"]
