"""Frame to Track."""

from flowrec.vision.stabiliser import Stabiliser
from flowrec.vision.tracker import Footprint, Tracker, carried, unseen

__all__ = ["Footprint", "Stabiliser", "Tracker", "carried", "unseen"]
