"""Effects, with their sizes, that make observations differ from the assumed flow besides boundary values and fluid.

With the measured flow y_i at x_i, the robot's own motion r_i as it is assumed, and the flow v:

    y_i = v(x_i) + dv/dx (offset - scale (x_i - c) - angle J (x_i - c)) + (scale + angle J) v + scale r_i
          + (gain + gain_k - hindrance (b_i - b) + stepping(|r_i|)) r_i + heading J r_i + rolling(t_i) r_i
          + sphere(v) + walls(x_i) + v p(t_i) + local(x_i) + noise

gain_k is what another robot, number k, rolls farther per revolution than the first one; rolling is of each robot.
stepping is what a robot near its step-out frequency f_c misses: beyond it, it follows 1 - sqrt(1 - (f_c / f)^2) of its
turns (Adler), and f_c is known to a fifth. It is a random walk over the speed, from FOLLOWS of the highest one on, less
its mean, which belongs to the gain, and of each robot. J turns from +x to +y, c is the mean of the places. b_i is the
drag of the side walls on a sphere of the robot's radius, relative to the largest one, and b its mean: the gain is that
of the robot where it was observed, and hindrance what differs nearer to or farther from a wall. sphere(v) is how a
sphere lags behind the flow, sphere_between_walls.py. Where the radius is not stated (older sessions), b_i = exp(-(d_i -
d) / (d / 2)) falls with the distance d_i to the wall, d is the least one that was observed, and the lag is carry b_i v
- curved d^2 / 6 lap v. p is a change of the whole flow in time: slow wander, and a spectral line. `local` is the error
of the grid. Each effect is linear in its unknowns around the flow and the registration in use, so the assimilation
repeats with those that it found.

Walls that are off by w pixels (one standard deviation, each wall on its own) change the width of a cell of the channels
by the fraction e = sqrt(2) w / width. In a channel at the same flow rate the mean speed changes by -e, the resistance
by -3 e (lubrication; Poiseuille between plates); beside a wall the whole profile moves with it, by w times the gradient
of the velocity. One size w belongs to all three, so the speeds that were observed in the middle of the channels tell
how far to trust the flow beside their walls, where no robot has been.

The median of a size is what is usual in a laboratory, the ln_std says how far that may be off: by a factor of 3 to 5,
so that the observations decide (evidence.py), and an effect that nothing asks for stays small.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from flowrec.core import Floats, cells_at
from flowrec.physics import ChannelWidths, SphereBetweenWalls, clearance_um
from flowrec.stages.refine.channel_cells import curvature
from flowrec.stages.refine.evidence import Effect
from flowrec.stages.refine.flow_model import FlowModel
from flowrec.stages.refine.observation_operator import ObservationOperator

# Median and ln_std of the size of each effect.
BOUNDARY = (1.0, 0.3)  # in the prior standard deviations of the settings
FLUID = (1.0, 0.02)  # viscosity, density, depth, shapes of the inlets, fraction of the grid's error: as stated
RESISTANCE = (0.05, 1.0)  # of a cell: a channel 3 % narrower than drawn has 9 % more
WALLS = (0.29, 0.8)  # px by which a wall is off: a wall somewhere in its pixel, 1 / sqrt(12)
WALLS_LONG = np.sqrt(0.5)  # of it, what extends over a cell: half of the variance; the rest over a channel's width
LOCAL = (1.0, 0.8)  # of the error of the grid that the model states
# px by which all walls are off, where they are: a quarter of a pixel to one, by the threshold of a segmentation
WALL_BIAS = (0.5, 0.6)
WALL_BIAS_NAME = "wall bias"
GAIN = (0.08, 1.3)  # um per revolution is known to a few per cent where it was calibrated, else to 15 %
# Of another robot, one value each: of a batch, of which one was calibrated, or of another kind.
OTHERS_GAIN = (0.2, 1.0)
HEADING = (0.01, 0.8)  # rad: coils and camera are aligned to half a degree
CURVED = (0.12, 0.8)  # of the part of Faxen's law that a sphere as large as the least distance to a wall would show
HINDRANCE = (0.05, 1.0)  # of the own motion, between the least distance to a wall and far from one
CARRY = (0.02, 0.4)  # of the flow, likewise: a sphere lags by few per cent until it nearly touches the wall
# Of the lag of a sphere of the stated radius (sphere_between_walls.py): a robot that the floor holds lags otherwise. In
# two simulated surveys on each of four chips the size 0.5 around no lag had smaller errors than 0.5 or 1 +- 0.5 of it.
SPHERE = (0.5, 0.3)
# Of the own motion, per unit of the drag of the side walls: a roller's floor has 2.2 to 3.4 times Stokes' drag at gaps
# of a tenth to a hundredth of its radius (Goldman, Cox and Brenner 1967), which the walls' drag adds to.
HELD = (0.3, 1.0)
# Of the flow, one value a tracer: between plates 0.27 (tracer_heights.py). In a deep channel less, with beads of other
# sizes and laws more. It changes over `HEIGHT_S`: a tracer settles, and its number may pass to another one. In 18
# surveys with 50 and 200 beads maps were 5.2 % off with 3 s, 5.4 with 10 s, 5.9 where it never changes.
HEIGHT = (0.3, 0.5)
HEIGHT_S = 3.0
# Of the own motion at the highest observed speed. With 0.05 maps of 27 surveys were as good, those in a flow that steps
# in time 10 % worse.
STEPPING = (0.02, 1.3)
FOLLOWS = 0.75  # of that speed, up to which a robot follows its field: with 0.5 likewise
OFFSET_PX = (0.3, 1.0)  # registration to a fraction of a pixel of the mask
SCALE = (0.006, 1.0)  # um per pixel of a camera
ANGLE = (0.004, 0.8)  # rad
WANDER = (0.02, 1.2)  # of the flow, over `WANDER_S`: a pump on a bench
WANDER_S = (2.0, 20.0)  # correlation times: one effect each
ROLLING = (0.02, 0.7)  # of the own motion: a roller's course and speed vary by that much, over `ROLLING_S`
ROLLING_S = 1.0  # correlation time: as long as a roller needs for some ten revolutions
LINE = (0.04, 1.3)  # amplitude of a spectral line
AS_STATED = 0.1  # of these sizes, for a chip that is as drawn and a robot and a camera that are as calibrated
_STATED = (
    *("resistance", "walls", "offset", "scale", "angle"),
    *("gain", "heading", "hindrance", "stepping", "carry", "curved", "sphere"),
)
# Of these sizes, where walls and registration were taken from an image (measure/wall_trace.py): 3 um are left of walls
# that were 12 um off. In ten simulated flights 0.3 of all had a smaller CRPS than 1, 0.15, and 0.3 without resistance.
AS_PICTURED = 0.3
_PICTURED = ("resistance", "walls", "offset", "scale", "angle")
DISTURBED = (3.0, 1.0)  # of a disturbance that was noticed, in typical stated standard deviations of an observation
NEIGHBOURHOOD_PX = 6.0  # over which the correlation of the model's local error falls to 1 / e
SLOWEST_HZ = 0.05  # of a line
LINE_STEP = 0.2  # of the frequencies that are tried, over the time that was observed: finer than its resolution
MOST_LINES = 400  # of them, for the time that it takes
LEAST_PERIODS = 0.5  # of a line in the time that was observed: less is a wander
FEWEST_FOR_LINE = 12  # observations: amplitude, phase and frequency on top of the flow
LINE_NAME = "line"
_HALF_PIXEL = 0.5 * np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])  # here, and to each side
NEAR_SHARE = 0.5  # of the least distance: over which hindrance falls to 1 / e


@dataclass(frozen=True, eq=False)  # no slots, for what is computed once
class _There:
    """Parts of the effects that follow from the places and times of the observations alone, whatever flows."""

    model: FlowModel
    operator: ObservationOperator  # on the fluid pixels of the model

    @cached_property
    def known(self) -> Floats:
        """(unknowns, n, 2) that boundary values and fluid add to the observations."""
        return self.operator.predict(self.model.known)

    @cached_property
    def resistance(self) -> Floats:
        """(cells, n, 2) that the resistances add to them."""
        return self.operator.predict(self.model.resistance)

    @cached_property
    def apart_px(self) -> Floats:
        """(n, n) distances."""
        return np.asarray(np.linalg.norm(self.operator.points[:, None] - self.operator.points, axis=-1))

    @cached_property
    def alike_in_place(self) -> Floats:
        """(2 n, 2 n) correlation over the width of a channel."""
        return _of_components(np.exp(-self.apart_px / self.model.channel_px))

    def alike_in_time(self, length_s: float) -> Floats:
        """(2 n, 2 n) correlation over a time."""
        assert self.operator.time_s is not None
        time_s = self.operator.time_s
        return _of_components(np.exp(-np.abs(time_s[:, None] - time_s) / length_s))

    @cached_property
    def stepping(self) -> Floats:
        """(2 n, 2 n) covariance of what each robot misses of its own motion besides the mean of that."""
        assert self.operator.rolled_um_s is not None
        own, robot = self.operator.rolled_um_s, self.operator.robot
        speed = np.hypot(*own.T)
        beyond = np.maximum(speed / max(float(speed.max()), 1e-9) - FOLLOWS, 0.0) / (1.0 - FOLLOWS)
        same = (robot[:, None] == robot).astype(np.float64)
        less_mean = np.eye(len(same)) - same / same.sum(axis=1)
        alike = less_mean @ (same * np.minimum(beyond[:, None], beyond)) @ less_mean.T
        return np.asarray(own.ravel()[:, None] * own.ravel() * _of_components(alike))

    @cached_property
    def local_error(self) -> Floats:
        """(2 n, 2 n) covariance of the model's own error: neighbours share it."""
        std = self.operator.predict(np.repeat(self.model.error_std[:, None], 2, axis=1))[:, 0]
        covariance = np.zeros((len(std), 2, len(std), 2))
        covariance[:, 0, :, 0] = covariance[:, 1, :, 1] = std[:, None] * std * np.exp(-self.apart_px / NEIGHBOURHOOD_PX)
        return covariance.reshape(2 * len(std), -1)


def _of_components(of_each: Floats) -> Floats:
    """(2 n, 2 n) of the components of observations, of which (n, n) is the same for both."""
    return np.repeat(np.repeat(of_each, 2, axis=0), 2, axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """The usable observations in the walls of one model, and what the effects need of each."""

    model: FlowModel
    operator: ObservationOperator  # on the fluid pixels of the model
    there: _There
    shifted: tuple[ObservationOperator, ...]  # half a pixel to the right, left, down, up
    cells: Floats  # (cells, n) weights of the cells there
    near: Floats  # (n,) b_i: 1 where walls hold the robot back most
    least_px: float  # least distance to a wall
    sphere: SphereBetweenWalls | None  # None: the robot's radius is not stated
    um_per_px: float
    stated: ObservationOperator  # where the registration puts the observations
    moved: Floats  # (n, 2) px from there to where the flow is read, by the registration in use
    usual: float = 1.0  # sizes of the effects in _STATED, over what is usual
    wall_mode: Floats | None = None  # (n, 2) see wall_bias.py; None: the walls have no bias

    def __post_init__(self) -> None:
        # A copy with another model or operator, by `replace`, must not keep what was computed with the one before.
        if self.there.model is not self.model or self.there.operator is not self.operator:
            object.__setattr__(self, "there", _There(self.model, self.operator))

    @classmethod
    def of(cls, model: FlowModel, operator: ObservationOperator, moved: Floats | None = None) -> Observed:
        """The observations of an operator, moved by (n, 2) px. Those in solid are predicted to be at rest."""
        mask = model.chip.mask
        stated, moved = operator, np.zeros_like(operator.points) if moved is None else moved
        operator = replace(operator, points=np.clip(operator.points + moved, 0.0, np.array(mask.shape[::-1]) - 1.0))
        here, *shifted = operator.beside(_HALF_PIXEL, model.expansion.wall_px, mask)
        clearance = np.minimum(clearance_um(mask, 1.0), np.float32(max(mask.shape)))
        distance = np.maximum(cells_at(operator.points, mask.shape).interpolate(clearance), 0.0)
        rolls = np.ones(len(distance)) if operator.tracer is None else (operator.tracer < 0.0).astype(np.float64)
        if rolls.any() and not rolls.all():  # a tracer is no sphere of the robot's radius
            distance = np.where(rolls > 0.0, distance, float(distance[rolls > 0.0].max()))
        least = max(float(distance.min()), 0.5)
        sphere = None
        if operator.radius_px is None:
            near = np.exp(-np.maximum(distance - least, 0.0) / (NEAR_SHARE * least))
        else:
            widths = ChannelWidths.of(mask, clearance).at(operator.points)
            sphere = SphereBetweenWalls.of(operator.radius_px, distance, widths)
            near = sphere.drag / float(sphere.drag.max())
        cells = model.cells[:, here.pixels[:, 0]].toarray()
        there = _There(model, here)
        return cls(model, here, there, tuple(shifted), cells, near, least, sphere, model.chip.um_per_px, stated, moved)

    def moved_by(self, registration: Floats) -> Floats:
        """(n, 2) px by which a registration (4,) moves the observations: offset x and y in px, scale, angle in rad."""
        away = self.away
        return np.asarray(registration[:2] - registration[2] * away - registration[3] * quarter_turn(away))

    def at(self, moved: Floats) -> Observed:
        """The observations (n, 2) px from where the stated registration puts them."""
        return replace(Observed.of(self.model, self.stated, moved), usual=self.usual, wall_mode=self.wall_mode)

    @property
    def away(self) -> Floats:
        """(n, 2) px from the mean of the places."""
        return np.asarray(self.stated.points - self.stated.points.mean(axis=0))

    def misfit(self, flow: Floats, in_use: Floats) -> Floats:
        """(n, 2) measured minus predicted from a flow (n, 2), for a registration without error.

        The flow is read where the registration in use has the observations; what this adds is taken off to first order,
        because the effects count from the stated registration.
        """
        added = np.einsum("an,anc->nc", self.moved.T, self._gradient(in_use)) if self.moved.any() else 0.0
        return np.asarray(self.operator.flow_um_s - self.operator.predict(flow) + added)

    def beyond_first_order(self, flow: Floats) -> Floats:
        """(n, 2) what the registration in use adds to the observations of a flow, but for its first order."""
        if not self.moved.any():
            return np.zeros_like(self.moved)
        first = np.einsum("an,anc->nc", self.moved.T, self._gradient(flow))
        return np.asarray(self.operator.predict(flow) - self.predict_stated(flow) - first)

    def predict_stated(self, flow: Floats) -> Floats:
        """(n, 2) a flow (n, 2) where the stated registration has the observations."""
        stated = self.stated.with_walls(self.model.expansion.wall_px).on_fluid(self.model.chip.mask)
        return stated.predict(flow)

    def _gradient(self, flow: Floats) -> Floats:
        """(2, n, 2) derivatives of a flow along x and y, um/s per px."""
        right, left, down, up = (one.predict(flow) for one in self.shifted)
        return np.stack([right - left, down - up])

    def effects(self, flow: Floats, line_hz: float | None) -> list[Effect]:
        """All effects around a flow (n, 2) of the model's pixels, with columns for the observations, x and y of each.

        The first have unknowns that belong to the field: boundary values, fluid, resistances, walls and their bias.
        """
        here, model = self.operator, self.model
        modes = [] if self.wall_mode is None else [self.wall_mode]
        v = here.predict(flow)
        gradient = self._gradient(flow)
        rolled, time_s = here.rolled_um_s, here.time_s
        own = np.zeros_like(v) if rolled is None else rolled
        away = self.away
        turned = quarter_turn(away)
        stretch = v + own - np.einsum("an,anc->nc", away.T, gradient)
        turn = quarter_turn(v) - np.einsum("an,anc->nc", turned.T, gradient)
        known, openings = self.there.known, len(model.chip.openings)
        found = [
            _effect("boundary", BOUNDARY, known[:openings]),
            _effect("fluid", FLUID, known[openings:]),
            _effect("resistance", RESISTANCE, self.there.resistance),
            replace(_effect("walls", WALLS, self._widening_flow(v)), kernel=self._beside_walls(v, gradient)),
            *(_effect(WALL_BIAS_NAME, WALL_BIAS, here.predict(mode[None])) for mode in modes),
            _effect("offset", OFFSET_PX, gradient),
            _effect("scale", SCALE, stretch[None]),
            _effect("angle", ANGLE, turn[None]),
            *self._transport_effects(v, flow),
            Effect("local", *LOCAL, np.zeros((0, v.size)), self.there.local_error),
        ]
        if rolled is not None:
            found += [
                _effect("gain", GAIN, own[None]),
                _effect("heading", HEADING, quarter_turn(own)[None]),
                _effect("hindrance", self._hindrance_size(), -((self.near - self.near.mean())[:, None] * own)[None]),
            ]
            found.append(Effect("stepping", *STEPPING, np.zeros((0, v.size)), self.there.stepping))
            others = np.unique(here.robot[here.robot > 0.0])
            if len(others):
                found.append(_effect("gain of others", OTHERS_GAIN, (here.robot == others[:, None])[:, :, None] * own))
        if time_s is not None:
            along = v.ravel()[:, None] * v.ravel()
            none = np.zeros((0, v.size))
            found += [
                Effect(f"wander {length:g} s", *WANDER, none, along * self.there.alike_in_time(length))
                for length in WANDER_S
            ]
            if rolled is not None:
                pushed = [(vectors.ravel()[:, None] * vectors.ravel()) for vectors in (own, quarter_turn(own))]
                alike = self.there.alike_in_time(ROLLING_S)
                if here.robot.any():
                    alike = alike * _of_components(here.robot[:, None] == here.robot)
                found.append(Effect("rolling", *ROLLING, none, sum(pushed) * alike))
            if line_hz is not None:
                found.append(_effect(LINE_NAME, LINE, waves(line_hz, time_s)[:, :, None] * v))
        noise = float(np.median(here.std_um_s))
        if here.tracer is not None and (here.tracer >= 0.0).any():
            same = _of_components((here.tracer[:, None] == here.tracer) & (here.tracer >= 0.0))
            alike = same if time_s is None else same * self.there.alike_in_time(HEIGHT_S)
            found.append(Effect("height", *HEIGHT, np.zeros((0, v.size)), v.ravel()[:, None] * v.ravel() * alike))
        found += [_effect(name, (DISTURBED[0] * noise, DISTURBED[1]), every) for name, every in here.disturbances]
        return [replace(effect, median=self._usual_share(effect.name) * effect.median) for effect in found]

    def _usual_share(self, name: str) -> float:
        """Size of an effect over what is usual, before any observation."""
        stated = self.usual if name in _STATED else 1.0
        return stated * AS_PICTURED if name in _PICTURED and self.model.chip.walls == "grey" else stated

    def _transport_effects(self, v: Floats, flow: Floats) -> list[Effect]:
        """Effects of a flow (n, 2), which is v (n, 2) at the observations, on a robot of finite size."""
        pixels = np.unique(self.operator.pixels)
        bent = np.zeros_like(flow)
        bent[pixels] = curvature(self.model.chip.mask, flow, pixels)
        laplacian = self.operator.predict(bent)
        if self.sphere is not None:
            return [_effect("sphere", SPHERE, (self.rolls * self.sphere.transport_slip(v, laplacian))[None])]
        return [
            _effect("carry", CARRY, -(self.rolls * self.near[:, None] * v)[None]),
            _effect("curved", CURVED, (self.least_px**2 / 6.0 * self.rolls * laplacian)[None]),
        ]

    @property
    def rolls(self) -> Floats:
        """(n, 1) 1 for observations of the robot, 0 for those of tracers."""
        tracer = self.operator.tracer
        return np.ones((self.operator.count, 1)) if tracer is None else (tracer[:, None] < 0.0).astype(np.float64)

    def _hindrance_size(self) -> tuple[float, float]:
        """Size of the hindrance of the own motion: median and ln_std."""
        return HINDRANCE if self.sphere is None else (HELD[0] * float(self.sphere.drag.max()), HELD[1])

    def _widening_flow(self, v: Floats) -> Floats:
        """(cells, n, 2) what walls that are a pixel off in a cell do to the flow v (n, 2), there and elsewhere."""
        both = 3.0 * self.there.resistance + self.cells[:, :, None] * v
        return np.asarray(-WALLS_LONG * self.model.widening[:, None, None] * both)

    def _beside_walls(self, v: Floats, gradient: Floats) -> Floats:
        """(2 n, 2 n) covariance of a profile that moves by a pixel and of what is shorter than a cell.

        `v` (n, 2) is the flow, `gradient` (2, n, 2) its derivatives, um/s per px.
        """
        wider = np.sqrt(1.0 - WALLS_LONG**2) * (self.model.widening @ self.cells)[:, None] * v
        flat = np.concatenate([gradient, wider[None]]).reshape(3, -1)
        return np.asarray((flat.T @ flat) * self.there.alike_in_place)


def waves(hz: float, time_s: Floats) -> Floats:
    """(2, n) cosine and sine of a line."""
    phase = 2.0 * np.pi * hz * time_s
    return np.stack([np.cos(phase), np.sin(phase)])


def lines_hz(time_s: Floats | None) -> Floats:
    """(k,) frequencies that observations at times (n,) could show: enough periods, and two observations in each."""
    if time_s is None or len(time_s) < FEWEST_FOR_LINE:
        return np.zeros(0)
    span = float(np.ptp(time_s))
    slowest, fastest = max(SLOWEST_HZ, LEAST_PERIODS / max(span, 1e-9)), 0.5 * (len(time_s) - 1) / max(span, 1e-9)
    if fastest <= slowest:
        return np.zeros(0)
    return np.arange(slowest, fastest, LINE_STEP / span)[:MOST_LINES]


def _effect(name: str, size: tuple[float, float], columns: Floats) -> Effect:
    return Effect(name, *size, np.ascontiguousarray(columns.reshape(len(columns), -1)))


def quarter_turn(vectors: Floats) -> Floats:
    """(n, 2) vectors turned by 90 degrees from +x to +y."""
    return np.stack([-vectors[:, 1], vectors[:, 0]], axis=1)
