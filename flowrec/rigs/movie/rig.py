"""The rig of a movie: it plays the images, and reads in a log what the coils did. It sends no command.

`Applied` at an image holds what acts on the robot: what the log says of the time robot.delay_s before it, or, of the
tables of a session, of that time.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from operator import attrgetter
from typing import Any

from flowrec.core import Currents, Phase, UsageError, nanoseconds, seconds
from flowrec.rigs.movie.source import MovieSource
from flowrec.stages import PHASES, Config, FieldLog, Inputs, Pipeline, ResolvedConfig

_MARGIN = 1.2  # of the robot's top speed over the fastest rotation in the log
# What no file tells, and how it is given.
_ASKED = {
    "camera.um_per_px": "[camera] um_per_px = 2.0",
    "robot.radius_um": "[robot] radius_um = 25.0",
    "chip.path": '[chip] path = "chip.png"',
}


class MovieRig:
    """Plays a movie; see rigs.rig.Rig.

    Parameters
    ----------
    source : the movie and the log, already on one clock. It is closed with the rig.
    delay_s : from the log to the motion.
    duration_s : None: all of it.
    realtime : pace the images by their stamps.

    Attributes
    ----------
    taken, images : images that were read, and that the movie states for the time that was asked for.
    """

    @classmethod
    def of(
        cls, pipeline: Pipeline, config: ResolvedConfig, duration_s: float | None = None, realtime: bool = False
    ) -> MovieRig:
        """The rig of a resolved configuration."""
        source = MovieSource(config.movie, config.coils)
        delay_s = 0.0 if source.log_delayed else config.robot.delay_s
        return cls(source, delay_s, duration_s, realtime)

    def __init__(
        self, source: MovieSource, delay_s: float, duration_s: float | None = None, realtime: bool = False
    ) -> None:
        self._source = source
        self._log = (source.log if source.log is not None else FieldLog()).shift_clock(nanoseconds(delay_s))
        self._end_ns = None if duration_s is None else nanoseconds(duration_s)
        self._realtime = realtime
        self._known = source.remarks
        stamps_ns = source.stamps_ns
        self.taken = 0
        self.images = len(stamps_ns) if self._end_ns is None else int((stamps_ns <= self._end_ns).sum())

    @property
    def noticed(self) -> list[str]:
        """Remarks made while the images were read, such as an early end."""
        return [remark for remark in self._source.remarks if remark not in self._known]

    def __enter__(self) -> MovieRig:
        return self

    def __exit__(self, *error: object) -> None:
        self._source.close()

    def inputs(self) -> Iterator[Inputs]:
        """Image after image; MovieError if one can not be read, or does not come after the one before."""
        before_ns: int | None = None
        began_s = time.monotonic()
        for frame in self._source.frames():
            if self._end_ns is not None and frame.stamp_ns > self._end_ns:
                return
            if self._realtime:
                time.sleep(max(0.0, began_s + seconds(frame.stamp_ns) - time.monotonic()))
            self.taken += 1
            yield Inputs(frame.stamp_ns, frame, self._log.applied_at(frame.stamp_ns, before_ns))
            before_ns = frame.stamp_ns

    def apply(self, currents: Currents) -> None:
        """Do nothing: what happened has happened."""

    def zero(self) -> None:
        """Do nothing: there are no coils."""


def fitted_to_movie(config: Config) -> tuple[Config, Mapping[str, str], list[str]]:
    """Settings that a movie and its log determine, the provenance of both, and remarks for people.

    The movie sets size, depth and rate of the camera. Without other phases the robot is observed. Its top speed, which
    only bounds what is plausible, is that of the fastest rotation in the log. A delay that is not given is 0. Without a
    log the flow is not refined, unless the body drifts.

    Raises
    ------
    UsageError : what no file tells is missing: um_per_px, the radius of the robot, the chip; all of it in one line.
    MovieError : the movie or its log can not be used.
    """
    with MovieSource(config.movie, config.coils) as source:
        config = _with_notes(config, source)
        _refuse_missing(config, source)
        facts, log, robot = source.facts, source.log, config.robot
        camera: dict[str, Any] = {"width_px": facts.width_px, "height_px": facts.height_px, "bits": facts.bits}
        if config.camera.rate_hz is None:
            camera["rate_hz"] = round(min(max(source.rate_hz or 1.0, 0.1), 5e3), 6)
        known: dict[str, Any] = {}
        if robot.delay_s is None:
            known["delay_s"] = 0.0
        if log is not None and robot.max_speed_um_s is None:
            fastest_hz = float(log.frequency_hz[log.amplitude_mt > 0.0].max())
            known["max_speed_um_s"] = round(_MARGIN * robot.um_per_rev * fastest_hz, 3)
        if log is not None and robot.step_out_hz is None:
            known["step_out_hz"] = round(_MARGIN * float(log.frequency_hz.max()), 6)
        mission, refine = config.mission, config.refine
        if mission.phases == PHASES:
            mission = replace(mission, phases=(Phase.OBSERVE,))
        if log is None and not config.movie.drifts:
            refine = replace(refine, observes_flow=False)
        remarks = list(source.remarks)
        told, used = facts.um_per_px, config.camera.um_per_px
        if told is not None and used is not None and abs(used / told - 1.0) > 0.01:
            remarks.append(f"the file says {told:.6g} um per pixel; camera.um_per_px = {used:g} is used")
        changed = replace(
            config,
            camera=replace(config.camera, **camera),
            robot=replace(robot, **known),
            mission=mission,
            refine=refine,
        )
        return changed, source.provenance(), remarks


def _with_notes(config: Config, source: MovieSource) -> Config:
    """The configuration with what flowrec wrote into the movie of a session, where nothing else is given."""
    notes = source.facts.notes
    if notes is None:
        return config
    camera, robot, chip = config.camera, config.robot, config.chip
    if camera.um_per_px is None:
        camera = replace(camera, um_per_px=notes.um_per_px)
    if robot.radius_um is None and notes.radius_um is not None:
        robot = replace(robot, radius_um=notes.radius_um)
    if not chip.path:
        chip = replace(chip, path=str(source.path))
    return replace(config, camera=camera, robot=robot, chip=chip)


def _refuse_missing(config: Config, source: MovieSource) -> None:
    missing = [key for key in _ASKED if attrgetter(key)(config) in (None, "")]
    if not missing:
        return
    example = " ".join(_ASKED[key] for key in missing)
    hint = f" (the file says {source.facts.um_per_px:.6g} um per pixel)" if source.facts.um_per_px is not None else ""
    raise UsageError(
        f"{source.path}: {source.facts.describe()}; it does not tell {', '.join(missing)}{hint}; flowrec init "
        f"{source.path} asks for them, or give them in a TOML, as in {example}"
    )
