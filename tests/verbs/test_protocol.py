"""`flowrec doctor --protocol`: ten measurements in order, which go on after an interruption and end in a note."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flowrec.core import FlowrecError, UsageError
from flowrec.rigs import EmulatedCamera, EmulatedInstruments
from flowrec.rigs.emulated.coils import OutputSamples, sample
from flowrec.stages import Coils, Refiner, load_config
from flowrec.store import Session
from flowrec.verbs import protocol, protocol_rows, ways_out
from flowrec.verbs.protocol import FAILED, NOT_DONE, PASSED, RESULTS, DayProtocol, walk
from flowrec.verbs.protocol_hands import Answers, EmulatedHand, Person
from flowrec.verbs.protocol_rows import ROWS, RowValue
from tests.conftest import needs_quiet, run
from tests.short_missions import SMALL, set_words
from tests.twins.coils import needs_compiler
from tests.twins.lab import PATIENT

NAMES = ["scale", "axes", "latency", "um_per_rev", "step_out", "field", "flow", "zero", "mission", "replay"]
MOUNTED = "mounted=yes"


@pytest.fixture
def camera() -> Iterator[EmulatedCamera]:
    with EmulatedCamera(8, 8, 10.0) as made:
        yield made


def results(done: DayProtocol) -> dict[str, str]:
    return {each.row: each.result for each in done.results}


def rows_with(monkeypatch: pytest.MonkeyPatch, **measures: Any) -> None:
    """The table, with other measurements of some rows; those of the others are not to be made."""

    def none(_day: object) -> RowValue:
        raise FlowrecError("not of this test")

    rows = tuple(row._replace(measure=measures.get(row.name, none)) for row in ROWS)
    monkeypatch.setattr(protocol, "ROWS", rows)


def test_the_ten_measurements_come_in_their_order_each_with_what_to_mount_a_command_a_limit_and_its_reason() -> None:
    assert [row.name for row in ROWS] == NAMES
    for row in ROWS:
        texts = (row.what, row.unit, row.mount, row.command, row.passes, row.why)
        assert all(texts) and not any("\n" in text for text in texts), row.name
        assert row.name in ("zero", "field") or "flowrec" in row.command


def test_without_somebody_who_has_mounted_it_nothing_is_run_and_the_protocol_is_printed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["doctor", "--protocol", "--folder", tmp_path, "--json"]) == 3
    told = json.loads(capsys.readouterr().out)
    assert [row["row"] for row in told["rows"]] == NAMES
    assert {row["result"] for row in told["rows"]} == {NOT_DONE}
    assert all(row["mount"] and row["command"] and row["passes"] for row in told["rows"])
    assert not list(tmp_path.iterdir()), "nothing was recorded"


@pytest.mark.parametrize(
    "words", [["--only", "scales", "--protocol"], ["--only", "scale"], ["--answer", "mounted=yes"]]
)
def test_an_unknown_row_and_options_without_the_protocol_are_refused(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["doctor", "--folder", tmp_path, *words]) == 2
    assert "Traceback" not in capsys.readouterr().err


def test_it_goes_on_where_it_was_interrupted_and_measures_again_what_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[str] = []

    def scale(_day: object) -> RowValue:
        calls.append("scale")
        return RowValue(0.5, 1.0, "")

    def axes(_day: object) -> RowValue:
        calls.append("axes")
        if calls.count("axes") == 1:
            raise KeyboardInterrupt
        return RowValue(9.0, 5.0, "")

    rows_with(monkeypatch, scale=scale, axes=axes)
    config, hand = load_config(None, SMALL), Answers([MOUNTED])
    with pytest.raises(KeyboardInterrupt):
        walk(config, None, {}, tmp_path, hand)
    for _ in range(2):
        found = results(walk(config, None, {}, tmp_path, hand))
        assert found["scale"] == PASSED and found["axes"] == FAILED
    assert calls == ["scale", "axes", "axes", "axes"]
    walk(config, None, {}, tmp_path, hand, ["scale"])
    assert calls[-1] == "scale", "a row that is named is measured again"
    other = load_config(None, [*SMALL, "robot.um_per_rev=24"])
    walk(other, None, {}, tmp_path, hand)
    assert calls.count("scale") == 3, "of another configuration nothing is known"
    assert len((tmp_path / RESULTS).read_text().splitlines()) >= len(calls) - 1


def test_a_line_of_the_results_that_was_cut_off_is_measured_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows_with(monkeypatch, scale=lambda _day: RowValue(0.5, 1.0, ""))
    config, hand = load_config(None, SMALL), Answers([MOUNTED])
    walk(config, None, {}, tmp_path, hand, ["scale"])
    kept = tmp_path / RESULTS
    kept.write_bytes(kept.read_bytes()[:-20])
    assert results(walk(config, None, {}, tmp_path, Answers([])))["scale"] == NOT_DONE


def test_of_a_run_from_which_a_row_has_failed_no_other_row_is_measured_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    known: list[dict[str, Path]] = []

    def measures(row: str, value: float) -> Any:
        def measure(day: Any) -> RowValue:
            known.append(dict(day.sessions))
            return RowValue(value, 1.0, "", tmp_path / f"{row}_002.mcap")

        return measure

    shared = {"latency": measures("motion", 0.5), "um_per_rev": measures("motion", 2.0)}
    rows_with(monkeypatch, scale=measures("still", 0.5), **shared)
    config, hand = load_config(None, SMALL), Answers([MOUNTED])
    walk(config, None, {}, tmp_path, hand)
    known.clear()
    walk(config, None, {}, tmp_path, hand)
    assert known == [{"still": tmp_path / "still_002.mcap"}], "what failed is recorded anew"


def measured(row: str, **config: Any) -> RowValue:
    """A row of the table, for a day on which all that it runs has gone well."""
    session = SimpleNamespace(path=Path("run.mcap"), config=SimpleNamespace(refine=Refiner(), flow=None), chip=None)
    session.last = SimpleNamespace(tracer_flow=SimpleNamespace(position_um=np.zeros((4, 2))))
    session.fields = {"assumed": SimpleNamespace(error_share=0.05)}
    day = SimpleNamespace(run=lambda *_: session, config=SimpleNamespace(**config), asked=None)
    day.hand = SimpleNamespace(read=lambda *_: "table.csv")
    (value,) = (each.measure(day) for each in ROWS if each.name == row)  # type: ignore[arg-type]
    return value


def test_a_row_has_the_error_of_what_was_stated_in_its_unit_and_the_limit_that_it_promises(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    fit = SimpleNamespace(offset_s=-0.08, offset_std_s=0.001, um_per_rev=33.0, um_per_rev_std=0.1)
    monkeypatch.setattr("flowrec.measure.calibrate_motion", lambda _path: SimpleNamespace(fit=fit))
    poses = [SimpleNamespace(calibration=SimpleNamespace(um_per_px=scale)) for scale in (2.0, 2.03, 1.99)]
    monkeypatch.setattr("flowrec.measure.calibrate_image", lambda *_: SimpleNamespace(poses=poses))
    currents_a = np.vstack((np.zeros(3), np.eye(3), -np.eye(3)))
    read_mt = currents_a @ np.array([[2.0, 0.3, 0.0], [0.1, 2.0, 0.0], [0.0, 0.4, 2.0]]).T
    monkeypatch.chdir(tmp_path)
    header = "i_x_a,i_y_a,i_z_a,b_x_mt,b_y_mt,b_z_mt"
    np.savetxt("table.csv", np.hstack((currents_a, read_mt)), "%g", ",", header=header, comments="")
    monkeypatch.setattr(protocol_rows, "flow_error", lambda *_: 0.08)
    monkeypatch.setattr(
        protocol_rows, "refine", lambda *_, **__: SimpleNamespace(refused="", note="", error_share=None)
    )
    camera, robot = SimpleNamespace(um_per_px=2.0, rate_hz=20.0), SimpleNamespace(delay_s=0.05, um_per_rev=30.0)
    coils = SimpleNamespace(mt_per_a=((2.0, 0.0, 0.0), (0.1, 2.0, 0.0), (0.0, 0.0, 2.0)))
    found = {
        row: measured(row, camera=camera, robot=robot, coils=coils)
        for row in ("scale", "latency", "um_per_rev", "field", "flow")
    }
    assert {row: (pytest.approx(each.value), each.limit) for row, each in found.items()} == {
        "scale": (1.5, 1.0),  # of the pose that is farthest from what was stated
        "latency": (30.0, 50.0),  # 80 ms where 50 are stated, to the time between two images
        "um_per_rev": (10.0, 10.0),
        "field": (25.0, 5.0),  # of the second coil, (0.3, 0, 0.4) of (0, 2, 0)
        "flow": (8.0, 10.0),  # twice the 5 % that the assumed map states
    }


def test_ways_out_that_a_person_has_timed_are_judged_by_the_slowest_and_one_that_was_not_is_told(
    tmp_path: Path,
) -> None:
    config = load_config(None, [*SMALL, "lab.guardian_s=0.1"])
    times = {"end": 0.0, "ctrl_c": 0.5, "operator": 0.1, "kill": 0.15, "camera": 0.2}
    given = [f"zero_{name}_s={seconds}" for name, seconds in times.items()]
    day = protocol.Day(config, None, {}, tmp_path, Answers(given))
    share, limit, text = ways_out.zero_on_ways(day)
    assert share == pytest.approx(25.0) and limit == 100.0 and "kill -9 0.15 s of 0.6" in text
    day = protocol.Day(config, None, {}, tmp_path, Answers([*given, "zero_kill_s=inf"]))
    assert ways_out.zero_on_ways(day)[0] == np.inf
    with pytest.raises(FlowrecError, match="--answer zero_camera_s=SECONDS"):
        ways_out.zero_on_ways(protocol.Day(config, None, {}, tmp_path, Answers(given[:-1])))


def test_the_emulated_probe_reads_the_field_of_the_true_coils_and_a_weak_one_fails(
    camera: EmulatedCamera, tmp_path: Path
) -> None:
    for strength, least, most in ((1.0, 0.0, 2.0), (0.8, 18.0, 22.0)):
        true = Coils(mt_per_a=tuple(tuple(strength * each for each in row) for row in Coils().mt_per_a))
        hand = EmulatedHand(EmulatedInstruments(OutputSamples(tmp_path / "none"), camera, true), tmp_path)
        day = protocol.Day(load_config(None, SMALL), None, {}, tmp_path, hand)
        (row,) = [row for row in ROWS if row.name == "field"]
        found = row.measure(day)
        assert least <= found.value < most and (found.value <= found.limit) == (strength == 1.0)


@pytest.mark.parametrize(("off_ms", "late_s"), [(-100, 0.0), (300, 0.3)])
def test_the_emulated_ammeter_tells_when_the_last_current_went(
    off_ms: int, late_s: float, camera: EmulatedCamera, tmp_path: Path
) -> None:
    file = tmp_path / "outputs"
    since_ns = 10_000_000_000
    rows = np.zeros(3, sample())
    rows["at_ns"] = [since_ns - 10**9, since_ns - 10**8 * 5, since_ns + off_ms * 10**6]
    rows["coils"][:2] = 0.5
    file.write_bytes(rows.tobytes())
    meter = EmulatedInstruments(OutputSamples(file), camera, Coils())
    assert meter.zero_after_s(since_ns, 1.0) == pytest.approx(late_s)
    file.write_bytes(rows[:2].tobytes())
    assert meter.zero_after_s(since_ns, 1.0) == np.inf


@pytest.mark.slow("records five missions in processes of their own")
def test_on_a_simulated_rig_all_that_needs_no_instrument_passes_and_the_session_of_the_mission_has_it_as_a_note(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "day"
    sets = [*SMALL, "simulated.tracers=60", "mission.check_axes=true"]
    words = ["doctor", "--protocol", "--folder", folder, "--answer", MOUNTED, "--json"]
    words += set_words(sets)
    assert run(words) == 3
    told = json.loads(capsys.readouterr().out)
    found = {row["row"]: row["result"] for row in told["rows"]}
    assert [name for name, result in found.items() if result != PASSED] == ["field", "zero"], told
    (note,) = Session(told["session"]).notes
    assert note.tags == ("protocol",) and [line.split()[0] for line in note.text.splitlines()] == NAMES
    before = {file: file.stat().st_mtime_ns for file in folder.glob("*.mcap")}
    assert len(before) == 5
    assert run(words) == 3
    assert {file: file.stat().st_mtime_ns for file in folder.glob("*.mcap")} == before, "nothing is recorded again"


WORLDS = {
    "scale": "um_per_px=20.6",
    "axes": "mirror=true",
    "latency": "delay_s=0.08",
    "um_per_rev": "um_per_rev_share=1.2",
    "step_out": "step_out_share=0.6",
    "flow": "inlet_speed_share=1.8",
}


@pytest.mark.slow("records missions in processes of their own")
@pytest.mark.parametrize("row", WORLDS)
def test_a_defect_of_the_simulated_world_fails_the_row_that_is_for_it(
    row: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sets = [*SMALL, "camera.um_per_px=20", "robot.delay_s=0.04", "simulated.tracers=60", "mission.check_axes=true"]
    words = ["doctor", "--protocol", "--folder", tmp_path, "--answer", MOUNTED, "--json", "--only", row]
    assert run([*words, *set_words([*sets, f"simulated.{WORLDS[row]}"])]) == 1
    found = {each["row"]: each for each in json.loads(capsys.readouterr().out)["rows"]}
    assert found[row]["result"] == FAILED and found[row]["value"] is not None, found[row]
    assert {each["result"] for name, each in found.items() if name != row} == {NOT_DONE}


def test_a_person_says_what_is_ready_and_a_closed_terminal_is_no_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    def typed(*lines: str) -> Person:
        monkeypatch.setattr("sys.stdin", io.StringIO("".join(lines)))
        return Person(["field_table=probe.csv"])

    assert typed("\n").ready("field", "a probe")
    assert not typed("s\n").ready("field", "a probe")
    assert (
        typed().read("field_table", "File") == "probe.csv" and typed("zero.csv\n").read("other", "File") == "zero.csv"
    )
    assert typed("0.3\n").zero_after_s("Ctrl-C", 0, 2.0) == 0.3
    for asked in (lambda: typed().ready("field", "a probe"), lambda: typed().pull_cable(pulled=True)):
        with pytest.raises(UsageError, match="terminal is closed"):
            asked()
    with pytest.raises(UsageError, match="no number of seconds"):
        typed("soon\n").zero_after_s("Ctrl-C", 0, 2.0)


DEFECTS = {
    "the y coil is connected the other way round": (
        ("--world", "coils.mt_per_a=[[2.1,0.0,0.0],[0.0,-1.9,0.0],[0.0,0.0,1.5]]"),
        {"axes": FAILED},
    ),
    "the camera is late": (("--camera-delay-ms", "130"), {"latency": FAILED}),
    "the field is 20 % weak": (
        ("--world", "coils.mt_per_a=[[1.68,0.0,0.0],[0.0,1.52,0.0],[0.0,0.0,1.2]]"),
        {"field": FAILED, "axes": PASSED},
    ),
}


@needs_compiler
@needs_quiet
@pytest.mark.slow("flies missions in real time")
@pytest.mark.parametrize("name", DEFECTS)
def test_a_defect_of_an_emulated_lab_fails_the_row_that_is_for_it(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words, expected = DEFECTS[name]
    rows = ("scale", *expected) if "field" in expected else ("scale", "axes", "latency", "um_per_rev", "step_out")
    done = run_protocol(tmp_path, [*words, *(word for row in rows for word in ("--only", row))], capsys)
    assert done["scale"] == PASSED
    assert {row: done[row] for row in expected} == expected, done
    assert [row for row in rows if done[row] == FAILED] == [row for row in expected if expected[row] == FAILED], done


@needs_compiler
@needs_quiet
@pytest.mark.slow("flies missions in real time")
def test_on_an_emulated_lab_that_is_as_stated_all_ten_pass(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_protocol(tmp_path, [], capsys) == dict.fromkeys(NAMES, PASSED)


def run_protocol(folder: Path, words: list[str], capsys: pytest.CaptureFixture[str]) -> dict[str, str]:
    """The result of each row on the emulated lab."""
    sets = ["simulated.world=kind", "simulated.tracers=60", "recording.accept_losses=true", *PATIENT]
    command = ["emulate", "lab", "-o", folder / "lab.toml", "--protocol", folder / "day", "--json", *words]
    run([*command, *set_words(sets)])
    printed = capsys.readouterr()
    print(printed.err)
    return {row["row"]: row["result"] for row in json.loads(printed.out)["rows"]}
