"""The operator: held robots stay, go on and arrive; the field is gone on the tick that is told so; replays agree."""

from __future__ import annotations

import math
import os
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from flowrec.core import Action, OperatorEvent, SessionError, Tick, seconds
from flowrec.run import DiskMonitor, RunControl, refuse_below
from flowrec.run.keyboard import Keyboard
from flowrec.stages import load_config
from flowrec.store import SessionReader
from flowrec.verbs import record as verb
from flowrec.verbs import session_replay as again
from flowrec.verbs.auto_recovery import leftovers, recover_leftovers
from flowrec.verbs.interactive import Unattended
from tests.conftest import HANG_S
from tests.short_missions import SMALL


class Scripted(RunControl):
    """An operator who does things at certain times of the session."""

    def __init__(self, script: tuple[tuple[float, str, str], ...]) -> None:
        super().__init__()
        self.left = list(script)

    def next_event(self, stamp_ns: int, held: bool) -> OperatorEvent | None:
        while self.left and seconds(stamp_ns) >= self.left[0][0]:
            _, action, text = self.left.pop(0)
            if action == "zero":
                self.stop(text, zero=True)
            elif action == "hold":
                self.toggle_hold()
            else:
                self.request(Action(action), text)
        return super().next_event(stamp_ns, held)


def flown(path: Path, *script: tuple[float, str, str], sets: tuple[str, ...] = ()):  # type: ignore[no-untyped-def]
    """A mission with one survey of known duration, so that the script meets the phases that it is meant for."""
    asked = load_config(None, [*SMALL, "survey.method=downstream", *sets])
    recorded = verb.record(asked, path, control=Unattended(Scripted(script)))
    return recorded, list(SessionReader(path).ticks(with_frames=False))


def said(ticks: list[Tick]) -> list[tuple[str, str]]:
    events = [tick.operator for tick in ticks if tick.operator is not None]
    return [(event.action, event.text) for k, event in enumerate(events) if k == 0 or event is not events[k - 1]]


@pytest.mark.slow("flies a mission with an operator and replays it")
def test_a_held_robot_stays_goes_on_and_arrives_and_a_replay_is_identical(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = ((0.2, "hold", ""), (0.4, "hold", ""), (1.7, "hold", ""), (1.7, "mark", "1"), (1.7, "note", "look"))
    script += ((3.2, "hold", ""), (7.0, "hold", ""), (9.0, "hold", ""))
    recorded, ticks = flown(tmp_path / "held.mcap", *script)
    assert recorded.report.outcome == "reached"
    assert recorded.report.contacts == 0
    # What was asked in one frame comes one by one, in order, each on a tick of its own.
    assert said(ticks) == [
        ("pause", ""),
        ("resume", ""),
        ("pause", ""),
        ("mark", "1"),
        ("note", "look"),
        ("resume", ""),
        ("pause", ""),
        ("resume", ""),
    ]
    stamps = [tick.stamp_ns for k, tick in enumerate(ticks) if k and tick.operator is not ticks[k - 1].operator]
    assert len(stamps) == len(set(stamps))
    holds: dict[int, list[Tick]] = {}
    phases = set()
    for tick in ticks:
        mission = tick.mission
        if mission is not None and mission.held_since_ns is not None:
            holds.setdefault(mission.held_since_ns, []).append(tick)
            phases.add(mission.phase)
    assert len(holds) == 3
    assert {"survey", "navigate"} <= phases
    radius_um = 50.0
    for held in list(holds.values())[1:]:
        settled = [tick for tick in held if seconds(tick.stamp_ns - held[0].stamp_ns) > 0.4]
        at_um = np.array([tick.truth.position_um for tick in settled])  # type: ignore[union-attr]
        assert len(at_um) > 20
        assert np.hypot(*(at_um - at_um.mean(axis=0)).T).max() < 0.3 * radius_um
        progress = {tick.demand.progress_s for tick in held}  # type: ignore[union-attr]
        assert len(progress) == 1
        assert progress.pop() > 0.0
    events = " ".join(tick.event.text for tick in ticks if tick.event is not None)
    for words in ("held by the operator", "goes on after", "operator: mark: 1", "operator: note: look"):
        assert words in events
    done = again.replay_session(recorded.path, again.Change(), verify=True)
    assert done.same
    assert done.comparison.identical, str(done.comparison.first)
    middle = again.replay_session(recorded.path, again.Change(), from_s=2.5)  # under the second hold
    assert middle.comparison.identical, str(middle.comparison.first)


def test_zero_takes_the_field_away_on_that_very_tick_and_a_replay_agrees(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded, ticks = flown(tmp_path / "zero.mcap", (2.0, "mark", "1"), (2.0, "zero", "enough"))
    assert (recorded.report.outcome, recorded.report.note) == ("stopped", "enough")
    assert said(ticks) == [("zero", "enough"), ("mark", "1")]  # the field first, and nothing is forgotten
    before, at = next((a, b) for a, b in pairwise(ticks) if b.operator is not None)
    assert before.currents is not None
    assert before.currents.amplitude_mt > 0.0
    assert at.currents is not None
    assert at.currents.stamp_ns == at.operator.stamp_ns  # type: ignore[union-attr]
    assert at.currents.amplitude_mt == 0.0
    assert not at.currents.currents_a.any()
    assert not at.currents.voltages_v.any()
    done = again.replay_session(recorded.path, again.Change(), verify=True)
    assert done.comparison.identical, str(done.comparison.first)


@pytest.mark.slow("flies a mission in a flow that is faster than the robot")
def test_a_robot_that_the_flow_carries_off_its_place_is_told_of_and_does_its_best(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Down the fast branch of a flow that is half as fast again as the robot.
    sets = ("simulated.inlet_speed_error=0", "robot.max_speed_um_s=160", "mission.phases=navigate", "duration_s=14")
    _, ticks = flown(tmp_path / "swept.mcap", (6.0, "hold", ""), sets=sets)
    swept = [tick for tick in ticks if tick.mission is not None and tick.mission.swept]
    assert swept
    assert any(tick.event is not None and "carried off the place" in tick.event.text for tick in swept)
    for tick in swept[5:]:
        assert tick.demand is not None
        assert math.hypot(*tick.demand.velocity_um_s) > 100.0


@dataclass
class Asked:
    events: list[tuple[str, str]]

    @classmethod
    def by(cls, *typed: str) -> list[tuple[str, str]]:
        run_control = RunControl()
        board = Keyboard(run_control)
        for piece in typed:
            board.take(piece)
        events = []
        while run_control.pending:
            event = run_control.next_event(len(events), held=("pause", "") in events)
            assert event is not None
            events.append((event.action, event.text))
        return events


def test_keys_become_events_in_order_and_notes_are_typed_without_being_obeyed() -> None:
    assert Asked.by("m", " ", " m") == [("mark", "1"), ("pause", ""), ("resume", ""), ("mark", "2")]
    assert Asked.by("nq", "uiet! ", "\x7f?\r") == [("note", "quiet!?")]
    assert Asked.by("nwrong\x1bm") == [("mark", "1")]
    assert Asked.by("n\r", "n  \r") == []
    assert Asked.by("\x1b[A", "\x1bOP", "\x1b[15~", "x") == []
    assert Asked.by("nü\x1b[Dα\r") == [("note", "üα")]
    assert Asked.by("mq!")[0][0] == "zero"


def test_below_its_floor_the_disk_ends_the_run_once_and_says_how_long_it_will_last(tmp_path: Path) -> None:
    left, written, told = [5_000_000_000], [0], []
    clock = iter((0.0, 1.0, 2.0))
    watch = DiskMonitor(tmp_path, lambda: written[0], 1.0, told.append, lambda _folder: left[0], clock.__next__)
    assert not watch.sample()
    written[0] = 10_000_000
    assert not watch.sample()
    assert watch.text == "disk 5 GB left, 7 min"  # 4 GB until the floor, at 10 MB/s
    left[0] = 900_000_000
    assert watch.sample()
    assert told == [f"disk floor: 0.9 GB left on {tmp_path}"]
    with pytest.raises(SessionError, match="disk_floor_gb"):
        refuse_below(1.0, tmp_path, lambda _folder: 900_000_000)
    refuse_below(0.0, tmp_path, lambda _folder: 0)


def test_the_disk_has_a_text_also_while_it_is_measured_for_the_first_time(tmp_path: Path) -> None:
    texts: list[str] = []

    def written() -> int:  # as long as this takes, another thread may ask
        texts.append(watch.text)
        return 0

    watch = DiskMonitor(tmp_path, written, 0.0, texts.append, lambda _folder: 5_000_000_000)
    watch.sample()
    assert [*texts, watch.text] == ["disk ?", "disk 5 GB left"]


def test_a_disk_that_runs_low_ends_a_run_in_good_order_with_status_3(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    left, watches = [2_000_000_000], []

    class Low(DiskMonitor):
        """Looks when a tick comes, not once a second: the mission may be over by then."""

        def __init__(self, *words, **more) -> None:  # type: ignore[no-untyped-def]
            super().__init__(*words, **more, free=lambda _folder: left[0])
            watches.append(self)

    class Filling(RunControl):
        def next_event(self, stamp_ns: int, held: bool) -> OperatorEvent | None:
            if seconds(stamp_ns) >= 1.0 and left[0] > 900_000_000:
                left[0] = 900_000_000
                assert watches[0].sample()
            return super().next_event(stamp_ns, held)

    monkeypatch.setattr("flowrec.verbs.mission_run.DiskMonitor", Low)
    recorded = verb.record(
        load_config(None, [*SMALL, "camera.rate_hz=30"]), tmp_path / "low.mcap", control=Unattended(Filling())
    )
    assert recorded.report.outcome == "stopped"
    assert recorded.exit_status == 3
    assert "disk floor: 0.9 GB" in recorded.report.note
    reader = SessionReader(recorded.path)
    assert reader.outcome["note"] == recorded.report.note
    last = reader.tick_before(reader.last_ns, with_frames=False)
    assert last.currents is None or last.currents.amplitude_mt == 0.0


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A recovery has as long as a busy machine needs."""
    monkeypatch.setattr("flowrec.verbs.auto_recovery._TIMEOUT_S", HANG_S)


@pytest.mark.usefixtures("patient")
def test_what_a_killed_run_left_is_recovered_at_the_next_start_and_its_name_is_taken(
    session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    left = tmp_path / "left.mcap.partial"
    left.write_bytes(session.read_bytes()[: session.stat().st_size // 2])
    junk = tmp_path / "junk.mcap.partial"
    junk.write_bytes(b"no session at all")
    (tmp_path / "left.recovering.mcap.partial").write_bytes(b"an earlier recovery was killed as well")
    with pytest.raises(SessionError, match="recovered"):
        verb.record(load_config(None, SMALL), tmp_path / "left.mcap")
    whole = SessionReader(tmp_path / "left.mcap")
    assert whole.outcome["outcome"] == "cut"
    assert not left.exists()
    told = capsys.readouterr().err
    assert "recovered" in told
    assert "junk.mcap.partial" in told
    assert recover_leftovers(tmp_path) == {}  # nothing more to be done, and the junk keeps nobody from anything
    assert junk.exists()


@pytest.mark.slow("three processes")
@pytest.mark.usefixtures("patient")
def test_remains_are_looked_after_in_any_thread(session: Path, tmp_path: Path) -> None:
    (tmp_path / "left.mcap.partial").write_bytes(session.read_bytes()[: session.stat().st_size // 2])
    with ThreadPoolExecutor() as pool:
        assert list(pool.submit(recover_leftovers, tmp_path).result()) == [tmp_path / "left.mcap"]


def test_a_recovery_that_takes_too_long_is_given_up_and_leaves_nothing_behind(
    session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    left = tmp_path / "left.mcap.partial"
    left.write_bytes(session.read_bytes()[: session.stat().st_size // 2])
    left.with_name("left.recovering.mcap.partial").write_bytes(b"")  # of one that was ended a little later
    threads, files = set(threading.enumerate()), set(Path("/dev/fd").iterdir())
    monkeypatch.setattr("flowrec.verbs.auto_recovery._TIMEOUT_S", 0.05)
    assert recover_leftovers(tmp_path) == {}
    assert f"flowrec recover {left}" in capsys.readouterr().err.replace("\n", "")
    assert set(threading.enumerate()) <= threads
    assert set(Path("/dev/fd").iterdir()) <= files
    assert [path.name for path in tmp_path.iterdir()] == [left.name]


def test_of_what_killed_runs_have_left_the_latest_comes_first(tmp_path: Path) -> None:
    ages = {"b": 2, "a": 1, "c": 3}
    for name, age in ages.items():
        (tmp_path / f"{name}.mcap.partial").write_bytes(b"x")
        os.utime(tmp_path / f"{name}.mcap.partial", (1e9 - age, 1e9 - age))
    (tmp_path / "d.recovering.mcap.partial").write_bytes(b"x")
    assert [path.name[0] for path in leftovers(tmp_path)] == ["a", "b", "c"]


def test_remains_that_are_too_large_are_offered_and_left_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    large = tmp_path / "large.mcap.partial"
    with large.open("wb") as file:
        file.truncate(3_000_000_000)
    assert recover_leftovers(tmp_path) == {}
    assert f"flowrec recover {large}" in capsys.readouterr().err.replace("\n", "")
    assert large.stat().st_size == 3_000_000_000
