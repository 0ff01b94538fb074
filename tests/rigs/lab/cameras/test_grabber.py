from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

from flowrec.core import RigError
from flowrec.rigs import CameraInfo, Wanted
from flowrec.rigs.lab.cameras.device_counts import Stamper
from flowrec.rigs.lab.cameras.grabber import Captured, Grabber
from tests.conftest import HANG_S
from tests.rigs.lab.cameras.scripted import GONE, INFO, WANTED, Scripted, Step, block
from tests.rigs.lab.cameras.watching import adds_up


@contextmanager
def grabbing(*cameras: Scripted, wanted: Wanted = WANTED, length: int = 1000) -> Iterator[Grabber]:
    """A grabber of cameras that come one after the other, as their connections fail."""
    left = iter(cameras)
    with Grabber(lambda: next(left, cameras[-1]), wanted, length) as grabber:
        yield grabber


def captured(grabber: Grabber, camera: Scripted) -> list[Captured]:
    """All frames of a camera up to the end of its script."""
    assert camera.exhausted.wait(HANG_S)
    return list(iter(lambda: grabber.next(0.0), None))


def following(grabber: Grabber) -> Captured:
    """The next frame."""
    frame = grabber.next(HANG_S)
    assert frame is not None
    return frame


def test_frames_and_losses_by_cause_add_up_to_the_ids() -> None:
    steps: list[Step] = [block(n) for n in (65_530, 65_531, 65_533, 65_534)]
    steps += [block(65_535, whole=False), block(1), block(5), block(3, whole=False), block(6)]
    camera = Scripted.delivering(steps)
    with grabbing(camera) as grabber:
        frames = captured(grabber, camera)
    last = frames[-1].losses
    assert [frame.index for frame in frames] == [0, 1, 3, 4, 6, 10, 11]
    assert (last.ids, last.frames, last.link, last.incomplete) == (12, 7, 3, 2)
    assert all(adds_up(frame.losses) for frame in frames)
    assert [int(frame.image[0, 0]) for frame in frames] == [n % 251 for n in (65_530, 65_531, 65_533, 65_534, 1, 5, 6)]


def test_a_stamp_is_the_middle_of_the_exposure_also_of_a_camera_whose_images_arrive_late() -> None:
    for delay_s in (0.0, 0.1):
        camera = Scripted.delivering([block(1), block(2)])
        with grabbing(camera, wanted=replace(WANTED, exposure_s=0.02, delay_s=delay_s)) as grabber:
            frames = captured(grabber, camera)
        before_ns = [frame.arrival_ns - frame.stamp_ns for frame in frames]
        assert before_ns == [round(1e9 * (0.01 + delay_s))] * 2


def test_an_incomplete_image_is_never_handed_on_and_is_counted() -> None:
    camera = Scripted.delivering([block(1, whole=False), block(2), block(3, whole=False), block(4)])
    with grabbing(camera) as grabber:
        frames = captured(grabber, camera)
    assert [frame.index for frame in frames] == [1, 3]
    assert frames[-1].losses.incomplete == 2 and adds_up(frames[-1].losses)


def test_what_a_full_queue_drops_is_the_oldest_and_counted_as_backlog() -> None:
    camera = Scripted.delivering([block(n) for n in range(1, 21)])
    with grabbing(camera, length=4) as grabber:
        frames = captured(grabber, camera)
    assert [frame.index for frame in frames] == [16, 17, 18, 19]
    assert frames[-1].losses.backlog == 16 and all(adds_up(frame.losses) for frame in frames)


def test_what_the_driver_threw_away_is_told_from_what_the_link_lost() -> None:
    camera = Scripted()
    # The driver's buffers hold blocks 2 and 3 when 4 to 6 find no room; 9 is lost on the link.
    camera.steps.extend([block(1), lambda: setattr(camera, "lost", 3), *map(block, (2, 3, 7, 8, 10))])
    with grabbing(camera) as grabber:
        last = captured(grabber, camera)[-1].losses
    assert (last.driver, last.link) == (3, 1) and adds_up(last)


def test_a_camera_without_ids_is_counted_by_its_driver() -> None:
    camera = Scripted(info=replace(INFO, id_bits=0))
    camera.steps.extend([block(None), lambda: setattr(camera, "lost", 2), block(None), block(None)])
    with grabbing(camera) as grabber:
        frames = captured(grabber, camera)
    assert [frame.index for frame in frames] == [0, 3, 4]
    assert frames[-1].losses.driver == 2 and adds_up(frames[-1].losses)


@pytest.mark.parametrize("end", [[GONE], []], ids=["the driver says so", "silence"])
def test_a_camera_that_is_gone_is_opened_again_until_it_is_back(end: list[Step]) -> None:
    first = Scripted.delivering([block(7), block(8), *end])
    away = [Scripted(info=RigError("no camera found")) for _ in range(3)]
    seen = threading.Event()
    back = Scripted.delivering([lambda: seen.wait(HANG_S) and None, block(1), block(3)])
    with grabbing(first, *away, back) as grabber:
        following(grabber), following(grabber)
        assert first.closed.wait(HANG_S) and grabber.absent
        seen.set()
        third, fourth = following(grabber), following(grabber)
        assert grabber.absent == ""
    assert (third.index, fourth.index) == (2, 4)
    assert fourth.losses.reconnections == 1 and fourth.losses.link == 1 and adds_up(fourth.losses)
    assert [camera.opened for camera in away] == [1, 1, 1]


def test_another_camera_in_the_place_of_the_one_that_is_gone_is_not_used() -> None:
    other = Scripted.delivering([block(1)], info=replace(INFO, serial="2"))
    back = Scripted.delivering([block(1)])
    with grabbing(Scripted.delivering([block(7), GONE]), other, back) as grabber:
        following(grabber), following(grabber)
    assert len(other.steps) == 1 and other.closed.is_set()


def test_with_a_trigger_silence_is_no_fault_while_the_camera_answers() -> None:
    camera = Scripted.delivering([block(1)], info=replace(INFO, exposure_s=0.0))
    with grabbing(camera, wanted=replace(WANTED, trigger="Line1")) as grabber:
        following(grabber)
        time.sleep(1.0)  # longer than a camera without a trigger may be silent
        assert grabber.absent == "" and not camera.closed.is_set()
        camera.answers = False
        assert camera.closed.wait(HANG_S) and grabber.absent


def test_triggers_that_no_block_has_answered_are_counted_by_the_clock_of_the_camera() -> None:
    period = 10_000_000
    times = [0, 1, 2, 5, 6, 8, 9]  # in periods: triggers 3, 4 and 7 are missed; block 5 is lost on the link
    blocks = [block(n, ticks=1_000 + at * period) for n, at in zip((1, 2, 3, 4, 6, 7, 8), times, strict=True)]
    arrived = [replace(one, arrival_ns=10**9 + at * period) for one, at in zip(blocks, times, strict=True)]
    camera = Scripted.delivering(arrived, info=replace(INFO, ticks_per_s=1e9))
    with grabbing(camera, wanted=replace(WANTED, trigger="Line1")) as grabber:
        last = captured(grabber, camera)[-1].losses
    assert (last.triggers, last.link) == (3, 1) and adds_up(last)


def test_a_software_trigger_is_sent_at_the_rate_and_a_missed_one_is_counted() -> None:
    camera = Scripted(info=replace(INFO, id_bits=64))

    def answer(timeout_s: float) -> object:
        time.sleep(min(timeout_s, 0.002))
        if camera.triggered > len(seen) and camera.triggered != 4:
            seen.append(camera.triggered)
            return block(camera.triggered if camera.triggered < 4 else camera.triggered - 1)
        return None

    seen: list[int] = []
    camera.grab = answer  # type: ignore[method-assign, assignment]
    with grabbing(camera, wanted=replace(WANTED, trigger="software")) as grabber:
        for _ in range(5):
            following(grabber)
        assert grabber.losses is not None and grabber.losses.triggers == 1 and adds_up(grabber.losses)


@pytest.mark.parametrize("ticks", [None, 0], ids=["none", "always 0"])
def test_without_a_clock_stamps_are_arrivals_less_half_of_the_exposure(ticks: int | None) -> None:
    blocks = [replace(block(n, ticks=ticks), arrival_ns=n * 10_000_000) for n in range(1, 8)]
    info = replace(INFO, ticks_per_s=0.0 if ticks is None else 1e9, exposure_s=0.004)
    camera = Scripted.delivering(blocks, info=info)
    with grabbing(camera) as grabber:
        frames = captured(grabber, camera)
        notes = grabber.notes
    assert [frame.stamp_ns for frame in frames] == [n * 10_000_000 - 2_000_000 for n in range(1, 8)]
    assert [frame.clock for frame in frames[1:]] == [None] * 6
    assert ("stands still" in " ".join(notes)) == (ticks == 0)


def test_stamps_follow_the_clock_of_the_camera_whatever_its_unit_and_survive_a_restart_of_it() -> None:
    rng = np.random.default_rng(3)

    def blocks(first_ns: int, started: int) -> Iterable[Step]:
        for n in range(600):
            at_ns = first_ns + n * 10_000_000
            late_ns = int(rng.exponential(3e6))
            # The device is said to count in ns, and counts in units of 8 ns.
            yield replace(block(n + 1, ticks=started + n * 1_250_000), arrival_ns=at_ns + late_ns)

    info = replace(INFO, ticks_per_s=1e9)
    first = Scripted.delivering([*blocks(10**9, 77_000_000_000), GONE], info=info)
    back = Scripted.delivering(blocks(9 * 10**9, 5), info=info)
    with grabbing(first, back, length=2000) as grabber:
        frames = captured(grabber, back)
    stamps = np.array([frame.stamp_ns for frame in frames])
    assert len(frames) == 1200 and (np.diff(stamps) > 0).all()
    for settled in (slice(350, 600), slice(950, 1200)):
        assert np.abs(np.diff(stamps[settled]) - 10_000_000).max() < 200_000  # arrivals scatter by 3 ms
    clock = frames[-1].clock
    assert clock is not None and clock.unit == pytest.approx(8.0, rel=0.01) and clock.resets == 1


def test_the_end_is_prompt_even_if_a_call_of_the_driver_hangs() -> None:
    hangs, released, over = threading.Event(), threading.Event(), threading.Event()

    def hang() -> None:
        hangs.set()
        released.wait(HANG_S)
        over.set()

    with grabbing(Scripted.delivering([block(1), hang])) as grabber:
        following(grabber)
        assert hangs.wait(HANG_S)
    assert not over.is_set()
    released.set()


def test_an_error_when_it_is_opened_is_that_of_the_driver() -> None:
    camera = Scripted(info=RigError("no camera found"))
    with pytest.raises(RigError, match="no camera found"):
        grabbing(camera).__enter__()
    assert camera.closed.is_set()  # it may be connected already


def test_a_defect_of_a_driver_reaches_the_loop() -> None:
    with grabbing(Scripted.delivering([block(1), ValueError("defect")])) as grabber:
        following(grabber)
        with pytest.raises(ValueError, match="defect"):
            grabber.next(HANG_S)


def test_a_clock_that_stands_still_is_left_alone_after_every_connection() -> None:
    stamper, info = Stamper(), CameraInfo("m", "s", 8, 8, 8, 30.0, ticks_per_s=1e9)
    arrivals = iter(range(0, 10**10, 33_000_000))
    for _ in range(3):
        stamper.reset(info, 0.0, 0.0)
        assert not stamper.frozen
        stamps = [(stamper.take(77, arrival_ns), arrival_ns) for arrival_ns in (next(arrivals) for _ in range(6))]
        assert stamper.frozen, "the operator is told"
        assert all(stamp_ns == arrival_ns and fit is None for (stamp_ns, fit, _), arrival_ns in stamps[2:])
