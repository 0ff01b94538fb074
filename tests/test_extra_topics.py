"""Extra topics of a run: declared by other packages, recorded, replayed, compared, and read without the package."""

from __future__ import annotations

import itertools
import json
import math
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
import pytest
from rerun.chunk import RrdReader

from flowrec.core import Applied, Message, OperatorEvent, RigError, Source, Tick, Topic, UsageError, outside
from flowrec.core.declarations import Shape, Vector
from flowrec.exports import export, write_layouts
from flowrec.rigs import SimulatedRig, increasing_stamps
from flowrec.run import Streams
from flowrec.stages import RIGS, ExtraRow, Inputs, Pipeline, load_config, topics_of
from flowrec.stages.extra_topics import TOPIC_ROWS
from flowrec.store import Session
from flowrec.verbs import replay_session
from flowrec.verbs.check import check
from flowrec.verbs.compare import compare
from flowrec.verbs.record import record
from flowrec.verbs.replay_segments import verify
from flowrec.view import plot_of
from flowrec.view.foxglove_layout import foxglove_layout
from tests.conftest import made_once
from tests.rewritten import rewrite
from tests.short_missions import SMALL
from tests.view.test_rrd import File


@dataclass(frozen=True, slots=True, eq=False)
class Pressure(Message):
    """Pressure of the pump."""

    stamp_ns: int
    pressure_pa: Annotated[float, "gauge pressure"]
    flow_ul_s: Annotated[Vector, Shape("n"), "of each channel of the pump"] = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True, slots=True, eq=False)
class Mean(Message):
    """Mean pressure so far."""

    stamp_ns: int
    count: int
    pressure_pa: float


@dataclass(frozen=True, slots=True)
class LabPressure:
    """pressure of the pump, by the rig."""

    topic: ClassVar[Topic] = Topic("/pump/pressure", Source.RIG, type=Pressure)


@dataclass(frozen=True, slots=True)
class LabLeak:
    """what a simulator knows of the pump."""

    topic: ClassVar[Topic] = Topic("/pump/leak", Source.SIMULATOR, type=Pressure)


@dataclass(frozen=True, slots=True)
class LabMean:
    """mean pressure so far."""

    scale: float = 1.0
    topic: ClassVar[Topic] = Topic("/pump/mean", Source.STAGE, 1e-9, {"pressure_pa": 1e-9}, type=Mean)

    def step(self, last: Tick, tick: Tick) -> Mean | None:
        pressure: Any = tick.extra.get("/pump/pressure")
        mine: Any = last.extra.get(self.topic.path)
        assert isinstance(pressure, Pressure | None) and isinstance(mine, Mean | None), "also in a replay"
        assert "/pump/leak" not in {**last.extra, **tick.extra}, "no stage sees what only a simulator knows"
        if pressure is None or pressure is last.extra.get("/pump/pressure"):
            return mine  # type: ignore[no-any-return]
        count, before = (0, 0.0) if mine is None else (mine.count, mine.pressure_pa)
        mean = before + (self.scale * pressure.pressure_pa - before) / (count + 1)
        return Mean(tick.stamp_ns, count + 1, mean)


class LabRig:
    """the simulated one with a pump."""

    @classmethod
    def of(cls, pipeline: Pipeline, config: Any, duration_s: float | None, realtime: bool) -> Any:
        rig = SimulatedRig.of(pipeline, config, duration_s, realtime)
        frames = rig.inputs

        def inputs() -> Iterator[Inputs]:
            for number, arrived in enumerate(frames()):
                extra: dict[str, Message] = {}
                if number % 7 == 3:
                    value = math.sin(0.1 * number)
                    extra["/pump/pressure"] = Pressure(arrived.stamp_ns, 1e4 + value, np.array([value] * (number % 3)))
                    extra["/pump/leak"] = Pressure(arrived.stamp_ns, value)
                yield replace(arrived, extra=extra) if extra else arrived

        rig.inputs = inputs  # type: ignore[method-assign]
        return rig


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[bool], None]]:
    """Installs the package of this file, or removes it."""
    rows = {"flowrec.topics": {"lab_pressure": "LabPressure", "lab_mean": "LabMean", "lab_leak": "LabLeak"}}
    rows["flowrec.rigs"] = {"lab_pump": "LabRig"}
    there = True

    def install(now: bool) -> None:
        nonlocal there
        there = now
        for table in (TOPIC_ROWS, RIGS):
            table._others.clear()

    def entry_points_of(group: str) -> dict[str, tuple[outside.Outside, ...]]:
        names = rows.get(group, {}) if there else {}
        return {name: (outside.Outside(name, f"{__name__}:{kind}", "kit", "2"),) for name, kind in names.items()}

    for where in ("core.outside", "core.methods"):
        monkeypatch.setattr(f"flowrec.{where}.entry_points_of", entry_points_of)
    monkeypatch.setattr("flowrec.core.entry_points_of", entry_points_of)
    yield install
    for table in (TOPIC_ROWS, RIGS):
        table._others.clear()


STATED = ["robot.radius_um=50", "robot.max_speed_um_s=600", "robot.step_out_hz=28", "robot.delay_s=0.04"]
STATED += ["camera.rate_hz=20", "camera.um_per_px=20", "stabilise.on=false", "mission.phases=plan,navigate"]
MISSION = ["rig=lab_pump", "duration_s=2", 'topics=["lab_pressure", "lab_mean", "lab_leak"]', *STATED]
MISSION += [text for text in SMALL if not text.startswith("simulated.")]


@pytest.fixture
def flown(installed: Callable[[bool], None], tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = made_once(tmp_path_factory, "extra", lambda to: record(load_config(None, MISSION), to / "a.mcap").path)
    return Path(shutil.copy(made, tmp_path))


def test_a_mission_with_extra_inputs_and_an_extra_stage_is_replayed_exactly_and_read_without_the_package(
    installed: Callable[[bool], None], flown: Path, tmp_path: Path
) -> None:
    with Session(flown) as session:
        pressures = session.table("/pump/pressure")["pressure_pa"].to_numpy()
        means = list(session.messages("/pump/mean"))
        assert len(pressures) == len(means) == session.topics["/pump/leak"] == 6
        assert np.allclose([each.pressure_pa for each in means], np.cumsum(pressures) / np.arange(1, 7))
        assert "outside.lab_mean" in session.provenance
        assert session.at(1.0, with_frames=False).extra["/pump/pressure"].stamp_ns == 850_000_000, "held"
    for done in (verify(flown), replay_session(flown, verify=True, from_s=1.0)):
        assert done.identical
        assert done.comparison.topics["/pump/mean"].identical == (6 if done.covered.part == "" else 3)
    again = tmp_path / "again.mcap"
    replay_session(flown, out=again)
    assert compare(flown, again, only=["/pump/*"]).identical
    installed(False)
    verdict = check(flown)
    assert verdict.word == "good" and verdict.topics["/pump/mean"] == 6
    assert "its stages need the packages kit 2" in verdict.facts["replay"]
    with Session(flown) as session:
        assert session.config.topics == ("lab_pressure", "lab_mean", "lab_leak")
        assert session.table("/pump/pressure")["flow_ul_s"].to_pylist()[1] == pytest.approx([math.sin(1.0)])
    assert compare(flown, again, only=["/pump/*"]).identical
    with pytest.raises(UsageError, match=r"topics = lab_mean is of the package kit 2, .*pip install kit==2"):
        replay_session(flown, verify=True)


def test_an_input_of_a_package_that_is_not_installed_is_replayed_as_it_was_recorded(
    installed: Callable[[bool], None], tmp_path: Path
) -> None:
    mission = [text.replace('"lab_mean", ', "") for text in MISSION]
    flown = record(load_config(None, mission), tmp_path / "a.mcap").path
    installed(False)
    again = tmp_path / "again.mcap"
    assert replay_session(flown, out=again).identical
    assert compare(flown, again, only=["/pump/*"]).identical
    assert "need" not in check(flown).facts["replay"]


AGAIN = pytest.mark.slow("edits, checks, compares and verifies a session again")


@pytest.mark.parametrize(
    "path", ["/pump/mean", *(pytest.param(each, marks=AGAIN) for each in ("/pump/pressure", "/pump/leak"))]
)
def test_a_change_in_an_extra_topic_is_found_by_check_compare_and_where_it_is_computed_by_verify(
    flown: Path, tmp_path: Path, path: str
) -> None:
    def edit(channel: Any, message: Any, wire: Any) -> bool:
        if channel.topic != path or message.log_time != first[path]:
            return False
        wire.pressure_pa += 1.0
        return True

    first: dict[str, int] = {}
    with Session(flown) as session:
        start_ns = session.header.start_unix_ns
        first[path] = start_ns + next(iter(session.messages(path))).stamp_ns
    edited, signed = tmp_path / "edited.mcap", tmp_path / "signed.mcap"
    assert rewrite(flown, edited, edit) == rewrite(flown, signed, edit, redigest=True) == 1
    assert any(path in finding.text for finding in check(edited).findings)
    compared = compare(flown, signed, only=["/pump/*"])
    assert compared.first is not None and compared.first.topic == path and not compared.same
    assert compared.comparison.topics[path].different == 1
    if path != "/pump/leak":  # the truth of a simulator: nothing is computed from it
        assert not replay_session(signed, verify=True).same


def test_topics_that_can_not_be_recorded_together_are_refused_in_one_line(installed: Callable[[bool], None]) -> None:
    with pytest.raises(UsageError, match=r"lab_pressure$"):
        load_config(None, ['topics=["lab_pressur"]'])
    config = load_config(None, ['topics=["lab_pressure", "lab_pressure"]'])
    with pytest.raises(UsageError, match="/pump/pressure: "):
        topics_of(config)


def test_a_stage_that_returns_another_message_and_a_rig_with_an_undeclared_one_are_refused(
    installed: Callable[[bool], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mission = [text.replace('"lab_leak"', "") for text in MISSION]
    with pytest.raises(RigError, match="/pump/leak: "):
        record(load_config(None, mission), tmp_path / "a.mcap")
    monkeypatch.setattr(LabMean, "step", lambda _self, _last, tick: Pressure(tick.stamp_ns, 1.0))
    with pytest.raises(UsageError, match=r"/pump/mean: .* Pressure.* Mean"):
        record(load_config(None, MISSION), tmp_path / "b.mcap")


def test_a_stage_with_a_hidden_state_is_found_by_a_replay_from_the_middle(
    flown: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    count = itertools.count()

    def step(_self: LabMean, last: Tick, tick: Tick) -> Mean | None:
        pressure: Any = tick.extra.get("/pump/pressure")
        return None if pressure is None else Mean(tick.stamp_ns, next(count), pressure.pressure_pa)

    monkeypatch.setattr(LabMean, "step", step)
    assert not replay_session(flown, verify=True, from_s=1.0).same


def test_a_stream_is_read_beside_the_loop_and_one_that_fails_is_told(tmp_path: Path) -> None:
    told: list[str] = []
    gate, taken = threading.Event(), []

    class Pump:
        def stream(self) -> Iterator[Message]:
            yield Pressure(0, 1.0)
            yield Pressure(0, 2.0)
            gate.wait(10.0)
            raise OSError("unplugged")

    class Stuck:
        def stream(self) -> Iterator[Message]:
            stop.wait(30.0)
            yield Pressure(0, 1.0)

    stop = threading.Event()
    stuck = replace(LabPressure.topic, path="/pump/stuck")
    rows = [ExtraRow(LabPressure.topic, Pump()), ExtraRow(stuck, Stuck()), ExtraRow(LabMean.topic, LabMean())]
    nothing = Applied(1, 0.0, 0.0, 0.0, np.zeros(3), np.zeros(2))
    with Streams(rows, told.append) as streams:
        deadline = time.monotonic() + 10.0
        while not taken and time.monotonic() < deadline:
            taken = [each.extra for each in streams.join(iter([Inputs(7, None, nothing)])) if each.extra]
        gate.set()
        while not told and time.monotonic() < deadline:
            time.sleep(0.001)
        stop.set()
    assert taken[0]["/pump/pressure"].stamp_ns == 7
    assert told == ["/pump/pressure: its stream has failed (OSError: unplugged); the run goes on without it"]


def test_messages_of_rejected_frames_come_with_the_next_one() -> None:
    def arrived(stamp_ns: int, **extra: Message) -> Inputs:
        applied = Applied(stamp_ns, 0.0, 0.0, 0.0, np.zeros(3), np.ones(2))
        return Inputs(stamp_ns, None, applied, extra={f"/{name}": message for name, message in extra.items()})

    one, two = Pressure(1, 1.0), Pressure(1, 2.0)
    frames = [arrived(5), arrived(4, a=one, b=one), arrived(6, b=two)]
    found = list(increasing_stamps(iter(frames), 0, lambda: None))
    assert found[1].extra == {"/a": one, "/b": two} and found[1].applied.turns.tolist() == [2.0, 2.0]


def test_viewers_show_the_numbers_of_extra_topics_over_time(
    installed: Callable[[bool], None], flown: Path, tmp_path: Path
) -> None:
    installed(False)
    layouts = write_layouts(flown, tmp_path)
    panels = json.loads(layouts.foxglove.read_text())["configById"]
    shown = {path["value"] for panel in panels.values() for path in panel.get("paths", ())}
    assert {"/pump/pressure.pressure_pa", "/pump/mean.pressure_pa", "/pump/leak.pressure_pa"} <= shown
    reader = RrdReader(layouts.rerun)
    bare = str([chunk.to_record_batch().to_pylist() for chunk in reader.stream(store=reader.blueprints()[0])])
    assert "flowrec.extra.pump.pressure.Pressure:message" in bare and "'.pressure_pa'" in bare
    found = File(export(flown, tmp_path / "a.rrd"))
    for name in ("pressure/pressure_pa", "pressure/flow_ul_s", "mean/pressure_pa"):
        assert found.views[f"/pump/{name}"] == [f"/extra/pump/{name}"] and found.rows[f"/extra/pump/{name}"]
    lines = found.columns["/extra/pump/pressure/flow_ul_s"]["Scalars:scalars"]
    assert [len(each) for each in lines] == [1, 2, 1, 2]  # type: ignore[arg-type]


def test_a_plot_of_an_extra_topic_has_a_line_for_each_float_and_each_element_of_a_vector() -> None:
    plot = plot_of(LabPressure.topic, Pressure(0, 1.0, np.ones(3)))
    assert plot is not None
    assert list(plot.lines) == ["pressure_pa", "flow_ul_s[0]", "flow_ul_s[1]", "flow_ul_s[2]"]
    assert plot_of(replace(LabPressure.topic, type=OperatorEvent), None) is not None
    layout = foxglove_layout((0.1, 0.2), 0.3, [plot])
    assert len({path["value"] for path in layout["configById"]["Plot!extra0"]["paths"]}) == 4
    assert "Plot!extra0" not in foxglove_layout((0.1, 0.2), 0.3)["configById"]
