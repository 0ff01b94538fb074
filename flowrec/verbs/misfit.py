"""Causes of a track that the log of the coils does not explain: shake, another particle, a body at rest, another log.

Each is told by what the movie shows, not by the bad fit, and the first that holds is said:

- the images move against the walls of the chip, or tremble, and nothing corrects that: shake;
- the body goes much slower than the log drives it: it does not move;
- the track itself is doubtful (stages/vision/track_quality.py): another particle;
- the body goes as the assumed flow carries it: another particle, which is not driven;
- else it moves as a driven robot does, but at other times or in other directions: the log of another run.

An image or a log with other axes (mirrored, turned, another scale) is looked for before all of these: the image is
compared with the walls of the chip (measure/picture_registration.py), and where that does not decide, the motion over
all of the movie with the log.
"""

from __future__ import annotations

import math

import numpy as np

from flowrec.core import AxesVerdict, ChipError, Floats, FlowField, nanoseconds
from flowrec.measure import ImageVerdict, sampled_s
from flowrec.physics import Calibration, Chip, Orientation, nearest, sample
from flowrec.stages import (
    MotionVerdict,
    MovieSettings,
    ResolvedConfig,
    contradiction,
    orientation_by_motion,
    own_gain,
    registration_of,
)
from flowrec.verbs.first_pass import MovieTracks
from flowrec.verbs.preparation import UNCHECKED

_WINDOW_S = 0.3  # of the mean velocities: longer than noise of a track, shorter than most commands hold
_LEAST_WINDOWS = 4  # with fewer, nothing is said of the log
_HIDES_PX = 0.5  # root mean square from which on shake hides the commands; 1 px at 3 Hz does in simulated movies
_STILL = 0.15  # of the speed that the log drives
_CARRIED = 0.8  # share of the motion that the flow explains, from which on the body is not driven


def why_unexplained(seen: MovieTracks, flow: FlowField, um_per_rev: float) -> str:
    """The most probable reason, with what to do, as words after a colon."""
    known = _shake(seen) or why_still(seen, um_per_rev)
    if known:
        return known
    if seen.doubts:
        return f"the track is doubtful: {seen.doubts[0]}; name the robot with --robot"
    middle_s, velocity = _velocities(seen.time_s, seen.positions_um)
    if len(velocity) < _LEAST_WINDOWS:
        return "the robot is seen too seldom in one piece to compare it with a log; take a longer movie"
    image_s = float(np.median(np.diff(seen.time_s)))
    row_s = sampled_s(seen.log, image_s)
    if row_s is not None:
        fastest_hz = float(seen.log.frequency_hz.max())
        return (
            f"it is sampled too slowly, at {1.0 / row_s:.3g} Hz where the movie has {1.0 / image_s:.3g} and the field "
            f"turns at up to {fastest_hz:.3g} Hz, so it lacks commands; or it is the log of another run: log every "
            "command, or take a longer movie"
        )
    if _carried_share(middle_s, velocity, seen, flow) > _CARRIED:
        return (
            "the tracked body goes where the assumed flow carries it, so it is another particle, which is not driven; "
            "name the robot with --robot"
        )
    return (
        f"the tracked body moves by itself, at {_speed(velocity):.0f} um/s, but not when and where this log says: "
        "it is the log of another run"
    )


def why_still(seen: MovieTracks, um_per_rev: float) -> str:
    """Text about a body that goes much slower than the log drives it; '' if it does not."""
    _, velocity = _velocities(seen.time_s, seen.positions_um)
    log = seen.log
    turning = log.frequency_hz[(log.amplitude_mt > 0.0) & (log.frequency_hz > 0.0)]
    if len(velocity) < _LEAST_WINDOWS or not turning.size:
        return ""
    speed, driven = _speed(velocity), um_per_rev * float(np.median(turning))
    if speed >= _STILL * driven:
        return ""
    return (
        f"the tracked body does not move by itself: it goes {speed:.1f} um/s where the log drives a robot at "
        f"{driven:.0f} um/s; is it stuck, or another particle? Name the robot with --robot"
    )


def _shake(seen: MovieTracks) -> str:
    if seen.shake_px is not None:
        if seen.shake_px < _HIDES_PX or seen.stabilised:
            return ""
        return (
            f"the image shakes by {seen.shake_px:.1f} px (root mean square) against the walls of the chip, and "
            "stabilise.on = false leaves that in the track; import it with stabilise.on = true"
        )
    trembles_px = trembling(seen.positions_um) / seen.um_per_px
    if trembles_px < _HIDES_PX:
        return ""
    return (
        f"the track trembles by {trembles_px:.1f} px from image to image: the stage or the camera shakes, and the "
        "image shows no walls to which it could be registered"
    )


def trembling(positions_um: Floats) -> float:
    """Root mean square in um, per axis, of what changes its sign from image to image: from second differences."""
    if len(positions_um) < 3:
        return 0.0
    # White noise of variance 1 has second differences of variance 1 + 4 + 1.
    return float(np.sqrt((np.diff(positions_um, 2, axis=0) ** 2).mean() / 6.0))


def _velocities(time_s: Floats, positions_um: Floats) -> tuple[Floats, Floats]:
    """Middles (m,) of windows, and the mean velocities (m, 2) in them, um/s."""
    first = np.searchsorted(time_s, np.arange(time_s[0], time_s[-1], _WINDOW_S)) if len(time_s) else np.zeros(0, int)
    ends = np.unique(np.append(first, len(time_s) - 1))
    span_s = np.diff(time_s[ends])
    whole = (span_s > 0.5 * _WINDOW_S) & (span_s < 2.0 * _WINDOW_S)
    velocity = np.diff(positions_um[ends], axis=0)[whole] / span_s[whole, None]
    return 0.5 * (time_s[ends[1:]] + time_s[ends[:-1]])[whole], velocity


def _speed(velocity: Floats) -> float:
    """Root mean square of velocities (m, 2)."""
    return math.sqrt(float((velocity**2).sum(1).mean()))


def _carried_share(middle_s: Floats, velocity: Floats, seen: MovieTracks, flow: FlowField) -> float:
    """Share of the mean square velocity that the assumed flow explains, with a factor of its own."""
    at = np.column_stack([np.interp(middle_s, seen.time_s, seen.positions_um[:, axis]) for axis in (0, 1)])
    carried = np.array([sample(flow, point) for point in at])
    size = float((carried**2).sum())
    if size <= 0.0:
        return 0.0
    factor = max(float((carried * velocity).sum()) / size, 0.0)
    return 1.0 - float(((velocity - factor * carried) ** 2).sum()) / float((velocity**2).sum())


def motion_by_log(seen: MovieTracks, config: ResolvedConfig) -> MotionVerdict:
    """Compare the track of a robot with the axes of a log; they agree with a log that hardly drives it."""
    late_ns = nanoseconds(config.robot.delay_s)
    own_um = config.robot.um_per_rev * seen.log.turns_until((seen.stamps_ns - late_ns).astype(np.float64))
    if not len(own_um) or float(np.ptp(own_um, axis=0).max()) < config.robot.radius_um:
        return MotionVerdict(AxesVerdict.AGREES)
    return orientation_by_motion(*own_gain(seen.time_s, seen.positions_um, own_um))


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
    return ChipError(f"{config.movie.coils}: {contradiction(orientation, 'the log', settings, stated)}{UNCHECKED}")


def _log_settings(orientation: Orientation, movie: MovieSettings) -> str:
    """The settings movie.heading_* with which the log is right."""
    offset_deg = -movie.heading_offset_deg if orientation.mirrored else movie.heading_offset_deg
    offset_deg = 180.0 - (180.0 - offset_deg - orientation.turned_deg) % 360.0
    mirrored = str(movie.heading_mirrored != orientation.mirrored).lower()
    return f"movie.heading_mirrored = {mirrored}, movie.heading_offset_deg = {offset_deg:g}"
