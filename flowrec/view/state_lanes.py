"""The lanes of the timeline of states: mission, sight of the robot, alarms, marks and losses of images."""

from __future__ import annotations

import rerun as rr

from flowrec.core import (
    ALARM_WORDS,
    NS_PER_S,
    Action,
    Alarm,
    CameraLosses,
    Drops,
    Health,
    Message,
    Mission,
    OperatorEvent,
    Track,
    completes_mission,
)
from flowrec.view import colours
from flowrec.view import entities as e
from flowrec.view.colours import Rgb
from flowrec.view.entities import EntityLogger

_MARK_NS = NS_PER_S // 2  # a mark is drawn this long: it has no duration
_STATES = 200  # of a lane that have a colour of their own: a session of hours may have many marks
_PHASES = 9  # that have a name in `StateLogger.phases`
_WITH_TEXT = (Action.MARK, Action.NOTE, Action.GOAL, Action.SPEED)
_LETTERS = 40  # of a mark's text
_NONE = ""  # a state that is not drawn


class StateLogger:
    """Logs the lanes of one session: only changes, and no lane that never had a state."""

    def __init__(self, entities: EntityLogger, *, doubtful: bool) -> None:
        self._log = entities.log
        self.doubtful = doubtful  # the result: its outcome is amber
        self.phases: dict[str, int] = {}  # stamp at which each phase, and the outcome, first began
        self._now: dict[str, str] = {}
        self._colours: dict[str, dict[str, Rgb]] = {}  # of the states of each lane so far
        self._mark_ends_ns: int | None = None

    def log(self, message: Message) -> None:
        """Log the state that a new message tells, if it tells one."""
        match message:
            case Mission():
                self._log_mission(message)
            case Track():
                self._log_state(e.SIGHT, _NONE if message.seen else "Not seen", colours.RED)
            case Health():
                # That the robot is not seen has a lane of its own.
                alarms = [name for name in message.alarms if name != Alarm.TRACKING]
                self._log_state(e.ALARM, ", ".join(ALARM_WORDS.get(name, name) for name in alarms), colours.RED)
            case OperatorEvent(action=action, text=said):
                text = f"{action} {said}" if action in (Action.GOAL, Action.SPEED) else said
                self._mark_ends_ns = message.stamp_ns + _MARK_NS
                self._log_state(e.MARKS, text[:_LETTERS] if action in _WITH_TEXT and said else action, colours.CYAN)
            case Drops(kept_every=every) if message.by_backlog or message.by_camera or every > 1:
                thinned = f", every {every}. kept" if every > 1 else ""
                self._log_state(e.LOSSES, f"{message.by_backlog + message.by_camera} lost{thinned}", colours.RED)
            case CameraLosses() if message.ids > message.frames:
                self._log_state(e.LOSSES, f"{message.ids - message.frames} lost before the loop", colours.RED)

    def _log_mission(self, mission: Mission) -> None:
        """The phase, and at the end the outcome."""
        name, colour = mission.phase, colours.OF_PHASE.get(mission.phase, colours.GREY)
        if mission.finished and mission.outcome:
            name = mission.outcome
            done = completes_mission(name)
            colour = colours.RED if not done else colours.YELLOW if self.doubtful else colours.GREEN
        if len(self.phases) < _PHASES:
            self.phases.setdefault(name, mission.since_ns)
        self._log_state(e.PHASE, name.capitalize(), colour)

    def end_marks(self, stamp_ns: int) -> None:
        """End a mark whose time is over."""
        if self._mark_ends_ns is not None and stamp_ns >= self._mark_ends_ns:
            self._mark_ends_ns = None
            self._log_state(e.MARKS, _NONE, colours.CYAN)

    def _log_state(self, lane: str, state: str, colour: Rgb) -> None:
        if state == self._now.get(lane, _NONE):
            return
        self._now[lane] = state
        known = self._colours.setdefault(lane, {_NONE: colour})
        if state not in known and len(known) < _STATES:
            known[state] = colour
            shown = rr.StateConfiguration(
                values=list(known),
                colors=list(known.values()),
                visible=[value != _NONE for value in known],
            )
            self._log(lane, shown, static=True)
        self._log(lane, rr.StateChange(state=state))
