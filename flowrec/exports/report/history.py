"""Time series and events that a report shows of a session, read in one pass over its ticks, without images."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from flowrec.core import (
    CameraLosses,
    Clocks,
    Demand,
    Drops,
    Estimate,
    Event,
    Floats,
    Health,
    Mission,
    OperatorEvent,
    Tick,
    Timing,
    Track,
    Truth,
    nanoseconds,
    printable,
    seconds,
)
from flowrec.exports.formats import TimeProgress
from flowrec.exports.report.curves import Curve, CurveBuilder, SpanBuilder
from flowrec.physics import sample_as_seen
from flowrec.store import Session

_MOST_REMARKS = 300  # events and actions of the operator; of more, the first
_SPEED_OVER_S = 0.25  # the speed over ground is a mean over at least this time
_MOST_ALARMS = 8  # different ones; flowrec has three
_LONGEST_NAME = 24  # letters of a phase or an alarm
_REPORT_EVERY = 200  # ticks
_SHOWN = (  # fields of a tick, in the order in which they are taken
    *("event", "operator", "mission", "track", "estimate", "demand"),
    *("health", "truth", "timing", "drops", "clocks", "losses"),
)


@dataclass(frozen=True, slots=True)
class Remark:
    """An event of the run, or an action of the operator."""

    time_s: float
    text: str
    level: str = ""  # enums.Level of an event, '' of an action
    action: str = ""  # enums.Action of an action, '' of an event


class History:
    """One session, thinned to what figures and tables can show; memory does not grow with the session.

    Curves by name, all at the stamps of their messages:

    - x_um, y_um: the robot's estimated position; speed_um_s: over ground; demand_um_s: demanded of it through the fluid
    - error_um: distance to where it should be; estimate_error_um: of the estimate to the true position
    - flow_x_um_s, flow_y_um_s: flow at the robot by the observer; flow_std_um_s: one standard deviation per component
    - map_x_um_s, map_y_um_s: the best map of that time at the robot
    - true_x_um_s, true_y_um_s: true flow at the robot
    - nis: mean normalised innovation squared
    - tick_ms, queue_mb, dropped: time per tick, data that waits for the disk, images dropped so far
    - lost: images that the camera has lost so far; late_ms, latest_ms: mean and largest delay of images

    Attributes
    ----------
    first_ns, last_ns : stamps of the first and the last tick.
    ticks : their number.
    found : the robot was ever seen; before, its position is only where the tracker begins to search.
    last : the last tick.
    remarks : events and actions in order; `remarks_left_out` more are not listed.
    losses, clocks : the last message of each; drops : likewise, by topic.
    phases, unseen, held, alarms : spans of time; alarms by name.
    """

    def __init__(self, first_ns: int, last_ns: int) -> None:
        self.first_ns, self.last_ns = first_ns, last_ns
        self.ticks = 0
        self.last = Tick()
        self.remarks: list[Remark] = []
        self.remarks_left_out = 0
        self.losses: CameraLosses | None = None
        self.clocks: Clocks | None = None
        self.drops: dict[str, Drops] = {}
        self.phases, self.unseen, self.held = SpanBuilder(), SpanBuilder(), SpanBuilder()
        self.alarms: dict[str, SpanBuilder] = {}
        self._builders: dict[str, CurveBuilder] = {}
        self.found = False
        self._position: tuple[int, Floats] | None = None

    @classmethod
    def of(cls, session: Session, progress: TimeProgress = lambda _: None) -> History:
        """Read a session; `progress` takes the session time in s since the first tick.

        Raises SessionError: a message is damaged.
        """
        first_ns = session.run.first_ns
        history = cls(first_ns, first_ns + nanoseconds(session.duration_s))
        for tick in session.ticks(with_frames=False):
            history.add(tick)
            if history.ticks % _REPORT_EVERY == 0:
                progress(seconds(tick.stamp_ns - history.first_ns))
        for spans in (history.phases, history.unseen, history.held, *history.alarms.values()):
            spans.end(history.last_s)
        return history

    @property
    def first_s(self) -> float:
        """Session time of the first tick."""
        return seconds(self.first_ns)

    @property
    def last_s(self) -> float:
        """Session time of the last tick; of a session of one tick a moment later."""
        return seconds(max(self.last_ns, self.first_ns + 1_000_000))

    def curve(self, name: str) -> Curve:
        """A curve of those above; empty if nothing was recorded for it."""
        return self._builders.get(name, CurveBuilder(self.first_ns, self.last_ns)).curve()

    def add(self, tick: Tick) -> None:
        before, self.last = self.last, tick.at_images(self.last)
        tick = self.last
        self.ticks += 1
        for message in tick.news(before, _SHOWN).values():
            self._take(message)

    def _take(self, message: Any) -> None:
        """Take a new message of the last tick."""
        now_s, put = seconds(message.stamp_ns), partial(self._put, message.stamp_ns)
        match message:
            case Event():
                self._remark(Remark(now_s, message.text, level=message.level))
            case OperatorEvent():
                self._remark(Remark(now_s, message.text, action=message.action))
            case Mission():
                held = message.held_since_ns is not None and not message.finished
                self.phases.add(min(now_s, self.last_s), _name(message.phase))
                self.held.add(now_s, "held" if held else "")
            case Track():
                self.found |= message.seen
                self.unseen.add(now_s, "" if message.seen else "not seen")
            case Estimate():
                self._estimate(message)
            case Demand():
                put(demand_um_s=math.hypot(*message.velocity_um_s))
                put(error_um=message.error_um)
            case Health():
                self._health(message)
            case Truth():
                put(true_x_um_s=message.flow_um_s[0], true_y_um_s=message.flow_um_s[1])
            case Timing():
                put(tick_ms=message.total_ms, queue_mb=message.queue_mb, dropped=message.dropped_frames)
            case Drops():
                self.drops[message.topic] = message
            case Clocks():
                self.clocks = message
                if message.rate:
                    put(late_ms=1e3 * message.late_s, latest_ms=1e3 * message.latest_s)
            case CameraLosses():
                self.losses = message
                put(lost=message.link + message.incomplete + message.driver + message.backlog)

    def _put(self, stamp_ns: int, **values: float) -> None:
        """Values that belong together: all of them, or none where one is not finite."""
        if not all(map(math.isfinite, values.values())):
            return
        for name, value in values.items():
            if name not in self._builders:
                self._builders[name] = CurveBuilder(self.first_ns, self.last_ns)
            self._builders[name].add(stamp_ns, float(value))

    def _remark(self, remark: Remark) -> None:
        if len(self.remarks) < _MOST_REMARKS:
            self.remarks.append(remark)
        else:
            self.remarks_left_out += 1

    def _estimate(self, estimate: Estimate) -> None:
        if not self.found and self.last.track is not None:
            return
        stamp_ns, position_um, tick = estimate.stamp_ns, estimate.position_um, self.last
        put = partial(self._put, stamp_ns)
        if not np.isfinite(position_um).all():
            return
        put(x_um=position_um[0], y_um=position_um[1])
        before_ns, before_um = self._position or (stamp_ns, position_um)
        moved_s = seconds(stamp_ns - before_ns)
        if moved_s >= _SPEED_OVER_S:
            self._put((stamp_ns + before_ns) // 2, speed_um_s=math.dist(position_um, before_um) / moved_s)
        if moved_s >= _SPEED_OVER_S or self._position is None:
            self._position = (stamp_ns, position_um)
        variance = np.diagonal(estimate.covariance)[2:4]
        flow_std = math.sqrt(max(float(variance.mean()), 0.0)) if variance.size else math.nan
        put(flow_x_um_s=estimate.flow_um_s[0], flow_y_um_s=estimate.flow_um_s[1])
        put(flow_std_um_s=flow_std)
        if tick.field is not None:
            on_map = sample_as_seen(tick.field, position_um)
            put(map_x_um_s=on_map[0], map_y_um_s=on_map[1])
        if tick.truth is not None and tick.truth.stamp_ns == stamp_ns:
            put(estimate_error_um=math.dist(position_um, tick.truth.position_um))

    def _health(self, health: Health) -> None:
        self._put(health.stamp_ns, nis=health.nis)
        now = set(map(_name, health.alarms[:_MOST_ALARMS])) - {""}
        for name in now | self.alarms.keys():
            if name not in self.alarms and len(self.alarms) >= _MOST_ALARMS:
                continue
            spans = self.alarms.setdefault(name, SpanBuilder())
            spans.add(seconds(health.stamp_ns), name if name in now else "")


def _name(text: str) -> str:
    """A word of a file for a figure, whatever it holds."""
    return printable(text)[:_LONGEST_NAME]
