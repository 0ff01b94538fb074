"""Frame to Track."""

from flowrec.stages.vision.several import Expected
from flowrec.stages.vision.stabiliser import Stabiliser
from flowrec.stages.vision.tracker import Footprint, Tracker, move_neighbours
from flowrec.stages.vision.trackers import unseen

__all__ = ["Expected", "Footprint", "Stabiliser", "Tracker", "move_neighbours", "unseen"]
