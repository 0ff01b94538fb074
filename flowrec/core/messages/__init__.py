"""The records that rigs, stages and the operator make: frozen, read-only, with units in the field names.

What a stage carries from one frame to the next is one of these, and each of them is recorded, so a session can be
replayed from any tick. Annotations (declarations.py) state the shape of each array and the topic of each field of
`Tick`; the wire format, the checks of what is read and the table of topics derive from them.

Chip frame: origin at the centre of the mask's pixel (0, 0), x right, y down; headings from +x towards +y.
Points are (x, y); arrays are [row, column] = [y, x]. Stamps are nanoseconds on the session clock.
"""

from flowrec.core.messages.control import AxesCheck, Currents, Demand, Event, Mission
from flowrec.core.messages.estimation import WALLS, Estimate, Health, Observations, RobotWalls
from flowrec.core.messages.rig import (
    PIXEL_BITS,
    Applied,
    Frame,
    Hand,
    Measured,
    OperatorEvent,
    TracerTruth,
    Truth,
    pixel_type,
)
from flowrec.core.messages.slow_stages import FlowField, Route
from flowrec.core.messages.streams import (
    BY_STREAM,
    EXPECTED,
    HEARD,
    PUMP,
    SAMPLES,
    SILENT,
    STREAMS,
    PumpShare,
    Samples,
    StreamStates,
)
from flowrec.core.messages.vision import Appearance, Background, Shift, Tracers, Track, shift_px

__all__ = [
    "BY_STREAM",
    "EXPECTED",
    "HEARD",
    "PIXEL_BITS",
    "PUMP",
    "SAMPLES",
    "SILENT",
    "STREAMS",
    "WALLS",
    "Appearance",
    "Applied",
    "AxesCheck",
    "Background",
    "Currents",
    "Demand",
    "Estimate",
    "Event",
    "FlowField",
    "Frame",
    "Hand",
    "Health",
    "Measured",
    "Mission",
    "Observations",
    "OperatorEvent",
    "PumpShare",
    "RobotWalls",
    "Route",
    "Samples",
    "Shift",
    "StreamStates",
    "TracerTruth",
    "Tracers",
    "Track",
    "Truth",
    "pixel_type",
    "shift_px",
]
