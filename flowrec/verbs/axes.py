"""The axes of camera and coils against what image and motion show, before a run, in an import and by the doctor.

The image is compared with the walls of the chip (measure/picture_registration.py). Where that does not decide, the
motion does: of a robot that is driven in the check at the beginning of a run (control/axes_check.py), of a movie
here, over all of it, against the log of the coils.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from flowrec.core import NS_PER_S, AxesVerdict, ChipError, Image, nanoseconds
from flowrec.measure import ImageVerdict, orientation_by_image
from flowrec.physics import Calibration, Chip, Orientation, nearest
from flowrec.stages import (
    FieldLog,
    MotionVerdict,
    MovieSettings,
    ResolvedConfig,
    contradiction,
    orientation_by_motion,
    own_gain,
    registration_of,
)

_OFF = "; mission.check_axes = false records without this check"


def checked_image(image: Image, config: ResolvedConfig, chip: Chip, where: str) -> ImageVerdict | None:
    """Compare an image (h, w) with the stated registration; None if mission.check_axes is off.

    Raises ChipError, in one line with the settings to paste, where it contradicts.
    """
    if not config.mission.check_axes:
        return None
    verdict = orientation_by_image(image, chip, registration_of(config.camera, chip))
    if verdict.contradiction:
        raise ChipError(f"{where}: {verdict.contradiction}{_OFF}")
    return verdict


def motion_by_log(
    stamps_ns: NDArray[np.int64], positions_um: NDArray[np.float64], log: FieldLog, config: ResolvedConfig
) -> MotionVerdict:
    """Compare positions (n, 2) of a robot with the axes of a log; they agree with a log that hardly drives it."""
    late_ns = nanoseconds(config.robot.delay_s)
    own_um = config.robot.um_per_rev * log.turns_until((stamps_ns - late_ns).astype(np.float64))
    if not len(own_um) or float(np.ptp(own_um, axis=0).max()) < config.robot.radius_um:
        return MotionVerdict(AxesVerdict.AGREES)
    return orientation_by_motion(*own_gain(stamps_ns / NS_PER_S, positions_um, own_um))


def orientation_of_heading(offset_rad: float, *, mirrored: bool) -> Orientation:
    """The orientation nearest to a heading offset, as `MotionFit` states it."""
    return nearest(Calibration(1.0, angle_deg=math.degrees(offset_rad), mirror=mirrored).axes)


def may_be_image(orientation: Orientation, image: ImageVerdict, config: ResolvedConfig, chip: Chip) -> bool:
    """True if the image may be turned so, and not the log: the chip would look the same."""
    return not image.alike or orientation.in_image(registration_of(config.camera, chip)) in image.alike


def turned_log(orientation: Orientation, image: ImageVerdict, config: ResolvedConfig, chip: Chip) -> ChipError:
    """The refusal of a log against which the robot moves in another orientation."""
    stated = registration_of(config.camera, chip) if may_be_image(orientation, image, config, chip) else None
    settings = _log_settings(orientation, config.movie)
    return ChipError(f"{config.movie.coils}: {contradiction(orientation, 'the log', settings, stated)}{_OFF}")


def _log_settings(orientation: Orientation, movie: MovieSettings) -> str:
    """The settings movie.heading_* with which the log is right."""
    offset_deg = -movie.heading_offset_deg if orientation.mirrored else movie.heading_offset_deg
    offset_deg = 180.0 - (180.0 - offset_deg - orientation.turned_deg) % 360.0
    mirrored = str(movie.heading_mirrored != orientation.mirrored).lower()
    return f"movie.heading_mirrored = {mirrored}, movie.heading_offset_deg = {offset_deg:g}"
