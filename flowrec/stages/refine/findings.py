"""Findings of an assimilation besides the boundary values: names, values, standard deviations, and plain words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from flowrec.core import Floats, FlowField
from flowrec.physics import ROLLING_BY_DRAG, Chip, SphereBetweenWalls
from flowrec.stages.refine.causes import LINE_NAME, WALL_BIAS_NAME, WANDER_S
from flowrec.stages.refine.disturbances import SHAKE
from flowrec.stages.refine.hypothesis import HypothesisFit
from flowrec.stages.refine.obstacles import Obstacle
from flowrec.stages.refine.predictive_check import NATS, UNEXPLAINED, Departure

SURE = 2.5  # standard deviations from zero above which a cause is named
PROBABLE = 0.9  # probability of a depth, or of none, above which it is said
LIKELY = 0.75  # of walls that are all off, from which on it is said: odds of 3 ("positive", Kass and Raftery 1995)
# Factor for people, least value that is worth a word, and the words for a negative and a positive value. Clockwise is
# from +x to +y, as the chip is drawn. The values have the signs of causes.py: um_per_px_share is the stated scale over
# the true one, less 1; an offset is where the robot is, from where it was measured, so the chip lies the other way.
WORDS = {
    "um_per_rev_share": (
        *(100.0, 0.02),
        "the robot moves {} % less per revolution than stated",
        "the robot moves {} % more per revolution than stated",
    ),
    "heading_deg": (
        *(1.0, 2.0),
        "the robot's own course lies {} degrees counterclockwise of its heading",
        "the robot's own course lies {} degrees clockwise of its heading",
    ),
    "hindrance_share": (
        *(100.0, 0.03),
        "near walls the robot rolls by {} % faster than elsewhere",
        "near walls the robot rolls by {} % slower than elsewhere",
    ),
    "um_per_px_share": (
        *(100.0, 0.005),
        "the image scale is {} % larger than stated",
        "the image scale is {} % smaller than stated",
    ),
    "angle_deg": (
        *(1.0, 0.3),
        "the chip is turned by {} degrees counterclockwise from how the registration puts it",
        "the chip is turned by {} degrees clockwise from how the registration puts it",
    ),
}
UNSURE = 0.04  # of um per revolution: a larger standard deviation is worth a word
MOVED_PX = 0.25  # least offset of the registration, or of walls, that is worth a word, in pixels of the mask
BIASED = 1.5  # standard deviations of walls that are all off: that they are so has been weighed already
WANDERS, PULSATES = 0.06, 0.03  # likewise of the flow in time, and of a line of the pump
OTHER_SCALE, OTHER_SCALE_STDS = 0.02, 3.0  # of um_per_px_share from which on a session is doubtful
PULSATION, WANDER = "the pump pulsates", "the flow wanders"  # beginnings of sentences
# Likewise of effects that follow a departure from all causes where they can.
TAKEN_FOR = (
    *(PULSATION, WANDER, "the flow changes", "the image shakes"),
    *("the walls seem off", "near walls the robot rolls"),
)
PERIODS = 1.5  # of a line in the time that was observed; with fewer, a place that was passed once looks like it


@dataclass(frozen=True, slots=True)
class Findings:
    """Named values with their standard deviations, means over the hypotheses; the rest is for the note."""

    names: tuple[str, ...]
    values: Floats
    stds: Floats
    words: tuple[str, ...]

    def of(self, name: str) -> tuple[float, float]:
        """Value and standard deviation of a name.

        Raises
        ------
        ValueError
            If there is no such name.
        """
        index = self.names.index(name)
        return float(self.values[index]), float(self.stds[index])


def map_doubts(field: FlowField, um_per_px: float, *, scale_known: bool = False) -> list[str]:
    """Reasons to doubt a refined field, or the scale with which it was made, unless that is known to be wrong."""
    unexplained = [clause.strip() for clause in field.note.split(";") if clause.strip().startswith(UNEXPLAINED)]
    scale = "" if scale_known else scale_doubt(field, um_per_px)
    return [*([scale] if scale else []), *(f"the refined flow: {clause}" for clause in unexplained)]


def scale_doubt(field: FlowField, um_per_px: float) -> str:
    """Reason to doubt a session's stated scale by its refined field; '' if the field has no other scale."""
    scale = field.parameter("um_per_px_share")
    if scale is None:
        return ""
    value, std = scale
    if abs(value) <= max(OTHER_SCALE, OTHER_SCALE_STDS * std):
        return ""
    way = "large" if value > 0.0 else "small"
    return (
        f"camera.um_per_px = {um_per_px:.4g} is {100.0 * abs(value):.1f} +- {100.0 * std:.1f} % too {way} for the "
        f"motion of the robot: measure it with flowrec calibrate image, or try {um_per_px / (1.0 + value):.4g}"
    )


def findings(found: Sequence[HypothesisFit], weights: Floats) -> Findings:
    """Combine the hypotheses."""
    parts = [_values(one) for one in found]
    names = list(dict.fromkeys(name for part in parts for name in part))
    values, stds = {}, {}
    for name in names:
        # A hypothesis that does not know an effect says that it is zero.
        pairs = np.array([part.get(name, (0.0, 0.0)) for part in parts])
        mean = float(weights @ pairs[:, 0])
        values[name] = mean
        stds[name] = float(np.sqrt(weights @ (pairs[:, 1] ** 2 + (pairs[:, 0] - mean) ** 2)))
    depth_words = []
    shallow = [index for index, one in enumerate(found) if one.observed.model.prior.depth_index is not None]
    share = float(weights[shallow].sum()) if shallow else 0.0
    if shallow:
        depths = np.array([found[index].depth_um for index in shallow])
        part = weights[shallow] / share
        ln_mean = float(part @ np.log(depths[:, 0]))
        ln_std = float(np.sqrt(part @ ((depths[:, 1] / depths[:, 0]) ** 2 + (np.log(depths[:, 0]) - ln_mean) ** 2)))
        depth, std = float(np.exp(ln_mean)), float(np.exp(ln_mean) * ln_std)
        if share > PROBABLE:
            names.append("depth_um")
            values["depth_um"], stds["depth_um"] = depth, std
            depth_words.append(f"chip depth {with_error(depth, std)} um")
        elif share > 1.0 - PROBABLE:
            depth_words.append(
                f"whether the chip is shallow they do not tell ({share:.0%}: {depth:.0f} +- {std:.0f} um)"
            )
    time_s = found[0].observed.operator.time_s
    observed_s = 0.0 if time_s is None else float(np.ptp(time_s))
    words = (*_bias_words(found, weights), *_words(values, stds, found[0].observed.um_per_px, observed_s), *depth_words)
    return Findings(tuple(names), np.array([values[n] for n in names]), np.array([stds[n] for n in names]), words)


def _bias_words(found: Sequence[HypothesisFit], weights: Floats) -> list[str]:
    """That all walls are off by the same distance, where that is likely."""
    biased = [index for index, one in enumerate(found) if one.observed.wall_mode is not None]
    share = float(weights[biased].sum())
    if share < LIKELY:
        return []
    mean, covariance = found[biased[0]].unknowns(WALL_BIAS_NAME)
    px = found[biased[0]].observed.um_per_px
    outside_um, std_um = px * float(mean[0]), px * float(np.sqrt(covariance[0, 0]))
    if abs(outside_um) < max(MOVED_PX * px, BIASED * std_um):
        return []
    seems = "seems" if share > PROBABLE else f"may be ({share:.0%})"
    way = "narrow" if outside_um > 0.0 else "wide"
    size = with_error(abs(outside_um), std_um)
    return [f"the mask {seems} wrong: its channels are drawn {size} um too {way} on each side"]


def _values(one: HypothesisFit) -> dict[str, tuple[float, float]]:
    """Value and standard deviation by name, of one hypothesis."""
    px = one.observed.um_per_px
    rolled = one.observed.operator.rolled_um_s
    response = {
        "um_per_rev_share": ("gain", 1.0),
        "hindrance_share": ("hindrance", 1.0),
        "heading_deg": ("heading", 180.0 / np.pi),
    }
    driven = rolled is not None and rolled.any()  # of a body that only drifts nothing is said of these
    singles = (response if driven else {}) | {
        "um_per_px_share": ("scale", 1.0),
        "angle_deg": ("angle", 180.0 / np.pi),
        "carry_share": ("carry", 1.0),
        "sphere_share": ("sphere", 1.0),
    }
    result: dict[str, tuple[float, float]] = dict(one.law)
    for name, (effect, factor) in singles.items():
        mean, covariance = one.unknowns(effect)
        if len(mean):
            result[name] = (factor * float(mean[0]), factor * float(np.sqrt(covariance[0, 0])))
    if driven and one.observed.sphere is not None:
        result |= _rolling_by_drag(one, one.observed.sphere)
    mean, covariance = one.unknowns("offset")
    for axis, index in (("x", 0), ("y", 1)):
        result[f"offset_{axis}_um"] = (px * float(mean[index]), px * float(np.sqrt(covariance[index, index])))
    mean, covariance = one.unknowns(LINE_NAME)
    if len(mean) and one.line_hz is not None:
        result[f"pump_{one.line_hz:.2f}_hz_share"] = _amplitude(mean, covariance)
    names = [effect.name for effect in one.effects]
    for name in names:
        if name.startswith(SHAKE):
            result[f"{name.replace(' ', '_')}_um_s"] = _amplitude(*one.unknowns(name))
    sizes = {"walls_px": ["walls"], "resistance_share": ["resistance"]}
    sizes["wander_share"] = [f"wander {length:g} s" for length in WANDER_S]
    for name, effects in sizes.items():
        chosen = [names.index(effect) for effect in effects if effect in names]
        if chosen:
            size = one.posterior.sizes[chosen]
            total = float(np.sqrt((size**2).sum()))
            std = float(np.sqrt(((size**2 * one.posterior.ln_size_std[chosen]) ** 2).sum())) / max(total, 1e-12)
            result[name] = (total, std)
    return result


def _rolling_by_drag(one: HypothesisFit, sphere: SphereBetweenWalls) -> dict[str, tuple[float, float]]:
    """The um per revolution over the stated one, less 1, as a line over the sphere's drag: at 0, and per unit."""
    mean, covariance = one.unknowns("gain", "hindrance")
    near, per_near = one.observed.near, 1.0 / float(sphere.drag.max())
    line = np.array([[1.0, float(near.mean())], [0.0, -per_near]])
    stds = np.sqrt(np.diag(line @ covariance @ line.T))
    return dict(zip(ROLLING_BY_DRAG, zip((line @ mean).tolist(), stds.tolist(), strict=True), strict=True))


def _amplitude(mean: Floats, covariance: Floats) -> tuple[float, float]:
    """Amplitude of a wave with the unknowns (k,), and its standard deviation."""
    amplitude = float(np.hypot.reduce(mean))
    return amplitude, float(np.sqrt(mean @ covariance @ mean)) / max(amplitude, 1e-12)


def _words(values: Mapping[str, float], stds: Mapping[str, float], um_per_px: float, observed_s: float) -> list[str]:
    """Causes that are certain, and those that the observations could not tell apart."""
    words = []
    for name, (factor, least, less, more) in WORDS.items():
        value, std = values.get(name, 0.0), stds.get(name, 0.0)
        if abs(value) > max(SURE * std, least):
            words.append((less if value < 0.0 else more).format(with_error(factor * abs(value), factor * std)))
    if stds.get("um_per_rev_share", 0.0) > UNSURE:
        words.append(
            f"um per revolution they tell to {100.0 * stds['um_per_rev_share']:.0f} % only: a survey with other "
            "headings tells more"
        )
    words += _offset_words(values, stds, um_per_px)
    for name in values:
        if name.startswith("viscosity_"):
            words.append(f"{name.replace('_', ' ')} {values[name]:.3g} +- {stds[name]:.2g}")
    words += _in_time(values, stds, observed_s)
    # The size is that of random errors around zero mean; of walls that are off to one side it is the smaller part.
    if values["walls_px"] > max(SURE * stds["walls_px"], MOVED_PX):
        words.append(f"the walls seem off by {values['walls_px'] * um_per_px:.0f} um or more in places")
    return words


def with_obstacle(found: Findings, chip: Chip, obstacle: tuple[Obstacle, float] | None) -> Findings:
    """Add the place of an obstacle whose probability exceeds PROBABLE."""
    if obstacle is None or obstacle[1] <= PROBABLE:
        return found
    place = obstacle[0]
    x_um, y_um = place.column * chip.um_per_px, place.row * chip.um_per_px
    return Findings(
        (*found.names, "obstacle_x_um", "obstacle_y_um"),
        np.append(found.values, [x_um, y_um]),
        np.append(found.stds, 2 * [place.half_width_px * chip.um_per_px]),
        (f"a channel is partly blocked at ({x_um:.0f}, {y_um:.0f}) um", *found.words),
    )


def explained_by_pump(found: Findings, departure: Departure) -> bool:
    """True if a pump that pulsates is named, and a departure of the flow at that time would be one.

    A flow that wanders is no explanation: where nothing is known of the pump, any departure is a wander.
    """
    return departure.nats_in_time > NATS and any(word.startswith(PULSATION) for word in found.words)


def wanders(found: Findings) -> bool:
    """True if a wander of the flow is named."""
    return any(word.startswith(WANDER) for word in found.words)


def with_departure(found: Findings, departure: Departure, um_per_px: float) -> Findings:
    """Add a departure from all causes. A cause that a departure may have been taken for is not said beside it.

    A wander of the flow is said beside a departure in time, which may be the largest part of it.
    """
    hidden = tuple(words for words in TAKEN_FOR if not (departure.in_time and words == WANDER))
    x_um, y_um = um_per_px * departure.place_px
    std_um = um_per_px * departure.radius_px
    return Findings(
        (*found.names, "unexplained_x_um", "unexplained_y_um", "unexplained_share"),
        np.append(found.values, [x_um, y_um, departure.share]),
        np.append(found.stds, [std_um, std_um, departure.spread]),
        (departure.words(um_per_px), *(word for word in found.words if not word.startswith(hidden))),
    )


def _in_time(values: Mapping[str, float], stds: Mapping[str, float], observed_s: float) -> list[str]:
    """Sentences on changes in time: a stage that shakes, a pump, a flow that wanders."""
    words, shaking_hz = [], [float(name.split("_")[1]) for name in values if name.startswith(SHAKE)]
    words += [f"the image shakes at {hz:.2f} Hz" for hz in shaking_hz]
    for name, share in values.items():
        if not name.startswith("pump_") or share <= max(SURE * stds[name], PULSATES):
            continue
        hz = float(name.split("_")[1])
        if any(abs(hz - other) * observed_s < 1.0 for other in shaking_hz):
            continue  # what the frequency of the stage leaves of its motion
        by = f"by {with_error(100.0 * share, 100.0 * stds[name])} % at {hz:.2f} Hz"
        slow = hz * observed_s < PERIODS
        words.append(f"the flow changes {by}, with the pump or by place" if slow else f"{PULSATION} {by}")
    # A robot that passes each place once can not tell a slow change from one along the way.
    wander, wander_std = (100.0 * of.get("wander_share", 0.0) for of in (values, stds))
    if wander > 100.0 * WANDERS:
        words.append(f"{WANDER} in time, or by place along the way, by {with_error(wander, wander_std)} %")
    return words


def _offset_words(values: Mapping[str, float], stds: Mapping[str, float], um_per_px: float) -> list[str]:
    """That the chip lies elsewhere than the registration puts it, and on which side; nothing where that is not sure."""
    offset = np.array([values["offset_x_um"], values["offset_y_um"]])  # of the robot on the chip
    spread = np.array([stds["offset_x_um"], stds["offset_y_um"]])
    size = float(np.hypot(*offset))
    along = float(np.hypot(*(offset * spread))) / max(size, 1e-12)
    if size <= max(SURE * along, MOVED_PX * um_per_px):
        return []
    x, y = -offset
    sides = [
        f"{abs(x):.0f} um to the {'left' if x < 0.0 else 'right'}",
        f"{abs(y):.0f} um {'up' if y < 0.0 else 'down'}",
    ]
    return [f"the chip lies {with_error(size, along)} um from where the registration puts it ({', '.join(sides)})"]


def with_error(value: float, std: float) -> str:
    """A value and its standard deviation with as many digits as that has a meaning: '15.1 +- 0.2'."""
    digits = 0 if std >= 0.95 else 1 if std >= 0.095 else 2
    return f"{value:.{digits}f} +- {std:.{digits}f}"
