"""Settings of the rig: plain data, so that a configuration can be read without starting a camera or a solver."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from flowrec.core import Method, Methods, OneOf, Range
from flowrec.movies import MOVIE_READERS

SIMULATED, MOVIE, LAB = "simulated", "movie", "lab"
# `of(pipeline, config, duration_s, realtime)` of a row's class makes the rig, a rigs.rig.Rig.
RIGS = Methods(
    "rig",
    Method(SIMULATED, "flowrec.rigs.simulated.rig:SimulatedRig", "a simulated microscope, coils and robot"),
    Method(MOVIE, "flowrec.rigs.movie.rig:MovieRig", "a movie, and the log of what the coils did", extra="movies"),
    Method(LAB, "flowrec.rigs.lab.rig:LabRig", "the camera and the coil amplifiers of a lab", needs=("realtime",)),
    group="flowrec.rigs",
    verb="of",
)
# Rows are rigs.lab.cameras.camera.Camera: `of(wanted)` makes one.
CAMERAS = Methods(
    "lab.camera",
    Method("genicam", "flowrec.rigs.lab.cameras.genicam:GenicamCamera", "GigE and USB3 Vision", extra="genicam"),
    Method("pylon", "flowrec.rigs.lab.cameras.pylon:PylonCamera", "Basler cameras by pylon", extra="pylon"),
    Method("mmcore", "flowrec.rigs.lab.cameras.mmcore:MmcoreCamera", "any device of Micro-Manager", extra="mmcore"),
    Method("opencv", "flowrec.rigs.lab.cameras.opencv:OpencvCamera", "webcams, V4L2 devices, streams, by OpenCV"),
    group="flowrec.cameras",
    verb="of",
)
# Rows are rigs.lab.amplifiers.amplifier.Amplifier: `of(config)` makes one of a resolved configuration.
AMPLIFIERS = Methods(
    "lab.amplifier",
    Method("serial", "flowrec.rigs.lab.amplifiers.serial_line:SerialAmplifier", "a microcontroller", extra="serial"),
    Method("ni", "flowrec.rigs.lab.amplifiers.ni:NiAmplifier", "analog outputs by NI-DAQmx", extra="ni"),
    group="flowrec.amplifiers",
    verb="of",
)
_Rate = Annotated[float, Range(0.1, 5e3)]
_Side = Annotated[int, Range(8, 16_384)]
_Bits = Annotated[int, OneOf(8, 10, 12, 14, 16)]
_Scale = Annotated[float, Range(1e-3, 1e3)]
Angle = Annotated[float, Range(-360.0, 360.0)]
_Coordinate = Annotated[float, Range(-1e7, 1e7)]
# See Columns.
_Number = Annotated[float, Range(-1e12, 1e12)]
Column = str | _Number | tuple[str, _Number] | tuple[str, _Number, _Number]
PointUm = tuple[_Coordinate, _Coordinate]


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """Images of the camera, and how the chip lies in them; None: chosen when the configuration is resolved."""

    width_px: _Side = 640  # width of an image
    height_px: _Side = 512  # height of an image
    bits: _Bits = 8  # depth of a pixel; grey levels are below 2^bits
    rate_hz: _Rate | None = None  # images per second; None: chosen to fit the robot's speed
    um_per_px: _Scale | None = None  # size of an image's pixel on the chip; None: the whole chip fills the image
    # File of a registration, which states how the chip lies in the image, and um_per_px. flowrec calibrate image
    # measures them and writes it; its settings go before those of this section.
    registration: str = ""
    angle_deg: Angle = 0.0  # direction of the chip's x axis in the image: 0 right, 90 down
    mirror: bool = False  # the image shows the chip as in a mirror
    centre_um: PointUm | None = None  # chip point at the centre of the image; None: the centre of the chip
    # walls and registration of the first image, where it shows them, in place of those stated
    trace_walls: bool = True
    # Stated by the file of a registration: when it was measured, in which picture, and how far the walls in the
    # picture are from where it puts them (root mean square).
    registered_on: str = ""
    registered_from: str = ""  # file of the registration that was read, for the record
    # root mean square distance of the registered points from where the registration puts them
    residual_um: Annotated[float, Range(0.0, 1e6)] | None = None
    # exposure time of an image; the robot is where it was in the middle of that time
    exposure_s: Annotated[float, Range(0.0, 10.0)] = 0.004

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of an image."""
        return self.width_px, self.height_px

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of an image."""
        return self.height_px, self.width_px


@dataclass(frozen=True, slots=True, kw_only=True)
class ResolvedCamera(CameraSettings):
    """The camera of a resolved configuration: no setting is None but those of which None is a value."""

    rate_hz: _Rate
    um_per_px: _Scale


@dataclass(frozen=True, slots=True)
class Safety:
    """Times after which the watchdog switches the field off, with --realtime and on hardware."""

    # time without a completed tick, while the field is on, after which the watchdog switches it off
    guard_timeout_s: Annotated[float, Range(0.01, 60.0)] = 0.5


@dataclass(frozen=True, slots=True)
class Columns:
    """Section [movie.columns]: where a log of the coils has what. None: the column of that name, if there is one.

    A value is the name of a column; or name and factor, or name, factor and offset, as in `["phi", -1.0, 90.0]` for
    90 - phi; or a number that holds throughout. See stages/control/coil_log.py for what a log must tell.
    """

    # name of the column with the time; a number: that for all rows. None: found by its name
    time_s: Column | None = None
    frequency_hz: Column | None = None  # column of the frequency at which the field rotates, or a number
    # column of the heading: 0 to the right of the chip, 90 downwards; counted upwards: ["phi", -1.0]
    heading_deg: Column | None = None
    amplitude_mt: Column | None = None  # column of the amplitude of the rotating field, or a number
    heading_rad: Column | None = None  # column of the heading in rad, as in applied.csv of flowrec export --format csv
    i_x_a: Column | None = None  # column of the current of the coil pair along x, where the log states currents
    i_y_a: Column | None = None  # column of the current of the coil pair along y
    i_z_a: Column | None = None  # column of the current of the coil pair along z
    b_x_mt: Column | None = None  # column of the field along x, where the log states the field
    b_y_mt: Column | None = None  # column of the field along y
    b_z_mt: Column | None = None  # column of the field along z


@dataclass(frozen=True, slots=True)
class MovieSettings:
    """The movie that the rig `movie` plays, and the log of what its coils did."""

    path: str = ""  # path of the movie: a file, or a folder of images
    reader: Annotated[str, MOVIE_READERS] | None = None  # reader of the movie; None: by the content of the file
    channel: Literal["red", "green", "blue", "grey"] | None = None  # colour channel that is used of a movie in colour
    bits: _Bits | None = None  # depth of the pixels, where the file does not tell it
    partial: bool = False  # a movie that breaks off is used up to there
    times: str = ""  # CSV with a column time_s, a row for each image; '': as the movie tells
    # images per second, where the movie does not tell their times, or instead of them
    rate_hz: Annotated[float, Range(1e-4, 1e6)] | None = None
    coils: str = ""  # log of the coils, CSV or Excel; '': there is none
    drifts: bool = False  # nothing drives the body, so that without a log its motion is that of the flow
    columns: Columns = field(default_factory=Columns)
    # seconds of the log per second of the movie
    clock_rate: Annotated[float, Range(0.01, 100.0)] = 1.0
    # time of the log at the first image; an import finds it by the motion of the robot
    clock_offset_s: Annotated[float, Range(-1e10, 1e10)] = 0.0
    # What the field does from one row of the log to the next: it keeps that of the row, or it changes evenly.
    between_rows: Literal["holds", "linear"] = "holds"
    # The heading in the chip is that of the log, with the opposite sign if it is mirrored, plus this.
    heading_offset_deg: Angle = 0.0
    heading_mirrored: bool = False  # the log counts its headings the other way round


@dataclass(frozen=True, slots=True)
class OutputLimits:
    """Section [lab.output]: limits of the coils besides those of [coils] and [coils.amplifier]."""

    # largest rate of change of a coil's current; None: not limited
    slew_a_s: Annotated[float, Range(1e-3, 1e9)] | None = None
    # longest time for which the coils may be energised; then they rest
    longest_on_s: Annotated[float, Range(0.1, 1e6)] = 3600.0
    # time for which they rest then; a shorter rest gives back a part of it
    rest_s: Annotated[float, Range(1e-3, 1e6)] = 600.0
    # largest difference between the current of a coil as put out and as the amplifier measures it; None: not compared
    measured_within_a: Annotated[float, Range(1e-4, 1e3)] | None = None
    # time for which a difference may be larger; then the coils go to zero and the run ends
    measured_after_s: Annotated[float, Range(0.0, 10.0)] = 0.05


@dataclass(frozen=True, slots=True)
class SerialPort:
    """Section [lab.serial]: the microcontroller of the amplifier `serial`."""

    port: str = ""  # serial port to which it is connected, such as '/dev/ttyACM0'
    baud: Annotated[int, Range(9600, 12_000_000)] = 115_200  # bits per second; a board with USB of its own ignores it


@dataclass(frozen=True, slots=True)
class NiOutputs:
    """Section [lab.ni]: the analog outputs of the amplifier `ni`, and inputs that measure what it does."""

    # outputs of the coils x, y, z: 'cDAQ1Mod1/ao0:2'. The guardian resets their device when it starts and when it acts,
    # which aborts every other task on it.
    channels: str = ""
    server: str = ""  # host:port of an NI gRPC Device Server; '': the driver of this computer
    # inputs that measure the currents, one a coil, in the order of the outputs: 'cDAQ1Mod2/ai0:2'; '': none does
    inputs: str = ""
    # volts at an input for one ampere of its coil: one number for all coils, or a list with one for each
    volts_per_a: Annotated[float | tuple[float, ...], Range(1e-6, 1e6)] = 1.0


@dataclass(frozen=True, slots=True)
class Lab:
    """The devices of the rig `lab`. Image size, depth, rate and exposure are in [camera]."""

    camera: Annotated[str, CAMERAS] = "genicam"
    device: str = ""  # serial number, model, address or name of the camera; '': the only one there is
    device_config: str = ""  # configuration file of the camera, where the driver needs one
    # column of the sensor at which the image begins; None: the image is in the middle of the sensor
    offset_x_px: Annotated[int, Range(0, 65_535)] | None = None
    # row of the sensor at which the image begins; None: the image is in the middle of the sensor
    offset_y_px: Annotated[int, Range(0, 65_535)] | None = None
    pixel_format: str = ""  # name of the pixel format; '': Mono8, Mono10, ... by camera.bits
    gain: Annotated[float, Range(-100.0, 1e4)] | None = None  # gain in the camera's unit; None: as the camera has it
    trigger: str = ""  # what triggers an image; '': the camera runs freely; 'software'; else the line, such as 'Line1'
    queue_frames: Annotated[int, Range(1, 1000)] = 8  # images that may wait for the loop; more are dropped and counted
    # constant time from the end of an exposure to the arrival of its image, which no clock tells: readout, transfer,
    # driver; flowrec calibrate motion finds it
    camera_delay_s: Annotated[float, Range(0.0, 1.0)] = 0.0
    # time without an image after which the field is off until there is one again; less than safety.guard_timeout_s
    camera_timeout_s: Annotated[float, Range(0.01, 60.0)] = 0.3
    # time without an image after which the run ends
    give_up_s: Annotated[float, Range(0.1, 1e5)] = 60.0
    amplifier: Annotated[str, AMPLIFIERS] = "serial"
    serial: SerialPort = field(default_factory=SerialPort)
    ni: NiOutputs = field(default_factory=NiOutputs)
    output: OutputLimits = field(default_factory=OutputLimits)
    # time without a step of the loop, while a field is on, after which the guardian process takes the field away
    guardian_s: Annotated[float, Range(0.02, 1.0)] = 0.1
