"""Predictive check of a refined flow: whether observations depart from it by more than any cause that it knows.

A departure is searched for in windows of place (as wide as a channel), of time and of heading. With the weights g_i of
the observations in a window, the flow v_i there, and J a quarter turn, the alternative to the fitted model is

    y_i = model + g_i (a v_i + b J v_i),    a, b ~ N(0, s^2),

with the robot's own motion in place of v_i in windows of heading. Its Bayes factor is that of the linear model, a mean
over sizes s. What follows from no cause (wander of the flow, rolling, the grid's own error) counts with its usual size
at most: at any size it would explain anything. Residuals count up to CLIP standard deviations of the noise (Huber
1964), so an outlier alone is no departure.

Where the flow departs, the bars are at least a discrepancy (Kennedy and O'Hagan 2001): what was found in the window,
and everywhere else the root mean square of what was found in all windows, as a part of the flow or as a speed,
whichever is smaller. A robot that passes a place once can not tell a departure there from one at that time, so both are
said; one of the heading is of the robot, and no bar grows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from flowrec.core import Floats
from flowrec.stages.refine.causes import quarter_turn
from flowrec.stages.refine.evidence import gains_of_trials
from flowrec.stages.refine.hypothesis import HypothesisFit
from flowrec.stages.refine.noise import NOISE, averages

# Gain in ln evidence of a departure that is said: above that of 72 surveys in worlds that the model contains.
NATS = 8.0
SIZES = (0.1, 0.2, 0.4)  # of a departure, over the flow
CLIP = 3.5  # standard deviations of the noise
WIDTH = 0.7  # of a window of place, one standard deviation in channel widths
TIMES = 12  # windows of time, one standard deviation each, in the time that was observed
HEADINGS, HEADING_RAD = 8, 0.5  # windows of heading, and the width of each
FEWEST = 8  # observations
NO_CAUSE = ("wander", "rolling", "local")  # beginnings of the names of effects that follow from no cause
SIDES = (
    *("to the right", "down and to the right", "down", "down and to the left"),
    *("to the left", "up and to the left", "up", "up and to the right"),
)
UNEXPLAINED = "nothing it knows explains"


@dataclass(frozen=True, slots=True, eq=False)
class Departure:
    """A window in which the observations contradict the fitted model.

    Attributes
    ----------
    nats : gain in ln evidence by it.
    nats_in_time : likewise of the best window of time.
    share : part of the flow, or of the own motion, by which the observations differ from the model.
    spread, spread_um_s : root mean square of such parts over all windows, of those in which something was found.
    place_px : (2,) mean of the places in the window.
    radius_px : standard deviation of a window of place.
    when_s : mean of the times in the window, None: times are not stated.
    heading_rad : of a window of heading; None: it is one of place or time.
    """

    nats: float
    nats_in_time: float
    share: float
    spread: float
    spread_um_s: float
    place_px: Floats
    radius_px: float
    when_s: float | None
    heading_rad: float | None

    @property
    def in_time(self) -> bool:
        """True if the window is one of time."""
        return self.nats == self.nats_in_time

    def least_variance(self, points_px: Floats, flow: Floats) -> Floats:
        """(n, 1) least variance of the components of a flow (n, 2) at points (n, 2)."""
        if self.heading_rad is not None:
            return np.zeros((len(flow), 1))
        window = np.exp(-0.5 * ((points_px - self.place_px) ** 2).sum(axis=1) / self.radius_px**2)
        speed = np.hypot(*flow.T)
        anywhere = np.minimum(self.spread * speed, self.spread_um_s)
        return np.asarray(np.maximum(anywhere, self.share * window * speed)[:, None] ** 2)

    def words(self, um_per_px: float) -> str:
        """One sentence."""
        by = f"{100.0 * self.share:.0f} %"
        x, y = um_per_px * self.place_px
        if self.heading_rad is not None:
            side = SIDES[round(self.heading_rad / (0.25 * np.pi)) % len(SIDES)]
            return f"{UNEXPLAINED} how the robot moves when it heads {side}: {by} otherwise than elsewhere"
        when = "" if self.when_s is None else f" at {self.when_s:.1f} s"
        return f"{UNEXPLAINED} the flow at ({x:.0f}, {y:.0f}) um{when}: it differs by {by} from the map"


def find_departure(found: HypothesisFit) -> Departure | None:
    """The departure of most evidence; None where there is none, or for too few observations."""
    here = found.observed.operator
    if here.count < FEWEST:
        return None
    average = averages(found.robust, here)
    covariance, y = _without_catch_alls(found, average)
    each = average[::2, ::2]
    points = each @ here.points
    flow = (average @ here.predict(found.in_use).ravel()).reshape(-1, 2)
    radius = WIDTH * found.observed.model.channel_px
    apart = np.linalg.norm(points[:, None] - points, axis=-1)
    windows = [(np.exp(-0.5 * (apart / radius) ** 2), flow)]
    time_s = None if here.time_s is None else each @ here.time_s
    if time_s is not None:
        std_s = max(float(np.ptp(time_s)) / TIMES, 1e-9)
        windows.append((np.exp(-0.5 * ((time_s[:, None] - time_s) / std_s) ** 2), flow))
    headings = 2.0 * np.pi * np.arange(HEADINGS) / HEADINGS
    if here.rolled_um_s is not None:
        own = (average @ here.rolled_um_s.ravel()).reshape(-1, 2)
        off = np.cos(np.arctan2(own[:, 1], own[:, 0]) - headings[:, None]) - 1.0
        windows.append((np.exp(off / HEADING_RAD**2), own))
    departures = []
    for weights, vectors in windows:
        nats, parts = _gains(weights, vectors, covariance, y)
        best = int(np.argmax(nats))
        mean = weights[best] / weights[best].sum()
        square = (parts[0] ** 2).sum(axis=1) * (nats > 0.5 * NATS)
        power = (weights @ (vectors**2).sum(axis=1)) / weights.sum(axis=1)
        departures.append(
            Departure(
                nats=float(nats[best]),
                nats_in_time=-np.inf,
                share=float(np.hypot(*parts[1, best])),
                spread=float(np.sqrt(square.mean())),
                spread_um_s=float(np.sqrt((square * power).mean())),
                place_px=mean @ points,
                radius_px=radius,
                when_s=None if time_s is None else float(mean @ time_s),
                heading_rad=float(headings[best]) if vectors is not flow else None,
            )
        )
    in_time = departures[1].nats if time_s is not None else -np.inf
    most = max(departures, key=lambda one: one.nats)
    return replace(most, nats_in_time=in_time) if most.nats > NATS else None


def _gains(weights: Floats, vectors: Floats, covariance: Floats, y: Floats) -> tuple[Floats, Floats]:
    """(k,) gain of a departure in each of k windows (k, n), and (2, k, 2) its most probable size along and across.

    `y` (2, m) are the observations with clipped residuals, which decide, and as they are.
    """
    columns = (weights[:, None, :, None] * np.stack([vectors, quarter_turn(vectors)])).reshape(len(weights), 2, -1)
    inverse = np.linalg.inv(covariance)
    precision = columns @ inverse @ columns.transpose(0, 2, 1) + np.eye(2) / max(SIZES) ** 2
    parts = np.stack([np.linalg.solve(precision, (columns @ (inverse @ one))[..., None])[..., 0] for one in y])
    return gains_of_trials(columns, covariance, y[0], SIZES) - np.log(len(SIZES)), parts


def _without_catch_alls(found: HypothesisFit, average: Floats) -> tuple[Floats, Floats]:
    """Covariance (m, m) of the observations by causes and noise; they (2, m), clipped and as they are."""
    evidence, mode = found.evidence, found.sizes.mode
    names = [effect.name for effect in evidence.effects]
    noise = names.index(NOISE[0])
    own = np.exp(2.0 * mode[noise]) * evidence.effects[noise].matrix
    left = own @ np.linalg.solve(evidence.covariance(mode), evidence.y)
    # Outliers have been given a wide noise: here all have the noise of the others, as it was found.
    factor = max(1.0, found.robust.factor * float(np.exp(mode[noise])))
    stated = factor**2 * (average * np.repeat(found.robust.variance, 2)) @ average.T
    std = np.sqrt(np.diag(stated))
    covariance = evidence.noise + stated
    for effect, ln_size in zip(evidence.effects, mode, strict=True):
        if effect.name != NOISE[0]:
            most = np.log(effect.median) if effect.name.startswith(NO_CAUSE) else np.inf
            covariance = covariance + np.exp(2.0 * min(ln_size, most)) * effect.matrix
    return covariance, np.stack([evidence.y - left + np.clip(left, -CLIP * std, CLIP * std), evidence.y])
