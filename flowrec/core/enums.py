"""The words that files and messages use for a phase, a work order, an outcome, a level, an operator's action.

Each is a `StrEnum`: a member equals the text that a session file holds. Message fields stay `str`, because a file of
another version may hold a word that is not listed here.
"""

from enum import StrEnum
from typing import Literal

View = Literal["spawn", "serve", "rrd", "none"]  # how a recording is watched


class Phase(StrEnum):
    """State of the mission. Configuration, terminal, reports, movies and the viewer all show these words."""

    START = "start"
    SURVEY = "survey"
    REFINE = "refine"
    PLAN = "plan"
    NAVIGATE = "navigate"
    OBSERVE = "observe"  # the robot is only watched, from the first frame to the last
    DONE = "done"


class WorkOrder(StrEnum):
    """Work of a slow stage that a mission can order."""

    SOLVE = "solve"
    SURVEY_ROUTE = "survey_route"
    REFINE = "refine"
    ROUTE = "route"


class Outcome(StrEnum):
    """End state of a run or a session."""

    REACHED = "reached"
    SURVEY_COMPLETE = "survey complete"
    REFINE_COMPLETE = "refine complete"
    PLAN_COMPLETE = "plan complete"
    OBSERVE_COMPLETE = "observe complete"
    STOPPED = "stopped"  # by a person, a signal or the disk monitor
    TIME_OVER = "time over"  # the time that the run was given
    TIMEOUT = "timeout"  # the time limit of a phase
    UNREACHABLE = "unreachable"
    REFUSED = "refused"  # the robot does not move as the axes of camera and coils say
    NOT_FOUND = "not found"  # the robot was never seen
    LOST = "lost"
    GAVE_UP = "gave up"
    FAILED = "failed"
    REPLAYED = "replayed"
    # Of a file rather than of a run.
    ENDED = "ended"
    CUT = "cut"  # recovered, with a loss
    CONTINUED = "continued"  # the next part follows
    SNAPSHOT = "snapshot"

    @property
    def completes_mission(self) -> bool:
        """True if the mission has done what its phases asked for."""
        return self in (
            Outcome.REACHED,
            Outcome.SURVEY_COMPLETE,
            Outcome.REFINE_COMPLETE,
            Outcome.PLAN_COMPLETE,
            Outcome.OBSERVE_COMPLETE,
        )


def completes_mission(outcome: str) -> bool:
    """True of a text, as a file has it, that is the outcome of a completed mission."""
    return any(outcome == each and each.completes_mission for each in Outcome)


class Level(StrEnum):
    """Severity of an event."""

    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


class Action(StrEnum):
    """Action of a person, or the end of the rig's frames."""

    STOP = "stop"
    MARK = "mark"
    NOTE = "note"
    PAUSE = "pause"
    RESUME = "resume"
    ZERO = "zero"
    END = "end"  # of the observation: its refinement is due
    GOAL = "goal"  # another place to go to
    SPEED = "speed"  # a speed limit, or none any more


class AxesVerdict(StrEnum):
    """Result of the test of the axes of camera and coils by the robot's motion."""

    AGREES = "agrees"
    CONTRADICTS = "contradicts"
    NO_MOTION = "no motion"  # the robot does not follow the field
    UNDECIDED = "undecided"


class Alarm(StrEnum):
    """Reason that the observer can not be believed."""

    NIS = "nis"
    PULSATION = "pulsation"
    TRACKING = "tracking"


# Alarms in pictures and on pages.
ALARM_WORDS: dict[str, str] = {
    Alarm.NIS: "motion not explained",
    Alarm.PULSATION: "flow pulsates",
    Alarm.TRACKING: "robot often unseen",
}
