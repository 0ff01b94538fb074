"""Settings of the streams of other programs, a section [streams.NAME] each; and the two topics that they share."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from flowrec.core import PUMP, SAMPLES, STREAMS, Method, Methods, PumpShare, Range, Samples, Source, StreamStates, Topic

SIMULATED_STREAM, LOG = "simulated", "log"
# Rows are rigs.streams.stream.SampleStream: `of(name, settings)` makes one. One that needs the rig comes from there.
STREAM_KINDS = Methods(
    "streams.NAME.kind",
    Method("lsl", "flowrec.rigs.streams.lsl:LslStream", "an outlet of the Lab Streaming Layer", extra="streams"),
    Method(
        "serial",
        "flowrec.rigs.streams.serial_output:SerialOutput",
        "a lamp, a valve or a generator on a serial port, which is set and recorded",
        extra="serial",
    ),
    Method(LOG, "flowrec.rigs.streams.log:LogStream", "what a program of Python gives to flowrec.RunLog.log"),
    Method(
        SIMULATED_STREAM,
        "flowrec.rigs.simulated.pump:PumpSensor",
        "a flow sensor at the simulated pump",
        needs=("rig",),
    ),
    group="flowrec.streams",
    verb="of",
)
STREAM_TOPICS = (Topic(SAMPLES, Source.RIG, type=Samples), Topic(STREAMS, Source.RIG, type=StreamStates))
PUMP_TOPIC = Topic(PUMP, Source.STAGE, 1e-6, type=PumpShare)


@dataclass(frozen=True, slots=True)
class StreamSettings:
    """A stream of samples that another program or device sends. They are recorded, and replayed as inputs."""

    kind: Annotated[str, STREAM_KINDS] = "lsl"  # source of the samples; flowrec methods streams tells what each is
    outlet: str = ""  # name of the outlet; '': that of this section
    # predicate in XPath that tells the outlet from others of its name, such as "type='Pump'"
    query: str = ""
    channels: tuple[str, ...] = ()  # names of the channels, in order; []: as the stream states them
    unit: str = ""  # unit of all channels; '': as the stream states them
    # Time without a sample after which the stream is silent. None: three periods of its rate, but at least 1 s
    silence_s: Annotated[float, Range(0.01, 1e5)] | None = None
    # answer to a stream that is silent: note an event, also hold the robot until it is back, or also end the run
    on_silence: Literal["note", "hold", "stop"] = "note"
    # time in which the stream has to be found before the run; with on_silence = note the run begins without it
    wait_s: Annotated[float, Range(0.1, 600.0)] = 5.0
    # largest number of samples that may wait for the loop; beyond it the oldest are lost
    queue_samples: Annotated[int, Range(1, 10_000_000)] = 100_000
    # settings of a kind that has its own: `serial` (rigs/streams/serial_output.py), and those of other packages
    device: dict[str, Any] = field(default_factory=dict)
