"""The step of `flowrec import` that looks through the movie before anything is recorded: shake, and which is the robot.

What is found become settings, so the session holds them and a replay does not depend on this step:
stabilise.first_px, how far the first image is from the mean place of all, because the registration of the chip holds
for that; and tracker.click_px where a person says which of several bodies is the robot. Where several bodies look alike
and nobody says it, the import is refused with a picture of them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from flowrec.commands.record import prepare
from flowrec.config import Config
from flowrec.declarations import Image
from flowrec.errors import UsageError
from flowrec.messages import Frame
from flowrec.pipeline import Pipeline, Sight, look
from flowrec.rigs.movie.source import MovieSource
from flowrec.system.outputs import PICTURE, Output
from flowrec.terminal import say
from flowrec.units import seconds
from flowrec.vision.bodies import MOST, View, bodies_like, bodies_that_stand_out
from flowrec.vision.walls import walls_in_view

_SHAKES_PX = 0.1  # root mean square from which on it is told; half a pixel is what a track is off at most
_PX = "px"
_SIDE_PX = 1200  # of the picture of candidates, about
_AMBER, _BLACK = (38, 140, 255), (0, 0, 0)  # blue, green, red

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """The first image that shows the robot, or the first one where none does."""

    frame: Frame
    sight: Sight


def first_pass(asked: Config, looked_at: Config, robot: str, folder: Path) -> tuple[Config, Mapping[str, str]]:
    """The configuration with what the movie shows, and facts for the head of the session.

    Parameters
    ----------
    looked_at : the same configuration with the log where it overlaps the movie.
    robot : which body is the robot: a number of the picture, "X,Ypx" in pixels of the first image, or "X,Y" in um on
        the chip; '': the only one that qualifies, or the one of tracker.click_px or box_px.
    folder : for the picture of the candidates.

    Raises
    ------
    UsageError : several bodies qualify, or the given one is not there.
    FlowrecError : as `import_movie`.
    """
    marked = asked.tracker.click_px is not None or asked.tracker.box_px is not None
    if robot and marked:
        raise UsageError(f"--robot {robot}: tracker.click_px or box_px is set too; give one of them")
    config, _, pipeline, *_ = prepare(looked_at, aloud=False)
    place_px = _clicked(robot, asked, pipeline)
    if place_px is not None:
        asked = replace(asked, tracker=replace(asked.tracker, click_px=place_px))
    choose = place_px is None and not marked
    seen, shifts = _looked_through(looked_at, pipeline, config.duration_s, choose=choose)
    if choose and seen is not None:
        asked = _chosen(asked, pipeline, seen, robot, folder)
    if shifts is None:
        return asked, {}
    return _steadied(asked, shifts)


def _looked_through(
    asked: Config, p: Pipeline, duration_s: float | None, *, choose: bool
) -> tuple[_Seen | None, Floats | None]:
    """The first image that shows the robot, and the shifts (n, 2) of all in px; (0, 2): they can not be measured."""
    first: _Seen | None = None
    found: _Seen | None = None
    sight, shifts, blind = Sight(), list[Floats](), False
    with MovieSource(asked.movie, asked.coils) as source:
        for frame in source.frames():
            if duration_s is not None and seconds(frame.stamp_ns) > duration_s:
                break
            if choose and found is None:
                sight = look(p, sight, frame)
                first = first or _Seen(frame, sight)
                if sight.track is not None and sight.track.seen:
                    found = _Seen(frame, sight)
            else:
                shift, background = p.stabiliser.register(
                    sight.shift, sight.background, sight.track, frame, p.chip, p.calibration, p.robot
                )
                sight = sight._replace(shift=shift, background=background)
            if sight.shift is not None:
                shifts.append(sight.shift.shift_px)
            blind = sight.background is None or not len(sight.background.pixels)
            if blind and (found is not None or not choose):
                break
    if not p.stabiliser.on:
        return found or first, None
    return found or first, np.zeros((0, 2)) if blind else np.array(shifts)


def _steadied(asked: Config, shifts_px: Floats) -> tuple[Config, Mapping[str, str]]:
    """The configuration with the shift of the first image from the mean place of all."""
    if not len(shifts_px):
        text = "not known: the image shows no walls of the chip to which it could be registered"
        say(f"{asked.movie.path}: the image shows no walls of the chip: whether stage or camera shake can not be seen")
        return asked, {"source_shake": text}
    off_px = shifts_px - shifts_px.mean(axis=0)
    rms_px, most_px = math.sqrt(float((off_px**2).sum(axis=1).mean())), float(np.hypot(*off_px.T).max())
    text = f"{rms_px:.2f} px (root mean square), {most_px:.2f} px at most"
    if rms_px < _SHAKES_PX:
        return asked, {"source_shake": text}
    say(f"{asked.movie.path}: the image shakes by {text}: each image is registered to the walls of the chip")
    first = asked.stabilise.first_px
    if not any(first):
        x, y = (-shifts_px.mean(axis=0)).round(3).tolist()
        first = (x, y)
    return replace(asked, stabilise=replace(asked.stabilise, first_px=first)), {"source_shake": text}


def _clicked(robot: str, asked: Config, p: Pipeline) -> tuple[float, float] | None:
    """The place of "X,Ypx" or "X,Y" in the first image, in px; None for a number, and for ''."""
    parts = robot.removesuffix(_PX).split(",")
    if not robot or (len(parts) == 1 and robot.isascii() and robot.isdigit()):
        return None
    try:
        x, y = (float(part) for part in parts)
    except ValueError:
        x = y = math.nan
    if not math.isfinite(x) or not math.isfinite(y):
        raise UsageError(
            f"--robot {robot}: neither a number of the picture, as in --robot 3, nor a place, as in --robot 320,256px "
            "(in the first image) or --robot 1250,840 (in um on the chip)"
        )
    if not robot.endswith(_PX):
        x, y = (p.calibration.to_px((x, y)) + np.asarray(asked.stabilise.first_px)).tolist()
    height, width = p.image_shape
    if not (0.0 <= x <= width - 1.0 and 0.0 <= y <= height - 1.0):
        raise UsageError(f"--robot {robot}: at ({x:.0f}, {y:.0f}) px, outside of the image of {width} x {height} px")
    return round(x, 2), round(y, 2)


def _chosen(asked: Config, p: Pipeline, seen: _Seen, robot: str, folder: Path) -> Config:
    """The configuration with the body that `robot` numbers; as it is, if only one qualifies."""
    places, what = _candidates(p, seen)
    image, name = seen.frame, asked.movie.path
    if not len(places) or (len(places) == 1 and not robot and seen.sight.appearance is not None):
        return asked
    if robot:
        number = int(robot)
        if not 1 <= number <= len(places):
            there = "is 1" if len(places) == 1 else f"are {len(places)}"
            raise UsageError(f"--robot {robot}: there {there} to choose from in image {image.index} of {name}")
        x, y = places[number - 1].round(2).tolist()
        return replace(asked, tracker=replace(asked.tracker, click_px=(x, y), click_frame=image.index))
    count = f"at least {len(places)}" if len(places) >= MOST - 4 else len(places)  # near the limit some are left out
    picture = _kept(_numbered(image.image, places, p), folder / f"{Path(name).stem}_robots{PICTURE[0]}")
    raise UsageError(
        f"{name}: {what.format(count, image.index)}; {picture} shows them with numbers: say which one is the "
        "robot with --robot N, or by its place: --robot X,Ypx in the first image, --robot X,Y in um on the chip"
    )


def _candidates(p: Pipeline, seen: _Seen) -> tuple[Floats, str]:
    """Places (n, 2) in px from the top down, and how they are told of."""
    walls, calibration, sight = walls_in_view(p.chip, p.calibration, p.image_shape), p.calibration, seen.sight
    if sight.shift is not None and sight.shift.shift_px.any():
        off_px = float(sight.shift.shift_px[0]), float(sight.shift.shift_px[1])
        walls, calibration = walls.moved(off_px), calibration.moved(off_px)
    radius_px = p.robot.radius_um / calibration.um_per_px
    view = View(seen.frame.image, walls, radius_px, -p.tracker.wall_error_radii * radius_px)
    if sight.appearance is None or sight.track is None or not sight.track.seen:
        found = bodies_that_stand_out(view)
        what = "no image shows a dark disc or one bright spot; {} bodies stand out in image {}"
    else:
        x, y = calibration.to_px(sight.track.position_um).tolist()
        found, what = bodies_like(view, (x, y), sight.appearance), "{} bodies in image {} look like the robot"
    return found[np.lexsort((found[:, 0], found[:, 1]))], what


def _numbered(image: Image, places_px: Floats, p: Pipeline) -> NDArray[np.uint8]:
    """The image (h, w, 3) with a circle and a number at each place."""
    low, high = (float(np.quantile(image, share)) for share in (0.001, 0.999))
    grey = np.clip((image.astype(np.float32) - low) * (255.0 / max(high - low, 1.0)), 0.0, 255.0).astype(np.uint8)
    factor = max(1, round(_SIDE_PX / max(image.shape)))
    shown = cv2.cvtColor(
        cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC), cv2.COLOR_GRAY2BGR
    )
    height, width = shown.shape[:2]
    radius = max(round(1.5 * factor * p.robot.radius_um / p.calibration.um_per_px), 12)
    size = 0.5 if len(places_px) > 1 and radius == 12 else 0.7
    for number, (x, y) in enumerate(places_px.tolist(), 1):
        at = round(factor * (x + 0.5) - 0.5), round(factor * (y + 0.5) - 0.5)
        text, (w, h) = str(number), cv2.getTextSize(str(number), cv2.FONT_HERSHEY_SIMPLEX, size, 2)[0]
        right = at[0] + radius + 3 + w < width
        corner = at[0] + radius + 3 if right else at[0] - radius - 3 - w, min(max(at[1] + h // 2, h + 1), height - 2)
        for colour, thick in ((_BLACK, 2), (_AMBER, 1)):
            cv2.circle(shown, at, radius, colour, thick, cv2.LINE_AA)
            cv2.putText(shown, text, corner, cv2.FONT_HERSHEY_SIMPLEX, size, colour, thick + 1, cv2.LINE_AA)
    return np.asarray(shown, np.uint8)


def _kept(picture: NDArray[np.uint8], path: Path) -> Path:
    """Write a picture under a name that no other file has; where it is there already, its path."""
    done, data = cv2.imencode(PICTURE[0], picture)
    assert done, "OpenCV writes PNG"
    number, target = 1, path
    while target.exists():
        if target.is_file() and target.read_bytes() == data.tobytes():
            return target
        number += 1
        target = path.with_stem(f"{path.stem}_{number}")
    with Output(target, PICTURE).new_file() as part:
        part.write_bytes(data.tobytes())
    return target
