"""Planning: a flow field and a goal to a timed route."""

from flowrec.stages.planning.planner import PLANNERS, Planner, warm_up
from flowrec.stages.planning.route import travel_time
from flowrec.stages.planning.survey import SURVEYS, SurveyPlanner

__all__ = ["PLANNERS", "SURVEYS", "Planner", "SurveyPlanner", "travel_time", "warm_up"]
