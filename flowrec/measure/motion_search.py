"""Search for the part of a coil log that a movie shows: correlation of whitened motion over all offsets and rates.

Both the positions and the log's turns pass through the filter of whitening.py, so the slow flow that carries the
robot counts little and a change of the command counts much. The correlation is that of complex numbers x + iy: the
log's heading axes may be turned against the chip's by any angle, or mirrored. One FFT gives all offsets of one rate.

The same search in the log played backwards, which has nothing to do with the movie but moves as much, says how large a
correlation is by chance.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from flowrec.stages import Flags, Floats, NoiseModel, whiten

# (n,) times of the log in s to (n, 2) revolutions along x and y since its first row.
Turns = Callable[[Floats], Floats]

_LEAST_OVERLAP = 0.5  # of the shorter of movie and log
_RATE_STEP = 0.6  # frames by which the ends of the movie move at most between two rates of the search
_MOST_RATES = 1500
_NULL_RATES = 24
_CLIP = 5.0  # times the whitened motion that 90 % of the frames do not exceed
_KEPT = 24  # candidates of each search, best first
_TAIL = 0.1  # fraction of the chance correlations that the exponential tail is fitted to


@dataclass(frozen=True, slots=True)
class Candidate:
    """A place in the log. Time of the log = offset_s + rate * time of the movie."""

    offset_s: float
    rate: float
    mirrored: bool
    r2: float  # fraction of the whitened motion that the log explains here


@dataclass(frozen=True, slots=True)
class SearchResult:
    """Candidates, best first; none where the log has no turns."""

    candidates: tuple[Candidate, ...]
    second_r2: float  # best that is neither near the first one in time nor in rate
    p_value: float  # probability that a log of another run reaches the first one's r2 somewhere in the search


@dataclass(frozen=True, slots=True)
class SearchRange:
    """Bounds of the search: offsets at the middle of the movie, in s of the log less s of the movie, and rates."""

    first_offset_s: float = -math.inf
    last_offset_s: float = math.inf
    least_rate: float = 1.0
    largest_rate: float = 1.0


def search(
    time_s: Floats,
    positions_um: Floats,
    flags: Flags,
    noise: NoiseModel,
    turns: Turns,
    log_span_s: tuple[float, float],
    within: SearchRange,
) -> SearchResult:
    """Candidates for the place of a movie in a log.

    Parameters
    ----------
    time_s, positions_um, flags : (n,), (n, 2) and (n,), see whitening.py.
    turns, log_span_s : the log, and its first and last time.
    """
    motion = _Motion.of(time_s, whiten(time_s, positions_um, flags, noise), flags)
    rates = _rates(motion, within)
    chances: list[float] = []
    found: list[Candidate] = []
    peaks_per_rate: list[int] = []
    null_rates = set(np.linspace(0, len(rates) - 1, min(_NULL_RATES, len(rates))).astype(int).tolist())
    begin, end = log_span_s
    for index, rate in enumerate(rates):
        surface = _Surface.of(motion, noise, turns, log_span_s, rate)
        found += surface.candidates(within)
        if index in null_rates:
            peaks_per_rate.append(surface.count(within))
            backwards = _Surface.of(motion, noise, lambda at: turns(begin + end - at), log_span_s, rate)
            chances += backwards.peaks().tolist()
    found.sort(key=lambda each: -each.r2)
    if not found or found[0].r2 <= 0.0:
        return SearchResult((), 0.0, 1.0)
    best = found[0]
    apart = [each.r2 for each in found if _apart(each, best, motion)]
    searched = len(rates) * float(np.mean(peaks_per_rate))
    kept: list[Candidate] = []
    for each in found:
        if all(_apart(each, other, motion) or each.mirrored != other.mirrored for other in kept):
            kept.append(each)
        if len(kept) == _KEPT:
            break
    return SearchResult(tuple(kept), max(apart, default=0.0), _p_value(best.r2, np.array(chances), searched))


@dataclass(frozen=True, slots=True)
class _Motion:
    """Whitened motion on the grid of the frames."""

    middle_s: float
    first_s: float
    step_s: float
    motion: NDArray[np.complex128]  # (n,)
    present: Floats  # (n,) 1 where there is a frame

    @classmethod
    def of(cls, time_s: Floats, white: Floats, flags: Flags) -> _Motion:
        step_s = float(np.median(np.diff(time_s)))
        at = np.rint((time_s - time_s[0]) / step_s).astype(int)
        motion, present = np.zeros(at[-1] + 1, np.complex128), np.zeros(at[-1] + 1)
        used = np.any(white != 0.0, axis=1)
        given = white[used, 0] + 1j * white[used, 1]
        # Clipped, so that a few wrong positions do not outweigh the motion.
        size = np.abs(given)
        limit = _CLIP * float(np.quantile(size, 0.9)) if size.size else 0.0
        np.add.at(motion, at[used], given * np.minimum(1.0, limit / np.maximum(size, 1e-300)))
        present[at[used]] = 1.0
        return cls(0.5 * float(time_s[0] + time_s[-1]), float(time_s[0]), step_s, motion, present)

    @property
    def duration_s(self) -> float:
        return (len(self.motion) - 1) * self.step_s


@dataclass(frozen=True, slots=True)
class _Surface:
    """Correlations at all offsets, for one rate."""

    rate: float
    offsets_s: Floats  # (k,) at the middle of the movie
    r2: Floats  # (2, k): axes as they are, and mirrored
    motion: _Motion

    @classmethod
    def of(cls, motion: _Motion, noise: NoiseModel, turns: Turns, span_s: tuple[float, float], rate: float) -> _Surface:
        n, step = len(motion.motion), motion.step_s * rate
        begin, end = span_s
        overlap = max(int(_LEAST_OVERLAP * min(n, (end - begin) / step)), 3)
        # The grid starts so much before the log that the movie overlaps it by `overlap` frames at the first offset.
        first = begin - (n - overlap) * step
        lags = max(int((end - begin) / step) + n - 2 * overlap, 1)
        at = first + step * np.arange(lags + n - 1)
        # The log's rows last on after its end and the field is off before it: motion in neither is of the log.
        given = np.where(at <= end, 1.0, 0.0)
        steady = np.zeros(len(at), np.int8)
        white = whiten(motion.step_s * np.arange(len(at), dtype=np.float64), turns(np.minimum(at, end)), steady, noise)
        rolled = (white[:, 0] + 1j * white[:, 1]) * given
        size = fft.next_fast_len(len(at) + n)
        of_motion, of_rolled = fft.fft(motion.motion, size), fft.fft(rolled, size)
        straight = fft.ifft(np.conj(of_motion) * of_rolled)[:lags]
        mirrored = fft.ifft(np.conj(fft.fft(np.conj(motion.motion), size)) * of_rolled)[:lags]
        energy = fft.irfft(np.conj(fft.rfft(motion.present, size)) * fft.rfft(np.abs(rolled) ** 2, size), size)[:lags]
        moved = float((np.abs(motion.motion) ** 2).sum())
        floor = 1e-9 * max(float(energy.max()), 1e-300)
        r2 = np.abs(np.stack([straight, mirrored])) ** 2 / (np.maximum(energy, floor) * max(moved, 1e-300))
        r2[:, energy <= floor] = 0.0
        shifts = first + step * np.arange(lags) - rate * motion.first_s  # offset at movie time 0
        offsets_s: Floats = np.asarray(shifts + (rate - 1.0) * motion.middle_s, np.float64)
        return cls(rate, offsets_s, np.asarray(np.minimum(r2, 1.0), np.float64), motion)

    def _inside(self, within: SearchRange) -> NDArray[np.bool_]:
        slack = 0.5 * self.motion.step_s * self.rate
        return (self.offsets_s >= within.first_offset_s - slack) & (self.offsets_s <= within.last_offset_s + slack)

    def _is_peak(self) -> NDArray[np.bool_]:
        padded = np.pad(self.r2, ((0, 0), (1, 1)))
        return (self.r2 > 0.0) & (self.r2 >= padded[:, :-2]) & (self.r2 >= padded[:, 2:])

    def peaks(self) -> Floats:
        """Local maxima over the offsets."""
        return self.r2[self._is_peak()]

    def count(self, within: SearchRange) -> int:
        """Number of local maxima in the searched range."""
        return int((self._is_peak() & self._inside(within)).sum())

    def candidates(self, within: SearchRange) -> list[Candidate]:
        inside = self._is_peak() & self._inside(within)
        r2 = np.where(inside, self.r2, 0.0)
        best = np.argsort(-r2, axis=None)[:_KEPT]
        result = []
        for mirror, lag in zip(*np.unravel_index(best, r2.shape), strict=True):
            if r2[mirror, lag] > 0.0:
                offset = float(self.offsets_s[lag]) - (self.rate - 1.0) * self.motion.middle_s
                result.append(Candidate(offset, self.rate, bool(mirror), float(r2[mirror, lag])))
        return result


def _rates(motion: _Motion, within: SearchRange) -> list[float]:
    """Rates in equal ratios, so that neighbours differ by less than a frame at the ends of the movie; 1 is one."""
    low, high = math.log(within.least_rate), math.log(within.largest_rate)
    if high <= low:
        return [within.least_rate]
    step = max(_RATE_STEP / max(len(motion.motion) / 2, 1), (high - low) / _MOST_RATES)
    if low <= 0.0 <= high:
        counts = np.arange(math.ceil(low / step), math.floor(high / step) + 1)
        return np.exp(step * counts).tolist()  # type: ignore[no-any-return]
    return np.exp(np.arange(low, high, step)).tolist()  # type: ignore[no-any-return]


def _apart(one: Candidate, other: Candidate, motion: _Motion) -> bool:
    """True if two candidates place the middle of the movie at different times of the log, or differ much in rate."""
    middle = motion.middle_s
    gap_s = abs(one.offset_s + one.rate * middle - other.offset_s - other.rate * middle)
    return gap_s > 0.25 or abs(one.rate - other.rate) * motion.duration_s > 1.0


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
