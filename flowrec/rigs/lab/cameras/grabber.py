"""A camera in a thread of its own, behind a queue of a few frames: frames with an index and a stamp, losses by cause.

The thread takes every image from the driver at once, so that the driver's buffers never overflow because a stage is
slow. If the queue is full, its oldest frame is dropped: a control loop needs the newest one.

Every block that the device counts is accounted for: those that were handed on and those lost, by cause, add up to the
ids (`CameraLosses`). A camera that is unplugged, or stands still, is closed and opened again until it is back;
meanwhile `absent` says why no frame comes.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Self, TypeVar

from flowrec.core import CameraLosses, Fit, Image, Priority, RigError, nanoseconds, realtime_priority, seconds
from flowrec.rigs.lab.cameras.camera import SOFTWARE, Camera, CameraInfo, Grabbed, Wanted
from flowrec.rigs.lab.cameras.device_counts import BlockIds, Stamper

_SLICE_S = 0.1  # longest wait in the driver, so that the thread ends promptly
_SILENT_S = 0.7  # without a frame, at least, before a camera is taken for absent
_SILENT_PERIODS = 3.0  # likewise, in periods of its frames
_START_S = 3.0  # a camera may take so long until its first frame
_ANSWER_S = 0.5  # time for an answer to alive()
_OPEN_S = 20.0  # time for the first open()
_CLOSE_S = 1.0  # time for close() of a camera that may hang
_AGAIN_S = 0.05  # between two attempts to open an absent camera
_REPORT_S = 1.0  # between two messages of losses that are the same
_RATE_S = 2.0  # over which a rate is measured, at least
_RATE_ERROR = 0.03  # relative difference of the rate that is worth a note

CAUSES = ("link", "incomplete", "driver", "backlog", "triggers", "reconnections")  # fields of CameraLosses
_loss_counts = attrgetter(*CAUSES)
_identity = attrgetter("model", "serial", "width_px", "height_px", "bits")  # of a CameraInfo

_T = TypeVar("_T")


@dataclass(frozen=True, slots=True)
class Captured:
    """One frame, as it leaves the queue.

    Attributes
    ----------
    image, bits : (height, width), uint8 for 8 bits, else uint16 with values below 2**bits.
    index : counts the blocks of the device from the first one on; what is missing was lost.
    stamp_ns : middle of the exposure on the host's monotonic clock: arrival by the fit of the device's clock, less half
        of the exposure and the constant delay that is wanted; strictly increasing. What of the time from the end of the
        exposure to the earliest arrival (readout and transfer) is not wanted remains in it.
    arrival_ns : on the host's monotonic clock.
    clock : the fit, with which the stamp was made; None: the device has no clock, or it stands still.
    losses : by cause; the same message until something more is lost, or a second has passed, so that few are written.
        `Grabber.losses` is that of this frame.
    """

    image: Image
    bits: int
    index: int
    stamp_ns: int
    arrival_ns: int
    clock: Fit | None
    losses: CameraLosses


class Grabber:
    """Takes the frames of a camera; a context manager.

    Entering it opens the camera (RigError in one line if that fails), leaving it ends the thread. `next` is for one
    thread at a time.

    While the camera is absent, or waits for a trigger, `next` returns None after its timeout. It is for the rig to
    decide what a silence means: the loop's watchdog fails a run whose field is on and whose ticks stay away for
    safety.guard_timeout_s, so a rig that is to go on when the camera is back takes the field away before.

    Parameters
    ----------
    make : makes the camera, not yet open; again for each new connection, because a driver may hang in the old one.
    wanted : as `make` uses it: exposure, rate and trigger.
    length : frames in the queue.

    Attributes
    ----------
    info : what the camera says of itself; valid once the context is entered.
    absent : why no frame comes, for people; '' while the camera delivers, or waits for a trigger.
    losses : up to the latest frame that was handed on; None before the first one.
    frames : handed on.
    backlog : dropped, because the queue was full.
    """

    def __init__(self, make: Callable[[], Camera], wanted: Wanted, length: int = 8) -> None:
        self.absent = ""
        self.losses: CameraLosses | None = None
        self.frames = self.backlog = 0
        self._make = make
        self._wanted = wanted
        self._length = length
        self._queue: deque[Captured] = deque()
        self._filled = threading.Condition()
        self._opened = threading.Event()
        self._over = threading.Event()
        self._failure: Exception | None = None
        self._info: CameraInfo | None = None
        self._reported: CameraLosses | None = None  # the latest one that a frame came with
        # Of the thread only.
        self._ids = BlockIds()
        self._stamper = Stamper()
        self._counts = CameraLosses(0, 0, 0, 0, 0, 0, 0, 0, 0)  # what the thread knows; frames and backlog stay 0
        self._span: tuple[tuple[int, int], tuple[int, int]] = (0, 0), (0, 0)  # index and stamp, first and last
        self._attributed = 0  # blocks of the driver's own count that are in the counts already
        self._thread = threading.Thread(target=self._work, name="camera", daemon=True)

    @property
    def info(self) -> CameraInfo:
        """Properties that the camera reports."""
        assert self._info is not None, "the context has been entered"
        return self._info

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks on the camera for people, a line each; more may come with the first frames."""
        notes = self.info.notes
        if not self.info.ticks_per_s:
            notes += ("the camera has no clock: frames are stamped by their arrival",)
        elif self._stamper.frozen:
            notes += ("the camera's clock stands still: frames are stamped by their arrival",)
        if not self.info.id_bits:
            notes += ("the camera does not number its images: what it or the link loses is not seen",)
        rate_hz, told_hz = self.rate_hz, self.info.rate_hz or self._wanted.rate_hz
        if rate_hz and abs(rate_hz - told_hz) > _RATE_ERROR * told_hz:
            notes += (f"camera.rate_hz = {self._wanted.rate_hz:g} Hz asked, {rate_hz:.4g} Hz measured",)
        return notes

    @property
    def rate_hz(self) -> float:
        """Blocks per second since the connection, by their ids and stamps; 0 during its first two seconds."""
        (index, stamp_ns), (last_index, last_ns) = self._span
        span_s = seconds(last_ns - stamp_ns)
        return (last_index - index) / span_s if span_s > _RATE_S else 0.0

    def __enter__(self) -> Self:
        self._thread.start()
        try:
            if not self._opened.wait(_OPEN_S):
                raise RigError(f"the camera does not answer for {_OPEN_S:g} s; switch it off and on, then try again")
        except BaseException:  # Ctrl-C too
            self._over.set()
            raise
        if self._info is None and self._failure is not None:
            raise self._failure
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """End the thread. If a call of the driver hangs, it is left behind after a second."""
        self._over.set()
        if self._thread.ident is not None:
            self._thread.join(_CLOSE_S)

    def next(self, timeout_s: float) -> Captured | None:
        """The next frame; None if none comes in this time.

        Raises
        ------
        RigError : the camera can not be used any more; an unplugged one is waited for instead.
        """
        with self._filled:
            if not self._queue and self._failure is None:
                self._filled.wait(timeout_s)
            if not self._queue:
                if self._failure is not None:
                    raise self._failure
                return None
            frame = self._queue.popleft()
            self.frames += 1
            # All that the queue has dropped lies before the frame, which was behind it.
            exact = self.losses = replace(frame.losses, frames=self.frames, backlog=self.backlog)
        last = self._reported
        if (
            last is None
            or exact.stamp_ns >= last.stamp_ns + nanoseconds(_REPORT_S)
            or _loss_counts(last) != _loss_counts(exact)
        ):
            self._reported = last = exact
        return replace(frame, losses=last)

    def wake(self) -> None:
        """Let `next` return now, if it waits: the loop has something else to do. Any thread."""
        with self._filled:
            self._filled.notify_all()

    # ---- the thread

    def _work(self) -> None:
        # Above the loop, which may be what uses all of the processor.
        with realtime_priority(Priority.DEVICE):
            camera: Camera | None = None
            try:
                camera = self._make()
                self._note_connection(camera.open())
            except Exception as error:  # noqa: BLE001  raised in the thread that waits for the camera
                self._failure = error
                if camera is not None:
                    _within(_CLOSE_S, camera.close)
                self._opened.set()
                return
            self._opened.set()
            try:
                while True:
                    self.absent = self._acquire(camera)
                    if self._over.is_set():
                        break
                    _within(_CLOSE_S, camera.close)
                    camera = self._found_again()
                camera.close()
            except Exception as error:  # noqa: BLE001  raised by `next`
                with self._filled:
                    self._failure = error
                    self._filled.notify_all()
                _within(_CLOSE_S, camera.close)

    def _note_connection(self, info: CameraInfo) -> None:
        self._info = info
        rate_hz = info.rate_hz or self._wanted.rate_hz
        self._ids.reset(info.id_bits, rate_hz)
        self._stamper.reset(info, self._wanted.exposure_s, self._wanted.delay_s)
        self._attributed = 0
        self._span = (0, 0), (0, 0)
        self._silent_s = max(_SILENT_S, _SILENT_PERIODS / rate_hz) + (info.exposure_s or self._wanted.exposure_s)

    def _acquire(self, camera: Camera) -> str:
        """Take images until the camera is gone, and say why it is; '' at the end."""
        silent_s = max(_START_S, self._silent_s)  # before the first frame
        heard_s = time.monotonic()
        pace = _Pace(self._wanted, self._silent_s)
        while not self._over.is_set():
            try:
                missed = pace.trigger(camera)
                grabbed = camera.grab(pace.wait_s())
            except RigError as error:
                return str(error)
            if missed:
                self._counts = replace(self._counts, triggers=self._counts.triggers + 1)
            now_s = time.monotonic()
            if grabbed is not None:
                self.absent = ""
                pace.note_frame()
                self._take(camera, grabbed)
                heard_s, silent_s = now_s, self._silent_s
            elif now_s - heard_s > silent_s:
                # With a trigger, silence is usual; without one, the connection is made anew even if the device answers.
                if not self._wanted.trigger or not _within(_ANSWER_S, camera.alive):
                    return f"the camera has delivered no frame for {now_s - heard_s:.1f} s"
                heard_s = now_s
        return ""

    def _take(self, camera: Camera, grabbed: Grabbed) -> None:
        """Count a block, and queue it if it is whole."""
        step = self._ids.step(grabbed.block_id, grabbed.arrival_ns)
        counts = self._counts
        if step <= 0:  # the same block again, or one that was counted as missing
            if step and grabbed.incomplete and counts.link:
                self._counts = replace(counts, link=counts.link - 1, incomplete=counts.incomplete + 1)
            return
        gap, discarded = step - 1, 0
        if gap or grabbed.block_id is None:
            # The driver's count runs ahead of the ids, by the frames that wait in its buffers.
            discarded = max(camera.discarded() - self._attributed, 0)
            if grabbed.block_id is None:
                gap = discarded
                self._ids.index += gap
            discarded = min(discarded, gap)
            self._attributed += discarded
        link, incomplete = counts.link + gap - discarded, counts.incomplete + grabbed.incomplete
        counts = replace(counts, link=link, incomplete=incomplete, driver=counts.driver + discarded)
        self._counts = counts
        if grabbed.incomplete or grabbed.image is None:
            return
        stamp_ns, fit, before_ns = self._stamper.take(grabbed.device_ticks, grabbed.arrival_ns)
        if fit is not None and before_ns is not None and self._wanted.trigger not in ("", SOFTWARE):
            due = round(seconds(stamp_ns - before_ns) * self._wanted.rate_hz)
            if due > step:
                self._counts = counts = replace(counts, triggers=counts.triggers + due - step)
        at = self._ids.index, stamp_ns
        self._span = (self._span[0] if self._span[1] != (0, 0) else at), at
        losses = replace(counts, stamp_ns=stamp_ns, ids=self._ids.index + 1)
        frame = Captured(grabbed.image, grabbed.bits, self._ids.index, stamp_ns, grabbed.arrival_ns, fit, losses)
        with self._filled:
            if len(self._queue) == self._length:
                self._queue.popleft()
                self.backlog += 1
            self._queue.append(frame)
            self._filled.notify()

    def _found_again(self) -> Camera:
        """Open the camera again and again until it is back, the same as before, or the thread is to end."""
        known = self.info
        while True:
            camera = self._make()
            if self._over.is_set():
                return camera
            try:
                info = camera.open()
            except RigError:
                info = None  # still absent; `absent` says since when, and this says nothing else
            if info is not None and _identity(known) == _identity(info):
                self._note_connection(info)
                self._counts = replace(self._counts, reconnections=self._counts.reconnections + 1)
                return camera
            if info is not None:
                self.absent = (
                    f"another camera has answered ({info.model} {info.serial}, {info.width_px} x {info.height_px} "
                    f"pixels of {info.bits} bits); connect {known.model} {known.serial} again"
                )
            _within(_CLOSE_S, camera.close)
            self._over.wait(_AGAIN_S)


class _Pace:
    """Timing of the driver: time to wait in it, and times of software triggers, one per frame at the wanted rate."""

    def __init__(self, wanted: Wanted, patience_s: float) -> None:
        self._software = wanted.trigger == SOFTWARE
        self._period_s = 1.0 / wanted.rate_hz
        self._patience_s = patience_s
        self._due_s = time.monotonic()
        self._sent_s: float | None = None

    def trigger(self, camera: Camera) -> bool:
        """Trigger if it is time to; whether the trigger before was missed.

        Raises
        ------
        RigError : of the driver.
        """
        if not self._software:
            return False
        now_s = time.monotonic()
        missed = self._sent_s is not None and now_s > self._sent_s + self._patience_s
        if missed:
            self._sent_s = None
        if self._sent_s is None and now_s >= self._due_s:
            self._sent_s = now_s
            self._due_s = max(self._due_s + self._period_s, now_s)
            camera.trigger()
        return missed

    def note_frame(self) -> None:
        """A frame has come."""
        self._sent_s = None

    def wait_s(self) -> float:
        """Longest time to wait for a frame."""
        if not self._software or self._sent_s is not None:
            return _SLICE_S
        return min(max(self._due_s - time.monotonic(), 1e-3), _SLICE_S)


def _within(time_s: float, call: Callable[[], _T]) -> _T | None:
    """The result of a call that may hang, in a thread that is left behind then; None if it takes longer."""
    results: list[_T] = []
    thread = threading.Thread(target=lambda: results.append(call()), name="camera call", daemon=True)
    thread.start()
    thread.join(time_s)
    return results[0] if results else None
