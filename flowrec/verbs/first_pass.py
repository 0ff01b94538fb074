"""The pass of `flowrec import` through the movie before anything is recorded: shake, which is the robot, its track.

What is found become settings, so the session holds them and a replay does not depend on this step:
stabilise.first_px, how far the first image is from the mean place of all, because the registration of the chip holds
for that; and tracker.click_px where a person says which of several bodies is the robot. Where several bodies look alike
and nobody says it, the import is refused with a picture of them.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from flowrec.core import NS_PER_S, PICTURE, Floats, Frame, Image, Ints, Track, UsageError, say, seconds, shift_px, warn
from flowrec.measure import write_picture
from flowrec.rigs import MovieSource
from flowrec.stages import (
    MOST,
    Config,
    FieldLog,
    Pipeline,
    ResolvedConfig,
    Sight,
    TrackQuality,
    View,
    bodies_like,
    bodies_that_stand_out,
    look,
    seen_walls,
)
from flowrec.verbs.preparation import Prepared, prepare

_SHAKES_PX = 0.1  # root mean square from which on it is told; half a pixel is what a track is off at most
_SAME_RADII = 0.25  # between two named places that are one body: robots that hide each other are farther apart
_ON_IT_RADII = 1.5  # between a named place and the disc that is found for it
_PX = "px"
_SURROUNDINGS_RADII = 6.0  # of the robot as stated: half the side of the window in which its size is measured
_OTHER_SIZE = 2.0  # factor from which on a size is another one
_SIDE_PX = 1200  # of the picture of candidates, about
_AMBER, _BLACK = (38, 140, 255), (0, 0, 0)  # blue, green, red


class MovieTracks(NamedTuple):
    """Track of the robot in the images of a movie, before anything is recorded."""

    stamps_ns: Ints  # (n,) session stamps of the images in which it is seen, by movie.clock_rate and clock_offset_s
    positions_um: Floats  # (n, 2) on the chip
    log: FieldLog  # what the coils did on the same clock, without the robot's delay
    shake_px: float | None  # root mean square of the images' motion against the walls; None: it can not be measured
    stabilised: bool  # that motion is taken out of the positions
    um_per_px: float  # of the camera
    doubts: Sequence[str]  # about the track

    @property
    def time_s(self) -> Floats:
        """The stamps in s."""
        return self.stamps_ns / NS_PER_S


class Looked(NamedTuple):
    """Findings of a movie before it is imported."""

    asked: Config  # the configuration with what the movie shows
    facts: Mapping[str, str]  # for the head of the session
    prepared: Prepared  # the settings of the pass, its chip, and what its images say about the axes
    tracks: MovieTracks | None  # None where there is no log that they could be compared with
    doubts: Sequence[str] = ()  # reasons to doubt the import


def first_pass(asked: Config, looked_at: Config, robots: Sequence[str], folder: Path) -> Looked:
    """Look through the movie once; the robot is tracked if there is a log to compare with.

    Raises UsageError: several bodies qualify, or the given one is not there; FlowrecError: as `import_movie`.

    Parameters
    ----------
    looked_at : the same configuration, with the log moved to where it overlaps the movie.
    robots : which bodies are the robots, the mission's one first: of each a number of the picture, "X,Ypx" in pixels
        of the first image, or "X,Y" in um on the chip; none: the only one that qualifies, or the one of
        tracker.click_px or box_px, or the tracker.robots most similar discs.
    folder : for the picture of the candidates.
    """
    named = [robot for robot in robots if robot]
    robot = named[0] if named else ""
    asks = asked.tracker
    marked = asks.click_px is not None or asks.box_px is not None or bool(asks.robots_px)
    if robot and marked:
        raise UsageError(f"--robot {robot}: tracker.click_px, box_px or robots_px is set too; give one of them")
    prepared = prepare(looked_at, aloud=False)  # the import says it, of the settings that are used
    p, config = prepared.pipeline, prepared.config
    several = len(named) > 1 or asks.count > 1
    place_px = None if several else _place_of(robot, asked, p)
    if several:
        asked = _with_robots(asked, p, config, named) if named or asks.robots_px else asked
    elif place_px is not None:
        asked = replace(asked, tracker=replace(asked.tracker, click_px=place_px))
    elif not marked and (seen := _first_seen(p, config)) is not None:
        asked = _with_chosen_body(asked, p, *seen, robot, folder)
    chosen = {name: getattr(asked.tracker, name) for name in ("click_px", "click_frame", "robots", "robots_px")}
    p = replace(p, tracker=replace(p.tracker, **chosen))
    if place_px is not None:
        _refuse_empty(robot, p, config)
    shifts_px, tracks = _look_through(p, config)
    facts: Mapping[str, str] = {}
    if p.stabiliser.on:
        first_px = asked.stabilise.first_px
        asked, facts = _with_mean_shift(asked, shifts_px)
        if tracks is not None:  # as they are with the shift of the first image that was found
            by_um = p.calibration.to_um(first_px) - p.calibration.to_um(asked.stabilise.first_px)
            tracks = tracks._replace(positions_um=tracks.positions_um + by_um)
    return Looked(asked, facts, prepared, tracks)


def _with_robots(asked: Config, p: Pipeline, config: ResolvedConfig, robots: Sequence[str]) -> Config:
    """The configuration with a point on each of several robots in the first image; UsageError where there is none.

    `robots`: as of `first_pass`; none: those of tracker.robots_px.
    """
    with MovieSource(config.movie, config.coils) as source:
        image = next(iter(_within(source, config)))
    names, places_px = [f"tracker.robots_px[{n}]" for n in range(len(asked.tracker.robots_px))], asked.tracker.robots_px
    if robots:
        names = [f"--robot {each}" for each in robots]
        numbered = [each for each in robots if _place_of(each, asked, p) is None]
        candidates = _numbered_places(numbered[0], image, p, config) if numbered else np.zeros((0, 2))
        places_px = tuple(
            _place_of(each, asked, p) or _place_of_number(each, candidates, image, asked) for each in robots
        )
    count = max(asked.tracker.robots, len(places_px))
    found = replace(p, tracker=replace(p.tracker, robots=count, robots_px=places_px))
    sight = look(found, Sight(), image)
    radius_px = p.robot.radius_um / p.calibration.um_per_px
    assert sight.track is not None
    for n, (name, at_px) in enumerate(zip(names, places_px, strict=True)):
        if any(math.dist(at_px, other_px) < _SAME_RADII * radius_px for other_px in places_px[:n]):
            raise UsageError(f"{name}: another robot is named at ({at_px[0]:.0f}, {at_px[1]:.0f}) px; name each once")
    for name, at_px, track in zip(names, places_px, (sight.track, *sight.others), strict=False):
        if not track.seen or math.dist(p.calibration.to_px(track.position_um), at_px) > _ON_IT_RADII * radius_px:
            raise UsageError(
                f"{name}: at ({at_px[0]:.0f}, {at_px[1]:.0f}) px of image {image.index} no disc of the "
                "robot's size and darkness is found; give the middle of a robot"
            )
    return replace(asked, tracker=replace(asked.tracker, robots=count, robots_px=places_px))


def _numbered_places(number: str, image: Frame, p: Pipeline, config: ResolvedConfig) -> Floats:
    """Places (n, 2) in px that the picture numbers; UsageError with one of them where it is not the first image."""
    seen = _first_seen(replace(p, tracker=replace(p.tracker, robots=1, robots_px=())), config)
    assert seen is not None, "the movie has a first image"
    if seen[0].index != image.index:
        raise UsageError(
            f"--robot {number}: the picture with the numbers is image {seen[0].index}, and several robots are named in "
            f"image {image.index}: give each as X,Ypx there"
        )
    return _candidates(p, *seen)[0]


def _place_of_number(robot: str, places_px: Floats, image: Frame, asked: Config) -> tuple[float, float]:
    number = int(robot)
    if not 1 <= number <= len(places_px):
        there = "is 1" if len(places_px) == 1 else f"are {len(places_px)}"
        raise UsageError(f"--robot {robot}: there {there} to choose from in image {image.index} of {asked.movie.path}")
    x, y = places_px[number - 1].round(2).tolist()
    return x, y


def _refuse_empty(robot: str, p: Pipeline, config: ResolvedConfig) -> None:
    """Raise UsageError where the first image shows no body at the place that was given."""
    with MovieSource(config.movie, config.coils) as source:
        sight = look(p, Sight(), next(iter(_within(source, config))))
    if sight.appearance is not None and sight.appearance.note:
        told = sight.appearance.note.replace("tracker.click_px =", "the pixels")
        raise UsageError(f"--robot {robot}: {told}")


def _first_seen(p: Pipeline, config: ResolvedConfig) -> tuple[Frame, Sight] | None:
    """The first image that shows the robot, or the first one where none does."""
    first, sight = None, Sight()
    with MovieSource(config.movie, config.coils) as source:
        for frame in _within(source, config):
            sight = look(p, sight, frame)
            first = first or (frame, sight)
            if sight.track is not None and sight.track.seen:
                return frame, sight
    return first


def _within(source: MovieSource, config: ResolvedConfig) -> Iterator[Frame]:
    """The images that are imported."""
    end_s = math.inf if config.duration_s is None else config.duration_s
    return itertools.takewhile(lambda frame: seconds(frame.stamp_ns) <= end_s, source.frames())


def _look_through(p: Pipeline, config: ResolvedConfig) -> tuple[Floats, MovieTracks | None]:
    """Shifts (n, 2) of all images in px, (0, 2) if they can not be measured; the robot's track, None without a log."""
    quality = TrackQuality(p.calibration, p.image_shape, p.robot)
    sight, seen, shifts = Sight(), list[Track](), list[Floats]()
    # The shift is measured, too, where it is not taken out of the track.
    stabilised, measures = bool(p.stabiliser.on), replace(p.stabiliser, on=True)
    shift, background = None, None
    with MovieSource(config.movie, config.coils) as source:
        log = source.log
        for frame in _within(source, config):
            if log is not None:
                sight = look(p, sight, frame)
                assert sight.track is not None, "the tracker says of every image whether it shows the robot"
                quality.take(sight.track, sight.appearance, sight.shift)
                seen += [sight.track] if sight.track.seen else []
            if log is not None and stabilised:
                shift, background = sight.shift, sight.background
            else:
                shift, background = measures.register(
                    shift, background, sight.track, frame, p.chip, p.calibration, p.robot
                )
            blind = background is None or not len(background.pixels)
            if blind and log is None:
                break
            shifts += [shift.shift_px] if shift is not None and not blind else []
    shifts_px = np.array(shifts).reshape(-1, 2)
    if log is None:
        return shifts_px, None
    stamps_ns = np.array([each.stamp_ns for each in seen], np.int64)
    positions_um = np.array([each.position_um for each in seen]).reshape(-1, 2)
    shake_px = float(np.sqrt(shifts_px.var(axis=0).sum())) if len(shifts_px) else None
    um_per_px, doubts = p.calibration.um_per_px, quality.doubts()
    return shifts_px, MovieTracks(stamps_ns, positions_um, log, shake_px, stabilised, um_per_px, doubts)


def _with_mean_shift(asked: Config, shifts_px: Floats) -> tuple[Config, Mapping[str, str]]:
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


def _place_of(robot: str, asked: Config, p: Pipeline) -> tuple[float, float] | None:
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


def _with_chosen_body(asked: Config, p: Pipeline, image: Frame, sight: Sight, robot: str, folder: Path) -> Config:
    """The configuration with the body that `robot` numbers; as it is, if only one qualifies."""
    places, what = _candidates(p, image, sight)
    name = asked.movie.path
    if not len(places) or (len(places) == 1 and not robot and sight.appearance is not None):
        if len(places) and (size := _size_text(p, image.image, places[0])):
            warn(f"{name}: the robot in image {image.index} has {size}")
        return asked
    if robot:
        at_px = _place_of_number(robot, places, image, asked)
        if size := _size_text(p, image.image, np.array(at_px)):
            warn(f"{name}: body {robot} of image {image.index} has {size}")
        return replace(asked, tracker=replace(asked.tracker, click_px=at_px, click_frame=image.index))
    count = f"at least {len(places)}" if len(places) >= MOST - 4 else len(places)  # near the limit some are left out
    factor, told = _factor(image.image), what.format(count, image.index)
    if len(places) == 1:
        size = _size_text(p, image.image, places[0])
        told = f"one body stands out in image {image.index}, not clearly the robot{size and f'; it has {size}'}"
    picture = write_picture(_draw_numbers(image.image, places, p), folder / f"{Path(name).stem}_robots{PICTURE[0]}")
    enlarged = f", {factor} times as large," if factor > 1 else ""
    raise UsageError(
        f"{name}: {told}; {picture} shows them{enlarged} with numbers from the top down: "
        "say which one is the robot with --robot N, or by its place: --robot X,Ypx in pixels of the movie, --robot "
        "X,Y in um"
    )


def _size_text(p: Pipeline, image: Image, place_px: Floats) -> str:
    """Size of a body in the image, where it is far from that which is stated for the robot; else ''."""
    stated_um = p.robot.radius_um
    measured_um = radius_in_image(image, place_px, stated_um / p.calibration.um_per_px) * p.calibration.um_per_px
    if not measured_um or 1.0 / _OTHER_SIZE < measured_um / stated_um < _OTHER_SIZE:
        return ""
    return f"a radius of about {measured_um:.3g} um, where robot.radius_um = {stated_um:g}: correct that, or the scale"


def radius_in_image(image: Image, place_px: Floats, about_px: float) -> float:
    """Radius in px of a disc as large as the body at a place (2,); 0 where its outline is not seen.

    The body is what differs from its surroundings by half as much as the most at that place does, with its holes.
    """
    reach, (x, y) = math.ceil(_SURROUNDINGS_RADII * max(about_px, 2.0)), (round(each) for each in place_px.tolist())
    left, top = max(x - reach, 0), max(y - reach, 0)
    window = image[top : y + reach + 1, left : x + reach + 1].astype(np.float32)
    off = np.abs(window - np.median(window))
    near = np.hypot(*np.ogrid[top - y : top - y + len(window), left - x : left - x + window.shape[1]]) <= max(
        about_px, 2.0
    )
    body = (off > 0.5 * np.quantile(off[near], 0.95)).astype(np.uint8)
    outlines, _ = cv2.findContours(body, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    distances = [abs(min(cv2.pointPolygonTest(each, (x - left, y - top), measureDist=True), 0.0)) for each in outlines]
    if not distances or min(distances) > about_px:
        return 0.0
    outline = outlines[int(np.argmin(distances))]
    width, height = window.shape[::-1]
    if (outline[:, 0].min(axis=0) == 0).any() or (outline[:, 0].max(axis=0) == (width - 1, height - 1)).any():
        return 0.0  # it goes on beyond the window
    filled = cv2.drawContours(np.zeros_like(body), [outline], 0, 1, cv2.FILLED)
    return math.sqrt(float(filled.sum()) / math.pi)


def _factor(image: Image) -> int:
    """Size of the drawn picture of the bodies over that of the image."""
    return max(1, round(_SIDE_PX / float(max(image.shape))))


def _candidates(p: Pipeline, frame: Frame, sight: Sight) -> tuple[Floats, str]:
    """Places (n, 2) in px from the top down, and how they are told of."""
    walls, calibration = seen_walls(p.chip, p.calibration, p.image_shape, shift_px(sight.shift))
    radius_px = p.robot.radius_um / calibration.um_per_px
    view = View(frame.image, walls, radius_px, -p.tracker.wall_error_radii * radius_px)
    if sight.appearance is None or sight.track is None or not sight.track.seen:
        found = bodies_that_stand_out(view)
        what = "{} bodies stand out in image {}, none of them clearly the robot"
    else:
        x, y = calibration.to_px(sight.track.position_um).tolist()
        found, what = bodies_like(view, (x, y), sight.appearance), "{} bodies in image {} look like the robot"
    return found[np.lexsort((found[:, 0], found[:, 1]))], what


def _draw_numbers(image: Image, places_px: Floats, p: Pipeline) -> NDArray[np.uint8]:
    """The image (h, w, 3) with a circle and a number at each place."""
    low, high = (float(np.quantile(image, share)) for share in (0.001, 0.999))
    grey = np.clip((image.astype(np.float32) - low) * (255.0 / max(high - low, 1.0)), 0.0, 255.0).astype(np.uint8)
    factor = _factor(image)
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
