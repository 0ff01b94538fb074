"""The simulated world: true flow, walls, pump, robot, coils and registration, drawn from the seed for the rig.

Each quantity has random numbers of its own, so that a setting which states one leaves the others as they are. What was
drawn is the note of the true field, for evaluation; no stage reads it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from flowrec.core import Bools, Floats, Floats32, FlowError, FlowField, wrap_rad
from flowrec.physics import Calibration, Chip, FlowSolver, Robot, clearance_um, median_width_um, with_settings
from flowrec.rigs.simulated.hindrance import NO_HINDRANCE, Hindrance, walls_around
from flowrec.rigs.simulated.pump import Pump
from flowrec.rigs.simulated.true_walls import at_centres, on_pixels, origin_um, true_walls
from flowrec.stages import Coils, Simulated, field_limits

_STREAM = (
    7  # of the seed; bodies, microscope, chip and clock have 1 to 6 and 8, beads 9, other robots 10, the sensor 34
)
# In the order of their random numbers; new ones at the end.
_DRAWN = (
    *("depth", "walls", "drift", "pulsation_hz", "pulsation_phase"),
    *("um_per_rev", "delay", "step_out", "offset", "angle", "scale", "shake", "coils"),
)
_PULSATION_HZ = (0.05, 2.0)  # of syringe and peristaltic pumps
_LEAST_DEPTH_RADII = 2.2  # the robot fits in


def drawn_from(seed: int, quantity: str) -> np.random.Generator:
    """The random numbers of one quantity."""
    return np.random.default_rng([seed, _STREAM, _DRAWN.index(quantity)])


def _share(simulated: Simulated, quantity: str, bound: str, stated: float | None = None) -> float:
    """True over assumed: stated, or drawn from 1 +- the setting `bound`."""
    if stated is not None:
        return stated
    return 1.0 + float(simulated.value(bound)) * float(drawn_from(simulated.seed, quantity).uniform(-1.0, 1.0))


def true_depth_um(chip: Chip, simulated: Simulated, radius_um: float = 0.0) -> float | None:
    """The true depth; None: two-dimensional. A drawn one leaves room for a robot of this radius."""
    if simulated.depth_um is not None:
        return simulated.depth_um or None
    mean_um = chip.depth_um
    if mean_um is None:
        widths = simulated.value("unstated_depth_widths")
        if widths == 0.0:
            return None
        mean_um = widths * median_width_um(chip)
    elif simulated.value("depth_error") == 0.0:
        return mean_um
    return max(mean_um * _share(simulated, "depth", "depth_error"), _LEAST_DEPTH_RADII * radius_um)


def true_chip(chip: Chip, simulated: Simulated, solver: FlowSolver, radius_um: float = 0.0) -> Chip:
    """The chip with the true boundary values, viscosity and its law, and depth, drawn from the seed.

    Each inlet speed times 1 +- (a third of inlet_speed_error to all of it) or times the stated share, the viscosity
    times 1 +- viscosity_error, each outlet's pressure plus up to +- outlet_pressure_error of the pressure drop across
    the chip; all uniform. One outlet alone keeps its pressure: only differences drive a flow.
    """
    rng = np.random.default_rng([simulated.seed, 5])
    inlet = np.array([opening.kind == "inlet" for opening in chip.openings])
    draws = rng.uniform(-1.0, 1.0, len(inlet))
    viscosity = chip.viscosity_mpa_s * (1.0 + simulated.value("viscosity_error") * float(rng.uniform(-1.0, 1.0)))
    # At least a third of the error, because an almost correct assumption would leave nothing to refine.
    wrong = np.sign(draws) * (1.0 + 2.0 * np.abs(draws)) / 3.0
    share = 1.0 + simulated.value("inlet_speed_error") * wrong
    if simulated.inlet_speed_share is not None:
        share = np.full_like(share, simulated.inlet_speed_share)
    values = chip.boundary_values * np.where(inlet, share, 1.0)
    law = with_settings(chip.law, simulated.viscosity, "simulated")
    chip = replace(chip, depth_um=true_depth_um(chip, simulated, radius_um), law=law)
    changed = chip.with_boundary(values, viscosity)
    outlet_error = simulated.value("outlet_pressure_error")
    if outlet_error == 0.0 or np.count_nonzero(~inlet) < 2:
        return changed
    pressure = solver.solve(changed).pressure_pa[chip.mask]
    drop = float(pressure.max() - pressure.min())
    values = values + np.where(inlet, 0.0, outlet_error * drop * draws)
    return chip.with_boundary(values, viscosity)


def true_robot(robot: Robot, simulated: Simulated) -> Robot:
    """The robot with the true um per revolution, slip, step-out frequency and delay."""
    rolled = _share(simulated, "um_per_rev", "um_per_rev_error", simulated.um_per_rev_share)
    step_out = _share(simulated, "step_out", "step_out_error", simulated.step_out_share)
    late = _share(simulated, "delay", "delay_error")
    return replace(
        robot,
        um_per_rev=robot.um_per_rev * rolled * (1.0 - simulated.value("slip")),
        step_out_hz=step_out * robot.step_out_hz,
        delay_s=robot.delay_s * late if simulated.delay_s is None else simulated.delay_s,
    )


def true_pump(simulated: Simulated) -> Pump:
    """The waveform of the pump."""
    seed, hz, phase_deg = simulated.seed, simulated.value("pulsation_hz"), simulated.value("pulsation_phase_deg")
    if hz is None:
        hz = math.exp(drawn_from(seed, "pulsation_hz").uniform(*np.log(_PULSATION_HZ)))
    if phase_deg is None:
        phase_deg = drawn_from(seed, "pulsation_phase").uniform(0.0, 360.0)
    drift = simulated.value("drift_share"), simulated.value("drift_s")
    pulse = simulated.value("pulsation_share"), hz, math.radians(phase_deg)
    return Pump(*pulse, *drift, drawn_from(seed, "drift"), simulated.step_share, simulated.step_s)


def misregister(stated: Calibration, simulated: Simulated, size_px: tuple[int, int]) -> Calibration:
    """The true registration of images of `size_px` (width, height) whose stated one is this; about the middle.

    What [simulated] states of it is in `stated` already, and is not drawn.
    """
    seed, shift_px = simulated.seed, np.zeros(2)
    offset_px = simulated.value("offset_px")
    if simulated.centre_um is None and offset_px > 0.0:
        rng = drawn_from(seed, "offset")
        away, towards = offset_px * rng.uniform(0.5, 1.0), rng.uniform(0.0, 2.0 * math.pi)
        shift_px = away * np.array([math.cos(towards), math.sin(towards)])
    turned_deg = 0.0
    if simulated.angle_deg is None and simulated.value("angle_error_deg") > 0.0:
        turned_deg = simulated.value("angle_error_deg") * drawn_from(seed, "angle").uniform(-1.0, 1.0)
    scaled = 1.0 if simulated.um_per_px is not None else _share(simulated, "scale", "scale_error")
    if not shift_px.any() and turned_deg == 0.0 and scaled == 1.0:
        return stated
    middle = stated.to_um(0.5 * (np.array(size_px) - 1.0) + shift_px)
    return Calibration.centre_on(
        stated.um_per_px * scaled, middle, size_px, stated.angle_deg + turned_deg, stated.mirror
    )


@dataclass(frozen=True, slots=True, eq=False)
class Shake:
    """A swing of the stage."""

    way_um: Floats  # (2,) amplitude
    hz: float
    phase_rad: float

    @classmethod
    def of(cls, simulated: Simulated) -> Shake | None:
        """The swing of a world; None: the stage stands still."""
        amplitude_um = simulated.value("shake_um")
        if amplitude_um == 0.0:
            return None
        angle, phase = drawn_from(simulated.seed, "shake").uniform(0.0, 2.0 * math.pi, 2)
        return cls(amplitude_um * np.array([math.cos(angle), math.sin(angle)]), simulated.value("shake_hz"), phase)

    def at(self, time_s: float) -> Floats:
        """(2,) um off at a time."""
        return self.way_um * math.sin(2.0 * math.pi * self.hz * time_s + self.phase_rad)


@dataclass(frozen=True, slots=True, eq=False)
class TrueCoils:
    """Coils whose calibration is wrong: the vector of their true field moves on an ellipse in a tilted plane.

    The commanded field B(theta) = B0 (h sin theta + z cos theta) is made with the currents A^-1 B; with the true matrix
    A' it is M B, M = A' A^-1. It turns about the normal of the plane of M h and M z, so the robot travels at an angle
    to the heading; and it follows up to a frequency that is proportional to the shorter axis of the ellipse. What the
    tilt takes of the rolled distance is of second order and left out, and so is a wrong bias.
    """

    coils: Coils  # as they are calibrated
    made: Floats  # (3, 3) M, from a commanded field to the true one

    @classmethod
    def of(cls, coils: Coils | None, simulated: Simulated) -> TrueCoils | None:
        """The coils of a world; None: as they are calibrated."""
        error = simulated.value("coil_error")
        if coils is None or error == 0.0:
            return None
        stated = np.array(coils.mt_per_a)
        draws = drawn_from(simulated.seed, "coils").uniform(-1.0, 1.0, stated.shape)
        return cls(coils, np.eye(3) + error * draws * np.linalg.norm(stated, axis=0) @ field_limits(coils).inverse)

    def motion(self, heading_rad: float) -> tuple[float, float]:
        """The direction in which the robot travels when this heading is asked for, and the field's strength, 1: full.

        The heading may be that of the plane or the opposite one: the answer turns with it.
        """
        forward, up = self.coils.field_mt([0.5 * math.pi, 0.0], heading_rad, 1.0)
        asked, axis = np.cross(forward, up), np.cross(self.made @ forward, self.made @ up)
        turned_rad = math.atan2(axis[1], axis[0]) - math.atan2(asked[1], asked[0])
        ellipse = np.linalg.svd(self.made @ np.column_stack([forward, up]), compute_uv=False)
        return wrap_rad(heading_rad + turned_rad), min(float(ellipse[-1]), 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """Flow and walls of a world on the pixels of the chip."""

    field: FlowField  # the steady flow; its note says what was drawn
    clearance_um: Floats32  # (h, w) from pixel centres to the true walls
    mask: Bools  # of the true walls, which the microscope shows
    mask_um_per_px: float
    mask_origin_um: float  # where the centre of its first pixel lies, on either axis of the chip frame
    hindrance: Hindrance


def world_of(chip: Chip, robot: Robot, simulated: Simulated, field: FlowField | None, clear_um: Floats) -> World:
    """The world of a seed. A given field keeps the chip's own walls.

    Parameters
    ----------
    chip, robot : as they are assumed.
    clear_um : (n, 2) places where no branch is blocked, um.

    Raises FlowError, RigError if there is no such world.
    """
    mask, um_per_px, mask_origin_um = chip.mask, chip.um_per_px, 0.0
    walls_um: Floats32 | None = None
    if field is None:
        solver = FlowSolver(k=simulated.value("k"))
        truth = true_chip(chip, simulated, solver, robot.radius_um)
        wall_error_px, blocked_share = simulated.value("wall_error_px"), simulated.value("blocked_share")
        words = ""
        if wall_error_px > 0.0 or blocked_share > 0.0:
            rng = drawn_from(simulated.seed, "walls")
            fine, words = true_walls(truth, wall_error_px, blocked_share, clear_um, rng)
            field = on_pixels(_solve(fine, solver), fine, chip)
            mask, um_per_px, mask_origin_um = fine.mask, fine.um_per_px, origin_um(fine, chip)
            walls_um = at_centres(clearance_um(fine.mask, fine.um_per_px), chip)
        else:
            field = solver.solve(truth)
        note = drawn_note(chip, truth, robot, simulated, words)
        field = replace(field, method="truth", note=note)
    if walls_um is None:
        walls_um = clearance_um(chip.mask, chip.um_per_px)
    share = simulated.value("hindrance")
    hindrance = Hindrance(share, walls_around(walls_um, chip.um_per_px)) if share > 0.0 else NO_HINDRANCE
    return World(field, walls_um, mask, um_per_px, mask_origin_um, hindrance)


def _solve(fine: Chip, solver: FlowSolver) -> FlowField:
    """The flow between smooth walls; along the pixels where the smooth ones would cut an opening."""
    try:
        return solver.solve(fine)
    except FlowError:
        return solver.solve(replace(fine, walls="pixel"))


def drawn_note(chip: Chip, truth: Chip, robot: Robot, simulated: Simulated, walls: str) -> str:
    """Description of the random deviations of a world, in words."""
    real = true_robot(robot, simulated)
    parts = ["drawn from the seed of the simulated rig"]
    if simulated.world != "kind":
        parts.append(f"world {simulated.world}")
    if truth.depth_um != chip.depth_um:
        parts.append(f"depth {truth.depth_um:.0f} um" if truth.depth_um is not None else "two-dimensional")
    if real.um_per_rev != robot.um_per_rev:
        parts.append(f"{real.um_per_rev:.2f} um per revolution")
    if real.step_out_hz != robot.step_out_hz:
        parts.append(f"step-out {real.step_out_hz:.1f} Hz")
    if real.delay_s != robot.delay_s:
        parts.append(f"delay {1e3 * real.delay_s:.0f} ms")
    if simulated.value("coil_error") > 0.0:
        parts.append(f"field of the coils up to {100.0 * simulated.value('coil_error'):g} % off")
    if walls:
        parts.append(walls)
    return "; ".join(parts)
