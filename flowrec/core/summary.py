"""Figures of a run, a replay or a file: numbers whose keys carry the unit, and their conversion to text and back."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

from flowrec.core.enums import Outcome
from flowrec.core.errors import printable

if TYPE_CHECKING:
    from flowrec.core.declarations import Floats
    from flowrec.core.messages import FlowField

Value = str | int | float | bool | None
Figures = dict[str, Value]
Row = tuple[str, Value, Value]  # key, recorded, replayed

# Numbers without a unit; every other number ends with one of _UNITS.
_COUNTS = frozenset(
    {"ticks", "contacts", "observations", "frames_dropped", "dropped_frames", "frames_missing_from_camera", "seed"}
)
_UNITS = {
    "_mt": "mT",
    "_um_s": "um/s",
    "_um": "um",
    "_s": "s",
    "_bytes": "bytes",
    "_ns": "ns",
    "_error": "",
    "_rad": "rad",
}
_WHOLE = ("_bytes", "_ns")
_LONGEST = 25  # characters of a number in a file; flowrec writes shorter ones
_ASSIMILATED = "assimilated "  # before the number of observations, at the begin of the note of a refined map
_UM = re.compile(r"(?<![\w.])um\b")
_ROBOT = re.compile(r"robot_\d{1,4}")  # keys of the figures of other robots, which are text
_HIDDEN = frozenset({"note", "wall_ns", "monotonic_ns"})
TRACERS = "tracers"  # key of the figures of the tracers, which are text
DOUBTS = "doubts"  # key of the outcome of a session: why its result is doubtful; absent: it is not
# Names of keys that would be misread as words.
_NAMES = {
    "wall_s": "computed in",
    "contacts": "wall contacts",
    "planned_s": "planned time",
    "navigation_s": "navigation time",
    "shortest_way_s": "time of shortest way",
    "observations": "flow observations",
    "assumed_method": "assumed flow",
    "refined_method": "refined flow",
    "unmet_mt": "missing field",
}


def as_text(figures: Mapping[str, Value]) -> dict[str, str]:
    """Figures as the metadata of a file, which is text only."""
    return {
        key: value if isinstance(value, str) else repr(value) for key, value in figures.items() if value is not None
    }


def of_text(text: Mapping[str, str]) -> Figures:
    """Figures from the metadata of a file. The writer's count `dropped_frames` is the figure `frames_dropped`."""
    figures = {key: _number(value) if is_numeric(key) else value for key, value in text.items()}
    dropped = figures.pop("dropped_frames", None)
    return figures | ({"frames_dropped": dropped} if isinstance(dropped, int) else {})


def doubts_text(doubts: Iterable[str]) -> str:
    """Doubts as a session states them in its outcome, each once; '' for none."""
    return "; ".join(dict.fromkeys(doubts))


def doubts_of(outcome: Mapping[str, object]) -> list[str]:
    """The doubts that the outcome of a session states."""
    return [each for each in str(outcome.get(DOUBTS) or "").split("; ") if each]


def finite(value: float) -> float | None:
    """The value, None if it is NaN or infinite, which JSON can not hold."""
    return value if math.isfinite(value) else None


def rows_for_people(figures: Mapping[str, Value]) -> list[tuple[str, str]]:
    """Names and values as text; the outcome together with its note."""
    rows = [(name_of(key), text_of_figure(key, value)) for key, value in figures.items() if key not in _HIDDEN]
    note = figures.get("note")
    return [(name, f"{value} ({note})" if name == "outcome" and note else value) for name, value in rows]


def comparison_for_people(rows: Iterable[Row]) -> list[tuple[str, str, str]]:
    """Rows of name, recorded value and replayed value of figures, as text with units."""
    return [(name_of(key), text_of_figure(key, was), text_of_figure(key, now)) for key, was, now in rows]


def name_of(key: str) -> str:
    """The name of a figure: its key without the unit, as words."""
    if key in _NAMES:
        return _NAMES[key]
    unit = next((unit for unit in _UNITS if key.endswith(unit) and unit != "_error"), "")
    return key.removesuffix(unit).replace("_", " ")


def is_of_robot(key: str) -> bool:
    """True for the key of the figures of a robot other than the first one."""
    return _ROBOT.fullmatch(key) is not None


def body_lines(figures: Mapping[str, Value]) -> list[str]:
    """A line for each robot other than the first one, and one for the tracers."""
    return [f"{name_of(key)}: {value}" for key, value in figures.items() if is_of_robot(key) or key == TRACERS]


def text_of_figure(key: str, value: Value) -> str:
    """A value with its unit; `-` if it is None."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    suffix = next((suffix for suffix in _UNITS if key.endswith(suffix)), None)
    if isinstance(value, str) or suffix is None:
        return f"{value:g}" if isinstance(value, float) else str(value)
    if suffix == "_error":
        return f"{100 * value:.1f} %"
    if suffix == "_bytes":
        return f"{value / 1e6:.1f} MB"
    if suffix == "_um" and abs(value) >= 1000:
        return f"{value / 1000:.2f} mm"
    return f"{value:.1f} {_UNITS[suffix]}"


def end_text(figures: Mapping[str, Value]) -> str:
    """Outcome of a run with its note and its duration, those that are known; '' without an outcome.

    A replay ends with its recording, so its duration is none of its own.
    """
    if not figures.get("outcome"):
        return ""
    note = f" ({figures['note']})" if figures.get("note") else ""
    duration = None if figures["outcome"] == Outcome.REPLAYED else figures.get("duration_s")
    return f"{figures['outcome']}{note}" + ("" if duration is None else f" after {text_of_figure('_s', duration)}")


def way_text(figures: Mapping[str, Value]) -> str:
    """The way to the goal, its time as planned and that on the shortest way; '' where nothing was navigated."""
    if any(figures.get(key) is None for key in ("route_length_um", "navigation_s", "planned_s")):
        return ""  # a file may state one without the other
    text = {key: text_of_figure(key, value) for key, value in figures.items()}
    if figures.get("outcome") == Outcome.REPLAYED:  # its robot is that of the recording
        return f"route of {text['route_length_um']} to the goal, planned {text['planned_s']}; it was not flown"
    way = f"{text['route_length_um']} to the goal in {text['navigation_s']}, planned {text['planned_s']}"
    if "shortest_way_um" in text:
        return f"{way}; the shortest way ({text['shortest_way_um']}) would take {text['shortest_way_s']}"
    return f"{way}; on the shortest way the flow is too fast for the robot" if "shortest_way_s" in text else way


def flow_text(figures: Mapping[str, Value]) -> str:
    """Methods and errors of the maps, as assumed and refined, and the error that the last one states; '' without."""
    text = {key: text_of_figure(key, value) for key, value in figures.items() if value is not None}
    maps = [
        " ".join(filter(None, (name, text.get(f"{name}_flow_error"), _in_brackets(text.get(f"{name}_method")))))
        for name in ("assumed", "refined")
        if f"{name}_method" in text
    ]
    if not maps:
        return ""
    told = f"flow{' error' if 'assumed_flow_error' in text else ''}: {', '.join(maps)}"
    if "stated_flow_error" in text:
        told += f"; the map states an error of {text['stated_flow_error']}"
    return told


def _unmet_text(figures: Mapping[str, Value]) -> str:
    """Sentence on the amplitude that the coils could not make; '' if they made all of it."""
    missing = figures.get("unmet_mt")
    if not missing:
        return ""
    return f"the field was {text_of_figure('unmet_mt', missing)} weaker than asked for: a limit of the coils"


def _in_brackets(text: str | None) -> str:
    return f"({text})" if text else ""


def goal_text(goal_um: Floats | None) -> str:
    """The goal (2,) of a mission, um on the chip; 'none' without one, or where it is not finite."""
    if goal_um is None or not all(map(math.isfinite, goal_um)):
        return "none"
    return f"({goal_um[0]:.0f}, {goal_um[1]:.0f}) um"


def learned_text(refined: FlowField | None) -> str:
    """Findings of the last refinement, or the reason of its refusal; '' without a refinement."""
    if refined is None:
        return ""
    if refined.refused:
        return f"the refined flow was refused, the map in use stays: {refined.refused}"
    first, _, rest = refined.note.partition("; ")
    if first.startswith(_ASSIMILATED):
        return f"learned from {first.removeprefix(_ASSIMILATED)}: {rest}" if rest else ""
    return f"learned: {refined.note}" if first else ""


def verdict_lines(figures: Mapping[str, Value], refined: FlowField | None = None) -> list[str]:
    """Sentences of every picture and page about a run: its end, the reason, its doubts, the way, the flow, findings.

    What is not known is left out. The first one begins with the outcome; units are spelt as in pictures.
    """
    doubts = [f"doubtful: {doubt}" for doubt in doubts_of(figures)]
    ended, note = end_text({**figures, "note": ""}), str(figures.get("note") or "")
    ended += ", doubtful" if ended and doubts else ""
    flow = flow_text(figures)
    asked = flow or not ended or refined is None or not refined.refused  # else no flow was: an open field
    told = [ended, note, *doubts, way_text(figures), _unmet_text(figures), flow, learned_text(refined) if asked else ""]
    return [with_micro(text[:1].upper() + text[1:]) for text in told if text]


def with_micro(text: str) -> str:
    """Text for a picture or a page: um and +-, as a terminal and a file may have them, as µm and ±."""
    return _UM.sub("µm", text).replace("+-", "±")


def text_for_picture(text: str, longest: int) -> str:
    """Text of a file for a picture or a page: printable, units as there, of so many characters at most."""
    shown = with_micro(printable(text))
    return shown if len(shown) <= longest else shown[: longest - 2] + " …"


def is_numeric(key: str) -> bool:
    """True if the value of a key is a number, by its name."""
    return key in _COUNTS or key.endswith(tuple(_UNITS))


def is_count(key: str) -> bool:
    """True if that number is whole."""
    return key in _COUNTS or key.endswith(_WHOLE)


def _number(text: str) -> Value:
    if len(text) > _LONGEST:
        return text
    for kind in (int, float):
        try:
            number = kind(text)
        except ValueError:
            continue
        return number if math.isfinite(number) else text
    return text
