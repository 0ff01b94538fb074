"""The rig of a lab: a camera behind its queue, and coils behind their limits and their guardian.

See rigs/lab/cameras/grabber.py and drive.py. Stamps are on the session clock, which is the host's monotonic clock
less the stamp of the first frame: the middle of the exposure, by the fit of the camera's own clock. `Applied` is made
of what the amplifier put out, not of what it was told.

While no image comes, the field is off, and there are ticks without an image: the run stays alive, its operator can end
it, and it goes on when the camera is back. A mission that only observes has no use for the coils, and does not open
them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack, contextmanager
from copy import copy
from dataclasses import replace
from functools import partial

import numpy as np

from flowrec.core import (
    Applied,
    CameraLosses,
    Currents,
    Delays,
    Fit,
    Frame,
    Image,
    Measured,
    RigError,
    UsageError,
    nanoseconds,
)
from flowrec.rigs.lab.cameras.camera import CameraInfo, wanted_of
from flowrec.rigs.lab.cameras.grabber import CAUSES, Captured, Grabber
from flowrec.rigs.lab.drive import BEAT_S, Drive
from flowrec.stages import CAMERAS, Inputs, Pipeline, ResolvedConfig

_ABSENT_S = 0.1  # between ticks without an image
_FIRST_S = 10.0  # for the first frame of a run
_LEAST_PERIODS = 3.0  # of the camera, before it is taken for absent


class LabRig:
    """Camera and coils; see rigs.rig.Rig and Connecting.

    Parameters
    ----------
    make_grabber : makes the camera's queue, not yet entered.
    drive : the coils, not yet entered; None: they are not used.
    config : for what the camera must deliver, and the limits of time.
    duration_s : None: without end.

    Raises UsageError for settings that exclude each other, and for a missing package.
    """

    @classmethod
    def of(
        cls,
        pipeline: Pipeline,
        config: ResolvedConfig,
        duration_s: float | None = None,
        realtime: bool = True,  # devices know no other time
    ) -> LabRig:
        """The rig of a resolved configuration."""
        wanted = wanted_of(config.camera, config.lab)
        make = partial(CAMERAS[config.lab.camera].load().of, wanted)
        rig = cls(partial(Grabber, make, wanted, config.lab.queue_frames), None, config, duration_s)
        if not config.mission.observes:
            rig.drive = Drive.of(config, lambda text: rig.tell(text))
        return rig

    def __init__(
        self,
        make_grabber: Callable[[], Grabber],
        drive: Drive | None,
        config: ResolvedConfig,
        duration_s: float | None = None,
    ) -> None:
        lab, guard_s = config.lab, config.safety.guard_timeout_s
        least_s = _LEAST_PERIODS / config.camera.rate_hz
        if not least_s <= lab.camera_timeout_s < guard_s:
            raise UsageError(
                f"lab.camera_timeout_s = {lab.camera_timeout_s:g}: must be at least {_LEAST_PERIODS:g} frames "
                f"({least_s:.3g} s at camera.rate_hz = {config.camera.rate_hz:g}) and less than "
                f"safety.guard_timeout_s = {guard_s:g}"
            )
        self.tell: Callable[[str], None] = lambda _text: None
        self.epoch_ns: int | None = None
        self.drive = drive
        self._make_grabber = make_grabber
        self._grabber: Grabber | None = None
        self._config = config
        self._duration_ns = None if duration_s is None else nanoseconds(duration_s)
        self._connection = ExitStack()
        self._told_measured: Measured | None = None
        self._told: set[str] = set()  # notes about the camera
        self._absent = False  # for the loop's thread only

    @contextmanager
    def connected(self) -> Iterator[None]:
        with ExitStack() as stack:
            # The camera first: a guardian that waits for a camera is of no use.
            grabber = self._grabber = stack.enter_context(self._make_grabber())
            stack.callback(setattr, self, "_grabber", None)
            self._check(grabber.info)
            self._tell_notes(grabber)
            if self.drive is not None:
                stack.enter_context(self.drive)
            yield

    def __enter__(self) -> LabRig:
        if self._grabber is None:
            self._connection.enter_context(self.connected())
        return self

    def __exit__(self, *error: object) -> None:
        try:
            if self.drive is not None:
                self.drive.zero()
        finally:
            self._connection.close()

    def apply(self, currents: Currents) -> None:
        """Send a command; while no image comes, none that makes a field."""
        if self.drive is None:
            return
        if self._absent:
            self.drive.rest()
            self.drive.beat()
        else:
            self.drive.apply(currents)

    def zero(self) -> None:
        """Switch the field off at once, until the devices are connected again."""
        if self.drive is not None:
            self.drive.zero()

    def rest(self) -> None:
        """Switch the field off until the next command, by the loop's next beat, which comes at once if it waits."""
        if self.drive is not None:
            self.drive.let_go()
        if (grabber := self._grabber) is not None:
            grabber.wake()

    def picture(self) -> Image:
        grabber = self._grabber
        assert grabber is not None, "the devices are open"
        return self._first(grabber).image

    def inputs(self) -> Iterator[Inputs]:
        """Frame after frame; while there is none, ticks without an image.

        Raises
        ------
        RigError : the camera or the coils can not be used any more, or no image has come for lab.give_up_s.
        """
        grabber = self._grabber
        assert grabber is not None, "the rig has been entered"
        first = self._first(grabber)
        assert grabber.losses is not None, "a frame was handed on"
        session = _Session(first, grabber.losses)
        self.epoch_ns = first.stamp_ns
        frame: Captured | None = first
        last_ns, absent_until_ns = session.stamp_ns(first.stamp_ns), None
        before_ns: int | None = None
        losses: CameraLosses | None = None
        while True:
            if frame is not None:
                self._absent = False
                stamp_ns = last_ns = session.stamp_ns(frame.stamp_ns)
            else:
                stamp_ns = absent_until_ns = max(self._absent_ns(session), last_ns + 1)
            if self._duration_ns is not None and stamp_ns > self._duration_ns:
                return
            applied = self._field_between(session, stamp_ns, before_ns)
            applied = replace(applied, absent_until_ns=absent_until_ns)
            if frame is None:
                yield Inputs(stamp_ns, None, applied, measured=self._new_measurement(session), delays=self._delays())
            else:
                losses, before = session.losses(frame.losses), losses
                if losses is not before:  # about once a second
                    self._tell_notes(grabber)
                yield Inputs(
                    stamp_ns,
                    Frame(stamp_ns, session.index(frame), frame.image, frame.bits),
                    applied,
                    clock=session.fit(frame.clock),
                    losses=losses,
                    measured=self._new_measurement(session),
                    delays=self._delays(frame),
                )
            before_ns = stamp_ns
            frame = self._next(grabber)

    def tried(self) -> Generator[Inputs]:
        """The camera's images, without the coils."""
        camera_only = copy(self)
        camera_only.drive = None
        yield from camera_only.inputs()

    # ---- the camera

    def _check(self, info: CameraInfo) -> None:
        """Refuse a camera that delivers other images than configured."""
        camera = self._config.camera
        if (info.width_px, info.height_px) != camera.size_px:
            raise RigError(
                f"{info.name}: images of {info.width_px} x {info.height_px} pixels, where camera.width_px x "
                f"camera.height_px = {camera.width_px} x {camera.height_px}; set them to what the camera can deliver"
            )
        if info.bits != camera.bits:
            raise RigError(
                f"{info.name}: images of {info.bits} bit ({info.pixel_format}), where camera.bits = {camera.bits}; set "
                "it, or lab.pixel_format"
            )

    def _tell_notes(self, grabber: Grabber) -> None:
        """Tell what the camera does otherwise than asked, each once; some is only known after seconds."""
        for note in grabber.notes:
            about = note.partition(" asked")[0]
            if about not in self._told:
                self._told.add(about)
                self.tell(f"{grabber.info.name}: {note}")

    def _first(self, grabber: Grabber) -> Captured:
        """The newest frame: those that came while the run was prepared belong to no run."""
        end_s, frame = time.monotonic() + _FIRST_S, None
        while (newer := grabber.next(0.0 if frame is not None else BEAT_S)) is not None or frame is None:
            frame = newer if newer is not None else frame
            if frame is None and time.monotonic() > end_s:
                raise RigError(
                    f"no image in {_FIRST_S:g} s: {grabber.absent or 'the camera waits'}; see to its trigger "
                    "(lab.trigger) and its cable"
                )
            if newer is None:
                self._beat()
        return frame

    def _next(self, grabber: Grabber) -> Captured | None:
        """The next frame; None when it is time for a tick without one."""
        begin_s = time.monotonic()
        patience_s = _ABSENT_S if self._absent else self._config.lab.camera_timeout_s
        while (frame := grabber.next(BEAT_S)) is None:
            self._beat()
            waited_s = time.monotonic() - begin_s
            if waited_s < patience_s:
                continue
            why = grabber.absent or "no image comes"
            if not self._absent:
                self._absent, self._absent_s = True, begin_s
                self.tell(f"{why}: the field is off until there is an image again")
            if self.drive is not None:
                self.drive.rest()
            if time.monotonic() - self._absent_s > self._config.lab.give_up_s:
                raise RigError(f"no image for {self._config.lab.give_up_s:g} s (lab.give_up_s): {why}")
            return None
        if self._absent:
            self.tell(f"the camera is back after {time.monotonic() - self._absent_s:.1f} s")
        return frame

    def _absent_ns(self, session: _Session) -> int:
        """Stamp of a tick without an image: before that of a frame whose exposure has begun."""
        late_s = self._config.camera.exposure_s + self._config.lab.camera_delay_s + BEAT_S
        return session.stamp_ns(time.monotonic_ns() - nanoseconds(late_s))

    def _delays(self, frame: Captured | None = None) -> Delays:
        field_ms = self.drive.field_ms if self.drive is not None else None
        if frame is None:
            return Delays(None, None, field_ms)
        return Delays(1e-6 * (frame.arrival_ns - frame.stamp_ns), frame.arrival_ns, field_ms)

    # ---- the coils

    def _beat(self) -> None:
        if self.drive is not None:
            self.drive.beat()

    def _new_measurement(self, session: _Session) -> Measured | None:
        """The latest measurement of the currents, on the session clock; None: none is new."""
        measured = None if self.drive is None else self.drive.read_back()
        if measured is None or measured is self._told_measured:
            return None
        self._told_measured = measured
        return replace(measured, stamp_ns=session.stamp_ns(measured.stamp_ns))

    def _field_between(self, session: _Session, stamp_ns: int, before_ns: int | None) -> Applied:
        if self.drive is None:
            return Applied(stamp_ns, 0.0, 0.0, 0.0, np.zeros(self._config.coils.count), np.zeros(2))
        begin_ns = None if before_ns is None else session.monotonic_ns(before_ns)
        return replace(self.drive.applied_at(session.monotonic_ns(stamp_ns), begin_ns), stamp_ns=stamp_ns)


class _Session:
    """From the camera's queue, which runs before the run does, to the run's clock and counts."""

    def __init__(self, first: Captured, losses: CameraLosses) -> None:
        self._epoch_ns = first.stamp_ns
        self._first_index = first.index
        self._before = losses  # up to the first frame; those that come with frames may be some frames older
        self._known: tuple[CameraLosses, CameraLosses] | None = None

    def stamp_ns(self, monotonic_ns: int) -> int:
        return monotonic_ns - self._epoch_ns

    def monotonic_ns(self, stamp_ns: int) -> int:
        return stamp_ns + self._epoch_ns

    def index(self, frame: Captured) -> int:
        return frame.index - self._first_index

    def fit(self, fit: Fit | None) -> Fit | None:
        """The fit of the camera's clock, with its arrival times on the session clock."""
        if fit is None:
            return None
        epoch_ns = self._epoch_ns
        return replace(
            fit,
            stamp_ns=fit.stamp_ns - epoch_ns,
            arrival_ns=fit.arrival_ns - epoch_ns,
            fitted_ns=fit.fitted_ns - epoch_ns,
        )

    def losses(self, losses: CameraLosses) -> CameraLosses:
        """The losses since the run began; the same object for the same one."""
        if self._known is None or self._known[0] is not losses:
            first = self._before
            since = losses if losses.ids > first.ids else first
            self._known = (
                losses,
                replace(
                    since,
                    stamp_ns=self.stamp_ns(since.stamp_ns),
                    ids=since.ids - first.ids + 1,
                    frames=since.frames - first.frames + 1,
                    **{cause: getattr(since, cause) - getattr(first, cause) for cause in CAUSES},
                ),
            )
        return self._known[1]
