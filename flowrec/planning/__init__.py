"""Planning: a flow field and a goal to a timed route."""

from flowrec.planning.planner import PLANNERS, Planner, warm_up
from flowrec.planning.route import travel_time
from flowrec.planning.survey import SURVEYS, SurveyPlanner

__all__ = ["PLANNERS", "SURVEYS", "Planner", "SurveyPlanner", "travel_time", "warm_up"]
