"""Worlds of the simulated rig: what a seed draws, what a preset states, and that the first world stays as it was."""

import math
from dataclasses import fields, replace

import cv2
import numpy as np
import pytest
import scipy

from flowrec.core import Currents, FlowField, faults
from flowrec.physics import (
    Calibration,
    ChipSettings,
    FlowSolver,
    PowerLaw,
    Robot,
    ViscositySettings,
    clearance_um,
    load_chip,
    median_width_um,
    relative_rmse,
    sample,
)
from flowrec.rigs import SimulatedRig, true_depth_um, true_robot
from flowrec.rigs.simulated.bodies import Swimmer
from flowrec.rigs.simulated.microscope import NO_PARTICLES, DrawnRobot, Microscope, Particles
from flowrec.rigs.simulated.pump import Pump
from flowrec.rigs.simulated.true_walls import at_centres, cut_up, true_walls
from flowrec.rigs.simulated.world import Shake, misregister, true_chip, true_pump
from flowrec.stages import (
    CameraSettings,
    Simulated,
    SimulatedImage,
    assemble,
    config_from_toml,
    derived_values,
    load_config,
    to_toml,
    with_sets,
)
from flowrec.stages.resolve import resolve
from flowrec.stages.simulated_settings import WORLDS
from tests.short_missions import SMALL

CHIP = load_chip(ChipSettings("bifurcation"))
ROBOT = Robot(radius_um=50.0, max_speed_um_s=600.0, step_out_hz=28.8)
QUIET = {"position_noise_um": 0.0, "heading_noise_rad": 0.0, "speed_noise": 0.0}


def rig_of(*sets):
    asked = load_config(None, [*SMALL, *sets])
    chip = load_chip(asked.chip)
    config = resolve(asked, chip)
    return SimulatedRig.of(assemble(config, chip), config, 2.0)


# Position, flow, clearance and mean grey level of every twelfth frame, as before there were other worlds.
KIND = {
    ("chip.name=vessels", "chip.seed=3", "simulated.seed=5", "simulated.pulsation_share=0.2",
     "simulated.step_out_share=0.8"): [
        [300.0, 2900.0, 460.004241943, 0.832188129, 130.0, 143.534594727],
        [589.998327284, 2895.874018127, 477.002117771, -129.966755509, 108.694616164, 143.51685791],
        [791.886612222, 2936.538903502, 180.592403336, -79.0053986, 0.03519874, 143.528833008],
        [835.402626824, 2924.738546877, 239.327134345, -112.771988963, -0.000751039, 143.524450684],
        [814.341746631, 2930.816826533, 186.428307035, -84.881992224, -0.000388961, 143.511035156],
        [782.533974598, 2934.213962163, 238.988384442, -102.95612365, 6.070961907, 143.516503906],
    ],
    ("simulated.seed=2",): [
        [300.0, 2700.0, 392.803710938, -0.01695754, 190.0, 143.676953125],
        [544.425658008, 2721.987589229, 389.581429382, 0.031505616, 168.012410771, 143.669421387],
        [785.96996424, 2829.868834272, 286.732282164, -0.026730309, 60.131165728, 143.67097168],
        [891.541499382, 2890.0, 166.083572264, -0.164550889, 0.0, 143.66986084],
        [850.273313839, 2890.0, 165.938708673, -0.18126952, 0.0, 143.677075195],
        [699.379582937, 2890.0, 165.999580454, 0.018387937, 0.0, 143.681494141],
    ],
}  # fmt: skip


@pytest.mark.parametrize("sets", KIND)
def test_the_first_world_is_what_it_always_was(sets):
    seen = []
    with rig_of(*sets, "simulated.world=kind") as rig:
        for k, inputs in enumerate(rig.inputs()):
            truth = inputs.truth
            row = [*truth.position_um, *truth.flow_um_s, truth.clearance_um, inputs.frame.image.mean()]
            seen += [row] if k % 12 == 0 else []
            rig.apply(Currents(inputs.stamp_ns, 8.0 + 0.4 * k, 0.05 * k, 5.0, 0.0, np.zeros(3), False))
    seen = np.array(seen, np.float64)
    np.testing.assert_allclose(seen[:, :5], np.array(KIND[sets])[:, :5], atol=1e-5)
    np.testing.assert_allclose(seen[:, 5], np.array(KIND[sets])[:, 5], atol=1e-3)


def test_a_session_from_before_the_setting_is_of_the_first_world_and_a_new_one_states_every_number():
    config = resolve(load_config(None, [*SMALL, "simulated.world=hard", "simulated.depth_error=0.3"]), CHIP)
    assert config_from_toml(to_toml(config), "session") == config
    stated = config.simulated
    assert stated.depth_error == 0.3 and stated.um_per_rev_error == WORLDS["hard"]["um_per_rev_error"]
    known = [each.name for each in fields(Simulated) if each.name in WORLDS["hard"]]
    assert set(known) == set(WORLDS["hard"]) and None not in [getattr(stated, name) for name in known]
    assert not [key for key in derived_values(load_config(None, SMALL), config) if key.startswith("simulated")]
    # The settings of the first release, without a world.
    text = to_toml(config)
    before = text[: text.index("[simulated]")] + "[simulated]\nseed = 3\nstep_out_share = 0.9\n\n"
    old = config_from_toml(before + text[text.index("[movie]") :], "session").simulated
    assert old == Simulated(world="kind", seed=3, step_out_share=0.9)
    assert with_sets(config, ["simulated.world=moderate"]).simulated.value("um_per_rev_error") == 0.08
    assert with_sets(config, ["simulated.world=moderate"]).simulated.value("depth_error") == 0.3


def test_every_world_states_numbers_within_their_ranges_and_knows_every_setting_of_the_first():
    for name, preset in WORLDS.items():
        simulated = Simulated(world=name).with_preset()
        assert not list(faults(simulated)), name
        drawn = {"pulsation_hz", "pulsation_phase_deg"}
        assert set(preset) | drawn == set(WORLDS["kind"])
        assert all(getattr(Simulated(), key) is None for key in preset)


def test_a_stated_error_leaves_what_else_is_drawn_as_it_is():
    hard = Simulated(world="hard", seed=11)
    first, other = true_robot(ROBOT, hard), true_robot(ROBOT, replace(hard, step_out_share=0.7, depth_error=0.0))
    assert (first.um_per_rev, first.delay_s) == (other.um_per_rev, other.delay_s)
    assert other.step_out_hz == 0.7 * ROBOT.step_out_hz
    exact = true_robot(ROBOT, replace(hard, um_per_rev_share=0.85, slip=0.1, delay_s=0.05))
    assert (exact.um_per_rev, exact.delay_s) == (pytest.approx(25.0 * 0.85 * 0.9), 0.05)
    inlet = true_chip(CHIP, replace(hard, inlet_speed_share=1.1, outlet_pressure_error=0.0), FlowSolver())
    assert inlet.boundary_values == pytest.approx(CHIP.boundary_values * 1.1)
    assert inlet.viscosity_mpa_s == true_chip(CHIP, hard, FlowSolver()).viscosity_mpa_s
    shares = [true_robot(ROBOT, Simulated(world="moderate", seed=n)).um_per_rev / 25.0 for n in range(200)]
    assert min(shares) == pytest.approx(0.92, abs=0.004) and max(shares) == pytest.approx(1.08, abs=0.004)
    assert np.mean(shares) == pytest.approx(1.0, abs=0.01)


def test_the_depth_is_the_stated_one_but_for_its_error_and_a_chip_may_have_one_that_nobody_stated():
    stated = replace(CHIP, depth_um=150.0)
    assert (
        true_depth_um(CHIP, Simulated(world="kind")) is None and true_depth_um(stated, Simulated(world="kind")) == 150.0
    )
    assert true_depth_um(CHIP, Simulated(world="moderate")) is None
    depths = [true_depth_um(stated, Simulated(world="moderate", seed=n)) for n in range(50)]
    assert 135.0 <= min(depths) < 139.0 and 161.0 < max(depths) <= 165.0
    assert true_depth_um(CHIP, Simulated(world="kind", depth_um=100.0)) == 100.0
    assert true_depth_um(stated, Simulated(world="kind", depth_um=0.0)) is None
    width_um = median_width_um(CHIP)
    depths = [true_depth_um(CHIP, Simulated(world="hard", seed=n), 50.0) for n in range(20)]
    assert all(0.6 * width_um <= depth <= 1.0 * width_um and depth >= 110.0 for depth in depths)
    # Friction flattens the profile and favours the narrow branch, which in two dimensions w^3 / L nearly closes.
    solver = FlowSolver()
    deep, shallow = (
        solver.solve(true_chip(CHIP, Simulated(world="kind", seed=1, depth_um=d), solver)) for d in (0.0, 60.0)
    )
    upper = np.hypot(*shallow.velocity_um_s[60].T).max() / np.hypot(*deep.velocity_um_s[60].T).max()
    assert upper > 1.1


def test_the_brownian_motion_of_the_robot_is_stokes_and_einsteins_and_tiny():
    still = Simulated(world="kind", position_noise_um=0.0, temperature_k=295.0, speed_noise=0.0)
    shape = (80, 80)
    field = FlowField(0, 0, "", 20.0, np.zeros((*shape, 2)), np.zeros(shape), None, np.zeros(0), 1.0, 1000.0, "")
    ends = []
    for seed in range(300):
        body = Swimmer((800.0, 800.0), ROBOT, replace(still, seed=seed), field, np.full(shape, 800.0, np.float32), 20.0)
        body.advance(1.0, 0.0, 0.0, 0.0)
        ends.append(body.position_um - 800.0)
    assert np.std(ends) == pytest.approx(0.0930, rel=0.08)  # sqrt(2 k T / (6 pi mu a) 1 s) of 50 um in water at 295 K


def test_the_drift_of_a_pump_is_a_process_of_time_and_not_of_the_steps_that_it_is_asked_in():
    drift = {"drift_share": 0.05, "drift_s": 2.0}
    one, other = (
        true_pump(Simulated(world="kind", seed=4, pulsation_share=0.1, pulsation_hz=0.5, **drift)) for _ in range(2)
    )
    times = np.linspace(0.0, 30.0, 61)
    late_first = [other.strength(time) for time in times[::-1]][::-1]
    assert [one.strength(time) for time in times] == late_first
    long = np.array([Pump(0.0, 1.0, 0.0, 0.05, 2.0, np.random.default_rng(n)).strength(9.0) for n in range(2000)])
    assert long.mean() == pytest.approx(1.0, abs=0.005) and long.std() == pytest.approx(0.05, rel=0.08)
    again = Pump(0.0, 1.0, 0.0, 0.05, 2.0, np.random.default_rng(1))
    series = np.array([again.strength(time) - 1.0 for time in np.arange(0.0, 8000.0, 2.0)])
    assert np.corrcoef(series[1:], series[:-1])[0, 1] == pytest.approx(math.exp(-1.0), abs=0.06)
    drawn = [true_pump(Simulated(world="hard", seed=n))._hz for n in range(100)]
    assert 0.05 <= min(drawn) < 0.08 and 1.4 < max(drawn) <= 2.0


@pytest.mark.parametrize(("name", "seed"), [("vessels", 10), ("bifurcation", 0)])
def test_true_walls_are_off_by_up_to_what_was_asked_in_patches_and_keep_every_channel(name, seed):
    chip = load_chip(ChipSettings(name, seed=seed))
    for error_px in (0.33, 1.0):
        true, words = true_walls(chip, error_px, 0.0, np.zeros((0, 2)), np.random.default_rng(3))
        assert f"{error_px:g} px" in words and true.um_per_px == 10.0
        distance = np.abs(clearance_um(cut_up(chip.mask, 2), 1.0))
        moved = true.mask != cut_up(chip.mask, 2)
        assert moved.mean() > 2e-3
        assert distance[moved].max() <= 2.0 * (error_px + 0.75)  # fine pixels; a staircase is half a pixel off itself
        assert (true.mask & ~cut_up(chip.mask, 2)).any() and (~true.mask & cut_up(chip.mask, 2)).any()
        # Channels and islands neither meet nor part.
        for mask, whole in ((true.mask, chip.mask), (~true.mask, ~chip.mask)):
            corners = np.ones((3, 3)) if mask is not true.mask else None
            assert scipy.ndimage.label(mask, corners)[1] == scipy.ndimage.label(whole, corners)[1]


def test_the_mask_of_a_large_chip_keeps_its_pixel_size_and_every_one_of_its_channels():
    mask = np.zeros((240, 500), np.bool_)
    mask[20:110], mask[130:220] = True, True
    mask[60:62, 100:400:50] = False  # posts of four pixels
    large = replace(CHIP, mask=mask, openings=CHIP.openings)
    true, _ = true_walls(large, 1.0, 0.0, np.zeros((0, 2)), np.random.default_rng(1))
    assert true.mask.shape == mask.shape and true.um_per_px == 20.0 and true.openings == large.openings
    assert scipy.ndimage.label(~true.mask)[1] == 3 + 6
    assert scipy.ndimage.label(true.mask)[1] == 2 and 200 < (true.mask != mask).sum() < 3000
    assert at_centres(true.mask.astype(float), large).shape == mask.shape


@pytest.mark.slow("solves the flow of worlds")
def test_a_blocked_branch_keeps_the_rest_of_its_width_and_keeps_away_from_the_start():
    start = np.array([[3100.0, 3400.0]])  # in the short branch
    places = []
    own = true_walls(CHIP, 0.0, 0.0, start, np.random.default_rng(0))[0].mask
    for seed in range(6):
        true, words = true_walls(CHIP, 0.0, 0.5, start, np.random.default_rng(seed))
        x, y = (float(part) for part in words.split(" at ")[1].removesuffix(" um").split(", "))
        places.append((x, y))
        assert math.dist((x, y), start[0]) > 2.0 * median_width_um(CHIP) - 1.0
        row, column = round((y + 5.0) / 10.0), round((x + 5.0) / 10.0)
        line = slice(max(row - 20, 0), row + 21), column
        assert 0.35 < true.mask[line].sum() / own[line].sum() < 0.75
        assert (own & ~true.mask).sum() > 30 and not (true.mask & ~own).any()
        assert scipy.ndimage.label(true.mask)[1] == 1
    assert len(set(places)) > 3


@pytest.mark.slow("solves a flow on a finer grid")
def test_the_flow_between_true_walls_is_what_the_finer_field_says_at_the_chips_pixels():
    rig = rig_of("simulated.world=moderate", "simulated.wall_error_px=1", "simulated.seed=2")
    world = rig.true_world()
    kind = rig_of("simulated.seed=2", "simulated.world=kind", "simulated.inlet_speed_error=0.15",
                  "simulated.viscosity_error=0.05").true_world()  # fmt: skip
    error = relative_rmse(world.field, kind.field, CHIP.mask).v
    assert 0.03 < error < 0.35  # other walls, the same inflow
    assert world.field.velocity_um_s.shape == (*CHIP.mask.shape, 2) and world.mask.shape == (512, 640)
    inside = at_centres(world.mask.astype(np.float64), CHIP) > 0.9
    speed = np.hypot(*np.moveaxis(world.field.velocity_um_s, -1, 0))
    assert (speed[inside] > 0.0).mean() > 0.999 and speed[
        at_centres(world.mask.astype(np.float64), CHIP) == 0.0
    ].max() == 0.0
    # Through the inlet flows what the boundary values say: the flow there is the profile of a straight channel.
    rows = np.arange(0.0, 5120.0, 2.0)
    inflow = sample(world.field, np.stack((np.full_like(rows, 60.0), rows), -1))[:, 0].sum() * 2.0
    opening = next(o for o in CHIP.openings if o.kind == "inlet")
    assert inflow == pytest.approx(world.field.boundary_values[0] * opening.width_px * 20.0, rel=0.02)
    assert "walls up to 1 px off" in world.field.note and "um per revolution" in world.field.note


def test_the_true_registration_is_off_by_what_the_world_allows_and_turns_about_the_middle():
    stated, size = Calibration.centre_on(10.0, (3190.0, 2550.0), (640, 512)), (640, 512)
    middle_px = np.array([319.5, 255.5])
    assert misregister(stated, Simulated(world="kind"), size) is stated
    for seed in range(20):
        true = misregister(stated, Simulated(world="moderate", seed=seed), size)
        off_um = np.hypot(*(true.to_um(middle_px) - stated.to_um(middle_px)))
        assert 5.0 <= off_um <= 10.0
        assert abs(true.angle_deg) <= 0.2 and abs(true.um_per_px / 10.0 - 1.0) <= 0.003
    only = Simulated(world="kind", scale_error=0.02, seed=3)
    assert misregister(stated, only, size).to_um(middle_px) == pytest.approx(stated.to_um(middle_px))


def test_a_shaken_stage_moves_the_image_of_everything_and_the_robot_of_the_truth_not_at_all():
    swing = Shake.of(Simulated(world="kind", seed=1, shake_um=10.0, shake_hz=3.0))
    assert Shake.of(Simulated(seed=1)) is None
    ways = np.array([swing.at(time) for time in np.linspace(0.0, 1.0, 200)])
    assert np.hypot(*ways.T).max() == pytest.approx(10.0, rel=1e-3) and np.abs(ways.mean(0)).max() < 0.2
    sets = ("simulated.seed=1", "simulated.image.debris=0", "simulated.world=kind", "simulated.image.read_noise=0",
            "simulated.image.photons_per_level=1e6")  # fmt: skip
    still, shaken = (list(rig_of(*sets, *more).inputs())[:12] for more in ((), ("simulated.shake_um=60",)))
    assert all(a.truth.same_as(b.truth) for a, b in zip(still, shaken, strict=True))
    for a, b in zip(still[1:8], shaken[1:8], strict=True):
        images = (np.float32(a.frame.image), np.float32(b.frame.image))
        found_px, _ = cv2.phaseCorrelate(*images, cv2.createHanningWindow((320, 256), cv2.CV_32F))
        expected_px = Shake.of(Simulated(world="kind", seed=1, shake_um=60.0)).at(a.stamp_ns * 1e-9) / 20.0
        assert found_px == pytest.approx(expected_px, abs=0.25)


def test_a_body_is_drawn_where_the_stage_has_moved_it_and_as_long_as_its_way_in_the_exposure():
    camera = CameraSettings(width_px=100, height_px=80, exposure_s=0.1)
    image = SimulatedImage(debris=0, read_noise=0.0, photons_per_level=1e6)
    mask = np.ones((80, 100), bool)
    mask[0] = mask[-1] = False
    scope = Microscope(mask, 10.0, Calibration(10.0, (0.0, 0.0)), camera, image, seed=1)
    at_um, columns, rows = np.array([500.0, 400.0]), np.arange(100.0), np.arange(80.0)

    def moments(values, weights):
        mean = np.average(values, weights=weights)
        return mean, np.average((values - mean) ** 2, weights=weights)

    def darkened(robots, particles=NO_PARTICLES, stage_um=(0.0, 0.0)):
        """Mean and variance along x and along y of what bodies darken, in px."""
        off_um = np.array(stage_um)
        dark = np.float64(scope.image([], stage_um=off_um)) - scope.image(robots, particles, off_um)  # rims: below 0
        dark[:22] = dark[55:] = dark[:, :32] = dark[:, 74:] = 0.0  # far from the body there is noise alone
        return moments(columns, dark.sum(0)), moments(rows, dark.sum(1))

    robot = DrawnRobot(at_um, 40.0)
    bead = Particles(at_um[None], np.array([40.0]), np.array([0.8]))
    for bodies in (([robot],), ([], bead)):
        for stage_um, place_px in (((0.0, 0.0), (50.0, 40.0)), ((60.0, -30.0), (56.0, 37.0))):
            (x, _), (y, _) = darkened(*bodies, stage_um=stage_um)
            assert (x, y) == pytest.approx(place_px, abs=0.05)
    still, moving = darkened([robot]), darkened([robot._replace(velocity_um_s=np.array([600.0, 0.0]))])
    assert moving[0][0] == pytest.approx(50.0, abs=0.05)
    # The variance of a way of 6 px that is exposed evenly is 6^2 / 12.
    assert moving[0][1] - still[0][1] == pytest.approx(3.0, abs=0.5)
    assert moving[1][1] == pytest.approx(still[1][1], abs=0.5)


def test_oblique_light_is_another_profile_whose_centre_the_tracker_still_finds():
    for seed in (1, 2):
        first = next(
            iter(rig_of(f"simulated.seed={seed}", "simulated.image.debris=0", "simulated.world=kind").inputs())
        )
        lit = next(
            iter(rig_of(f"simulated.seed={seed}", "simulated.image.debris=0", "simulated.optics=oblique").inputs())
        )
        assert np.abs(first.frame.image.astype(int) - lit.frame.image).max() > 20
        asked = load_config(None, SMALL)
        config = resolve(asked, CHIP)
        pipeline = assemble(config, CHIP)
        track, _ = pipeline.tracker.follow(None, None, lit.frame, CHIP, pipeline.calibration, config.robot)
        assert track.seen and math.dist(track.position_um, lit.truth.position_um) < 0.25 * config.robot.radius_um


def test_the_true_fluid_can_have_another_law_than_the_assumed_one():
    chip = load_chip(ChipSettings("straight"))
    assert true_chip(chip, Simulated(), FlowSolver()).law is None
    thinning = Simulated(viscosity=ViscositySettings("power_law", exponent=0.6))
    assert true_chip(chip, thinning, FlowSolver()).law == PowerLaw(0.6)
    blunter = Simulated(viscosity=ViscositySettings(exponent=0.4))
    assert true_chip(replace(chip, law=PowerLaw(0.6, 2.0)), blunter, FlowSolver()).law == PowerLaw(0.4, 2.0)
