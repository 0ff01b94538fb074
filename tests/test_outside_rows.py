"""Rows that other packages add to the tables: used, refused, recorded. The entry points name classes of this file."""

from __future__ import annotations

import pickle
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Annotated, Any, ClassVar

import numpy as np
import pytest

from flowrec.core import Estimate, FlowField, Range, RigError, Seed, Share, Track, UsageError, outside
from flowrec.physics import load_chip
from flowrec.rigs import Guardian, SimulatedRig, Wanted, probe_amplifier
from flowrec.rigs.lab.amplifiers.amplifier import AmplifierInfo
from flowrec.rigs.lab.cameras.grabber import Grabber
from flowrec.stages import (
    CONTROLLERS,
    OBSERVERS,
    PLANNERS,
    REFINERS,
    RIGS,
    Config,
    FieldCommand,
    Kalman,
    Observer,
    Pipeline,
    Tracker,
    config_from_toml,
    load_config,
    with_row,
    with_sets,
)
from flowrec.stages.control.tracking_laws import Reference, Situation, TrackingLaw, VectorLaw
from flowrec.stages.resolve import resolve
from flowrec.stages.vision.tracker import TRACKERS
from flowrec.store import Session
from flowrec.verbs import replay_session
from flowrec.verbs.record import record
from tests.conftest import HANG_S
from tests.outsider.pi_law import ProportionalIntegral  # noqa: F401 - named by an entry point
from tests.outsider.vendor_camera import AcmeCamera
from tests.short_missions import SMALL

ROOT = Path(__file__).parents[1]


def zero_of(file: str) -> Callable[[], str]:
    """The guardian's part of an amplifier: it writes into a file."""

    def zero() -> str:
        Path(file).write_text("0 A")
        return "the fuse is out"

    return zero


class LabAmplifier:
    """a file that says what is put out."""

    @dataclass(frozen=True, slots=True)
    class Settings:
        file: str = ""

    def __init__(self, file: Path) -> None:
        self.file = file

    @classmethod
    def of(cls, config: Any) -> LabAmplifier:
        return cls(Path(config.lab.fuse.file))

    def open(self) -> AmplifierInfo:
        return AmplifierInfo("Fuse", "1", 50.0, 48.0, 1e5, 0.001, 0.0)

    def guard(self) -> tuple[tuple[str, ...], tuple[int, ...]]:
        return ("call", f"{__name__}:zero_of", str(self.file)), ()

    def arm(self) -> None:
        self.file.unlink()

    def apply(self, _command: FieldCommand) -> None: ...

    def zero(self) -> None: ...

    def close(self) -> None: ...


@dataclass(frozen=True, slots=True)
class LabTracker:
    """a dark disc."""

    least_score: Share = 0.5

    def track(self, previous: Track | None, *scene: Any) -> Track:
        return Tracker(least_score=self.least_score).track(previous, *scene)


@dataclass(frozen=True, slots=True)
class LabObserver:
    """a Kalman filter by another name."""

    kalman: Kalman = field(default_factory=Kalman)

    def estimate(self, *given: Any) -> Estimate:
        return self.kalman.estimate(*given)


@dataclass(frozen=True, slots=True)
class LabRefiner:
    """the assumed flow times a factor."""

    factor: Annotated[float, Range(0.0, 10.0)] = 1.0

    def fit(self, problem: Any) -> FlowField:
        velocity = np.float32(self.factor) * problem.assumed.velocity_um_s
        return replace(problem.assumed, velocity_um_s=velocity, method="lab", note="times a factor")


@dataclass(frozen=True, slots=True)
class LabController(TrackingLaw):
    """towards the reference, without regard to the flow ahead."""

    per_s: Annotated[float, Range(0.0, 100.0)] = 3.0

    def velocity(self, now: Situation, reference: Reference) -> tuple[np.ndarray, bool]:
        return VectorLaw(self.per_s).velocity(now, reference)


@dataclass(frozen=True, slots=True)
class LabPlanner:
    """is never asked."""

    def plan(self, _problem: object) -> None: ...


class LabRig:
    """the simulated one by another name."""

    needs = ("realtime",)
    made: ClassVar[list[tuple[int, bool]]] = []

    @dataclass(frozen=True, slots=True)
    class Settings:
        seed: Seed = 1

    @classmethod
    def of(cls, pipeline: Pipeline, config: Any, duration_s: float | None, realtime: bool) -> SimulatedRig:
        cls.made.append((config.bench.seed, realtime))
        return SimulatedRig.of(pipeline, config, duration_s, realtime)


class NoPlanner:
    """has no verb."""


@dataclass
class Thawed:
    """is not frozen."""

    def plan(self, _problem: object) -> None: ...


@dataclass(frozen=True)
class Demanding:
    """has a setting without a default."""

    needed: int

    def plan(self, _problem: object) -> None: ...


@pytest.fixture
def entries(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, dict[str, str]]]:
    """Entry points by group and name: the class of this file that each names."""
    wanted: dict[str, dict[str, str]] = {}

    def entry(name: str, where: str, number: int) -> outside.Outside:
        return outside.Outside(name, f"{__name__}:{where}", f"kit{number}", "2")

    def entry_points_of(group: str) -> dict[str, tuple[outside.Outside, ...]]:
        return {
            name: tuple(entry(name, each, number) for number, each in enumerate(classes.split()))
            for name, classes in wanted.get(group, {}).items()
        }

    for where in ("outside", "methods"):
        monkeypatch.setattr(f"flowrec.core.{where}.entry_points_of", entry_points_of)
    monkeypatch.setattr("flowrec.core.entry_points_of", entry_points_of)
    yield wanted
    for table in (PLANNERS, OBSERVERS, TRACKERS, REFINERS, CONTROLLERS, RIGS):
        table._others.clear()


@pytest.mark.parametrize(
    ("name", "classes", "said"),
    [
        ("thin", "NoPlanner", "no class with the method plan"),
        ("thin", "Thawed", "no frozen dataclass"),
        ("thin", "Demanding", "must all have defaults"),
        ("thin-one", "LabObserver", "no class with the method plan"),
        ("thin", "Absent", "has no attribute 'Absent'"),
        ("thin", "Thawed Demanding", "declared by kit0 2 and by kit1 2"),
    ],
)
def test_an_entry_point_that_is_no_row_is_refused_in_a_line_that_names_its_package(
    entries: dict[str, dict[str, str]], name: str, classes: str, said: str
) -> None:
    entries["flowrec.planners"] = {name: classes}
    with pytest.raises(UsageError, match=r"kit0 2") as refused:
        load_config(None, [f"plan.method={name}"])
    assert said in str(refused.value) and "\n" not in str(refused.value)
    assert any(said in row.fault for row in PLANNERS.list_rows())
    assert load_config(None, ["plan.method=astar_time"]).plan.method == "astar_time"


def test_a_stage_that_was_made_without_the_settings_of_its_package_says_so(entries: dict[str, dict[str, str]]) -> None:
    entries["flowrec.observers"] = {"lab": "LabObserver"}
    with pytest.raises(UsageError, match="kit0 2"):
        Observer("lab").estimate(None, *[None] * 3)  # type: ignore[arg-type]


def test_benches_have_the_rows_of_packages_that_can_be_used(entries: dict[str, dict[str, str]]) -> None:
    entries["flowrec.observers"] = {"lab": "LabObserver", "thin": "Absent", "kalman": "LabObserver"}
    names = OBSERVERS.usable()
    assert sorted(names) == sorted([*OBSERVERS, "lab"]) and "thin" in OBSERVERS.names()
    made = {name: with_row(Observer(kalman=Kalman(agility=0.7)), OBSERVERS, name) for name in names}
    assert all(stage.method == name and stage.kalman.agility == 0.7 for name, stage in made.items())
    assert made["lab"].lab == LabObserver() and not hasattr(made["kalman"], "lab")
    assert OBSERVERS["lab"].build(made["lab"]) is made["lab"].lab
    with pytest.raises(UsageError, match="'Absent'"):
        with_row(Observer(), OBSERVERS, "thin")


def test_a_name_of_ours_can_not_be_taken(entries: dict[str, dict[str, str]]) -> None:
    entries["flowrec.planners"] = {"astar_time": "LabPlanner", "swift": "LabPlanner"}
    assert PLANNERS["astar_time"].source is None
    assert ["is taken by flowrec" in row.fault for row in PLANNERS.list_rows() if row.name == "astar_time"] == [
        False,
        True,
    ]
    with pytest.raises(UsageError, match=r"kit0 2, and the section plan\.swift of its settings is taken"):
        load_config(None, ["plan.method=swift"])


@pytest.mark.slow("flies a mission and replays it")
def test_a_controller_of_a_lab_with_an_integral_arrives_and_replays_exactly_from_the_middle(
    entries: dict[str, dict[str, str]], tmp_path: Path
) -> None:
    """Where the integral is kept in a message: without it the demands after a restart would be others."""
    entries["flowrec.controllers"] = {"pi": "ProportionalIntegral"}
    recorded = record(load_config(None, [*SMALL, "control.method=pi", "control.pi.ki_per_s2=4"]), tmp_path / "a.mcap")
    assert recorded.facts["outcome"] == "reached"
    assert recorded.facts["contacts"] == 0
    assert replay_session(recorded.path, from_s=5.0, verify=True).identical


class _Acme(ModuleType):
    """A vendor's package with one camera, whose images and faults are listed."""

    class AcmeError(Exception):
        pass

    class NoImage(AcmeError):  # noqa: N818 - as vendors name them
        pass

    model, serial, overruns, rate_hz, exposure_us = "A1", "7", 0, 50.0, 4000.0
    region = (8, 6)

    def __init__(self, steps: list[Any]) -> None:
        super().__init__("acme_sdk")
        self.steps, self.begun = steps, 0
        self.memory = np.zeros((6, 8), np.uint8)  # of which each image is a view

    def connect(self, device: str | None, buffers: int) -> _Acme:
        assert (device, buffers) == (None, 4)
        return self

    def start(self) -> None:
        self.begun += 1

    def next_image(self, timeout_ms: float) -> Any:
        step = self.steps.pop(0) if self.steps else None
        if step is None:
            time.sleep(1e-3 * timeout_ms)
            raise self.NoImage
        if isinstance(step, Exception):
            raise step
        self.memory[:] = step
        return SimpleNamespace(pixels=self.memory, number=step, stamp_us=20_000 * step, damaged=step == 5)

    def ping(self) -> bool:
        return True

    def stop(self) -> None:
        pass


def test_a_camera_by_the_package_of_its_vendor_is_counted_and_opened_again_like_ours(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    acme = _Acme([1, 2, 4, 5, 6, _Acme.AcmeError("unplugged"), 7, 8])
    monkeypatch.setitem(sys.modules, "acme_sdk", acme)
    wanted = Wanted(width_px=8, height_px=6, rate_hz=50.0, settings=AcmeCamera.Settings(buffers=4))
    with Grabber(lambda: AcmeCamera.of(wanted), wanted, 100) as grabber:
        frames = [grabber.next(HANG_S) for _ in range(6)]
        assert grabber.info.name == "A1 7"
    assert [int(frame.image[0, 0]) for frame in frames if frame] == [1, 2, 4, 6, 7, 8], "copies, none of a damaged one"
    losses = frames[-1].losses
    assert (losses.link, losses.incomplete, losses.reconnections, acme.begun) == (1, 1, 1, 2)
    assert frames[1].clock is not None, "stamps are by the camera's clock"
    with pytest.raises(RigError, match="trigger"):
        AcmeCamera.of(replace(wanted, trigger="Line1")).open()


@pytest.mark.slow("flies a mission and replays it")
def test_a_mission_whose_stages_are_all_of_packages_arrives_and_replays_exactly(
    entries: dict[str, dict[str, str]], tmp_path: Path
) -> None:
    stages = {"tracker": "LabTracker", "observer": "LabObserver", "refine": "LabRefiner", "control": "LabController"}
    groups = ("flowrec.trackers", "flowrec.observers", "flowrec.refiners", "flowrec.controllers")
    entries |= {group: {"lab": name} for group, name in zip(groups, stages.values(), strict=True)}
    chosen = [f"{section}.method=lab" for section in stages]
    config = load_config(None, [*SMALL, *chosen, "observer.lab.kalman.agility=1.5", "refine.lab.factor=1.02"])
    assert pickle.loads(pickle.dumps(config)) == config, "the process of the worker gets its stages"
    recorded = record(config, tmp_path / "a.mcap")
    assert recorded.facts["outcome"] == "reached"
    with Session(recorded.path) as session:
        assert session.fields["refined"].method == "lab"
        assert {key for key in session.provenance if key.startswith(outside.FACT)} == {
            f"outside.{section}.lab" for section in stages
        }
    assert replay_session(recorded.path, verify=True).identical
    assert replay_session(recorded.path, from_s=5.0, verify=True).identical, "a restart in the middle"


def test_a_rig_of_a_package_is_in_real_time_if_it_says_so_and_its_recording_replays_without_it(
    entries: dict[str, dict[str, str]], tmp_path: Path
) -> None:
    entries["flowrec.rigs"] = {"bench": "LabRig"}
    stated = ["robot.radius_um=50", "robot.max_speed_um_s=600", "robot.step_out_hz=28", "robot.delay_s=0.04"]
    stated += ["camera.rate_hz=20", "camera.um_per_px=20", "stabilise.on=false", "mission.phases=plan,navigate"]
    small = [text for text in SMALL if not text.startswith("simulated.")]
    config = load_config(None, ["rig=bench", "bench.seed=5", "duration_s=1", *small, *stated])
    recorded = record(config, tmp_path / "a.mcap")
    assert Session(recorded.path).setting("bench", "seed") == 5
    assert LabRig.made == [(5, True)]
    entries.clear()
    RIGS._others.clear()
    assert replay_session(recorded.path, verify=True).same


@pytest.mark.slow("starts a guardian for an amplifier of a package")
def test_an_amplifier_of_a_package_is_opened_and_its_guardian_takes_the_output_to_zero(
    entries: dict[str, dict[str, str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "path", [*sys.path, str(ROOT)])  # the guardian's process imports this file,
    monkeypatch.chdir(tmp_path)  # and nothing from the working directory
    told = tmp_path / "told"
    entries["flowrec.amplifiers"] = {"fuse": "LabAmplifier"}
    stated = ["robot.radius_um=50", "robot.max_speed_um_s=600", "robot.step_out_hz=28", "robot.delay_s=0.04"]
    stated += ["camera.rate_hz=20", "camera.um_per_px=20", "rig=lab", "lab.amplifier=fuse", f"lab.fuse.file={told}"]
    config = load_config(None, stated)
    seen = probe_amplifier(resolve(config, load_chip(config.chip)))
    assert seen.info.model == "Fuse"
    assert told.read_text() == "0 A"
    with Guardian(("call", f"{__name__}:zero_of", str(told))) as guardian:
        assert guardian.trip()
        with pytest.raises(RigError, match="asked to; the fuse is out"):
            guardian.beat(energised=True)


def test_a_configuration_without_other_packages_is_of_our_class_and_reads_no_entry_point(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def never(_group: str) -> None:
        raise AssertionError("entry points are read")

    monkeypatch.setattr("flowrec.core.outside.entry_points_of", never)
    monkeypatch.setattr("flowrec.core.methods.entry_points_of", never)
    config = with_sets(load_config(None, SMALL), ["plan.method=astar_time"])
    assert type(config) is Config
    with Session(ROOT / "sessions" / "golden.mcap") as session:
        assert config_from_toml(session.header.config_toml, "golden") == session.config
