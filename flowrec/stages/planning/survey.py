"""The survey's routes: where the robot looks at the flow before the mission plans its way; and the table of methods."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from flowrec.core import Method, Methods, PositiveShare, Range, Route, Share
from flowrec.stages.planning.free_space import FastFlowMargin
from flowrec.stages.planning.route import with_remarks
from flowrec.stages.planning.survey_design import SurveyOrder

_ALL = ("speed_share", "clearance_margin_um", "swift", "middle_pull", "outlet_gap_radii")
_NO_PRIOR = "downstream"  # the method that needs none

SURVEYS = Methods(
    "survey.method",
    Method(
        "information",
        "flowrec.stages.planning.survey_information:Information",
        "stretch by stretch to where observations lower the error of the flow most per second, while it is worth it",
        (
            *_ALL,
            "distance_um",
            "fast_share",
            "drift_share",
            "route_share",
            "detour_share",
            "robust_deviations",
            "model_share",
            "places",
            "worth",
            "memory_stretches",
        ),
        needs=("uncertainty",),
    ),
    Method(
        "downstream",
        "flowrec.stages.planning.survey_downstream:Downstream",
        "one path with the main stream, over a limited distance",
        (*_ALL, "distance_um", "share"),
    ),
)


@dataclass(frozen=True, slots=True)
class SurveyPlanner:
    """Chooses where the robot observes the flow; a method reads the settings that its row in SURVEYS names."""

    method: Annotated[str, SURVEYS] = "information"
    # length of the survey at most; None: `share` of the longest path downstream, or no limit of `information`
    distance_um: Annotated[float, Range(1.0, 1e7)] | None = None
    # length of a survey `downstream` over that of the longest path; None: 1/8; 1/2 where there are several inlets or
    # outlets to tell apart
    share: PositiveShare | None = None
    # ratio to the robot's speed limit: slower than usual, to observe more on the way
    speed_share: PositiveShare = 0.5
    # distance that is kept from the walls beside the robot's radius; None: half of the radius
    clearance_margin_um: Annotated[float, Range(0.0, 1e4)] | None = None
    swift: FastFlowMargin = field(default_factory=FastFlowMargin)  # as in plan.swift
    # additional cost of a pixel next to the wall, as a ratio to that of one in the middle
    middle_pull: Annotated[float, Range(0.0, 1e3)] = 2.0
    # distance between the end of the route and any opening, in robot radii
    outlet_gap_radii: Annotated[float, Range(0.0, 1e3)] = 3.0
    # another ratio to the speed limit at which a stretch of the survey may be travelled. A drift observes the flow
    # almost without the robot's own motion, so it is tried only where constants of the robot are in doubt.
    fast_share: PositiveShare = 0.85
    # another ratio to the speed limit, a drift, tried where constants of the robot are in doubt
    drift_share: PositiveShare = 0.15
    # part of the squared error to be lowered that counts on the ways to the goal; the rest counts all over the map
    route_share: Share = 0.5
    # A way to the goal that takes longer than the fastest by this ratio counts for a third of it.
    detour_share: Annotated[float, Range(0.01, 100.0)] = 0.5
    # standard deviations by which the flow may be worse than believed where the goal must stay within reach; fewer
    # where no way is
    robust_deviations: Annotated[float, Range(0.0, 100.0)] = 1.0
    # one standard deviation of what the model does not explain, as a ratio to the speed of the flow, the same all over
    # a place: what is known as well as this is not looked at again
    model_share: Annotated[float, Range(0.0, 10.0)] = 0.05
    places: Annotated[int, Range(1, 10_000)] = 120  # largest number of ends of a stretch that are compared, per speed
    # The survey ends when a crossing's time of it would lower the relative error of the flow by less than this.
    # Chosen against 0.02 on eight procedural vessels of `flowrec bench survey`, at equal count. Those have a mean error
    # of .0238 in 4.8 crossings without a memory, .0243 in 3.4 crossings with that of three stretches.
    worth: Annotated[float, Range(0.0, 10.0)] = 0.01
    # The next stretch is believed to be worth as much less as the latest ones were, in the fall of the stated error or
    # in the move of the map, than was expected of them; so many count. 0: what is expected is believed. Cut after the
    # same choices, nine surveys (five worlds, bifurcation and three procedural vessels) took 39 s with 0, 24 s with 2,
    # 28 s with 3 and with 4, and the mean errors were .092, .096, .093, .091.
    memory_stretches: Annotated[int, Range(0, 1000)] = 3

    @property
    def needs_uncertainty(self) -> bool:
        """True if the method asks how wrong the flow may be, which takes as long to compute as a refinement."""
        return "uncertainty" in SURVEYS[self.method].needs

    def plan(self, order: SurveyOrder) -> Route:
        """The route (stamp and request 0) of the survey as far as it is decided, or no route with the reason.

        A method that needs the uncertainty of the flow is replaced by one that does not, where there is none.

        Raises
        ------
        UsageError
            If the robot has no speed, or field and chip do not fit together.
        FlowError
            If the field is not finite.
        """
        row, remark = SURVEYS[self.method], ""
        if self.needs_uncertainty and order.uncertainty is None:
            remark = f"survey {_NO_PRIOR}: nothing says how wrong the assumed flow may be"
            row = SURVEYS[_NO_PRIOR]
        route: Route = row.build(self).plan(order)
        return with_remarks(route, remark)
