"""Frame to Track."""

from flowrec.stages.vision.assignment import move_neighbours
from flowrec.stages.vision.several import Expected
from flowrec.stages.vision.stabiliser import Stabiliser
from flowrec.stages.vision.tracker import Tracker
from flowrec.stages.vision.trackers import unseen

__all__ = ["Expected", "Stabiliser", "Tracker", "move_neighbours", "unseen"]
