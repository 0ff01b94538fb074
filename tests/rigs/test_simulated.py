import itertools
import math
import time
from dataclasses import replace

import numpy as np
import pytest

from flowrec.core import Applied, ChipError, Currents, FlowField, RigError, UsageError
from flowrec.physics import Calibration, ChipSettings, FlowSolver, Robot, load_chip
from flowrec.rigs import SimulatedRig, increasing_stamps
from flowrec.rigs.simulated.world import true_chip
from flowrec.stages import Coils, Inputs, ResolvedCamera, Simulated, SimulatedImage

ROBOT = Robot(radius_um=50.0, max_speed_um_s=600.0, step_out_hz=24.0)
EXACT = Simulated(
    world="kind", position_noise_um=0.0, heading_noise_rad=0.0, speed_noise=0.0, image=SimulatedImage(debris=0)
)
NOISELESS = replace(EXACT, image=SimulatedImage(photons_per_level=1e9, read_noise=0.0, debris=0))
STRAIGHT = load_chip(ChipSettings("straight"))  # rows 22 to 41 of 64, 20 um a pixel: y from 430 to 830 um
CAMERA = ResolvedCamera(width_px=256, height_px=64, rate_hz=30.0, um_per_px=STRAIGHT.size_um[0] / 256)
MIDDLE = 31.5 * 20.0


def steady(vx, vy=0.0):
    """A uniform flow on the straight chip."""
    velocity = np.zeros((*STRAIGHT.mask.shape, 2), np.float32)
    velocity[..., 0], velocity[..., 1] = vx, vy
    values = STRAIGHT.boundary_values
    return FlowField(0, 0, "known", 20.0, velocity, np.zeros(STRAIGHT.mask.shape), None, values, 1.0, 1000.0, "")


def rig_with(start=(1000.0, MIDDLE), flow=None, simulated=EXACT, camera=CAMERA, duration_s=1.0, robot=ROBOT, **more):
    calibration = Calibration(STRAIGHT.size_um[0] / camera.width_px)
    flow = steady(0.0) if flow is None else flow
    return SimulatedRig(STRAIGHT, robot, calibration, camera, simulated, start, duration_s, true_field=flow, **more)


def command(frequency_hz, heading_rad=0.0, amplitude_mt=5.0):
    return Currents(0, frequency_hz, heading_rad, amplitude_mt, 0.0, np.array([1.0, 2.0, 3.0]), False)


def fly(rig, commands=()):
    """All inputs, with `commands` (frame number to Currents) applied after their frames."""
    commands = dict(commands)
    seen = []
    with rig:
        for k, inputs in enumerate(rig.inputs()):
            seen.append(inputs)
            if k in commands:
                rig.apply(commands[k])
    return seen


def test_zero_acts_at_once_and_no_field_comes_back_until_the_rig_is_entered_again():
    rig = rig_with(simulated=replace(EXACT, delay_s=0.1))
    amplitudes = []
    with rig:
        for k, inputs in enumerate(rig.inputs()):
            amplitudes.append(inputs.applied.amplitude_mt)
            rig.apply(command(10.0 + k))  # three of them are always on their way
            if k == 10:
                rig.zero()
    assert amplitudes[10] > 0.0
    assert not any(amplitudes[11:])
    again = fly(rig, {0: command(10.0)})
    assert again[-1].applied.amplitude_mt > 0.0


def test_the_same_seed_and_commands_give_the_same_bytes_at_any_pace():
    commands = {2: command(10.0, 0.3), 9: command(15.0, -0.5)}
    simulated = Simulated(world="kind", seed=5, image=SimulatedImage(debris=12))
    first, second = (fly(rig_with(simulated=simulated, flow=steady(200.0)), commands) for _ in range(2))
    for a, b in zip(first, second, strict=True):
        assert a.frame.same_as(b.frame)
        assert a.truth.same_as(b.truth)
        assert a.applied.same_as(b.applied)
    other = fly(rig_with(simulated=replace(simulated, seed=6), flow=steady(200.0)), commands)
    assert not first[5].frame.same_as(other[5].frame)


def test_frames_are_stamped_by_index_over_rate_from_zero():
    seen = fly(rig_with(camera=replace(CAMERA, rate_hz=29.97), duration_s=2.0))
    assert [i.stamp_ns for i in seen] == [round(k * 1e9 / 29.97) for k in range(60)]
    assert all(i.stamp_ns == i.frame.stamp_ns == i.applied.stamp_ns == i.truth.stamp_ns for i in seen)
    assert seen[0].true_field is not None
    assert all(i.true_field is None for i in seen[1:])


def test_without_a_field_the_robot_goes_where_the_flow_goes():
    seen = fly(rig_with(flow=steady(250.0, 30.0)), {0: command(20.0, amplitude_mt=0.0)})
    moved = seen[-1].truth.position_um - seen[0].truth.position_um
    assert np.allclose(moved, [250.0, 30.0])
    assert np.allclose(seen[-1].applied.turns, 0.0)


def test_a_command_acts_exactly_after_its_delay_and_the_readback_says_so():
    # Sent on frame 3 (0.1 s), delay 0.04 s: it acts from 0.14 s, within the interval of frame 5.
    seen = fly(rig_with(), {3: command(12.0, math.pi / 2)})
    turns = np.array([i.applied.turns for i in seen])
    assert np.all(turns[:5] == 0.0)
    assert turns[5] == pytest.approx([0.0, 12.0 * (5 / 30 - 0.14)], abs=1e-8)
    assert turns[6] == pytest.approx([0.0, 12.0 / 30], abs=1e-8)
    assert seen[4].applied.frequency_hz == 0.0
    assert seen[5].applied.frequency_hz == 12.0
    assert seen[5].applied.currents_a.tolist() == [1.0, 2.0, 3.0]
    positions = np.array([i.truth.position_um for i in seen])[:14]  # before it reaches the wall
    assert np.allclose(np.diff(positions, axis=0), ROBOT.um_per_rev * turns[1:14], atol=1e-5)


def test_several_commands_on_their_way_are_obeyed_in_order():
    slow = replace(EXACT, delay_s=0.1)
    seen = fly(rig_with(simulated=slow), {0: command(3.0), 1: command(6.0), 2: command(9.0)})
    assert [round(i.applied.frequency_hz) for i in seen[:6]] == [0, 0, 0, 3, 6, 9]
    total = sum(i.applied.turns[0] for i in seen)
    assert total == pytest.approx((3.0 + 6.0) / 30 + 9.0 * (1.0 - 0.1 - 2 / 30), abs=1e-6)


def test_above_step_out_the_robot_rolls_slower():
    far = {f: fly(rig_with(), {0: command(f)})[-1].truth.position_um[0] for f in (20.0, 24.0, 40.0)}
    assert far[24.0] > far[20.0] > far[40.0] > 1000.0


def test_the_simulated_field_turns_to_a_new_heading_within_half_a_revolution_and_carries_the_robot_all_the_while():
    # With nothing left to turn the plane with, the new heading waits for the field to stand on z; 12.5 Hz from 0.04 s
    # on stands there every 0.04 s, so at 0.16 s, where the command of frame 3 (sent at 0.1 s) is 20 ms old.
    limit = {"limit_hz": 12.5}
    seen = fly(rig_with(), {0: replace(command(12.5), **limit), 3: replace(command(12.5, 1.2), **limit)})
    turns = np.array([i.applied.turns for i in seen])
    waited = 12.5 * (0.16 - 4 / 30) * np.array([1.0, 0.0])
    turned = 12.5 * (5 / 30 - 0.16) * np.array([math.cos(1.2), math.sin(1.2)])
    assert turns[5] == pytest.approx(waited + turned, abs=1e-6)
    assert seen[4].applied.heading_rad == 0.0 and seen[5].applied.heading_rad == pytest.approx(1.2)
    # With something left it does not wait so long, and back it goes at once.
    limit = {"limit_hz": 24.0}
    seen = fly(rig_with(), {0: replace(command(12.5), **limit), 3: replace(command(12.5, math.pi), **limit)})
    assert seen[5].applied.turns == pytest.approx([12.5 * (2 * 0.14 - 4 / 30 - 5 / 30), 0.0], abs=1e-6)
    positions = np.array([i.truth.position_um for i in seen])
    moved = ROBOT.um_per_rev * np.array([i.applied.turns for i in seen])
    assert np.allclose(np.diff(positions, axis=0), moved[1:], atol=1e-5)


def test_currents_are_read_back_as_they_are_now_and_a_weak_field_loses_the_robot():
    coils = Coils(bias_mt=(0.0, 0.0, 0.3))
    first, second = command(12.0, amplitude_mt=4.0), command(12.0, amplitude_mt=1.0)
    seen = fly(rig_with(coils=coils), {0: first, 15: second})
    elapsed = 10 / 30 - 0.04
    field = 4.0 * np.array([math.sin(2 * math.pi * 12.0 * elapsed), 0.0, math.cos(2 * math.pi * 12.0 * elapsed)])
    assert seen[10].applied.currents_a == pytest.approx(field / [2.1, 1.9, 1.5] - [0.0, 0.0, 0.2], abs=1e-6)
    x = np.array([i.truth.position_um[0] for i in seen])
    full, weak = (x[14] - x[10]) * 30 / 4, (x[-1] - x[-5]) * 30 / 4
    assert full == pytest.approx(12.0 * 25.0, rel=1e-3)
    assert weak == pytest.approx(25.0 * (12.0 - math.sqrt(12.0**2 - 6.0**2)), rel=1e-3)  # a quarter of 24 Hz


def test_a_wall_stops_the_robot_at_its_radius_and_lets_it_slide_along():
    heading = math.radians(30)
    seen = fly(rig_with(duration_s=2.0), {0: command(12.0, heading)})
    truth = seen[-1].truth
    assert all(i.truth.clearance_um > -0.01 for i in seen)
    assert truth.clearance_um == pytest.approx(0.0, abs=0.01)
    assert truth.position_um[1] == pytest.approx(830.0 - 50.0, abs=0.1)
    assert truth.position_um[0] - 1000.0 == pytest.approx(300.0 * math.cos(heading) * (2.0 - 0.04), rel=1e-3)
    assert truth.contacts == 1


def test_leaving_a_wall_and_coming_back_is_a_second_contact():
    up, down = command(12.0, -math.pi / 2), command(12.0, math.pi / 2)
    seen = fly(rig_with(duration_s=3.0), {0: down, 30: up, 40: down})
    assert seen[29].truth.contacts == 1
    assert seen[-1].truth.contacts == 2


def test_a_robot_that_leaves_through_an_opening_is_in_no_image_any_more():
    seen = fly(rig_with(start=(5000.0, MIDDLE), flow=steady(400.0), simulated=NOISELESS))
    with_robot, without = seen[0].frame.image.astype(int), seen[-1].frame.image.astype(int)
    assert with_robot.min() < 0.5 * without.min()
    assert math.isnan(seen[-1].truth.clearance_um)
    assert np.abs(without - seen[-2].frame.image).max() <= 1  # a level on the edge between two numbers


def test_the_robot_is_drawn_where_the_truth_says_to_a_twentieth_of_a_pixel():
    # Radius 4 px, some of it between pixels; the empty image is the one after it has left.
    seen = {"camera": replace(CAMERA, width_px=400, height_px=100), "simulated": NOISELESS}
    empty = fly(rig_with(start=(5080.0, MIDDLE), flow=steady(600.0), **seen))[-1].frame.image.astype(float)
    rig = rig_with(start=(1003.7, MIDDLE + 3.1), flow=steady(313.0, 41.0), **seen)
    for inputs in itertools.islice(fly(rig), 0, None, 5):
        dark = np.clip(empty - inputs.frame.image - 5.0, 0.0, None)  # less what rounding leaves everywhere
        rows, columns = np.indices(dark.shape)
        centre = np.array([(dark * columns).sum(), (dark * rows).sum()]) / dark.sum()
        drawn = Calibration(STRAIGHT.size_um[0] / 400).to_um(centre)
        assert drawn == pytest.approx(inputs.truth.position_um, abs=0.05 * 12.8)


def test_noise_grows_with_the_square_root_of_light_and_is_fresh_in_every_frame():
    simulated = replace(EXACT, image=SimulatedImage(photons_per_level=4.0, read_noise=0.0, debris=0))
    films = np.array(
        [i.frame.image[30:34] for i in fly(rig_with(start=(100.0, MIDDLE), simulated=simulated, duration_s=6.0))]
    )
    level, variance = films[..., 60:].mean(0), films[..., 60:].var(0)
    # A twelfth comes from rounding to whole grey levels.
    assert np.mean(variance) == pytest.approx(np.mean(level) / 4.0 + 1 / 12, rel=0.02)
    noise = films[..., 60:] - level
    assert abs(np.mean(noise[1:] * noise[:-1])) < 0.03 * np.mean(variance)
    assert abs(np.mean(noise[..., 1:] * noise[..., :-1])) < 0.03 * np.mean(variance)


def test_debris_drifts_with_the_flow_and_never_runs_out():
    flown = {"start": (2560.0, MIDDLE), "flow": steady(500.0), "duration_s": 20.0}
    seen = fly(rig_with(simulated=replace(NOISELESS, image=replace(NOISELESS.image, debris=12)), **flown))
    clean = fly(rig_with(simulated=NOISELESS, **flown))
    changed = [np.abs(a.frame.image.astype(int) - b.frame.image).sum() for a, b in zip(seen, clean, strict=True)]
    assert min(changed[::30]) > 0.3 * max(changed[::30])
    assert not np.array_equal(seen[0].frame.image[22:42, :150], seen[5].frame.image[22:42, :150])


def test_the_true_world_differs_from_the_assumed_one_within_its_bounds():
    chip = load_chip(ChipSettings("vessels", seed=2))
    solver = FlowSolver(1)
    worlds = [true_chip(chip, Simulated(world="kind", seed=seed), solver) for seed in range(12)]
    inlets = np.array([world.boundary_values[0] for world in worlds]) / chip.boundary_values[0]
    assert np.all(np.abs(inlets - 1.0) <= 0.25)
    assert np.all(np.abs(inlets - 1.0) >= 0.25 / 3.0)
    assert np.ptp(inlets) > 0.1
    assert all(np.any(world.boundary_values[1:] != 0.0) for world in worlds)
    exact = Simulated(world="kind", inlet_speed_error=0.0, outlet_pressure_error=0.0, viscosity_error=0.0)
    same = true_chip(chip, exact, solver)
    assert np.array_equal(same.boundary_values, chip.boundary_values)
    assert same.viscosity_mpa_s == chip.viscosity_mpa_s


@pytest.mark.slow("thousands of images")
def test_the_robot_jitters_as_much_as_it_is_told_to():
    simulated = replace(EXACT, position_noise_um=3.0)
    ends = [
        fly(rig_with(simulated=replace(simulated, seed=seed), camera=replace(CAMERA, height_px=8, width_px=32)))[
            -1
        ].truth
        for seed in range(60)
    ]
    moved = np.array([truth.position_um for truth in ends]) - [1000.0, MIDDLE]
    assert np.std(moved) == pytest.approx(3.0, rel=0.2)


def test_in_real_time_frames_keep_to_the_clock(monkeypatch):
    now_ns = [10**12]
    monkeypatch.setattr(time, "monotonic_ns", lambda: now_ns[0])
    monkeypatch.setattr(time, "sleep", lambda s: now_ns.append(now_ns.pop() + round(s * 1e9)))
    rig = rig_with(realtime=True, camera=replace(CAMERA, rate_hz=50.0), duration_s=0.3)
    rig.__enter__()
    arrived = []
    for _ in rig.inputs():
        arrived.append(now_ns[0])
        now_ns[0] += 3_000_000  # what is done with a frame; the next one does not come later for it
    assert len(arrived) == 16
    np.testing.assert_allclose(np.diff(arrived), 20e6, atol=2e6)


def test_a_world_that_can_not_be_is_refused_in_one_line():
    dark = replace(EXACT, image=SimulatedImage(photons_per_level=0.0))
    for wrong, named in (
        ({"start": (1000.0, 100.0)}, "start 1000,100 um"),  # in a wall
        ({"start": (1000.0, 450.0)}, "start 1000,450 um .*50 um"),  # nearer to one than its radius
        ({"simulated": dark}, r"simulated\.image\.photons_per_level = 0"),
        ({"simulated": replace(EXACT, inlet_speed_error=1.5)}, r"inlet_speed_error = 1\.5"),
    ):
        with pytest.raises((ChipError, UsageError), match=named):
            rig_with(**wrong)
    other = FlowSolver(1).solve(load_chip(ChipSettings("bifurcation")))
    with pytest.raises(RigError, match="chip"):
        next(iter(rig_with(flow=other).inputs()))


def test_the_true_step_out_may_lie_below_the_stated_one():
    weak = replace(EXACT, step_out_share=0.5)  # at 12 of 24 Hz
    far = {f: fly(rig_with(simulated=weak), {0: command(f)})[-1].truth.position_um[0] - 1000.0 for f in (12.0, 20.0)}
    assert far[12.0] == pytest.approx(25.0 * 12.0 * 0.96, rel=1e-3)
    assert far[20.0] == pytest.approx(25.0 * (20.0 - 16.0) * 0.96, rel=1e-3)


def test_a_held_robot_stays_at_its_start_for_that_time_and_until_the_field_is_up():
    def at(**commands):
        rig = rig_with(flow=steady(100.0), hold_s=0.5, duration_s=2.0, coils=Coils())
        return np.array([inputs.truth.position_um[0] for inputs in fly(rig, **commands)])

    def let_go_s(places):
        return (np.argmax(places > 1000.0) - 1) / CAMERA.rate_hz

    assert (at() == 1000.0).all(), "without a field it is not let go"
    soon = at(commands={0: command(1.0)})
    assert let_go_s(soon) == pytest.approx(0.5, abs=2.0 / CAMERA.rate_hz)
    assert soon[-1] - 1000.0 == pytest.approx(1.5 * (100.0 + 25.0), rel=0.05), "then it swims and drifts"
    late = at(commands={k: command(1.0, amplitude_mt=0.1 * k) for k in range(41)})
    assert 0.0 < let_go_s(late) - 41 / CAMERA.rate_hz < 0.4, "soon after it rises no more"


def test_of_frames_whose_stamps_go_back_no_turn_is_lost_and_the_latest_message_of_each_topic_comes_with_the_next():
    stamps_ns = [10, 20, 5, 20, 30, 29, 31]
    sent = [
        Inputs(
            stamp_ns,
            None,
            Applied(stamp_ns, 1.0, 0.0, 1.0, np.zeros(3), np.array([1.0, -(2.0**number)])),
            extra={"/every": number, f"/own/{number}": number},
        )
        for number, stamp_ns in enumerate(stamps_ns)
    ]
    rejected = []
    taken = list(increasing_stamps(iter(sent), 0, lambda: rejected.append(1)))
    assert [each.stamp_ns for each in taken] == [10, 20, 30, 31] and len(rejected) == 3
    np.testing.assert_array_equal(sum(each.applied.turns for each in taken), sum(each.applied.turns for each in sent))
    assert [each.extra["/every"] for each in taken] == [0, 1, 4, 6]
    assert {f"/own/{number}" for number in (2, 3, 4)} <= taken[2].extra.keys()
