"""The plots that Rerun and Foxglove show of a session file itself: fields of messages, by topic."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from flowrec.core import SAMPLES, Message, Topic, message_fields


@dataclass(frozen=True, slots=True)
class Plot:
    """One plot over time.

    Attributes
    ----------
    title : with the unit.
    topic, lines : of the messages, and the names of the lines by the field that each shows.
    points : single points, not lines.
    """

    title: str
    topic: str
    lines: dict[str, str]
    points: bool = False


_FLOW = {"flow_um_s": "measured", "map_um_s": "map", "difference_um_s": "difference"}
# Plots of one group are behind each other.
PLOTS: dict[str, tuple[Plot, ...]] = {
    "flow": (
        Plot("Flow at the robot (µm/s)", "/view/robot_flow", _FLOW),
        Plot("Observations (µm/s)", "/view/observation", _FLOW, points=True),
    ),
    "error": (
        Plot("Tracking error (µm)", "/control/demand", {"error_um": "tracking error"}),
        Plot("Relative error that the map states", "/view/robot_flow", {"map_error_share": "of the map"}),
    ),
    "coils": (
        Plot("Field (Hz)", "/coils/command", {"frequency_hz": "frequency"}),
        Plot("Heading (rad)", "/coils/command", {"heading_rad": "heading"}),
        Plot("Field (mT)", "/coils/command", {"amplitude_mt": "amplitude"}),
    ),
}
# Along the latest route: the first field is that of the x axis.
ROUTE = Plot(
    "Flow along the route (µm/s over µm)",
    "/view/route_flow",
    {"distance_um": "", "map_um_s": "speed", "along_um_s": "along the route", "std_um_s": "1 σ"},
)
STATES = {"/run/mission": ("phase", "mission"), "/run/health": ("alarm", "alarm")}  # field and name by topic
IMAGE = "/camera/frame"
MAPS = {"/view/flow_assumed": "Assumed flow", "/view/flow_refined": "Refined flow"}
ON_IMAGE = ("/camera/frame/path", "/camera/frame/goal", "/camera/frame/robot")  # points on the chip
EVENTS = ("/run/events", "/operator/events")
_LINES = 12  # in one plot at most


def plot_of(topic: Topic, first: Message | None) -> Plot | None:
    """The plot of an extra topic: all of its floats and, by its first message, the elements of its vectors."""
    lines: list[str] = []
    for each in message_fields(topic.type):
        if each.is_float and each.dtype is None:
            lines.append(each.name)
        elif each.kind == "vector" and first is not None:
            lines += [f"{each.name}[{number}]" for number in range(len(getattr(first, each.name)))]
    return Plot(topic.path, topic.path, {line: line for line in lines[:_LINES]}) if lines else None


def stream_plots(units: Mapping[str, str]) -> list[Plot]:
    """A plot of each stream, with the latest values of its channels; `units` by name stream/channel, in order."""
    streams: dict[str, dict[str, str]] = {}
    for place, (name, unit) in enumerate(units.items()):
        lines = streams.setdefault(name.partition("/")[0], {})
        if len(lines) < _LINES:
            lines[f"latest[{place}]"] = f"{name} ({unit})" if unit else name
    return [Plot(f"Stream {stream}", SAMPLES, lines) for stream, lines in streams.items()]
