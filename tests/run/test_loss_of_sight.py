"""What comes from a camera is checked on arrival; a robot that is out of sight is held, then the field goes off."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flowrec.core import Applied, Currents, Event, Frame, RigError
from flowrec.rigs import SimulatedRig, checked_images
from flowrec.stages import Inputs, load_config
from flowrec.store import SessionReader
from flowrec.verbs import session_replay as replay
from flowrec.verbs.record import record
from flowrec.verbs.run_summary import Recorded
from tests.short_missions import SMALL

AT_S = 1.2  # a moment while it navigates
FRAME_S = 1 / 30
Fault = Callable[[Inputs, Inputs], Inputs]  # of what arrives now and what arrived last before the fault


class FaultyCamera(SimulatedRig):
    """A simulated rig whose camera fails for a while. `log` is what the coils were told: (stamp in s, mT)."""

    def spoil(self, fault: Fault, from_s: float, until_s: float) -> None:
        self.fault, self.span_s, self.log = fault, (from_s, until_s), list[tuple[float, float]]()

    def inputs(self) -> Iterator[Inputs]:
        good: Inputs | None = None
        for arrived in super().inputs():
            if good is not None and self.span_s[0] <= arrived.stamp_ns / 1e9 < self.span_s[1]:
                yield self.fault(arrived, good)
            else:
                good = arrived
                yield arrived

    def apply(self, currents: Currents) -> None:
        super().apply(currents)
        self.log.append((currents.stamp_ns / 1e9, currents.amplitude_mt))

    def zero(self) -> None:
        super().zero()
        self.log.append((math.inf, 0.0))


def frozen(now: Inputs, before: Inputs) -> Inputs:
    assert now.frame is not None and before.frame is not None
    return replace(now, frame=replace(now.frame, image=before.frame.image.copy()))


def empty(now: Inputs, _before: Inputs) -> Inputs:
    """A dark, noisy image: no robot is in it, and no image is like another."""
    assert now.frame is not None
    noise = np.random.default_rng(now.frame.index).integers(0, 4, now.frame.image.shape, dtype=np.uint8)
    return replace(now, frame=replace(now.frame, image=noise))


def as_inputs(*images: np.ndarray) -> Iterator[Inputs]:
    for stamp, each in enumerate(images):
        applied = Applied(stamp, 0.0, 0.0, 0.0, np.zeros(3), np.zeros(2))
        yield Inputs(stamp, Frame(stamp, stamp, each), applied)


def test_an_image_with_one_pixel_changed_is_a_new_one() -> None:
    image = np.full((64, 48), 9, np.uint8)
    changed = image.copy()
    changed[13, 5] += 1
    arriving = as_inputs(image, image.copy(), changed, changed.copy())
    assert [each.applied.image_since_ns for each in checked_images(arriving, (64, 48))] == [0, 0, 2, 2]


@pytest.mark.parametrize("shape", [(64, 49), (48, 64)])
def test_an_image_of_another_size_or_turned_is_refused(shape: tuple[int, int]) -> None:
    with pytest.raises(RigError, match=f"{shape[1]} x {shape[0]} pixels, .* = 48 x 64 "):
        list(checked_images(as_inputs(np.zeros(shape, np.uint8)), (64, 48)))


def wrong_image(image: np.ndarray) -> Fault:
    return lambda now, _before: replace(now, frame=Frame(now.stamp_ns, 0, image))


def flown(
    monkeypatch: pytest.MonkeyPatch, path: Path, fault: Fault, until_s: float = 1e9, sets: tuple[str, ...] = ()
) -> tuple[Recorded | RigError, list[tuple[float, float]]]:
    """A mission with a faulty camera, or how it failed, and the log of its coils."""
    rigs: list[FaultyCamera] = []

    class Made:
        @staticmethod
        def of(*args: object) -> SimulatedRig:
            rig = FaultyCamera.of(*args)  # type: ignore[arg-type]
            assert isinstance(rig, FaultyCamera)
            rig.spoil(fault, AT_S, until_s)
            rigs.append(rig)
            return rig

    monkeypatch.setattr("flowrec.rigs.simulated.rig.SimulatedRig", Made)
    try:
        sets = ("mission.phases=navigate", "duration_s=13", *sets)
        done: Recorded | RigError = record(load_config(None, [*SMALL, *sets]), path)
    except RigError as error:
        done = error
    return done, rigs[0].log


def alarms(path: Path) -> list[Event]:
    return [event for event in SessionReader(path).messages("event") if event.level != "info"]  # type: ignore[attr-defined]


def off_from(log: list[tuple[float, float]]) -> float:
    """When the field went off for good."""
    return next(stamp for stamp, amplitude in reversed(log) if amplitude > 0.0)


@pytest.mark.parametrize(
    ("fault", "cause"), [(frozen, "the camera repeats one image since"), (empty, "robot not seen since")]
)
def test_out_of_sight_the_robot_is_held_then_the_field_goes_off_and_an_alarm_names_the_cause(
    fault: Fault, cause: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done, log = flown(monkeypatch, tmp_path / "s.mcap", fault)
    assert isinstance(done, Recorded)
    assert off_from(log) - AT_S < 1.4 + 0.1
    assert max(amplitude for stamp, amplitude in log if stamp > AT_S + 1.4) == 0.0
    told = [(event.stamp_ns / 1e9 - AT_S, event.level, event.text) for event in alarms(tmp_path / "s.mcap")]
    held, off, lost = [each for each in told if cause in each[2]]
    demands = [
        tick.demand
        for tick in SessionReader(tmp_path / "s.mcap").ticks(with_frames=False)
        if tick.demand is not None and held[0] <= tick.stamp_ns / 1e9 - AT_S < off[0]
    ]
    assert len(demands) > 20
    assert len({demand.progress_s for demand in demands}) == 1  # the route is not followed any more
    assert len({tuple(demand.reference_um) for demand in demands}) == 1
    assert 0.45 < held[0] < 0.55 and held[1] == "warning" and "held" in held[2]
    assert 1.35 < off[0] < 1.45 and off[1] == "error" and "field off" in off[2]
    assert done.report.outcome == "lost" and cause in done.report.note and "mission: lost" in lost[2]


@pytest.mark.slow("flies a mission with a fault and replays it four times")
def test_in_sight_again_the_robot_goes_on_and_the_session_replays_from_every_part_of_the_fault(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sets = ("recording.region=robot",)  # what is in such a file does not tell whether an image is new
    done, log = flown(monkeypatch, tmp_path / "s.mcap", frozen, until_s=AT_S + 2.0, sets=sets)
    assert isinstance(done, Recorded) and done.report.outcome == "reached"
    texts = [event.text for event in SessionReader(tmp_path / "s.mcap").messages("event")]  # type: ignore[attr-defined]
    assert any("in sight again" in text for text in texts)
    assert max(amplitude for stamp, amplitude in log if stamp > AT_S + 2.0) == 4.0
    for from_s in (AT_S + 0.3, AT_S + 1.0, AT_S + 1.8, AT_S + 2.5):
        replayed = replay.replay_session(tmp_path / "s.mcap", replay.Change(), from_s=from_s, verify=True)
        assert replayed.comparison.identical, str(replayed.comparison.first)


@pytest.mark.slow("flies two missions")
def test_a_repeated_image_is_no_measurement_of_the_flow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flown(monkeypatch, tmp_path / "s.mcap", frozen, until_s=AT_S + 0.4)
    ticks = [tick for tick in SessionReader(tmp_path / "s.mcap").ticks(with_frames=False) if tick.estimate is not None]
    before, after = (next(tick for tick in ticks if tick.stamp_ns / 1e9 > AT_S + later_s) for later_s in (-0.1, 0.35))
    assert before.estimate is not None and after.estimate is not None and after.truth is not None
    off_um_s = np.linalg.norm(after.estimate.flow_um_s - after.truth.flow_um_s)
    assert off_um_s < 0.35 * np.linalg.norm(after.truth.flow_um_s)
    assert not after.estimate.seen


@pytest.mark.parametrize(
    ("image", "told"),
    [
        (np.full((256, 320), 300, np.uint16), "uint16"),
        (np.zeros((257, 320), np.uint8), "320 x 257 pixels, where camera.width_px x camera.height_px = 320 x 256"),
    ],
    ids=["16 bit", "one row more"],
)
def test_an_image_that_can_not_be_kept_as_it_is_ends_the_run_in_one_line_with_the_coils_off(
    image: np.ndarray, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    failed, log = flown(monkeypatch, tmp_path / "s.mcap", wrong_image(image))
    assert isinstance(failed, RigError), "the image was taken"
    assert told in str(failed) and "\n" not in str(failed)
    assert any(amplitude > 0.0 for _, amplitude in log) and log[-1][1] == 0.0
    reader = SessionReader(tmp_path / "s.mcap")
    assert reader.outcome["outcome"] == "failed" and told in reader.outcome["reason"]
    assert abs(reader.last_ns / 1e9 - (AT_S - FRAME_S)) < FRAME_S


@pytest.mark.parametrize("dtype", [np.uint16, np.int64, np.float64, np.bool_])
def test_a_frame_casts_nothing(dtype: type) -> None:
    with pytest.raises(RigError, match=f"frame 7: an image of {np.dtype(dtype)}"):
        Frame(5, 7, np.ones((4, 4), dtype))
    with pytest.raises(RigError, match="4 x 4 x 3"):
        Frame(5, 7, np.ones((4, 4, 3), np.uint8))
    turned = np.arange(12, dtype=np.uint8).reshape(3, 4).T
    assert np.array_equal(Frame(5, 7, turned).image, turned)
