from dataclasses import replace

import numpy as np
import pytest

from flowrec.core import Demand, Estimate, Route
from flowrec.physics import clearance_um
from flowrec.stages import Controller
from flowrec.stages.control.controller import wall_barrier
from flowrec.stages.control.delay_compensation import CorrectedFlow, corrected_flow, predict_position
from flowrec.stages.control.tracking_laws import Situation
from tests.stages.control.plant import CENTRE_UM, ROBOT, field_of, fly, lemniscate, mission, straight, vortex

UNGOVERNED = {"lag_free_radii": 1e9, "lag_full_radii": 2e9}  # the paper's reference does not wait
START = CENTRE_UM + np.array([1200.0, 600.0])
STILL = field_of(lambda x, y: (0.0 * x, 0.0 * y))


def wrong_vortex(x, y):
    return tuple(1.1 * part for part in vortex(x, y))


# So swift a robot as the plant's is driven with quicker gains; this one with those that are written down.
UNHURRIED = replace(ROBOT, max_speed_um_s=600.0)


def seen_at(position, stamp=0, flow=(0.0, 0.0), seen=True):
    return Estimate(stamp, np.array(position, float), np.array(flow), np.eye(4), 2.0, np.array(position), seen)


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize(
    ("method", "noise_um", "told", "delay_s", "steady_um", "settled_s"),
    [
        ("vector", 0.0, vortex, 0.0, 2.0, 2.0),
        ("vector", 10.0, wrong_vortex, 0.04, 10.0, 2.0),
        ("ff_fb", 0.0, vortex, 0.0, 8.0, 6.0),
        ("ff_fb", 10.0, wrong_vortex, 0.04, 15.0, 6.0),
    ],
)
def test_the_papers_lemniscate_is_tracked(method, noise_um, told, delay_s, steady_um, settled_s):
    route, robot = lemniscate(turns=1), replace(ROBOT, delay_s=delay_s)
    controller = Controller(method=method, **UNGOVERNED)
    run = fly(controller, route, vortex, 40.0, START, field_of(told), noise_um=noise_um, robot=robot, seed=1)
    error = run.error_um(route)
    assert rms(error[20_000:]) < steady_um
    assert error[round(1000 * settled_s) :].max() < 50.0


def test_without_a_map_the_observer_is_enough_and_without_both_the_error_persists():
    route = lemniscate(turns=1)
    observed = fly(Controller(**UNGOVERNED), route, vortex, 20.0, START, None, noise_um=10.0)
    assert rms(observed.error_um(route)[10_000:]) < 12.0
    # A flow map of zero, and an observer that is not listened to: the paper's "without compensation".
    deaf = fly(Controller(map_error=0.0, **UNGOVERNED), route, vortex, 20.0, START, STILL, robot=UNHURRIED)
    assert rms(deaf.error_um(route)[10_000:]) > 50.0


def test_the_reference_waits_for_a_robot_that_can_not_follow_and_never_runs_away():
    slow = replace(ROBOT, max_speed_um_s=200.0)
    route = straight(speed_um_s=300.0)
    run = fly(Controller(), route, lambda x, y: (0.0, 0.0), 25.0, (500.0, 2500.0), STILL, robot=slow)
    assert max(demand.error_um for demand in run.demands) < 3.0 * slow.radius_um
    assert all(np.hypot(*demand.velocity_um_s) <= 200.0 + 1e-9 for demand in run.demands)
    progress = [demand.progress_s for demand in run.demands]
    assert (np.diff(progress) >= 0.0).all()
    assert progress[-1] == route.arrival_s[-1], "it arrives all the same"
    assert run.demands[-1].error_um < 5.0


def test_a_robot_swept_ahead_pulls_the_reference_along_instead_of_fighting_the_flow():
    route = straight(speed_um_s=100.0)
    weak = replace(ROBOT, max_speed_um_s=300.0)
    run = fly(Controller(), route, lambda x, y: (350.0, 0.0), 6.0, (500.0, 2500.0), STILL, robot=weak)
    assert run.demands[-1].progress_s > 6.5


def test_across_a_current_near_its_limit_the_robot_keeps_to_its_course_and_gives_up_speed():
    route = straight(speed_um_s=300.0)
    weak = replace(ROBOT, max_speed_um_s=250.0)
    field = field_of(lambda x, y: (0.0 * x, 220.0 + 0.0 * x))
    run = fly(Controller(), route, lambda x, y: (0.0, 220.0), 15.0, (500.0, 2500.0), field, robot=weak)
    assert np.abs(run.position_um[2000:, 1] - 2500.0).max() < 25.0
    assert run.position_um[-1, 0] > 1800.0
    assert not run.demands[200].saturated, "the reference asks for no more than it can have"


@pytest.mark.parametrize("phase", ["start", "refine", "plan"])
def test_between_drives_the_robot_holds_the_place_where_the_phase_finds_it(phase):
    run = fly(Controller(), lemniscate(), vortex, 6.0, START, field_of(vortex), noise_um=10.0, mission=mission(phase))
    assert np.hypot(*(run.position_um[1000:] - START).T).max() < 35.0
    assert all((demand.reference_um == run.demands[0].reference_um).all() for demand in run.demands)


def test_where_the_robot_turns_into_another_stream_the_map_is_believed_over_an_observer_that_lags():
    corner = field_of(lambda x, y: (300.0 * (x < 2500.0), 300.0 * (x >= 2500.0)))
    stale = Estimate(
        0, CENTRE_UM + 25.0, np.array([300.0, 0.0]), np.diag([1.0, 1.0, 100.0, 100.0]), 2.0, CENTRE_UM, True
    )
    sent = np.array([[400.0, -300.0]])
    turning = corrected_flow(corner, stale, sent, 0.3, 0.3).at(stale.position_um)
    np.testing.assert_allclose(turning, [0.0, 300.0], atol=30.0)
    steady = field_of(lambda x, y: (0.0 * x, 300.0 + 0.0 * x))
    seen = replace(stale, flow_um_s=np.array([40.0, 330.0]))
    np.testing.assert_allclose(
        corrected_flow(steady, seen, sent, 0.3, 0.3).at(stale.position_um), [40.0, 330.0], atol=3.0
    )


def test_a_new_phase_starts_its_route_at_the_beginning_and_a_finished_mission_asks_for_nothing():
    controller, route = Controller(), straight()
    first = controller.control(None, mission(), route, seen_at((500, 2500), 1), STILL, UNHURRIED, None, 1.0)
    assert first.progress_s == 0.0 and (first.reference_um == route.waypoints_um[0]).all()
    later = first
    for stamp in range(2, 20):
        at = seen_at(later.reference_um, stamp * 33_000_000)
        later = controller.control(later, mission(), route, at, STILL, UNHURRIED, None, 1.0)
    assert later.progress_s > 0.5
    stamp = 20 * 33_000_000
    again = controller.control(
        later, mission(since_ns=stamp), route, seen_at((600, 2500), stamp), STILL, UNHURRIED, None, 1
    )
    assert again.progress_s == 0.0
    held = controller.control(
        later, mission("plan", stamp), route, seen_at((600, 2500), stamp), STILL, UNHURRIED, None, 1
    )
    overshoot_um = held.reference_um - [600.0, 2500.0]
    assert 0.0 < overshoot_um[0] < UNHURRIED.delay_s * 340.0, (
        "it can not stop before the last demands have been used up"
    )
    done = controller.control(
        later, mission("done", stamp, finished=True), route, seen_at((600, 2500), stamp), STILL, UNHURRIED, None, 1.0
    )
    assert not done.velocity_um_s.any()


def test_a_robot_that_is_not_seen_is_soon_asked_for_nothing_and_taken_up_again_where_it_is_found():
    run = fly(Controller(), None, lambda x, y: (50.0, 0.0), 8.0, START, None, blind=(2.0, 6.0), mission=mission("plan"))
    speed = np.array([np.hypot(*demand.velocity_um_s) for demand in run.demands])
    time = np.array([demand.stamp_ns for demand in run.demands]) / 1e9
    blind = (time >= 2.0) & (time < 6.0)
    assert (np.diff(speed[blind]) <= 1e-9).all()
    assert not speed[(time > 4.0) & (time < 6.0)].any() and np.isnan(run.demands[150].error_um)
    assert run.demands[-1].error_um < 5.0
    assert run.position_um[-1, 0] > START[0] + 50.0, "not driven back to where it was lost"
    never = Controller().control(None, mission("start"), None, seen_at((1, 1), seen=False), None, ROBOT, None, 1.0)
    assert not never.velocity_um_s.any() and np.isnan(never.error_um)


def test_the_wall_guard_keeps_the_robot_off_the_wall_that_its_route_leads_into():
    mask = np.zeros((101, 101), bool)
    mask[40:61] = True  # walls at y = 1975 and 3025 um
    clearance = clearance_um(mask, 50.0)
    time = np.linspace(0.0, 10.0, 101)
    crash = Route(0, 1, "", True, "", np.stack([500.0 + 200.0 * time, 2500.0 - 80.0 * time], -1), time)
    guard, careless = Controller(), Controller(guard_radii=0.0)
    wall_um = 1975.0
    runs = [
        fly(c, crash, lambda x, y: (0.0, -30.0), 12.0, (500.0, 2500.0), None, noise_um=3.0, clearance=(clearance, 50.0))
        for c in (guard, careless)
    ]
    nearest = [run.position_um[:, 1].min() - wall_um for run in runs]
    assert nearest[0] > 0.9 * ROBOT.radius_um and nearest[1] < 0.0


def test_the_clearance_that_is_kept_is_that_of_the_narrowest_place_of_the_route_near_the_robot():
    """A wall along y = 0: of any set of waypoints near the robot the one nearest to the wall gives the clearance."""
    um_per_px, keep_um, rng = 10.0, 300.0, np.random.default_rng(0)
    clearance = np.repeat(um_per_px * np.arange(101, dtype=np.float32)[:, None], 101, axis=1)
    robot = replace(ROBOT, radius_um=100.0)
    at_um, down = np.array([500.0, 320.0]), np.array([0.0, -1e4])
    for far in (False, True):
        for count in (2, 5, 16):
            waypoints_um = np.stack([500.0 + rng.uniform(-50, 50, count), rng.uniform(120.0, 400.0, count)], -1)
            least_um = waypoints_um[:, 1].min()
            if far:  # one beyond four radii, which does not count
                waypoints_um = np.vstack([waypoints_um, [950.0, 110.0]])
            route = Route(0, 1, "", True, "", waypoints_um, np.arange(float(len(waypoints_um))))
            now = Situation(
                *(None, mission("navigate"), route, seen_at(at_um), None, CorrectedFlow(None, np.zeros(2)), robot),
                *(at_um, 1e6, 0.04, um_per_px),
            )
            guarded, _ = wall_barrier(down, now, clearance, keep_um, 2.0)
            assert -guarded[1] == pytest.approx(2.0 * (at_um[1] - min(least_um, keep_um)), rel=1e-5), (far, count)


def test_a_demand_that_the_law_or_the_wall_guard_asks_beyond_the_speed_limit_is_saturated():
    mask = np.zeros((101, 101), bool)
    mask[40:61] = True  # walls at y = 1975 and 3025 um
    slow = replace(ROBOT, max_speed_um_s=200.0)

    def saturated(at_um, held_um, walls):
        first = Controller().control(None, mission("plan"), None, seen_at(held_um, 1), STILL, slow, None, 50.0)
        now = seen_at(at_um, 33_000_001)
        return Controller().control(first, mission("plan"), None, now, STILL, slow, walls, 50.0).saturated

    walls, middle_um, near_um = clearance_um(mask, 50.0), (500.0, 2500.0), (500.0, 1980.0)
    assert not saturated(middle_um, middle_um, walls)
    assert saturated((2000.0, 2400.0), middle_um, walls), "by the law, where the guard has nothing to do"
    assert saturated(near_um, near_um, walls) and not saturated(near_um, near_um, None), "by the guard alone"


@pytest.mark.parametrize("method", ["vector", "ff_fb"])
def test_from_any_demand_on_the_run_goes_on_the_same_and_nothing_is_ever_nan(method):
    controller, route, field = Controller(method=method), lemniscate(), field_of(vortex)
    run = fly(controller, route, vortex, 4.0, START, field, noise_um=10.0)
    for tick in (1, 17, 60, len(run.demands) - 1):
        fields = {name: getattr(run.demands[tick - 1], name) for name in Demand.__dataclass_fields__}
        before = Demand(**{key: np.array(v) if isinstance(v, np.ndarray) else v for key, v in fields.items()})
        again = Controller(method=method).control(
            before, mission(), route, run.estimates[tick], field, ROBOT, None, 1.0
        )
        assert again.same_as(run.demands[tick])
    assert all(np.isfinite(demand.velocity_um_s).all() for demand in run.demands)


@pytest.mark.parametrize("method", ["vector", "ff_fb"])
def test_no_error_no_motion_and_no_flow_are_no_division_by_zero(method):
    demand = Controller(method=method).control(
        None, mission("plan"), None, seen_at((500.0, 500.0)), STILL, ROBOT, None, 1.0
    )
    np.testing.assert_array_equal(demand.velocity_um_s, [0.0, 0.0])


def test_the_same_frame_twice_is_the_same_demand():
    controller = Controller()
    first = controller.control(None, mission(), straight(), seen_at((500, 2500), 5), STILL, ROBOT, None, 1.0)
    assert controller.control(first, mission(), straight(), seen_at((9, 9), 5), STILL, ROBOT, None, 1.0) is first


def test_a_swifter_robot_is_driven_with_quicker_gains_as_far_as_the_frames_allow():
    def pull_per_s(robot, dt_ns):
        first = Controller().control(None, mission("plan"), None, seen_at((500, 2500), 1), STILL, robot, None, 1.0)
        off = seen_at((490, 2500), 1 + dt_ns)
        demand = Controller().control(first, mission("plan"), None, off, STILL, robot, None, 1.0)
        return demand.velocity_um_s[0] / 10.0

    assert pull_per_s(UNHURRIED, 10_000_000) == pytest.approx(3.0)
    assert pull_per_s(replace(UNHURRIED, max_speed_um_s=2400.0), 10_000_000) == pytest.approx(12.0)
    assert pull_per_s(replace(UNHURRIED, max_speed_um_s=24000.0), 10_000_000) == pytest.approx(30.0)


def test_a_route_that_is_adopted_on_the_way_continues_the_reference_where_it_is():
    first = straight(speed_um_s=300.0)
    longer = replace(
        first,
        stamp_ns=2_000_000_000,
        waypoints_um=np.vstack([first.waypoints_um, first.waypoints_um[-1] + np.array([0.0, 500.0])]),
        arrival_s=np.concatenate([first.arrival_s, first.arrival_s[-1:] + 2.0]),
    )
    way = np.array([np.interp(1.0, first.arrival_s, first.waypoints_um[:, c]) for c in (0, 1)])
    under_way = Demand(1_000_000_000, np.zeros(2), way, 1.0, 0.0, False, np.zeros((0, 2)))
    for held in (None, 1_500_000_000):
        now = replace(mission("survey"), since_ns=0, held_since_ns=held)
        demand = Controller().control(
            under_way, now, longer, seen_at(way, 2_000_000_000), STILL, ROBOT, None, STILL.um_per_px
        )
        assert demand.progress_s == pytest.approx(1.0 if held else 2.0)
        assert np.hypot(*(demand.reference_um - way)) == pytest.approx(0.0 if held else 300.0, abs=1.0)


@pytest.mark.parametrize("delay_frames", [0.4, 1.0, 1.7, 3.0, 3.5])
def test_the_predicted_position_is_where_the_demands_that_are_on_their_way_take_the_robot(delay_frames):
    dt_s, rng = 0.04, np.random.default_rng(0)
    delay_s = delay_frames * dt_s
    sent = rng.uniform(-300.0, 300.0, (int(np.ceil(delay_frames)) + 1, 2))  # the last of them a frame ago
    flow = np.array([70.0, -20.0])
    # Each demand acts from one delay after it was sent until the next one does; from now until a delay later.
    time = (np.arange(40_000) + 0.5) * delay_s / 40_000
    index = np.floor((time - delay_s) / dt_s).astype(int)  # -1: sent a frame ago
    expected = delay_s * (flow + sent[np.maximum(index, -len(sent))].mean(axis=0))
    found = predict_position(np.zeros(2), sent, dt_s, delay_s, CorrectedFlow(None, flow))
    np.testing.assert_allclose(found, expected, atol=0.05)


def test_before_the_first_demand_acts_the_map_and_its_correction_alone_move_the_robot():
    mapped = field_of(lambda x, y: (0.0 * x, 300.0 + 0.0 * x))
    flow = CorrectedFlow(mapped, np.array([10.0, 0.0]))
    found = predict_position(CENTRE_UM, np.array([[100.0, 0.0]]), 0.04, 0.2, flow) - CENTRE_UM
    np.testing.assert_allclose(found, [0.2 * 10.0 + 0.04 * 100.0, 0.2 * 300.0], atol=0.01)


@pytest.mark.parametrize(("stated_um_s", "least", "most"), [(3.0, 0.1, 0.5), (90.0, 0.7, 1.0)])
def test_an_observer_is_believed_by_what_the_map_states_of_itself(stated_um_s, least, most):
    steady = field_of(lambda x, y: (0.0 * x, 300.0 + 0.0 * x))
    mapped = replace(steady, std_um_s=np.full_like(steady.velocity_um_s, stated_um_s))
    covariance = np.diag([1.0, 1.0, 40.0**2, 40.0**2])
    seen = Estimate(0, CENTRE_UM, np.array([60.0, 300.0]), covariance, 2.0, CENTRE_UM, True)
    correction = corrected_flow(mapped, seen, np.zeros((0, 2)), 0.3, 0.0).at(CENTRE_UM)[0]
    assert least * 60.0 < correction < most * 60.0


@pytest.mark.parametrize("found_um_s", [4.0, 50.0, 1000.0])
def test_the_correction_of_a_map_is_never_more_than_twice_what_the_map_may_be_wrong_by(found_um_s):
    mapped = field_of(lambda x, y: (0.0 * x, 300.0 + 0.0 * x))
    sure = Estimate(0, CENTRE_UM, np.array([found_um_s, 300.0]), 1e-6 * np.eye(4), 2.0, CENTRE_UM, True)
    correction = corrected_flow(mapped, sure, np.zeros((0, 2)), 0.05, 0.0).correction_um_s
    np.testing.assert_allclose(correction, [min(found_um_s, 2.0 * (0.05 * 300.0 + 1.0)), 0.0], rtol=1e-3)
