"""Search for the part of a coil log that a movie shows: correlation of whitened motion over all offsets and rates.

Both the positions and the log's turns pass through the filter of whitening.py, so the slow flow that carries the
robot counts little and a change of the command counts much. The correlation is that of complex numbers x + iy: the
log's heading axes may be turned against the chip's by any angle, or mirrored. One FFT gives all offsets of one rate.

The same search in the log played backwards, which has nothing to do with the movie but moves as much, says how large a
correlation is by chance.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy import fft

from flowrec.core import Floats
from flowrec.measure.motion_regression import TrackRegression, Turns
from flowrec.stages import whiten

_LEAST_OVERLAP = 0.5  # of the shorter of movie and log
_RATE_STEP = 0.6  # frames by which the ends of the movie move at most between two rates of the search
_MOST_RATES = 1500  # in the search, which bounds its time for a long movie
_NULL_RATES = 24  # of them, at which the null distribution is computed
_CLIP = 5.0  # times the whitened motion that 90 % of the frames do not exceed
_KEPT = 24  # candidates of each search, best first
_TAIL = 0.1  # fraction of the chance correlations that the exponential tail is fitted to


class Candidate(NamedTuple):
    """A place in the log. Time of the log = offset_s + rate * time of the movie."""

    offset_s: float
    rate: float
    mirrored: bool
    r2: float  # fraction of the whitened motion that the log explains here


class SearchRange(NamedTuple):
    """Bounds of the search: offsets at the middle of the movie, in s of the log less s of the movie, and rates."""

    first_offset_s: float = -math.inf
    last_offset_s: float = math.inf
    least_rate: float = 1.0
    largest_rate: float = 1.0


def search(
    track: TrackRegression, log_span_s: tuple[float, float], within: SearchRange
) -> tuple[list[Candidate], float]:
    """Candidates for the place of a movie in a log, best first; none where the log has no turns.

    `log_span_s`: first and last time of the log. Returns the candidates, and the probability that a log of another run
    reaches the first one's r2 somewhere in the search.
    """
    motion, turns = _Motion(track), track.turns
    rates = _rates(motion, within)
    chances: list[float] = []
    found: list[Candidate] = []
    peaks_per_rate: list[int] = []
    null_rates = set(np.linspace(0, len(rates) - 1, min(_NULL_RATES, len(rates))).astype(int).tolist())
    begin, end = log_span_s
    for index, rate in enumerate(rates):
        offsets_s, r2 = _peaks(motion, turns, log_span_s, rate)
        slack_s = 0.5 * motion.step_s * rate
        inside = (offsets_s >= within.first_offset_s - slack_s) & (offsets_s <= within.last_offset_s + slack_s)
        r2 = np.where(inside, r2, 0.0)
        for mirror, lag in zip(*np.unravel_index(np.argsort(-r2, axis=None)[:_KEPT], r2.shape), strict=True):
            if r2[mirror, lag] > 0.0:
                offset_s = float(offsets_s[lag]) - (rate - 1.0) * motion.middle_s
                found.append(Candidate(offset_s, rate, bool(mirror), float(r2[mirror, lag])))
        if index in null_rates:
            peaks_per_rate.append(int((r2 > 0.0).sum()))
            _, by_chance = _peaks(motion, lambda at: turns(begin + end - at), log_span_s, rate)
            chances += by_chance[by_chance > 0.0].tolist()
    if not found:
        return [], 1.0
    found.sort(key=lambda each: -each.r2)
    kept: list[Candidate] = []
    for each in found:
        if all(_apart(each, other, motion) or each.mirrored != other.mirrored for other in kept):
            kept.append(each)
        if len(kept) == _KEPT:
            break
    return kept, _p_value(found[0].r2, np.array(chances), len(rates) * float(np.mean(peaks_per_rate)))


class _Motion:
    """Whitened motion on the grid of the frames.

    Attributes
    ----------
    motion : (n,).
    present : (n,) 1 where there is a frame.
    """

    def __init__(self, track: TrackRegression) -> None:
        time_s, white = track.time_s, track.whiten(track.positions_um)
        self.noise, self.middle_s, self.first_s = track.noise, track.middle_s, float(time_s[0])
        self.step_s = float(np.median(np.diff(time_s)))
        at = np.rint((time_s - time_s[0]) / self.step_s).astype(int)
        self.motion, self.present = np.zeros(at[-1] + 1, np.complex128), np.zeros(at[-1] + 1)
        used = np.any(white != 0.0, axis=1)
        given = white[used, 0] + 1j * white[used, 1]
        # Clipped, so that a few wrong positions do not outweigh the motion.
        size = np.abs(given)
        limit = _CLIP * float(np.quantile(size, 0.9)) if size.size else 0.0
        np.add.at(self.motion, at[used], given * np.minimum(1.0, limit / np.maximum(size, 1e-300)))
        self.present[at[used]] = 1.0


def _peaks(motion: _Motion, turns: Turns, span_s: tuple[float, float], rate: float) -> tuple[Floats, Floats]:
    """Offsets (k,) at the middle of the movie for one rate, and the local maxima (2, k) of r2 there; 0 elsewhere.

    The first row is of the log's axes as they are, the second one of mirrored ones.
    """
    n, step = len(motion.motion), motion.step_s * rate
    begin, end = span_s
    overlap = max(int(_LEAST_OVERLAP * min(n, (end - begin) / step)), 3)
    # The grid starts so much before the log that the movie overlaps it by `overlap` frames at the first offset.
    first = begin - (n - overlap) * step
    lags = max(int((end - begin) / step) + n - 2 * overlap, 1)
    at = first + step * np.arange(lags + n - 1)
    steady = np.zeros(len(at), np.int8)
    white = whiten(
        motion.step_s * np.arange(len(at), dtype=np.float64), turns(np.minimum(at, end)), steady, motion.noise
    )
    # The log's rows last on after its end and the field is off before it: motion in neither is of the log.
    rolled = (white[:, 0] + 1j * white[:, 1]) * np.where(at <= end, 1.0, 0.0)
    size = fft.next_fast_len(len(at) + n)
    of_rolled = fft.fft(rolled, size)
    products = [
        fft.ifft(np.conj(fft.fft(each, size)) * of_rolled)[:lags] for each in (motion.motion, np.conj(motion.motion))
    ]
    energy = fft.irfft(np.conj(fft.rfft(motion.present, size)) * fft.rfft(np.abs(rolled) ** 2, size), size)[:lags]
    moved = float((np.abs(motion.motion) ** 2).sum())
    floor = 1e-9 * max(float(energy.max()), 1e-300)
    r2 = np.abs(np.stack(products)) ** 2 / (np.maximum(energy, floor) * max(moved, 1e-300))
    r2[:, energy <= floor] = 0.0
    r2 = np.minimum(r2, 1.0)
    beside = np.pad(r2, ((0, 0), (1, 1)))
    shifts_s = first + step * np.arange(lags) - rate * motion.first_s  # offset at movie time 0
    peak = (r2 >= beside[:, :-2]) & (r2 >= beside[:, 2:])
    return np.asarray(shifts_s + (rate - 1.0) * motion.middle_s, np.float64), np.where(peak, r2, 0.0)


def _rates(motion: _Motion, within: SearchRange) -> list[float]:
    """Rates in equal ratios, so that neighbours differ by less than a frame at the ends of the movie; 1 is one."""
    low, high = math.log(within.least_rate), math.log(within.largest_rate)
    if high <= low:
        return [within.least_rate]
    step = max(_RATE_STEP / max(len(motion.motion) / 2, 1), (high - low) / _MOST_RATES)
    if low <= 0.0 <= high:
        counts = np.arange(math.ceil(low / step), math.floor(high / step) + 1)
        return np.exp(step * counts).tolist()
    return np.exp(np.arange(low, high, step)).tolist()


def _apart(one: Candidate, other: Candidate, motion: _Motion) -> bool:
    """True if two candidates place the middle of the movie at different times of the log, or differ much in rate."""
    middle = motion.middle_s
    gap_s = abs(one.offset_s + one.rate * middle - other.offset_s - other.rate * middle)
    duration_s = (len(motion.motion) - 1) * motion.step_s
    return gap_s > 0.25 or abs(one.rate - other.rate) * duration_s > 1.0


def _p_value(r2: float, chances: Floats, searched: float) -> float:
    """Probability of r2 among `searched` correlations by chance; -log(1 - r2) of those has an exponential tail."""
    if len(chances) < 10:
        return 1.0
    values = -np.log1p(-np.minimum(chances, 1.0 - 1e-12))
    threshold = float(np.quantile(values, 1.0 - _TAIL))
    excess = float((values[values > threshold] - threshold).mean()) if (values > threshold).any() else 0.0
    value = -math.log1p(-min(r2, 1.0 - 1e-12))
    if value <= threshold:
        return 1.0
    single = _TAIL * math.exp(-(value - threshold) / excess) if excess > 0.0 else 0.0
    return float(-math.expm1(searched * math.log1p(-single)))
