"""Meanings of the outcomes and figures of a run, for a reader who has not flown one."""

from __future__ import annotations

from flowrec.core import Outcome

LONGEST = 2000  # characters of one text of a session

OUTCOMES: dict[str, str] = {
    Outcome.REACHED: "The robot reached its goal.",
    Outcome.SURVEY_COMPLETE: "The survey was completed; the mission asked for no more.",
    Outcome.REFINE_COMPLETE: "The flow was refined; the mission asked for no more.",
    Outcome.PLAN_COMPLETE: "A route was planned; the mission asked for no more.",
    Outcome.OBSERVE_COMPLETE: "The robot was observed to the end.",
    Outcome.STOPPED: "The run was stopped by a person, a signal or the disk monitor.",
    Outcome.TIME_OVER: "The time that the run was given was over.",
    Outcome.TIMEOUT: "A phase of the mission took longer than it may.",
    Outcome.UNREACHABLE: "No route leads to the goal.",
    Outcome.REFUSED: "The robot does not move as the axes of camera and coils say.",
    Outcome.NOT_FOUND: "The robot was never seen.",
    Outcome.LOST: "The robot was lost from view.",
    Outcome.GAVE_UP: "The mission gave up.",
    Outcome.FAILED: "The run failed.",
    Outcome.REPLAYED: "This is a replay: recorded inputs, computed again.",
    Outcome.ENDED: "The file was recovered after the run had ended; nothing was lost.",
    Outcome.CUT: "The file was recovered from a run that was cut off; its end is missing.",
    Outcome.CONTINUED: "This is a part of a run; the next part follows.",
    Outcome.SNAPSHOT: "This is a snapshot: the time around an event.",
}

# By the key of a figure; names and units are those of flowrec.core.summary.
MEANINGS: dict[str, str] = {
    "duration_s": "session time, from the first image to the last",
    "ticks": "steps of the loop: one an image, and of a movie some after the last, which wait for the refinement",
    "axes_check": "whether the robot moved as camera and coils say, before anything was controlled",
    "planner": "method of the route",
    "route_length_um": "of the route to the goal",
    "planned_s": "of the route, as planned",
    "navigation_s": "taken for the route",
    "latest_goal": "set by the operator during the run",
    "speed_limit_um_s": "set by the operator, of the robot through the fluid",
    "unmet_mt": "of coils.amplitude_mt, what the limits of current and voltage of the coils did not permit",
    "contacts": "counted by the simulation",
    "robot": "a robot beside the mission's one; wall contacts are counted by the simulation",
    "tracers": "bodies beside the robots that drift with the flow",
    "assumed_method": "how the flow was computed before the run",
    "assumed_flow_error": "root mean square difference from the simulated true flow, relative to that flow",
    "refined_method": "how the flow was corrected in the run",
    "refined_flow_error": "the same after the refinement",
    "observations": "places where the flow was measured by the motion of the robot",
    "tracking_error_um": "root mean square distance to the route while navigating",
    "loop_priority": "of the control loop in the operating system",
    "frames_dropped": "images that were not written",
    "map": "method of the best map",
    "residual_um_s": "root mean square of observed minus mapped flow",
    "travel_time_on_replayed_map_s": "of the route, in the flow of the replay's map",
    "controller": "control law",
    "shortest_way_um": "from where the last route begins to the goal, for comparison",
    "shortest_way_s": "time on the shortest way by the same map; empty where the flow is too fast on it",
    "commands_compared": "demands of the controller, one an image",
    "commands_changed": "of them, by more than 1 µm/s",
    "commands_difference_rms_um_s": "of the demanded velocity, root mean square",
    "first_changed_command_s": "session time",
    "stated_flow_error": "what the best map expects its error to be",
    "frames_missing_from_camera": "images that the camera did not deliver",
}

# What the words of this page mean.
GLOSSARY: tuple[tuple[str, str], ...] = (
    ("session", "one recorded run in one file; all times are session time, in seconds"),
    ("assumed flow", "the map of the flow that is computed from the shape of the chip and the stated inflow"),
    ("refined flow", "that map, corrected by what the robot experienced in the flow"),
    ("phase", "part of the mission; the coloured strip above the curves"),
    ("survey", "phase in which the robot swims to learn the flow"),
    ("observer", "estimates position and flow at the robot from camera images and coil commands (a Kalman filter)"),
    ("observation", "flow at one place, measured by the motion of the robot, with its standard deviation"),
    ("route", "the planned path, with the time at which each point should be passed"),
    ("replay", "recorded inputs through the same program again, with the same or other methods and settings"),
)


def sentence(outcome: str) -> str:
    """Meaning of an outcome; '' for a word of another version."""
    return OUTCOMES.get(outcome, "")
