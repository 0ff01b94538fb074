"""The names of everything that is logged, shown by blueprint.py and read by people in the viewer."""

from __future__ import annotations

from rerun import new_entity_path

SESSION_TIME = "session time"
FRAME = "frame"

IMAGE = "camera/image"
OUTLINE = "camera/chip outline"
ARROWS = "camera/flow arrows"
PATH = "camera/path"
PATH_LABEL = "camera/path label"
GOAL = "camera/goal"
REFERENCE = "camera/reference"
TRAIL = "camera/trail"
ROBOT = "camera/robot"
ROBOT_LABEL = "camera/robot label"
COMMAND = "camera/commanded velocity"

ASSUMED = "flow/assumed/speed"
REFINED = "flow/refined/speed"
TRUE = "flow/truth/speed"
CHANGE = "flow/change/map"
UNCERTAINTY = "flow/uncertainty/map"
NOT_YET = "not yet"  # beside a map that comes later in the session
SPEED_SCALE = "flow/speed scale"  # colour bar and ticks, common to all maps of speed
CHANGE_SCALE = "flow/change/scale"
UNCERTAINTY_SCALE = "flow/uncertainty/scale"
TIME_TO_GO = "plan/time to go/map"
TIME_TO_GO_SCALE = "plan/time to go/scale"

CURRENT = "coils/current"
FREQUENCY = "coils/frequency"
HEADING = "coils/heading"
TRACKING_ERROR = "robot/tracking error"
ESTIMATE_ERROR = "robot/estimate error"
FLOW_COMPONENTS = "robot/flow components"
FLOW_SPEED = "robot/flow speed"
NIS = "robot/observer NIS"
NIS_MEAN = "robot/observer NIS, mean"
PULSATION = "robot/pulsation"
VOLTAGE = "coils/voltage"
TIMING = "run/timing"
PHASE = "run/phase"
SIGHT = "run/sight"
EVENTS = "run/events"
OPERATOR = "run/operator"


def under(prefix: str, entity: str) -> str:
    """The entity's full path, escaped as Rerun wants it; `prefix` is '', 'recorded' or 'replayed'."""
    return new_entity_path([part for part in (prefix, *entity.split("/")) if part])
