"""The pump as a measurement: the flow of the map follows a measured flow rate or pressure from tick to tick.

Without inertia a Newtonian flow between outlets of one pressure is proportional to the speed at its inlets, so that of
one pump's flow no new solution is needed: u(x, t) = r(t) u_0(x), where r is the measured value over the one at which
the inlets have the speeds that the chip states, and u_0 the map, assumed or refined. Observations are divided by r, so
that a refinement sees a steady flow; the error of the measurement is added to theirs.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from flowrec.core import (
    NS_PER_S,
    PUMP,
    SAMPLES,
    STREAMS,
    Estimate,
    Floats,
    FlowField,
    Observations,
    PumpShare,
    Range,
    Samples,
    StreamStates,
    Tick,
    UsageError,
    nanoseconds,
    seconds,
)
from flowrec.physics import Chip
from flowrec.stages.estimation.kalman import memory_s, newest_share
from flowrec.stages.estimation.superposition import Superposition, at_share

_SLOW_S = 5.0  # memory of the mean that plans are made with
_REYNOLDS = 1.0  # above it a flow is not proportional to the speed at its inlets
_LEAST = 0.02  # of the share; a flow that nearly stands still says nothing of the flow at the nominal one
_MARKS = 60  # of the integral of the share that are kept


@dataclass(frozen=True, slots=True)
class PumpFollower:
    """A measured flow rate or pressure of the pump that feeds all inlets, or of one at each; the map's flow follows."""

    channel: str = ""  # stream and channel that measure it, such as pump/flow; '': nothing does
    # value of the channel, in its unit, at which the inlets have the speeds that the chip states
    nominal: Annotated[float, Range(1e-12, 1e12)] = 1.0
    # channel of each inlet, in the order of the chip's openings, where each has a pump of its own; instead of `channel`
    inlets: tuple[str, ...] = ()
    # values of these channels at the speeds that the chip states; []: `nominal` for all
    nominals: tuple[Annotated[float, Range(1e-12, 1e12)], ...] = ()
    error_share: Annotated[float, Range(0.0, 1.0)] = 0.02  # standard deviation of the measured value, as a ratio
    delay_s: Annotated[float, Range(0.0, 60.0)] = 0.0  # time from a change of the flow to the sample that shows it
    smoothing_s: Annotated[float, Range(0.0, 60.0)] = 0.05  # memory of the mean over samples

    def refuse_unfit(self, chip: Chip, streams: Collection[str], *, inertia: bool, tracers: bool) -> None:
        """Raise UsageError where the flow of a chip does not follow its pump by a factor, or no stream measures it."""
        if not self.channels:
            return
        where = f"pump.inlets = {list(self.inlets)}" if self.inlets else f"pump.channel = {self.channel!r}"
        if self.inlets:
            self._refuse_lists(chip, where, tracers=tracers)
        for name in (channel.partition("/")[0] for channel in self.channels):
            if name not in streams:
                there = ", ".join(sorted(streams)) or "none"
                raise UsageError(f"{where}: there is no section [streams.{name}]; there are {there}")
        outlets = {opening.value for opening in chip.openings if opening.kind == "outlet"}
        reason = ""
        if len(outlets) > 1:
            reason = "its outlets have different pressures"
        elif chip.law is not None:
            reason = "the viscosity of its fluid depends on the flow"
        elif inertia:
            speeds = [opening.value * opening.width_px for opening in chip.openings if opening.kind == "inlet"]
            area_um2_s = max(speeds, default=0.0) * chip.um_per_px
            reynolds = 1e-9 * area_um2_s * chip.density_kg_m3 / chip.viscosity_mpa_s
            reason = f"its fluid has inertia (Reynolds number {reynolds:.2g})" if reynolds > _REYNOLDS else ""
        if reason:
            raise UsageError(f"{where}: the flow of chip '{chip.name}' is not proportional to its pump's: {reason}")

    def _refuse_lists(self, chip: Chip, where: str, *, tracers: bool) -> None:
        count = sum(opening.kind == "inlet" for opening in chip.openings)
        if self.channel:
            raise UsageError(f"{where}: pump.channel is of one pump that feeds all inlets; leave one of both out")
        if len(self.inlets) != count:
            raise UsageError(f"{where}: chip '{chip.name}' has {count} inlets; name a channel for each")
        if self.nominals and len(self.nominals) != count:
            raise UsageError(f"pump.nominals = {list(self.nominals)}: give a value for each of {count} inlets")
        if tracers:
            raise UsageError(f"{where}: tracers follow one pump only; set tracker.tracers = false, or pump.channel")

    @property
    def channels(self) -> tuple[str, ...]:
        """The channels that measure the pumps; none where nothing does."""
        return self.inlets or ((self.channel,) if self.channel else ())

    def follow(
        self, last: Tick, tick: Tick, inlets: Superposition | None = None, memory_s: float = 0.0
    ) -> PumpShare | None:
        """The share of this tick; None before the first sample. Of a stream that is silent the last value stays.

        `memory_s`: time over which a mean of the share can be asked for later, see `mean_share`.
        """
        if not self.channels:
            return None
        previous = last.extra.of(PUMP, PumpShare)
        if inlets is not None:
            return self._follow_each(last, tick, previous, inlets)
        now = self._share_of(last, tick, previous, self.channel, self.nominal)
        if now is None or memory_s <= 0.0:
            return now
        if previous is None or not len(previous.mark_s):  # the last: a replay that follows tracers from a tick on
            return replace(now, mark_s=np.array([seconds(tick.stamp_ns)]), flowed_s=np.zeros(1))
        return _with_marks(previous, now, memory_s + self.delay_s)

    def _follow_each(
        self, last: Tick, tick: Tick, previous: PumpShare | None, inlets: Superposition
    ) -> PumpShare | None:
        """The shares of several pumps; one that has not told anything yet is as it was set, once another has."""
        rows = [] if previous is None else [*_rows(previous)]
        # Rows of another number of pumps are those of a replay that follows other pumps from a tick on.
        before = rows if len(rows) == len(self.inlets) else [None] * len(self.inlets)
        nominals = self.nominals or (self.nominal,) * len(self.inlets)
        each = [
            self._share_of(last, tick, row, channel, nominal)
            for row, channel, nominal in zip(before, self.inlets, nominals, strict=True)
        ]
        if not any(each):
            return None
        as_set = PumpShare(tick.stamp_ns, 1.0, 1.0, 1.0, tick.stamp_ns)
        known = [one or as_set for one in each]
        shares = np.array([[one.share, one.slow_share, one.observed_share, seconds(one.sample_ns)] for one in known])
        share, slow, observed = (inlets.mean(column) for column in shares.T[:3])
        newest_ns = max(one.sample_ns for one in known)
        return PumpShare(tick.stamp_ns, share, slow, observed, newest_ns, inlets=shares.ravel())

    def _share_of(
        self, last: Tick, tick: Tick, previous: PumpShare | None, channel: str, nominal: float
    ) -> PumpShare | None:
        """The share that one channel tells; None before its first sample."""
        known = self._measurement(last, tick, channel, nominal)
        if previous is None:
            return None if known is None else PumpShare(tick.stamp_ns, *(known[1][-1],) * 3, int(known[0][-1]))
        share, sample_ns = previous.share, previous.sample_ns
        for time_ns, value in zip(*known, strict=True) if known is not None else ():
            share += (value - share) * newest_share(seconds(int(time_ns) - sample_ns), self.smoothing_s)
            sample_ns = max(int(time_ns), sample_ns)
        dt_s = seconds(tick.stamp_ns - previous.stamp_ns)
        slow = previous.slow_share + (share - previous.slow_share) * newest_share(dt_s, _SLOW_S)
        # The share is that much behind already.
        filter_s = max(_filter_s(last) - self.delay_s, 0.0)
        observed = previous.observed_share + (share - previous.observed_share) * newest_share(dt_s, filter_s)
        return PumpShare(tick.stamp_ns, float(share), float(slow), float(observed), sample_ns)

    def mean_share(self, pump: PumpShare, began_s: Floats, ended_s: Floats) -> Floats:
        """(n,) means of the share over times (n,), (n,); what the sensor will tell within its delay is as it is now.

        A time before the first mark counts as the first.
        """
        ends_s = np.stack([began_s, ended_s]) + self.delay_s
        beyond_s = np.maximum(ends_s - pump.mark_s[-1], 0.0)
        began, ended = np.interp(ends_s, pump.mark_s, pump.flowed_s) + beyond_s * pump.share
        known_s = np.maximum(ends_s, pump.mark_s[0])
        lasted_s = known_s[1] - known_s[0]
        return np.divide(ended - began, lasted_s, out=np.full(len(began_s), pump.share), where=lasted_s > 0.0)

    def _measurement(self, last: Tick, tick: Tick, channel: str, nominal: float) -> tuple[Floats, Floats] | None:
        """Times and values, over the nominal one, of the samples of this tick; None without any."""
        samples, states = tick.extra.of(SAMPLES, Samples), tick.extra.of(STREAMS, StreamStates)
        if samples is None or states is None:
            return None
        if samples is last.extra.get(SAMPLES) or channel not in (names := states.channel_names()):
            return None
        mine = (samples.channel == names.index(channel)) & np.isfinite(samples.value)
        if not mine.any():
            return None
        return samples.sample_ns[mine] - round(self.delay_s * NS_PER_S), samples.value[mine] / nominal

    def at_nominal(
        self,
        before: Observations | None,
        now: Observations | None,
        pump: PumpShare,
        inlets: Superposition | None = None,
    ) -> Observations | None:
        """Observations whose newest one is that of the nominal flow; those before it are already."""
        if now is None or now is before:
            return now
        share = pump.observed_share
        if share < _LEAST:
            return before
        newest = now.only(slice(-1, None))
        if inlets is not None:
            away_um_s = inlets.departure_um_s(newest.position_um, _column(pump, _OBSERVED))
            newest = replace(newest, flow_um_s=newest.flow_um_s - away_um_s)
        newest = self._over(newest, np.array([share]))
        return newest if len(now.std_um_s) == 1 else now.only(slice(None, -1)).followed_by(newest)

    def stretches_at_nominal(
        self, pump: PumpShare, new: Observations, began_s: Floats, ended_s: Floats
    ) -> Observations | None:
        """Observations that are means over times (n,), (n,), as those of the nominal flow; None if none is left."""
        share = self.mean_share(pump, began_s, ended_s)
        flows = share >= _LEAST
        return self._over(new.only(flows), share[flows]) if flows.any() else None

    def _over(self, observed: Observations, share: Floats) -> Observations:
        """Observations over the shares (n,) of their times, with the error of the measured ones in theirs."""
        error_um_s = self.error_share * np.hypot(*observed.flow_um_s.T)
        return replace(
            observed,
            flow_um_s=observed.flow_um_s / share[:, None],
            std_um_s=np.hypot(observed.std_um_s, error_um_s) / share,
            rolled_um_s=None if observed.rolled_um_s is None else observed.rolled_um_s / share[:, None],
        )


def _with_marks(previous: PumpShare, now: PumpShare, memory_s: float) -> PumpShare:
    """The share with the integral over time up to now; marks lie a part of the memory apart, the last one is now."""
    time_s, marks, flowed = seconds(now.stamp_ns), previous.mark_s, previous.flowed_s
    total = flowed[-1] + 0.5 * (previous.share + now.share) * (time_s - marks[-1])
    if len(marks) > 1 and marks[-1] - marks[-2] < memory_s / _MARKS:
        marks, flowed = marks[:-1], flowed[:-1]
    kept = slice(-_MARKS - 2, None)  # two more: the time of an image, and the mark that the memory ends in
    return replace(now, mark_s=np.append(marks[kept], time_s), flowed_s=np.append(flowed[kept], total))


def _filter_s(last: Tick) -> float:
    """Memory of the filter from whose estimates the observations are taken."""
    estimate: Estimate | None = last.mapless if last.mapless is not None else last.estimate
    return 0.0 if estimate is None else min(memory_s(estimate.covariance), _SLOW_S)


_NOW, _SLOW, _OBSERVED = range(3)  # of the numbers of an inlet


def _column(pump: PumpShare, which: int) -> Floats:
    """(n,) numbers of the inlets."""
    return pump.inlets.reshape(-1, 4)[:, which]


def _rows(pump: PumpShare) -> Iterator[PumpShare]:
    """The share of each inlet, as that of one pump."""
    for share, slow, observed, sample_s in pump.inlets.reshape(-1, 4).tolist():
        yield PumpShare(pump.stamp_ns, share, slow, observed, nanoseconds(sample_s))


def at_pump(flow: FlowField | None, pump: PumpShare | None, inlets: Superposition | None = None) -> FlowField | None:
    """A map as the pump drives it now, or the pumps of several inlets."""
    if flow is None or pump is None:
        return flow
    return at_share(flow, pump.share) if inlets is None else inlets.at_shares(flow, _column(pump, _NOW))


def as_planned(tick: Tick, inlets: Superposition | None = None) -> Tick:
    """The tick of an order with its maps at the slow mean of the pump's flow: for routes."""
    pump = tick.extra.of(PUMP, PumpShare)
    if pump is None:
        return tick
    slow = replace(pump, share=pump.slow_share)
    if inlets is not None:
        slow = replace(slow, inlets=np.repeat(_column(pump, _SLOW), 4))
    return replace(tick, assumed=at_pump(tick.assumed, slow, inlets), refined=at_pump(tick.refined, slow, inlets))
