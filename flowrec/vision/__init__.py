"""Frame to Track."""

from flowrec.vision.tracker import Sight, Tracker, missed

__all__ = ["Sight", "Tracker", "missed"]
