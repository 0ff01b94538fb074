"""Temporary motion of the image or the robot that no flow causes: a shaking stage, and a robot that was held.

Both add a velocity to the observations that follows from time alone, so no flow and no place in the chip explains it.

- A stage that shakes at one frequency adds its velocity to every observation: a spectral line along x and y. Where the
  observations scatter more than they state, the frequency that explains most is found by the evidence (as that of the
  pump in hypothesis.py, which multiplies the flow instead).
- A robot that does not follow its field for a moment (step-out, a sticky spot of the floor) is seen in a few successive
  observations, which are near each other also in space: an obstacle there could explain them as well.
"""

from __future__ import annotations

import numpy as np

from flowrec.core import Floats
from flowrec.stages.refine.evidence import EffectModel, Sizes, gains_of_trials
from flowrec.stages.refine.observation_operator import Disturbance

SHAKE = "shake"
HELD_BACK = "held back"
FEWEST = 16  # observations: frequency, amplitude and phase along two axes on top of the flow
SLOWEST_HZ, FASTEST_HZ = 0.5, 15.0  # slower is a wander; above half the rate of a usual camera the image shows an alias
STEP = 0.2  # of the frequencies that are tried, over the time that was observed: finer than its resolution
MOST = 2000  # frequencies, which bounds the time of the search in a long run
TRIALS = (1.0, 3.0, 10.0)  # amplitudes at which frequencies are compared, in typical standard deviations of the noise
ALIKE = 1.0  # in ln evidence
# Assumptions: an observation every fifth of a second is usual, and a robot that slips does so for a second or less.
STRETCH_S = 0.6  # observations of one stretch of time follow each other at least so soon
FADES_S = 0.15  # by which such a stretch ends softly


def shaking(hz: float, time_s: Floats) -> Disturbance:
    """A stage that shakes at a frequency, seen at times (n,)."""
    phase = 2.0 * np.pi * hz * time_s
    return f"{SHAKE} {hz:.2f} hz", _along_both(np.stack([np.cos(phase), np.sin(phase)]))


def held_back(near: Floats, time_s: Floats) -> Disturbance | None:
    """A robot that was held in the stretches of time in which observations are `near` (n,); None for no observation."""
    times = time_s[near]
    if not len(times):
        return None
    stretches = np.split(times, np.flatnonzero(np.diff(times) > STRETCH_S) + 1)
    waves = []
    for stretch in stretches:
        beyond = np.maximum(np.maximum(stretch[0] - time_s, time_s - stretch[-1]), 0.0)
        soft = np.exp(-0.5 * (beyond / FADES_S) ** 2)
        # A part that is the same all the while, one that comes and goes, and one that changes sign.
        place = np.clip((time_s - stretch[0]) / max(float(np.ptp(stretch)), 1e-9), 0.0, 1.0)
        waves += [soft, soft * np.sin(np.pi * place), soft * np.cos(np.pi * place)]
    return HELD_BACK, _along_both(np.stack(waves))


def frequencies_hz(time_s: Floats | None) -> Floats:
    """(k,) at which a stage may shake that observations at times (n,) show."""
    if time_s is None or len(time_s) < FEWEST:
        return np.zeros(0)
    return np.arange(SLOWEST_HZ, FASTEST_HZ, STEP / max(float(np.ptp(time_s)), 1e-9))[:MOST]


def likeliest_hz(
    evidence: EffectModel, sizes: Sizes, average: Floats, time_s: Floats, noise_um_s: float
) -> float | None:
    """The frequency of a stage that explains most of what other effects leave; None where none could be seen.

    `average` (m, 2 n) makes the values of the evidence of observations at times (n,) with a typical noise.
    """
    frequencies = frequencies_hz(time_s)
    if not len(frequencies):
        return None
    scaled = zip(evidence.effects, sizes.mode, strict=True)
    base = evidence.noise + sum(np.exp(2.0 * ln_size) * effect.matrix for effect, ln_size in scaled)
    columns = np.stack([shaking(float(hz), time_s)[1].reshape(4, -1) @ average.T for hz in frequencies])
    gains = gains_of_trials(columns, base, evidence.y, [trial * noise_um_s for trial in TRIALS])
    # Of aliases, which explain the same, the slowest.
    peak = (gains >= np.append(gains[1:], -np.inf)) & (gains >= np.append(-np.inf, gains[:-1]))
    return float(frequencies[np.flatnonzero(peak & (gains > gains.max() - ALIKE))[0]])


def _along_both(waves: Floats) -> Floats:
    """(2 k, n, 2) waves (k, n) along x, then along y."""
    return np.concatenate([waves[:, :, None] * axis for axis in np.eye(2)])
