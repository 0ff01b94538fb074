"""The logged entities: their names, which people read in the viewer, what they look like, and how they are logged."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from rerun import new_entity_path

from flowrec.view import colours
from flowrec.view.colours import Rgb

SESSION_TIME = "session time"
FRAME = "frame"
LOG_TIME = "message_log_time"  # Rerun's name for the time of a message of an .mcap
_ROWS = 64  # of an entity that wait at most
_ENCODERS = 2  # threads

MEASURED = "camera/measured"  # what is moved by the registration that a refinement found, and by the image's shift
IMAGE = "camera/measured/image"
OUTLINE = "camera/chip outline"
ARROWS = "camera/flow arrows"
PATH = "camera/path"
GOAL = "camera/goal"
REFERENCE = "camera/reference"
TRAIL = "camera/trail"
ROBOT = "camera/robot"
ROBOT_LABEL = "camera/robot label"
COMMAND = "camera/commanded velocity"
TRACERS = "camera/tracers"
OTHERS = "camera/other robots"

ASSUMED = "flow/assumed/speed"
REFINED = "flow/refined/speed"
TRUE = "flow/truth/speed"
CHANGE = "flow/change/map"
UNCERTAINTY = "flow/uncertainty/map"
TIME_TO_GO = "plan/time to go/map"
SPEED_SCALE = "flow/speed scale"
SCALES = {  # of each map: the colour bar and its ticks; one is common to all maps of speed
    ASSUMED: SPEED_SCALE,
    REFINED: SPEED_SCALE,
    TRUE: SPEED_SCALE,
    CHANGE: "flow/change/scale",
    UNCERTAINTY: "flow/uncertainty/scale",
    TIME_TO_GO: "plan/time to go/scale",
}
NOT_YET = "not yet"  # beside a map that comes later in the session

AMPLITUDE = "coils/amplitude"
FREQUENCY = "coils/frequency"
HEADING = "coils/heading"
READ_BACK = "coils/read-back"  # currents as measured less those put out, of an amplifier that measures them
TRACKING_ERROR = "robot/tracking error"
POSITION = "robot/position"  # where no flow is told of
ESTIMATE_ERROR = "robot/estimate error"
FLOW_COMPONENTS = "robot/flow components"
FLOW_SPEED = "robot/flow speed"
NIS = "robot/observer NIS"
NIS_MEAN = "robot/observer NIS, mean"
PULSATION = "robot/pulsation"
TIMING = "run/timing"
# Lanes of the timeline of states, which shows these names in the order of the alphabet.
PHASE = "Mission"
ALARM = "Observer"
MARKS = "Operator"
LOSSES = "Recording"
SIGHT = "Robot"
LANES = (PHASE, ALARM, MARKS, LOSSES, SIGHT)
LANES_OF_RUN = (MARKS, LOSSES, SIGHT)  # the same in a replay
EXTRA = "extra"  # before the path of an extra topic and the field of its message
# A session may lack these: a layout shows those that were logged.
OPTIONAL = frozenset(
    {*SCALES, *LANES, POSITION, TRACKING_ERROR, ESTIMATE_ERROR, PULSATION, TIMING, TRACERS, OTHERS, READ_BACK}
)
SUMMARY = "summary"
EVENTS = "run/events"
OPERATOR = "run/operator"

points = rr.Radius.ui_points  # a width on the screen, at any zoom


@dataclass(frozen=True, slots=True)
class Style:
    """Style that distinguishes one of up to two sessions in a view from the other."""

    word: str
    path: Rgb
    robot: Rgb
    width: float  # of the path; the first session's is wide and below: both are visible where they coincide
    second: bool = False


_STYLES = {
    "": Style("", colours.CYAN, colours.ORANGE, 1.4),
    "recorded": Style("recorded ", colours.ORANGE, colours.ORANGE, 3.2),
    "replayed": Style("replayed ", colours.CYAN, colours.CYAN, 1.2, second=True),
    "A": Style("A: ", colours.ORANGE, colours.ORANGE, 3.2),
    "B": Style("B: ", colours.CYAN, colours.CYAN, 1.2, second=True),
}


REPLAY, PAIR = ("recorded", "replayed"), ("A", "B")  # prefixes of two sessions in one view


@functools.cache
def entity_path(prefix: str, entity: str) -> str:
    """The entity's full path, escaped for Rerun; `prefix` is '' or one of REPLAY or PAIR."""
    return new_entity_path([part for part in (prefix, *entity.split("/")) if part])


class ColumnBuffer:
    """Rows that wait until there are many of an entity, or for `flush`: a call for one row costs more than the row.

    In a file their order does not matter. As a context it ends its threads.
    """

    def __init__(self, stream: rr.RecordingStream) -> None:
        self._stream = stream
        self._waiting: dict[tuple[Any, ...], list[tuple[Any, ...]]] = {}
        self._encoders = ThreadPoolExecutor(_ENCODERS)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._encoders.shutdown()

    def encode(self, function: Callable[..., bytes], *given: Any) -> Future[bytes]:
        """Call a function in another thread; the result may be a component of a row."""
        return self._encoders.submit(function, *given)

    def add(self, path: str, kind: Any, stamp_ns: int, frame: int | None, fields: dict[str, Sequence[Any]]) -> None:
        """Take a row of an entity: a list of components for each field of the archetype `kind`."""
        key = (path, kind, frame is None, *fields)
        rows = self._waiting.setdefault(key, [])
        rows.append((stamp_ns, frame, *fields.values()))
        if len(rows) >= _ROWS:
            self._send(key)

    def flush(self) -> None:
        """Send all rows."""
        for key in [*self._waiting]:
            self._send(key)

    def _send(self, key: tuple[Any, ...]) -> None:
        path, kind, frameless, *names = key
        stamps_ns, frames, *fields = zip(*self._waiting.pop(key), strict=True)
        indexes = [rr.TimeColumn(SESSION_TIME, duration=np.array(stamps_ns, "timedelta64[ns]"))]
        if not frameless:
            indexes.append(rr.TimeColumn(FRAME, sequence=frames))
        columns: list[Any] = []
        for name, lists in zip(names, fields, strict=True):
            values = [value for components in lists for value in components]
            components = [value.result() if isinstance(value, Future) else value for value in values]
            columns += kind.columns(**{name: components}).partition([len(each) for each in lists])
        rr.send_columns(path, indexes, columns, recording=self._stream, strict=True)


class EntityLogger:
    """Logs the entities of one session below `prefix`: '', or one of REPLAY or PAIR.

    `columns`: takes the rows of moving entities, which are written when it is flushed; None: they are sent at once.
    `present`: the OPTIONAL entities, and those of extra topics, that were ever logged.
    """

    def __init__(self, stream: rr.RecordingStream, prefix: str, columns: ColumnBuffer | None = None) -> None:
        self.stream = stream
        self.prefix = prefix
        self._columns = columns
        self._stamp_ns = 0
        self._index: int | None = None
        self.style = _STYLES[prefix]
        self.present: set[str] = set()

    def log(self, entity: str, *components: rr.AsComponents, static: bool = False) -> None:
        """Log the components of an entity at the present time, or (static) for all times."""
        self.stream.log(entity_path(self.prefix, entity), components[0], *components[1:], static=static)
        if not static and not isinstance(components[0], rr.Clear):
            self._note(entity)

    def row(self, entity: str, kind: Any, **fields: Sequence[Any]) -> None:
        """Log fields of the archetype `kind`, each a list of components, of an entity that changes with every tick."""
        if self._columns is None:
            self.log(entity, kind.from_fields(**fields))
            return
        self._columns.add(entity_path(self.prefix, entity), kind, self._stamp_ns, self._index, fields)
        self._note(entity)

    def scalars(self, entity: str, *values: float) -> None:
        """Log a value of each line of a plot."""
        self.row(entity, rr.Scalars, scalars=values)

    def encode(self, function: Callable[..., bytes], *given: Any) -> Any:
        """A component of a row that takes time to encode: what the function returns, or will have returned."""
        return function(*given) if self._columns is None else self._columns.encode(function, *given)

    def _note(self, entity: str) -> None:
        if entity in OPTIONAL or entity.startswith(EXTRA):
            self.present.add(entity)

    def set_time(self, stamp_ns: int, index: int | None) -> None:
        """The present time, and the number of the image if there is one."""
        self._stamp_ns, self._index = stamp_ns, index
        self.stream.set_time(SESSION_TIME, duration=np.timedelta64(stamp_ns, "ns"))
        if index is not None:
            self.stream.set_time(FRAME, sequence=index)
        else:
            self.stream.disable_timeline(FRAME)

    def clear(self, entity: str) -> None:
        """Show nothing of an entity from the present time on."""
        self.log(entity, rr.Clear(recursive=False))

    def log_styles(self) -> None:
        """Log what never changes of moving entities, so that each tick logs only their positions."""
        style, replayed = self.style, self.style.second
        name = [f"{style.word}reference"]
        for entity, components in (
            (TRAIL, rr.LineStrips2D.from_fields(colors=(*style.robot, 150), radii=points(1.0), draw_order=24.0)),
            (ROBOT, rr.LineStrips2D.from_fields(radii=points(style.width), draw_order=30.0 + replayed)),
            (ROBOT_LABEL, rr.Points2D.from_fields(radii=points(0.0), show_labels=True)),
            (
                REFERENCE,
                rr.Points2D.from_fields(
                    colors=colours.YELLOW, radii=points(3.5), labels=name, show_labels=False, draw_order=28.0
                ),
            ),
            (COMMAND, rr.Arrows2D.from_fields(colors=style.robot, radii=points(1.6), draw_order=29.0)),
        ):
            self.log(entity, components, static=True)

    def log_series(self) -> None:
        """Log names and colours of all plotted lines. A single line of two sessions is named after its session."""
        replayed = self.style.second
        own = self.style.path if self.prefix else colours.YELLOW
        pale = colours.BLUE if replayed else colours.YELLOW
        truth = {} if replayed else {"truth": colours.GREEN}  # the same in both
        lines: dict[str, dict[str, Rgb]] = {
            AMPLITUDE: {"amplitude (mT)": own},
            FREQUENCY: {"frequency (Hz)": own},
            HEADING: {"heading (°)": own},
            TRACKING_ERROR: {"tracking error (µm)": own},
            POSITION: {"x": colours.CYAN, "y": colours.YELLOW},
            ESTIMATE_ERROR: {"estimate error (µm)": own},
            NIS: {"NIS": own},
            NIS_MEAN: {"mean (2 is right)": colours.WHITE},
            PULSATION: {"pulsation (% of the flow)": own},
            FLOW_SPEED: {"observer": self.style.path, "map": pale} | truth,
            FLOW_COMPONENTS: {
                "vx observer": colours.CYAN,
                "vx map": colours.BLUE,
                "vy observer": colours.YELLOW,
                "vy map": colours.ORANGE,
            },
            TIMING: {
                "track (ms)": colours.CYAN,
                "observe (ms)": colours.PURPLE,
                "control (ms)": colours.YELLOW,
                "sinks (ms)": colours.BLUE,
                "total (ms)": colours.WHITE,
            },
        }
        width = max(self.style.width, 1.5)
        for entity, named in lines.items():
            single = bool(self.prefix) and len(named) == 1
            names = [self.prefix] if single else list(named)
            series = rr.SeriesLines(names=names, colors=list(named.values()), widths=[width] * len(named))
            self.log(entity, series, static=True)


def label(at: NDArray[Any], text: str, colour: Rgb) -> rr.Points2D:
    """A word just below a point (2,) of the picture plane, readable at any zoom."""
    return rr.Points2D([at], labels=[text], show_labels=True, colors=colour, radii=points(0.0))
