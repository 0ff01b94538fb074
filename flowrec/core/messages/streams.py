"""Samples of the streams of other programs, and the state of these streams: inputs of the run, beside its stages.

All streams of a run share two topics, so that a stream of a thousand samples a second costs the loop one message a
tick, whatever the number of its channels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from flowrec.core.declarations import NOT_STATED, Ints, Matrix, Message, Shape, Vector

SAMPLES, STREAMS, PUMP = "/streams/samples", "/streams/state", "/flow/pump"  # paths of the topics
BY_STREAM = "stream "  # the text of an operator's event that a stream has caused begins so
EXPECTED, HEARD, SILENT = 0, 1, 2  # of StreamStates.state


@dataclass(frozen=True, slots=True, eq=False)
class Samples(Message):
    """Samples that have come since the tick before, a row a value: in order of arrival within a stream."""

    stamp_ns: int
    channel: Annotated[
        NDArray[np.int32], "array", Shape("n"), "place of the channel in StreamStates.channels, the first is 0"
    ]
    sample_ns: Annotated[Ints, "array", Shape("n"), "when it was taken, on the session clock"]
    value: Annotated[Matrix, Shape("n", finite=False), "in the unit of the channel"]
    latest: Annotated[
        Vector, Shape("m", finite=False), "latest value of each channel so far, for plots; NaN before the first"
    ]


@dataclass(frozen=True, slots=True, eq=False)
class StreamStates(Message):
    """Streams of a run, s of them: about once a second, and when one stops, comes back or has a channel more."""

    stamp_ns: int
    streams: Annotated[str, "their names, a line each"]
    channels: Annotated[str, "all channels as stream/channel, a line each"]
    units: Annotated[str, "unit of each channel, a line each; empty where nobody states it"]
    state: Annotated[NDArray[np.int32], "array", Shape("s"), "0: nothing has come yet, 1: it comes, 2: it is silent"]
    samples: Annotated[Ints, "array", Shape("s"), "samples so far, each with all channels of its stream"]
    lost: Annotated[Ints, "array", Shape("s"), "samples thrown away by the queue before the loop, so far"]
    missing: Annotated[Ints, "array", Shape("s"), "samples that gaps in the stamps of a regular stream tell of, so far"]
    steps: Annotated[Ints, "array", Shape("s"), "steps of the sender's clock that were taken out, so far"]
    restarts: Annotated[Ints, "array", Shape("s"), "how often the stream has come back, so far"]
    correction_s: Annotated[
        Vector,
        Shape("s", finite=False),
        "added to the sender's stamps, to have them on the clock of this machine; NaN: unknown",
    ]
    age_s: Annotated[Vector, Shape("s", finite=False), "mean time from sample to arrival since the message before"]
    jitter_s: Annotated[Vector, Shape("s", finite=False), "standard deviation of that time"]

    def channel_names(self) -> list[str]:
        """All channels as stream/channel, in the order of `Samples.channel`."""
        return self.channels.split("\n") if self.channels else []

    def stream_names(self) -> list[str]:
        """The streams, in the order of the arrays."""
        return self.streams.split("\n")


@dataclass(frozen=True, slots=True, eq=False)
class PumpShare(Message):
    """The pump's measured flow over the one at which the inlets have the speeds that the chip states."""

    stamp_ns: int
    share: Annotated[float, "now, as far as it has been measured"]
    slow_share: Annotated[float, "a mean over some seconds, with which routes are planned"]
    observed_share: Annotated[float, "a mean over the time of which an observation of the flow is a mean"]
    sample_ns: Annotated[int, "time that the latest sample tells of, on the session clock"]
    mark_s: Annotated[
        Vector, Shape("n"), "times of some ticks of the last seconds and of this one; (0,) without tracers"
    ] = NOT_STATED
    flowed_s: Annotated[Vector, Shape("n"), "integral of the share over time up to each of these"] = NOT_STATED
    inlets: Annotated[
        Vector,
        Shape("m"),
        "Of several pumps, four numbers an inlet: share, slow share, observed share, and the time in s that its latest "
        "sample tells of; the shares above are means by the inflow of each. (0,) of one pump.",
    ] = NOT_STATED
