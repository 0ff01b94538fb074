"""The format nwb: Neurodata Without Borders, with the robot's pose by ndx-pose, coils, flow fields and images.

The reference time is the start of the run with its zone; timestamps are s on the session clock. Images are in the
file, compressed, with the stamp of each. A session that states no start time is refused: NWB demands it.

The images are an ImageSeries. Of a short session, with fewer images than they have pixels on a side, nwbinspector takes
that for a series that is turned, which no archive accepts; they are Images then, with the times in an IndexSeries.
The subject is the sample; age and sex, which NWB's inspector demands, are stated as unknown.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from hdmf.backends.hdf5.h5_utils import H5DataIO
from hdmf.common import DynamicTable, VectorData
from hdmf.data_utils import DataChunkIterator, GenericDataChunkIterator
from ndx_pose import PoseEstimation, PoseEstimationSeries, Skeleton, Skeletons
from numpy.typing import NDArray
from pynwb import NWBHDF5IO, NWBFile, TimeSeries
from pynwb.base import ImageReferences, Images
from pynwb.file import Subject
from pynwb.image import GrayscaleImage, ImageSeries, IndexSeries

from flowrec.declarations import Image
from flowrec.errors import SessionError, printable
from flowrec.exports.camera_images import first_frame, image_stamps, started, with_images
from flowrec.exports.hdf5_file import new_hdf5
from flowrec.messages import FlowField, Frame, pixel_type
from flowrec.session import Session
from flowrec.units import NS_PER_S, seconds

_LEVEL = 1  # of gzip
_MOST_LETTERS = 2000


class NwbExport:
    """Implements flowrec.exports.formats.Exporter."""

    suffixes = (".nwb",)
    folder = False
    advice = "open it with pynwb or NWB Widgets:"

    def write(self, session: Session, part: Path, progress: Callable[[float], None]) -> None:
        began = started(session)
        if not began:
            raise SessionError(f"{session.path}: states no start time, which NWB demands; export it as parquet or tiff")
        recording = session.config.recording
        file = NWBFile(
            session_description=_text(recording.notes) or f"flowrec session {session.path.name}",
            identifier=session.key,
            session_start_time=datetime.fromisoformat(began),
            session_id=session.path.stem,
            experimenter=_text(recording.operator) or None,
            experiment_description=f"a magnetic micro-robot in flow on the chip {_text(session.chip.name)}",
            keywords=["micro-robot", "magnetic actuation", "microfluidics"],
            source_script=f"flowrec {session.provenance.get('flowrec', '')}".strip(),
            source_script_file_name="flowrec export",
        )
        what = f"micro-robot with a radius of {session.config.robot.radius_um:.6g} um, no organism"
        sample = _text(recording.sample) or "robot"
        file.subject = Subject(subject_id=sample, description=what, age="P0D/", sex="U")  # any age; sex unknown
        with new_hdf5(part) as made:

            def done(frame: Frame) -> None:
                made.check()
                progress(seconds(frame.stamp_ns - session.run.first_ns))

            if session.topics.get("/camera/frame", 0):
                _add_images(file, session, done)
            _add_pose(file, session)
            _add_coils(file, session)
            for name, field in session.fields.items():
                file.add_analysis(_flow_table(name, field, session.chip.mask))
            with NWBHDF5IO(file=made.file, mode="w") as output:
                output.write(file)


def _add_images(file: NWBFile, session: Session, done: Callable[[Frame], None]) -> None:
    stamps = image_stamps(session)
    bits = session.config.camera.bits
    file.create_device(name="camera", description="camera of the microscope")
    what = f"of {bits} bit; {session.config.camera.um_per_px:.6g} um per pixel"
    if len(stamps) < max(first_frame(session).image.shape):
        images = [
            GrayscaleImage(
                name=f"image_{number:05d}",
                data=_compressed(_OneImage(session, stamp, done), bits),
                resolution=1e4 / session.config.camera.um_per_px,  # pixels per cm
                description=f"taken at {seconds(stamp):.9f} s",
            )
            for number, stamp in enumerate(stamps)
        ]
        order = ImageReferences(name="order_of_images", data=images)
        shown = Images(name="camera_images", images=images, description=f"images {what}", order_of_images=order)
        file.add_acquisition(shown)
        times = IndexSeries(
            name="camera_image_times",
            description="number of each image in camera_images, at the time when it was taken",
            data=np.arange(len(stamps), dtype=np.uint32),
            unit="N/A",
            indexed_images=shown,
            timestamps=_seconds(stamps),
        )
        file.add_acquisition(times)
        return

    def each() -> Iterator[Any]:
        for _, frame in with_images(session):
            done(frame)
            yield frame.image

    file.add_acquisition(
        ImageSeries(
            name="camera_images",
            description=f"images (time, row, column) {what}",
            data=_compressed(DataChunkIterator(data=each(), buffer_size=1), bits),
            unit="grey level",
            timestamps=_seconds(stamps),
            device=file.devices["camera"],
        )
    )


class _OneImage(GenericDataChunkIterator):  # type: ignore[misc]  # hdmf has no types
    """An image that is read when it is written."""

    def __init__(self, session: Session, stamp_ns: int, done: Callable[[Frame], None]) -> None:
        self._session, self._stamp_ns, self._done = session, stamp_ns, done
        shape = session.config.camera.height_px, session.config.camera.width_px
        super().__init__(buffer_shape=shape, chunk_shape=shape)

    def _get_data(self, selection: tuple[slice, ...]) -> Image:
        frame = self._session.reader.frame_at(self._stamp_ns)
        self._done(frame)
        return frame.image[selection]

    def _get_maxshape(self) -> tuple[int, int]:
        return self._session.config.camera.height_px, self._session.config.camera.width_px

    def _get_dtype(self) -> np.dtype[Any]:
        return np.dtype(pixel_type(self._session.config.camera.bits))


def _compressed(data: Any, bits: int) -> H5DataIO:
    return H5DataIO(data, compression="gzip", compression_opts=_LEVEL, shuffle=bits > 8)


def _add_pose(file: NWBFile, session: Session) -> None:
    estimates = list(session.messages("estimate"))
    if not estimates:
        return
    skeleton = Skeleton(name="robot", nodes=["centre"])
    seen = np.array([each.seen for each in estimates], np.float64)
    series = PoseEstimationSeries(
        name="centre",
        description="centre of the robot, the observer's estimate",
        data=np.array([each.position_um for each in estimates]) * 1e-6,
        unit="meters",
        reference_frame="centre of the chip mask's first pixel; x to the right, y downwards",
        timestamps=_seconds([each.stamp_ns for each in estimates]),
        confidence=seen,
        confidence_definition="1 where the robot was seen in the image, else 0",
    )
    what = "pose of the robot, and the flow that carries it"
    behavior = file.create_processing_module(name="behavior", description=what)
    behavior.add(Skeletons(skeletons=[skeleton]))
    behavior.add(
        PoseEstimation(
            name="PoseEstimation",
            pose_estimation_series=[series],
            description="position of the robot on the chip",
            skeleton=skeleton,
            source_software="flowrec",
            source_software_version=session.provenance.get("flowrec", "not stated"),
        )
    )
    behavior.add(
        TimeSeries(
            name="flow_at_robot",
            description="flow velocity (x, y) at the robot, the observer's estimate",
            data=np.array([each.flow_um_s for each in estimates]) * 1e-6,
            unit="m/s",
            timestamps=series.timestamps,
        )
    )


def _add_coils(file: NWBFile, session: Session) -> None:
    commands = list(session.messages("currents"))
    if not commands:
        return
    times = _seconds([each.stamp_ns for each in commands])
    for name, unit, what, values in (
        ("coil_currents", "amperes", "commanded currents of the coils x, y, z", [c.currents_a for c in commands]),
        ("field_frequency", "hertz", "commanded frequency of the rotating field", [c.frequency_hz for c in commands]),
        ("field_heading", "radians", "demanded direction, from x towards y", [c.heading_rad for c in commands]),
        ("field_amplitude", "tesla", "commanded amplitude of the field", [1e-3 * c.amplitude_mt for c in commands]),
    ):
        file.add_stimulus(
            TimeSeries(name=name, description=what, data=np.array(values, np.float64), unit=unit, timestamps=times)
        )


def _flow_table(name: str, field: FlowField, mask: NDArray[np.bool_]) -> DynamicTable:
    """A flow field with a row for each pixel of fluid."""
    rows, columns = np.nonzero(mask)
    what = f"{name} flow by {_text(field.method)}, known from {seconds(max(field.stamp_ns, 0)):.3f} s on"
    values = {
        "x_um": ("place, to the right, um", columns * field.um_per_px),
        "y_um": ("place, downwards, um", rows * field.um_per_px),
        "velocity_x_um_s": ("velocity to the right, um/s", field.velocity_um_s[mask][:, 0]),
        "velocity_y_um_s": ("velocity downwards, um/s", field.velocity_um_s[mask][:, 1]),
    }
    if field.std_um_s is not None:
        for axis, letter in enumerate("xy"):
            text = f"one standard deviation of velocity_{letter}_um_s, um/s"
            values[f"std_{letter}_um_s"] = (text, field.std_um_s[mask][:, axis])
    made = [VectorData(name=column, description=text, data=np.asarray(data)) for column, (text, data) in values.items()]
    description = f"{what}; a row is a pixel of fluid of the chip's mask"
    return DynamicTable(name=f"{name}_flow", description=description, columns=made)


def _seconds(stamps_ns: list[int]) -> Any:
    return np.array(stamps_ns, np.int64) / NS_PER_S


def _text(text: str) -> str:
    return printable(text)[:_MOST_LETTERS].strip()
