"""Data of a report's figures: a session's history, chip, flow fields, and a camera image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flowrec.core import Floats, FlowField, Image, Observations, SessionError, shell_word
from flowrec.exports.formats import TimeProgress
from flowrec.exports.report.history import History
from flowrec.stages import tells_flow
from flowrec.store import Session, nonzero_window
from flowrec.view import ColourScale, Scene, peak

_IMAGES = 7  # of which the median is the picture: what moves disappears
_LARGEST_PX = 900  # width of the picture; a wider one is thinned
_DARKEST, _BRIGHTEST = 0.5, 99.5  # percentiles of the grey levels that become black and white


@dataclass(frozen=True, slots=True, eq=False)
class CameraImage:
    """Median of several camera images, at a reduced size."""

    image: NDArray[np.uint8]  # (h, w) uint8, every `step`-th row and column of the camera's image
    step: int
    images: int  # number of images of which it is the median


@dataclass(frozen=True, slots=True, eq=False)
class ReportData:
    """One session for its figures; `picture` is None where no image is in the file."""

    session: Session
    scene: Scene
    history: History
    picture: CameraImage | None

    @classmethod
    def of(cls, session: Session, progress: TimeProgress = lambda _: None) -> ReportData:
        """Read a session; `progress` takes the session time in s since the first tick.

        Raises FlowrecError: header, chip or a message is not valid.
        """
        config = session.config
        size_px = config.camera.size_px
        scene = Scene(session.chip, session.calibration, config.robot, session.path.stem, image_px=size_px)
        data = cls(session, scene, History.of(session, progress), picture_of(session))
        for name, field in (("assumed", data.assumed), ("refined", data.refined), ("true", data.truth)):
            sizes = () if field is None else (field.velocity_um_s.shape[:2], scene.chip.mask.shape)
            if len({*sizes}) > 1:
                found, wanted = (" x ".join(map(str, size)) for size in sizes)
                raise SessionError(
                    f"{session.path}: the {name} flow has {found} pixels, and the mask of the chip {wanted}; the file "
                    f"was edited or damaged, see flowrec check {shell_word(session.path)}"
                )
        return data

    @property
    def tells_flow(self) -> bool:
        """False in an open field that nothing drives, where no flow was found."""
        return tells_flow(self.scene.chip, self.history.last)

    @property
    def assumed(self) -> FlowField | None:
        """The map before any refinement."""
        return self.history.last.assumed if self.tells_flow else None

    @property
    def refined(self) -> FlowField | None:
        """The map of the last refinement."""
        return self.history.last.refined if self.tells_flow else None

    @property
    def field(self) -> FlowField | None:
        """The best map at the end."""
        return self.history.last.field if self.tells_flow else None

    @property
    def truth(self) -> FlowField | None:
        """The true flow of a simulation."""
        return self.session.fields.get("true")

    @property
    def observations(self) -> Observations | None:
        """The observations of the flow, without those that hold NaN or infinity; None where there is none."""
        found = self.history.last.observations
        if found is None:
            return None
        table = np.column_stack([found.position_um, found.flow_um_s, found.std_um_s])
        known = found.only(np.isfinite(table).all(axis=1) & (found.std_um_s >= 0.0))
        return known if len(known.position_um) else None

    @property
    def no_map(self) -> str:
        """Reason why there is no map of the flow; '' if there is one."""
        return "the session holds no map of the flow" if self.assumed is None and self.refined is None else ""

    @property
    def no_position(self) -> str:
        """Reason why there is no position of the robot; '' if there is one."""
        if self.history.curve("x_um"):
            return ""
        unseen = self.history.last.track is not None and not self.history.found
        return "the robot was never seen" if unseen else "the session holds no estimate of the robot's position"

    @property
    def path_um(self) -> Floats:
        """(n, 2) the way of the robot; a row of NaN interrupts it."""
        curves = self.history.curve("x_um"), self.history.curve("y_um")
        return np.column_stack([curve.mean for curve in curves])

    def speed_scale(self) -> ColourScale:
        """The one scale of all maps of speed of this session."""
        fields = (self.assumed, self.refined, self.truth)
        return ColourScale.up_to(max((peak(field) for field in fields if field is not None), default=1.0), "speed")


def picture_of(session: Session) -> CameraImage | None:
    """Median of images over the whole session, in 8 bit; cut images are left out where there is a whole one."""
    if not session.reader.counts.get("frame"):
        return None
    first_ns, last_ns = session.run.first_ns, session.run.last_ns
    images: dict[int, Image] = {}
    for stamp_ns in np.linspace(first_ns, last_ns, _IMAGES).astype(np.int64).tolist():
        frame = session.reader.tick_before(stamp_ns).frame
        if frame is not None and frame.image.size:
            images[frame.index] = frame.image
    if not images:
        return None
    first, *_ = images.values()
    height, width = first.shape
    alike = [image for image in images.values() if image.shape == first.shape]
    whole = [image for image in alike if nonzero_window(image) == (0, 0, width, height)]
    chosen = np.stack(whole or [first])
    step = -(-chosen.shape[2] // _LARGEST_PX)
    grey = np.median(chosen[:, ::step, ::step], axis=0)
    low, high = np.percentile(grey, (_DARKEST, _BRIGHTEST))
    levels = np.clip((grey - low) / max(high - low, 1.0) * 255.0, 0.0, 255.0)
    return CameraImage(levels.astype(np.uint8), step, len(chosen))
