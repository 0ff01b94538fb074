"""The planner stage: a timed route to the goal, or the reason why there is none; and the table of its methods."""

from __future__ import annotations

from dataclasses import dataclass
from dataclasses import field as setting
from typing import Annotated, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike

from flowrec.core import (
    FlowField,
    Method,
    Methods,
    OneOf,
    PositiveShare,
    Range,
    Route,
    Seed,
    Share,
    UsageError,
    check_ranges,
)
from flowrec.physics import Chip, FlowUncertainty, Opening, Robot
from flowrec.stages.planning.feasibility import joined_ends, narrowest, too_swift
from flowrec.stages.planning.free_space import FastFlowMargin, spaces_by_margin
from flowrec.stages.planning.problem import Problem
from flowrec.stages.planning.route import no_route, planning_speed_um_s, with_remarks
from flowrec.stages.planning.survey import SURVEYS, SurveyPlanner
from flowrec.stages.planning.survey_design import Sampling, SurveyOrder

PLANNERS = Methods(
    "plan.method",
    Method(
        "time_field",
        "flowrec.stages.planning.time_field:TimeField",
        "time to go by the eikonal equation, its descent refined; the only one with a policy or with energy as cost",
        (
            "cost",
            "idle_speed_um_s",
            "policy_share",
            "policy_margin_share",
            "policy_course_share",
            "wall_error_um",
            "policy_points_per_radius",
            "policy_points_per_px",
            "robust_deviations",
            "flow_error_share",
            "reach_px",
            "refine",
        ),
        provides=("time_to_go",),
    ),
    Method(
        "astar_time",
        "flowrec.stages.planning.grid_search:AstarTime",
        "A* on the pixels by travel time with an admissible heuristic, its path refined",
        ("reach_px", "refine"),
    ),
    Method(
        "astar_paper",
        "flowrec.stages.planning.grid_search:AstarPaper",
        "A* with the paper's cost and heuristic as printed",
        ("paper_radius_px", "reach_px"),
    ),
    Method(
        "astar_length",
        "flowrec.stages.planning.grid_search:AstarLength",
        "A* on the pixels by length; ignores the flow",
        ("reach_px",),
    ),
    Method("rrt", "flowrec.stages.planning.rrt:Rrt", "RRT of OMPL: the first path found", ("rrt",), "ompl"),
    Method("rrt_star", "flowrec.stages.planning.rrt:RrtStar", "RRT* of OMPL by travel time", ("rrt",), "ompl"),
    group="flowrec.planners",
    verb="plan",
)


class PlanningMethod(Protocol):
    """Interface of a row's target: a class whose fields are the row's options, with this method."""

    def plan(self, problem: Problem) -> Route:
        """The route of a problem whose ends are connected by free pixels, or no route with its reason."""
        ...


@dataclass(frozen=True, slots=True)
class RrtSettings:
    """Settings of both trees."""

    seed: Seed = 0  # seed of the branches
    iterations: Annotated[int, Range(1, 100_000_000)] = 20000  # largest number of branches; rrt stops at its first path
    range_px: Annotated[float, Range(0.1, 1e5)] = 12.0  # longest branch
    goal_bias: Share = 0.05  # fraction of the samples that are the goal itself


@dataclass(frozen=True, slots=True)
class Planner:
    """Plans the route to the goal; a method reads the settings that its row in PLANNERS names, or no row does."""

    method: Annotated[str, PLANNERS] = "time_field"
    cost: Literal["time", "energy"] = "time"  # what a route has least of; energy counts the swimming and the time
    # swimming at this speed takes as much power as everything else; None: half of V
    idle_speed_um_s: Annotated[float, Range(0.01, 1e6)] | None = None
    # distance that is kept from the walls beside the robot's radius; None: half of the radius
    clearance_margin_um: Annotated[float, Range(0.0, 1e4)] | None = None
    swift: FastFlowMargin = setting(default_factory=FastFlowMargin)  # more is kept where the flow is fast
    speed_share: PositiveShare = 0.85  # ratio to the robot's speed limit; the rest is left to the controller
    policy_share: PositiveShare = 1.0  # ratio to the speed limit in the time to go: a policy keeps no reserve
    # Distance by which a wall may lie elsewhere than where the robot is seen beside it: errors of the mask and of the
    # registration. The time to go keeps that from the walls, at most the margin; None, not known: all of the margin (a
    # run fills in the robot's radius, which is more). Upstream on procedural networks (`flowrec bench missions`, 6
    # seeds, assumed map) a fifth of the margin touched a wall in all 6 missions of `moderate`, whose registration is a
    # pixel of the camera off; all of it in none, and it arrived earlier, because the walls slow a robot beside them.
    wall_error_um: Annotated[float, Range(0.0, 1e4)] | None = None
    # Least ratio to the margin in the time to go. Against the flow the fastest way is along the wall, and a policy,
    # which no reference pulls there, keeps off it by itself; a robot that tracks a route needs all of the margin.
    # Where walls and registration are exact, a fifth touched no wall in 76 missions upstream; a tenth touched one in 3
    # of 29 and was no faster.
    policy_margin_share: Share = 0.2
    # Ratio to the course error of `swift` in the time to go. A quarter is a twentieth faster on chips whose robot swims
    # its own radius in a frame, and touches a wall there in 3 missions of 7, where half of it touches none.
    policy_course_share: Share = 0.5
    # Points of the time to go per radius of the robot: against the flow the way along the wall lies between the pixels.
    policy_points_per_radius: Annotated[float, Range(0.1, 100.0)] = 10.0
    # most of these points per pixel; fewer where there would be over 2 million in all
    policy_points_per_px: Annotated[int, Range(1, 16)] = 8
    # standard deviations by which the flow may be worse than believed; fewer where no way is left
    robust_deviations: Annotated[float, Range(0.0, 100.0)] = 1.0
    # one standard deviation of a flow that states none, as a ratio of its speed; None: from the map
    flow_error_share: Annotated[float, Range(0.0, 10.0)] | None = None
    # reach of a step of astar_time and astar_length: 1, 2, 3 give 8, 16, 32 directions
    reach_px: Annotated[int, OneOf(1, 2, 3)] = 3
    paper_radius_px: Annotated[float, Range(1.0, 100.0)] = 3.5  # reach of a step of astar_paper; 1.5 gives 8 neighbours
    refine: bool = True  # refine the path of time_field and astar_time off the pixels
    # standard deviations of the gain that another route must gain on the way to be taken
    replan_deviations: Annotated[float, Range(0.0, 100.0)] = 2.0
    rrt: RrtSettings = setting(default_factory=RrtSettings)

    def plan(self, field: FlowField, start_um: ArrayLike, goal_um: ArrayLike, chip: Chip, robot: Robot) -> Route:
        """Route from start to goal, both (2,) um; stamp and request are 0.

        A reachable route may carry a remark in `reason`. A start too near to a wall is joined to the nearest place with
        room. Where a channel leaves no room for the usual margin, half of it is kept, or none; a margin that was asked
        for is kept.

        Raises
        ------
        UsageError
            If the robot has no speed, a setting makes no sense, a package is missing, or field and chip do not fit
            together.
        FlowError
            If the field is not finite.
        """
        robot = _as_found(robot, field)
        speed_um_s = planning_speed_um_s(self.speed_share, robot)
        method = self._method()
        start_at, goal_at = np.asarray(start_um, np.float64), np.asarray(goal_um, np.float64)
        course_error = self.swift.course_error(robot, robot.speed_limit_um_s, field)
        for space, margin_um, less in spaces_by_margin(chip, field, robot, self.clearance_margin_um, course_error):
            start, goal, error = joined_ends(space, start_at, goal_at)
            if not error:
                route = method.plan(
                    Problem(self.method, space, field, start, goal, goal_at, robot, margin_um, speed_um_s)
                )
                return with_remarks(route, less, start.remark, goal.remark)
        if self.clearance_margin_um is not None:
            error = narrowest(space, start_at, goal_at) or error
        too_fast = too_swift(chip, field, start_at, goal_at, course_error)
        return no_route(self.method, too_fast or error)

    def _method(self) -> PlanningMethod:
        row = PLANNERS[self.method]
        if self.cost == "energy" and "cost" not in row.options:
            able = " or ".join(f"'{other.name}'" for other in PLANNERS.values() if "cost" in other.options)
            raise UsageError(f"plan: {self.method} knows no energy; cost = 'energy' goes with method = {able}")
        check_ranges(self, "plan")
        return row.build(self)


def _as_found(robot: Robot, field: FlowField) -> Robot:
    """The robot with the smaller um per revolution that the refinement of a field has found; no plan needs a larger."""
    found = robot.learned_from(field)
    return found if found.um_per_rev < robot.um_per_rev else robot


def warm_up() -> None:
    """Plan on a toy chip with every method installed by default, so that the first real order does not compile."""
    mask = np.zeros((9, 24), np.bool_)
    mask[2:7] = True
    velocity = np.zeros((9, 24, 2), np.float32)
    velocity[2:7, :, 0] = 1.0
    openings = (Opening("left", 2, 6, "inlet", 1.0), Opening("right", 2, 6, "outlet", 0.0))
    chip = Chip("warm-up", mask, 1.0, openings, 1.0, 1000.0)
    field = FlowField(
        0, 0, "none", 1.0, velocity, np.zeros((9, 24), np.float32), None, chip.boundary_values, 1.0, 1000.0, ""
    )
    robot = Robot(radius_um=0.5, max_speed_um_s=5.0, step_out_hz=10.0)
    modes = velocity[chip.mask].astype(np.float64)
    nothing = np.zeros((0, len(modes)))
    uncertainty = FlowUncertainty(modes, modes[None], nothing, 0.1 * np.eye(1), np.zeros(len(modes)))
    start_um, goal_um, sampling = np.array([2.0, 4.0]), np.array([20.0, 4.0]), Sampling(1.0, 0.0, 0.1)
    for row in SURVEYS.values():
        order = SurveyOrder(field, start_um, chip, robot, goal_um, uncertainty, sampling)
        SurveyPlanner(method=row.name).plan(order)
    for row in PLANNERS.values():
        if not row.extra:
            Planner(method=row.name).plan(field, (2.0, 4.0), (20.0, 4.0), chip, robot)
