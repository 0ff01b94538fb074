"""Frame to Track."""

from flowrec.vision.tracker import Footprint, Tracker, unseen

__all__ = ["Footprint", "Tracker", "unseen"]
