"""Causes of a world, by the words in which a refinement names each, with the side where it has one.

A warning is worth something where it names what is wrong. A clause about anything else, or on the wrong side, sends a
person to the wrong place. What is only said of the observations (outliers, noise, what they can not tell) names none.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

import numpy as np

from flowrec.physics import Chip
from flowrec.rigs import true_depth_um, true_robot, true_view
from flowrec.stages import ResolvedConfig, calibration_of

# Clauses that name no cause: what was used and seen, what could not be told, the null model, methods on themselves.
_NO_CAUSE = re.compile(
    r"assimilated|\d+ more distrusted|ignored|they say nothing|of (in|out)let|whether|they do not ask|not refined"
    r"|the assumed flow times|the observations scatter around it|residual|start|corrected|misfit|they scatter"
    r"|nothing it knows explains|null model|um per revolution they tell|far from what was assumed|viscosity|$"
)
# From where on a cause is one: as the sentences have it (refine/findings.py), the depth by what a lab knows of it.
_ROBOT, _SCALE, _ANGLE_DEG, _OFFSET_PX, _WALLS_PX, _PUMP, _DEPTH = 0.02, 0.005, 0.3, 0.25, 0.25, 0.03, 0.05
_MOVED = "the chip lies .* from where the registration puts it"  # also by a wrong scale or angle: where the survey was
_SIDE = 0.5  # of an offset: the part along an axis from where on its side has to be right


def count_causes(note: str, planted: Sequence[str]) -> tuple[int, int]:
    """Clauses of a note that name a planted cause, and clauses that name another one or the wrong side."""
    clauses = [clause.strip() for clause in note.split(";")]
    causes = [clause for clause in clauses if not _NO_CAUSE.match(clause)]
    right = sum(any(re.search(words, clause) for words in planted) for clause in causes)
    return right, len(causes) - right


def planted_causes(config: ResolvedConfig, chip: Chip) -> list[str]:
    """Expressions for the sentences that are right in the simulated world of a configuration."""
    return [*_of_the_robot(config), *_of_the_camera(config, chip), *_of_the_chip(config, chip), *_of_the_pump(config)]


def _of_the_robot(config: ResolvedConfig) -> Iterator[str]:
    robot, simulated = config.robot, config.simulated
    true = true_robot(robot, simulated)
    share = true.um_per_rev / robot.um_per_rev - 1.0
    hindered = simulated.value("hindrance") > 0.0
    # A robot that steps out, or that walls hold back, also moves less per revolution.
    if share < -_ROBOT or hindered or true.step_out_hz < (1.0 - _ROBOT) * robot.step_out_hz:
        yield "% less per revolution than stated"
    if share > _ROBOT:
        yield "% more per revolution than stated"
    if hindered:
        yield "near walls the robot rolls by .* slower than elsewhere"


def _of_the_camera(config: ResolvedConfig, chip: Chip) -> Iterator[str]:
    stated, true, camera = calibration_of(config, chip), true_view(config, chip), config.camera
    share = true.um_per_px / stated.um_per_px - 1.0
    if abs(share) > _SCALE:
        yield f"the image scale is .* % {'larger' if share > 0.0 else 'smaller'} than stated"
        yield _MOVED
    turned_deg = (true.angle_deg - stated.angle_deg + 180.0) % 360.0 - 180.0
    if abs(turned_deg) > _ANGLE_DEG and true.mirror == stated.mirror:
        clockwise = (turned_deg > 0.0) != stated.mirror
        yield f"the chip is turned by .* degrees {'' if clockwise else 'counter'}clockwise"
        yield _MOVED
    middle_px = 0.5 * (np.array(camera.size_px) - 1.0)
    x, y = stated.to_um(middle_px) - true.to_um(middle_px)  # where the registration puts the chip: short by this
    size = float(np.hypot(x, y))
    if size > _OFFSET_PX * chip.um_per_px:
        sides = [
            words
            for along, words in ((x, "to the left" if x < 0.0 else "to the right"), (y, "up" if y < 0.0 else "down"))
            if abs(along) > _SIDE * size
        ]
        yield f"{_MOVED} .*" + ".*".join(sides)
    if config.simulated.value("shake_um") > 0.0:
        yield "the image shakes at"


def _of_the_chip(config: ResolvedConfig, chip: Chip) -> Iterator[str]:
    simulated = config.simulated
    depth_um = true_depth_um(chip, simulated, config.robot.radius_um)
    if depth_um is not None and (chip.depth_um is None or abs(depth_um / chip.depth_um - 1.0) > _DEPTH):
        yield "chip depth"
    if simulated.value("wall_error_px") > _WALLS_PX:
        yield "the walls seem off|the mask (seems|may be) "
    if simulated.value("blocked_share") > 0.0:
        yield "a channel is partly blocked"


def _of_the_pump(config: ResolvedConfig) -> Iterator[str]:
    simulated = config.simulated
    if simulated.value("drift_share") > _PUMP:
        yield "the flow (wanders|changes)"
    if simulated.value("pulsation_share") > _PUMP:
        yield "the pump pulsates|the flow changes"
