"""Planning: a flow field and a goal to a timed route."""

from flowrec.planning.planner import Planner
from flowrec.planning.survey import SurveyPlanner
from flowrec.planning.timing import travel_time
from flowrec.planning.warm_up import warm_up

__all__ = ["Planner", "SurveyPlanner", "travel_time", "warm_up"]
