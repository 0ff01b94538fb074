"""Inputs of one tick, and the tick before any stage has run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

from flowrec.core import (
    BY_FIELD,
    FIXED,
    NO_EXTRA,
    TOPICS,
    Appearance,
    Applied,
    Background,
    CameraLosses,
    Delays,
    Extra,
    Fit,
    FlowField,
    Frame,
    Hand,
    Measured,
    Message,
    OperatorEvent,
    RigError,
    Role,
    Route,
    Shift,
    Source,
    Tick,
    TopicTable,
    Tracers,
    TracerTruth,
    Track,
    Truth,
)


@dataclass(frozen=True, slots=True)
class Inputs:
    """Inputs of one tick: from the rig, the operator and the worker. None: nothing new."""

    stamp_ns: int
    frame: Frame | None  # None only in a replay of a recording that had to drop the image
    applied: Applied
    operator: OperatorEvent | None = None
    assumed: FlowField | None = None  # adopted on this tick
    refined: FlowField | None = None
    route: Route | None = None
    truth: Truth | None = None  # for the record only, no stage reads it
    true_field: FlowField | None = None  # likewise
    true_tracers: TracerTruth | None = None  # likewise
    track: Track | None = None  # the recorded one, if `frame` was dropped
    appearance: Appearance | None = None  # likewise, if it changed then
    background: Background | None = None  # likewise
    shift: Shift | None = None  # likewise
    tracers: Tracers | None = None  # likewise
    clock: Fit | None = None  # of the camera's clock, with which the stamp was made
    losses: CameraLosses | None = None  # of the camera so far, for the record only
    measured: Measured | None = None  # currents of the coils, by an amplifier that measures them; for the record only
    hand: Hand | None = None  # the sample by which the operator steers on this tick, or why he does no longer
    delays: Delays | None = None  # of the image and of the latest command, for the record only
    extra: Mapping[str, Message] = NO_EXTRA  # new messages of the extra topics of rig and simulator, by path


# Fields of a Tick that arrive from outside, and those of them that stay known until the next message.
ARRIVING = tuple(topic.field for topic in TOPICS if topic.role in (Role.INPUT, Role.TRUTH))
HELD = tuple(name for name in ARRIVING if BY_FIELD[name].source in (Source.RIG, Source.OPERATOR, Source.WORKER))
# The results of the stages that read the image: where it was not recorded, a replay takes these.
FROM_IMAGE = ("track", "appearance", "background", "shift", "tracers")
if {each.name for each in fields(Inputs)} != {"stamp_ns", *FROM_IMAGE, "clock", "losses", "delays", "extra", *ARRIVING}:
    raise TypeError(f"stages.Inputs needs a field for each input of Tick: {', '.join(ARRIVING)}")


def with_inputs(last: Tick, inputs: Inputs, topics: TopicTable = FIXED) -> Tick:
    """The tick after `last` before any stage has run: the state of `last` with the new inputs.

    Raises RigError: a message of a topic that the run does not declare.
    """
    new: dict[str, Any] = {name: message for name in HELD if (message := getattr(inputs, name)) is not None}
    if inputs.extra:
        new["extra"] = last.extra.with_messages(_of_source(inputs.extra, topics, Source.RIG))
    return replace(
        last, stamp_ns=inputs.stamp_ns, frame=inputs.frame, truth=None, true_field=None, true_tracers=None, **new
    )


def recorded_extra(tick: Tick, inputs: Inputs, topics: TopicTable) -> Extra:
    """The messages of the extra topics that are recorded with a tick: those of a simulator, too."""
    return tick.extra.with_messages(_of_source(inputs.extra, topics, Source.SIMULATOR)) if inputs.extra else tick.extra


def _of_source(extra: Mapping[str, Message], topics: TopicTable, source: Source) -> dict[str, Message]:
    for path in extra:
        if path not in topics.by_field:
            raise RigError(f"{path}: the rig has a message of this topic, which no row of `topics` declares; add it")
    return {path: message for path, message in extra.items() if topics.by_field[path].source is source}
