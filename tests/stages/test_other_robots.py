"""Robots beside the mission's one: expectation, response, walls, the limit of speed; and what a stage may not know."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from flowrec.core import (
    PUMP,
    WALLS,
    Applied,
    Demand,
    Estimate,
    Extra,
    Mission,
    Observations,
    PumpShare,
    RobotWalls,
    Source,
    Tick,
    Timing,
    Topic,
    Track,
    Truth,
)
from flowrec.physics import Robot, clearance_um, load_chip
from flowrec.rigs import SimulatedRig
from flowrec.run import LockstepWorker, messages_read, run
from flowrec.run.route_orders import observations_of
from flowrec.stages import (
    Observer,
    assemble,
    config_from_toml,
    load_config,
    resolve,
    robot_number,
    robot_topic,
    step,
    to_toml,
)
from flowrec.stages.control.events import event_of
from flowrec.stages.estimation import Sampler
from flowrec.stages.other_robots import OtherRobots, as_stated, expected_robots, observe_others
from flowrec.stages.robot_topics import messages_of, robot_topics
from flowrec.stages.run_figures import RobotStatistics, RunStatistics, chain_ms
from tests.short_missions import SMALL

ROBOT = Robot(radius_um=50.0, um_per_rev=25.0, max_speed_um_s=600.0, step_out_hz=28.0)
MASK = np.zeros((40, 60), bool)
MASK[10:30] = True
UM = 20.0
CLEARANCE = clearance_um(MASK, UM)
SEVERAL = [*SMALL, "simulated.robots=3", "tracker.robots=3", "simulated.seed=4"]
MIDDLE_UM, FLOOR_UM = 390.0, 590.0  # of the channel; its lower wall, in +y


def estimate(y_um: float, um_per_rev: float = 25.0, flow=(0.0, 0.0), stamp_ns: int = 0) -> Estimate:
    flow_um_s = np.array(flow)
    place = np.array([600.0, y_um])
    return Estimate(stamp_ns, place, flow_um_s, np.eye(4), 2.0, place, True, um_per_rev=um_per_rev)


def track(y_um: float, *, seen: bool = True, stamp_ns: int = 0) -> Track:
    return Track(stamp_ns, seen, np.array([600.0, y_um]), 0.9, 0, 5.0, np.zeros(4), seen_ns=stamp_ns if seen else None)


def walls(y_um: float, velocity=(0.0, 0.0), settings=OtherRobots(), before: RobotWalls | None = None) -> RobotWalls:  # noqa: B008
    demand = Demand(0, np.array(velocity), np.full(2, math.nan), 0.0, 0.0, False, np.zeros((0, 2)))
    last = Tick(demand=demand, extra=Extra({} if before is None else {WALLS: before}))
    return settings.watch(last, [track(y_um)], [estimate(y_um, 50.0)], ROBOT, [50.0], CLEARANCE, UM)


def test_the_distance_is_from_the_surface_and_the_speed_that_of_the_robots_own_response() -> None:
    told = walls(FLOOR_UM - 90.0, (30.0, 40.0))
    assert told.wall_um[0] == pytest.approx(40.0, abs=1.0)
    assert told.towards_um_s[0] == pytest.approx(80.0), "it rolls twice as far as the mission's robot"
    assert walls(FLOOR_UM - 90.0, (30.0, -40.0)).towards_um_s[0] == pytest.approx(-80.0)


def test_the_alarm_begins_below_a_distance_and_ends_farther_off() -> None:
    settings = OtherRobots(near_um=40.0)
    far = walls(FLOOR_UM - 95.0, settings=settings)
    near = walls(FLOOR_UM - 85.0, settings=settings)
    assert (far.near[0], near.near[0]) == (0.0, 1.0)
    assert walls(FLOOR_UM - 95.0, settings=settings, before=near).near[0] == 1.0
    assert walls(FLOOR_UM - 130.0, settings=settings, before=near).near[0] == 0.0
    ticks = [Tick(extra=Extra({WALLS: each})) for each in (far, near, far)]
    said = [event_of(a, b) for a, b in pairwise(ticks)]
    assert "robot 1 is 35 um from a wall" in said[0].text and "alarm over: robot 1" in said[1].text


@pytest.mark.parametrize(
    ("y_um", "velocity", "limited"),
    [
        (FLOOR_UM - 70.0, (0.0, 90.0), True),
        (FLOOR_UM - 70.0, (0.0, -90.0), False),  # away from the wall
        (MIDDLE_UM, (0.0, 90.0), False),  # far from it
    ],
)
def test_the_speed_is_limited_only_while_a_robot_is_near_a_wall_and_driven_there(y_um, velocity, limited) -> None:
    assert walls(y_um, velocity).limit_um_s is None, "no limit unless one is set"
    told = walls(y_um, velocity, OtherRobots(speed_limit_um_s=70.0))
    assert told.limit_um_s == (70.0 if limited else None)


def test_one_robot_near_a_wall_and_another_that_is_driven_to_a_wall_far_off_limit_nothing() -> None:
    demand = Demand(0, np.array([0.0, 100.0]), np.full(2, math.nan), 0.0, 0.0, False, np.zeros((0, 2)))
    settings, near_ceiling_um = OtherRobots(speed_limit_um_s=50.0), 190.0 + 60.0
    places = (near_ceiling_um, 560.0 - 100.0)  # the first one is driven off its wall, the second one towards its own
    tracks, estimates = [track(y_um) for y_um in places], [estimate(y_um) for y_um in places]
    told = settings.watch(Tick(demand=demand), tracks, estimates, ROBOT, [50.0, 50.0], CLEARANCE, UM)
    assert told.near.tolist() == [1.0, 0.0] and told.towards_um_s[0] < 0.0 < told.towards_um_s[1]
    assert told.limit_um_s is None


@pytest.mark.parametrize("seen", [True, False])
def test_a_robot_is_expected_as_nearly_as_its_estimate_tells_after_a_time(seen) -> None:
    dt, covariance = 0.5, np.kron(np.array([[900.0, 700.0], [700.0, 1600.0]]), np.eye(2))
    told = replace(estimate(MIDDLE_UM), covariance=covariance)
    last = Tick(track=track(MIDDLE_UM, seen=seen), estimate=told)
    still = Applied(0, 0.0, 0.0, 0.0, np.zeros(3), np.zeros(2))
    (expected,) = expected_robots(last, 1, still, round(dt * 1e9), ROBOT)
    variance = dt**2 * 1600.0 + (0.0 if seen else 900.0 + 2.0 * dt * 700.0)  # where it was seen it is known better
    assert expected.std_um == pytest.approx(math.hypot(math.sqrt(variance), 0.12 * ROBOT.radius_um))


def test_of_a_robot_that_is_not_in_view_nothing_is_told() -> None:
    unseen = track(FLOOR_UM - 60.0, seen=False)
    settings = OtherRobots(speed_limit_um_s=70.0)
    demand = Demand(0, np.array([0.0, 90.0]), np.full(2, math.nan), 0.0, 0.0, False, np.zeros((0, 2)))
    told = settings.watch(Tick(demand=demand), [unseen], [estimate(FLOOR_UM - 60.0)], ROBOT, [50.0], CLEARANCE, UM)
    assert math.isnan(told.wall_um[0]) and told.near[0] == 0.0 and told.limit_um_s is None


def test_a_robot_is_expected_where_flow_and_its_own_um_per_revolution_take_it() -> None:
    dt_ns = 100_000_000
    extra = Extra(messages_of(1, track(390.0), estimate(390.0, 40.0, (50.0, 0.0))))
    last = Tick(stamp_ns=0, track=track(300.0), estimate=estimate(300.0), extra=extra)
    applied = Applied(dt_ns, 10.0, 0.0, 5.0, np.zeros(3), np.array([1.0, 0.5]))
    first, other = expected_robots(last, 2, applied, dt_ns, ROBOT)
    np.testing.assert_allclose(first.position_um, [625.0, 312.5])
    np.testing.assert_allclose(other.position_um, [600.0 + 40.0 + 5.0, 390.0 + 20.0])


def test_an_observer_of_each_finds_its_um_per_revolution_where_the_heading_varies() -> None:
    true_um_per_rev, dt, place = 31.0, 1.0 / 30.0, np.array([600.0, 390.0])
    flow = np.array([40.0, -15.0])
    last = Tick()
    for index in range(400):
        heading = 2.0 * math.pi * index / 60.0
        turns = 8.0 * dt * np.array([math.cos(heading), math.sin(heading)])
        place = place + (true_um_per_rev * turns + flow * dt if index else 0.0)
        stamp_ns = round(index * dt * 1e9)
        applied = Applied(stamp_ns, 8.0, heading, 5.0, np.zeros(3), turns)
        seen = replace(track(0.0, stamp_ns=stamp_ns), position_um=place)
        (found,) = observe_others(Observer(method="kalman"), last, [seen], applied, ROBOT, None)
        last = Tick(stamp_ns=stamp_ns, extra=Extra(messages_of(1, seen, found)))
    assert found.um_per_rev == pytest.approx(true_um_per_rev, rel=0.02)
    np.testing.assert_allclose(found.flow_um_s, flow, atol=4.0)


def test_topics_are_those_of_the_first_robot_with_a_number() -> None:
    config = load_config(None, SEVERAL)
    topics = {topic.path: topic for topic in robot_topics(config)}
    assert set(topics) == {
        *("/robot/1/track", "/robot/1/estimate", "/robot/2/track", "/robot/2/estimate"),
        *("/robot/1/observations", "/robot/2/observations"),
        *("/robots/walls", "/truth/robot/1", "/truth/robot/2"),
    }
    unasked = {topic.path for topic in robot_topics(load_config(None, [*SEVERAL, "others.observe_flow=false"]))}
    assert unasked == {path for path in topics if not path.endswith("/observations")}
    assert topics["/robot/2/track"].type is Track and topics["/truth/robot/1"].source is Source.SIMULATOR
    assert [robot_number(path) for path in ("/robot/12/track", "/robot/track", "/truth/robot/3", "/robots/walls")] == [
        *(12, 0, 3, 0)
    ]
    assert not list(robot_topics(load_config(None, SMALL)))
    assert isinstance(topics["/robot/1/estimate"], Topic)


def test_no_stage_reads_the_truth_of_a_robot() -> None:
    config = load_config(None, SEVERAL)
    chip = load_chip(config.chip)
    config = resolve(config, chip)
    pipeline = assemble(config, chip)
    rig = SimulatedRig.of(pipeline, config, duration_s=1.0)
    true, other = Tick(), Tick()
    for inputs in rig.inputs():
        true = step(pipeline, true, inputs)
        lied = {path: replace(told, position_um=told.position_um + 500.0) for path, told in inputs.extra.items()}
        assert lied and all(isinstance(told, Truth) for told in lied.values())
        other = step(pipeline, other, replace(inputs, extra=lied))
        for number in (1, 2):
            path = robot_topic("/robot/estimate", number)
            np.testing.assert_array_equal(true.extra[path].position_um, other.extra[path].position_um)
        np.testing.assert_array_equal(true.extra[WALLS].wall_um, other.extra[WALLS].wall_um)
    assert "/truth/robot/1" not in true.extra


def test_a_limit_slows_the_command_while_a_robot_is_near_a_wall() -> None:
    """The frequency that is sent, in a mission in which the others are near walls all the time."""
    fastest = {}
    for limit in (None, 60.0):
        sets = [*SEVERAL, "others.near_um=1000", *([f"others.speed_limit_um_s={limit}"] if limit else [])]
        config = load_config(None, sets)
        chip = load_chip(config.chip)
        config = resolve(config, chip)
        pipeline = assemble(config, chip)
        ticks: list[Tick] = []
        rig = SimulatedRig.of(pipeline, config, duration_s=2.5)
        run(pipeline, rig, LockstepWorker(pipeline, 0.3), [], on_tick=ticks.append)
        told = [(tick.extra[WALLS].limit_um_s, math.hypot(*tick.demand.velocity_um_s)) for tick in ticks]
        fastest[limit] = max(speed for _, speed in told)
        assert all(speed <= 60.0 + 1e-6 for holds, speed in told if holds is not None)
        assert (limit is None) or any(holds is not None and speed > 50.0 for holds, speed in told)
    assert fastest[None] > 200.0


def test_an_estimate_as_of_the_stated_response_has_the_same_velocity_over_ground() -> None:
    """By draws from the covariance of the filter: the flow is what is left of the velocity, whatever the response."""
    rng = np.random.default_rng(3)
    root = rng.normal(size=(8, 8)) * np.array([1.0, 1.0, 5.0, 5.0, 0.1, 0.1, 0.1, 2.0])[:, None]
    turns = np.array([6.0, -3.0])
    own = replace(
        estimate(MIDDLE_UM, 31.0, (80.0, 20.0)),
        covariance=root @ root.T,
        rolled_um_s=31.0 * turns,
        slopes_per_s=np.zeros(3),
    )
    stated = as_stated(own, ROBOT)
    np.testing.assert_allclose(stated.flow_um_s + stated.rolled_um_s, own.flow_um_s + own.rolled_um_s)
    np.testing.assert_allclose(stated.rolled_um_s, 25.0 * turns)
    drawn = rng.normal(size=(200_000, 8)) @ root.T
    flow = drawn[:, 2:4] + drawn[:, 7:] * turns
    np.testing.assert_allclose(stated.covariance[2:4, 2:4], np.cov(flow.T), rtol=0.03)
    assert stated.um_per_rev is None and len(stated.covariance) == 7
    bare = estimate(MIDDLE_UM, 31.0)
    assert as_stated(bare, ROBOT) is bare, "before anything rolled"


@pytest.mark.parametrize(
    ("near", "observed"), [((0.0, 0.0), True), ((1.0, 0.0), False), ((0.0, 1.0), False), ((0.0, None), False)]
)
def test_a_robot_that_touches_a_wall_or_is_out_of_view_observes_no_flow(near, observed) -> None:
    told = [
        RobotWalls(k, np.array([math.nan if each is None else 30.0]), np.array([each or 0.0]), np.zeros(1))
        for k, each in enumerate(near)
    ]
    before, now = (
        replace(estimate(MIDDLE_UM, 25.0, (50.0, 0.0), stamp_ns), covariance=np.eye(5), rolled_um_s=np.ones(2))
        for stamp_ns in (0, 40_000_000)
    )
    last = Tick(extra=Extra({WALLS: told[0], **messages_of(1, track(MIDDLE_UM), before)}))
    made = OtherRobots().collect(Sampler(), last, [now], told[1], ROBOT, lambda _, found: found)
    assert bool(made) is observed
    assert not OtherRobots(observe_flow=False).collect(Sampler(), last, [now], told[1], ROBOT, lambda _, found: found)


def test_observations_of_robots_are_joined_by_number_and_tracers_follow() -> None:
    def seen(count: int, at: float, rolled: bool = True) -> Observations:
        values = np.full((count, 2), at)
        return Observations(1, values, values, np.ones(count), values if rolled else None, np.full(count, at), 50.0)

    first, bead = seen(3, 0.0), replace(seen(2, 9.0), tracer=np.array([7.0, 8.0]), entered=np.zeros(2))
    joined = first.with_robots({2: seen(2, 2.0), 1: seen(1, 1.0), 3: seen(4, 3.0, rolled=False)}).with_tracers(bead)
    assert joined.tracer.tolist() == [-1.0, -1.0, -1.0, -2.0, -3.0, -3.0, 7.0, 8.0]
    assert joined.time_s.tolist() == [0.0, 0.0, 0.0, 1.0, 2.0, 2.0, 9.0, 9.0] and joined.radius_um == 50.0
    assert first.with_robots({}) is first and first.with_robots({1: seen(0, 1.0)}) is first
    none = seen(0, 0.0).with_robots({2: seen(2, 2.0)})
    assert none.tracer.tolist() == [-3.0, -3.0]


def test_a_session_that_lacks_the_setting_observes_with_the_first_robot_alone() -> None:
    config = load_config(None, SEVERAL)
    chip = load_chip(config.chip)
    text = to_toml(resolve(config, chip))
    assert "observe_flow = true" in text
    assert config_from_toml(text, "a").others.observe_flow
    assert not config_from_toml(text.replace("observe_flow = true\n", ""), "a").others.observe_flow


def test_an_order_has_the_observations_of_all_robots_and_the_process_that_does_it_gets_them() -> None:
    config = resolve(load_config(None, SEVERAL), load_chip(load_config(None, SEVERAL).chip))
    pipeline = assemble(config, load_chip(config.chip))
    ticks: list[Tick] = []
    run(
        pipeline,
        SimulatedRig.of(pipeline, config, duration_s=2.0),
        LockstepWorker(pipeline, 0.3),
        [],
        on_tick=ticks.append,
    )
    last = ticks[-1]
    others = {k: last.extra[robot_topic("/robot/observations", k)] for k in (1, 2)}
    joined = observations_of(pipeline, last)
    counts = [int((joined.tracer == -1.0 - k).sum()) for k in range(3)]
    assert counts == [len(last.observations.std_um_s), *(len(each.std_um_s) for each in others.values())]
    pump = PumpShare(1, 1.0, 1.0, 1.0, 0)
    read = messages_read(replace(last, extra=last.extra.with_messages({PUMP: pump})), "refined")
    assert read[PUMP] is pump and all(read[robot_topic("/robot/observations", k)] is each for k, each in others.items())
    assert "/robot/1/track" not in read and not messages_read(last, "assumed")


def test_an_observation_is_less_certain_while_the_own_motion_of_a_robot_of_unknown_lag_changes() -> None:
    told = RobotWalls(0, np.array([30.0]), np.zeros(1), np.zeros(1))
    stds = {}
    for change in (0.0, 10.0):
        estimates = [
            replace(
                estimate(MIDDLE_UM, 25.0, (50.0, 0.0), stamp_ns),
                covariance=np.eye(5),
                rolled_um_s=np.array([100.0 + change * (stamp_ns > 0), 0.0]),
            )
            for stamp_ns in (0, 40_000_000)
        ]
        last = Tick(extra=Extra({WALLS: told, **messages_of(1, track(MIDDLE_UM), estimates[0])}))
        (made,) = OtherRobots().collect(Sampler(), last, [estimates[1]], told, ROBOT, lambda _, found: found).values()
        stds[change] = float(made.std_um_s[-1])
    assert stds[0.0] == pytest.approx(math.hypot(7.0, 2.8), rel=0.05), "uneven rolling, and the sampler's own"
    late_um_s = ROBOT.delay_s * 10.0 / 0.04
    assert stds[10.0] == pytest.approx(math.hypot(stds[0.0], late_um_s), rel=0.05)


def test_the_least_distance_of_a_robot_is_that_of_the_frames_that_show_it_near_a_wall() -> None:
    figures = RobotStatistics(1)
    for number, wall_um in enumerate((80.0, math.nan, 30.0, math.nan, 55.0)):
        told = RobotWalls(number, np.array([wall_um]), np.array([float(wall_um < 40.0)]), np.zeros(1))
        figures.write(Tick(number, extra=Extra({WALLS: told})), track(MIDDLE_UM, stamp_ns=number))
    assert figures.text == "tracked in 100% of 5 images, at least 30 um from walls, 1 alarm near walls"


def test_the_tracking_error_counts_each_demand_once_and_only_on_the_way_to_the_goal() -> None:
    run, nothing = RunStatistics(), np.zeros(2)
    demands = [
        Demand(n, nothing, nothing, 0.0, error, False, np.zeros((0, 2))) for n, error in enumerate((9.0, 3.0, 4.0))
    ]
    way = [("plan", demands[0]), ("navigate", demands[1]), *3 * [("navigate", demands[2])]]
    for stamp_ns, (phase, demand) in enumerate(way):
        mission = Mission(0, phase, 0, 1, "", 0, nothing, nothing, False, "", "")
        run.write(Tick(stamp_ns, mission=mission, demand=demand))
    assert run.tracking_error_um == pytest.approx(math.sqrt((9.0 + 16.0) / 2.0))
    assert run.navigating_ns == 1


def test_the_latency_adds_up_from_the_exposure_to_the_field_and_what_is_not_told_is_not_known():
    told = Timing(
        0, track_ms=10.0, observe_ms=2.0, control_ms=3.0, sinks_ms=50.0, total_ms=70.0, queue_mb=0.0, dropped_frames=0
    )
    assert np.isnan(chain_ms(told)).all()
    known = replace(told, arrival_ms=5.0, wait_ms=1.0, apply_ms=0.5, field_ms=4.0)
    assert chain_ms(known) == (5.0, 16.0, 20.5, 21.0, 25.0)
