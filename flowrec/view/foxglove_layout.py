"""A layout for Foxglove and Lichtblick: camera with overlays, maps, plots, phases and log of a session file.

Both import it with Layouts > Import from file. Topics that a file does not have leave their panels empty.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

from flowrec.store import HEIGHT
from flowrec.view.bare_plots import EVENTS, IMAGE, ON_IMAGE, PLOTS, ROUTE, STATES, Plot

_COLOURS = ("#4e98e2", "#f5774d", "#f7df71")
_MAP = "/view/flow_refined"
_VIRIDIS = ("#440154ff", "#fde725ff")  # its ends: the colours of the other pictures
# Of points. Without a mode and a field Foxglove colours them by x.
_OWN_COLOURS = {"colorMode": "rgba-fields", "colorField": "red"}

Panel = dict[str, Any]


def foxglove_layout(
    centre: tuple[float, float],
    size: float,
    extra: Sequence[Plot] = (),
    unit: str = "mm",
    top_um_s: float | None = None,
) -> dict[str, Any]:
    """The layout as JSON data, for a chip with this centre and longer side in a unit; `extra`: plots of extra topics.

    `unit` is that of the lengths in the file's viewer topics, m in files of older flowrec; `top_um_s` the highest speed
    of the refined flow, None without one.
    """
    panels: dict[str, Panel] = {
        "Image!camera": _image("Camera", IMAGE, "/view/camera"),
        "Image!map": _image("Refined flow", _MAP, "/view/map"),
        "3D!chip": _chip(centre, size, unit, top_um_s),
        "Plot!route": _along_route(),
        "StateTransitions!states": _states(),
        "RosOut!log": {"searchTerms": [], "preload": True, "minLogLevel": 1, "topicToRender": EVENTS[0]},
        "Tab!maps": _tab({"Refined flow": "Image!map", f"Chip ({unit})": "3D!chip"}),
    }
    groups = PLOTS | ({"extra": tuple(extra)} if extra else {})
    for name, group in groups.items():
        found = {f"Plot!{name}{number}": plot for number, plot in enumerate(group)}
        panels |= {panel: _plot(plot) for panel, plot in found.items()}
        tabs = {plot.title: panel for panel, plot in found.items()}
        panels[f"Tab!{name}"] = _tab(tabs | ({"Route": "Plot!route"} if name == "flow" else {}))
    states = _split("column", "StateTransitions!states", "RosOut!log", 40)
    coils = _split("row", "Tab!coils", "Tab!extra", 50) if extra else "Tab!coils"
    below = _split("row", states, _split("row", "Tab!flow", _split("row", "Tab!error", coils, 50), 36), 28)
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _split("column", _split("row", "Image!camera", "Tab!maps", 58), below, 60),
    }


def _image(title: str, topic: str, calibration: str) -> Panel:
    """An image; what is drawn over that of the camera is in its pixels, over a map projected from the chip."""
    in_pixels = topic == IMAGE
    return {
        "foxglovePanelTitle": title,
        "imageMode": {
            "imageTopic": topic,
            "calibrationTopic": calibration,
            "annotations": {name: {"visible": in_pixels} for name in ("/view/route_mark", "/view/robot_mark")},
            "synchronize": False,
        },
        "topics": {name: {"visible": not in_pixels, "pointSize": 3, **_OWN_COLOURS} for name in ON_IMAGE},
        "followTf": "chip",
    }


def _chip(centre: tuple[float, float], size: float, unit: str, top_um_s: float | None) -> Panel:
    """Flow, route and robot on the chip, seen from where the camera is: x to the right, y down."""
    grid: Panel = {"visible": True, "colorMode": "gradient", "gradient": list(_VIRIDIS), "colorField": "speed_um_s"}
    if top_um_s:
        grid |= {"minValue": 0.0, "maxValue": top_um_s}  # by itself Foxglove takes 0 to 1
    return {
        "foxglovePanelTitle": f"Chip ({unit})",
        "cameraState": {
            # Only a camera with perspective can look along z.
            "perspective": True,
            "distance": 1.4 * size,
            "phi": 180,
            "thetaOffset": 0,
            "target": [0, 0, 0],
            "targetOffset": [*centre, 0],
            "targetOrientation": [0, 0, 0, 1],
            "fovy": 45,
            "near": 0.01 * size,
            "far": 1000.0 * size,
        },
        "followMode": "follow-none",
        "followTf": "chip",
        "scene": {"transforms": {"showLabel": False, "axisSize": 0.0, "axisScale": 0.0, "lineWidth": 0.0}},
        "topics": {
            **{name: {"visible": True, "pointSize": 4, **_OWN_COLOURS} for name in ON_IMAGE},
            "/view/flow_refined_grid": grid,
            IMAGE: {"visible": False, "cameraInfoTopic": "/view/camera", "distance": HEIGHT[unit]},
        },
        "layers": {},
    }


def _plot(plot: Plot) -> Panel:
    paths = [
        {
            **_path(plot.topic, field, label),
            "color": colour,
            "showLine": not plot.points,
            "lineSize": 2.5 if plot.points else 1.5,
        }
        for (field, label), colour in zip(plot.lines.items(), itertools.cycle(_COLOURS), strict=False)
    ]
    return {
        "foxglovePanelTitle": plot.title,
        "paths": paths,
        "xAxisVal": "timestamp",
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "showLegend": len(paths) > 1,
        "legendDisplay": "floating",
        "showPlotValuesInLegend": False,
        "isSynced": True,
        "sidebarDimension": 240,
    }


def _along_route() -> Panel:
    """Numbers along the route over the distance along it."""
    (distance, _), *lines = ROUTE.lines.items()
    panel = _plot(Plot(ROUTE.title, ROUTE.topic, {f"{field}[:]": label for field, label in lines}))
    axis = {"value": f"{ROUTE.topic}.{distance}[:]", "enabled": True}
    return panel | {"xAxisVal": "currentCustom", "xAxisPath": axis, "isSynced": False}


def _states() -> Panel:
    return {"paths": [_path(topic, *state) for topic, state in STATES.items()], "isSynced": True}


def _path(topic: str, field: str, label: str) -> Panel:
    """A field of a topic as it is at each time that a message was received."""
    return {"value": f"{topic}.{field}", "label": label, "enabled": True, "timestampMethod": "receiveTime"}


def _tab(panels: dict[str, str]) -> Panel:
    tabs = [{"title": title, "layout": panel} for title, panel in panels.items()]
    return {"activeTabIdx": 0, "tabs": tabs}


def _split(direction: str, first: Any, second: Any, percentage: float) -> dict[str, Any]:
    return {"direction": direction, "first": first, "second": second, "splitPercentage": percentage}
