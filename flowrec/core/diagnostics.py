"""Messages about the recording itself: times, losses, clocks. No stage reads them and no replay compares them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from flowrec.core.declarations import Message


@dataclass(frozen=True, slots=True, eq=False)
class Timing(Message):
    """Wall time of each part of this tick. Diagnostic: never compared."""

    stamp_ns: int
    track_ms: Annotated[float, "wall time of tracking"]
    observe_ms: Annotated[float, "wall time of the observer"]
    control_ms: Annotated[float, "wall time of mission, controller, coils and rig"]
    sinks_ms: Annotated[float, "wall time of handing the tick before this one over to recorder and viewer"]
    total_ms: Annotated[float, "wall time of the whole tick"]
    queue_mb: Annotated[float, "data that waits for the disk"]
    dropped_frames: Annotated[int, "images not recorded so far"]
    apply_ms: Annotated[float | None, "part of control_ms until the amplifier has the command; None: not stated"] = None
    arrival_ms: Annotated[
        float | None, "from the middle of the exposure to the arrival of the image; None: no camera, or not stated"
    ] = None
    wait_ms: Annotated[float | None, "from the arrival of the image to the begin of the tick; None: not stated"] = None
    field_ms: Annotated[
        float | None,
        "from a command at the amplifier to the field that it asks for, by the log of the outputs; of the latest one "
        "of which it is known, None before it",
    ] = None


@dataclass(frozen=True, slots=True)
class Delays:
    """Delays that a rig of devices knows, for `Timing`; None: it does not know.

    Attributes
    ----------
    arrival_ms, field_ms : as of Timing.
    arrived_ns : of the image, on the host's monotonic clock; None: there is no image.
    """

    arrival_ms: float | None
    arrived_ns: int | None
    field_ms: float | None


@dataclass(frozen=True, slots=True, eq=False)
class Drops(Message):
    """Losses of a topic so far, written when they begin, change and end. Diagnostic."""

    stamp_ns: int
    topic: Annotated[str, "topic that has losses"]
    by_backlog: Annotated[int, "number not written because disk or processor was slower than the camera"]
    by_camera: Annotated[int, "number never delivered by the camera: gaps in the frame index"]
    kept_every: Annotated[int, "from now on every n-th frame is written; 1: all"]


@dataclass(frozen=True, slots=True, eq=False)
class Clocks(Message):
    """Wall clock and camera clock, about once a second and after each step or fault of one. Diagnostic."""

    stamp_ns: int
    monotonic_ns: Annotated[int, "monotonic clock of the host, read together with wall_ns"]
    wall_ns: Annotated[int, "time of day since 1970, UTC"]
    wall_set_s: Annotated[float, "sum of all steps of the wall clock since the run began"]
    wall_jumps: Annotated[int, "number of these steps"]
    passed_over: Annotated[int, "frames rejected because their stamp did not increase"]
    device: Annotated[int, "raw count of the camera's clock at its latest frame"]
    arrival_ns: Annotated[int, "stamp at which that frame arrived, on the session clock"]
    fitted_ns: Annotated[int, "predicted earliest arrival (lower envelope of the arrival times)"]
    rate: Annotated[
        float, "ns of the session clock per count: the fit is fitted_ns + rate (counts - device); 0: no clock"
    ]
    known: Annotated[bool, "whether the rate has been measured"]
    late_s: Annotated[float, "mean of arrival - fit since the previous message"]
    latest_s: Annotated[float, "maximum of arrival - fit since the previous message"]
    duplicates: Annotated[int, "frames delivered twice, so far"]
    disordered: Annotated[int, "frames older than their predecessor, so far"]
    wraps: Annotated[int, "overflows of the counter, so far"]
    resets: Annotated[int, "backward steps of the camera's clock, each followed by a new fit, so far"]
    jumps: Annotated[int, "forward steps or stops of it, each followed by a new fit, so far"]
    unit: Annotated[float, "apparent length of a count in ns if it differs from the declared one; else 0"]


@dataclass(frozen=True, slots=True, eq=False)
class CameraLosses(Message):
    """Blocks (images) that a camera has counted so far, and what became of them. Diagnostic.

    ids = frames + link + incomplete + driver + backlog.
    """

    stamp_ns: int
    ids: Annotated[int, "by the camera's own block ids, unwrapped"]
    frames: Annotated[int, "handed on to the loop"]
    link: Annotated[int, "gaps of the ids: lost in the camera or on the link"]
    incomplete: Annotated[int, "arrived with parts missing, or marked as bad by the camera"]
    driver: Annotated[int, "thrown away by the driver, whose buffers were full"]
    backlog: Annotated[int, "thrown away by the queue before the loop, because the loop was slower than the camera"]
    triggers: Annotated[int, "triggers that no block has answered; not among the ids"]
    reconnections: Annotated[int, "the camera was absent and came back; blocks of the time between are not known"]
