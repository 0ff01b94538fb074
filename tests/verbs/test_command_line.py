"""The same words mean the same in every verb, and what is printed can be read wherever it is printed."""

from __future__ import annotations

import importlib
import io
import json
import shlex
import shutil
import sys
from pathlib import Path

import pytest
from typer.main import get_command

from flowrec.bench import plan
from flowrec.core import REPLAYED, terminal
from flowrec.verbs import completion
from flowrec.verbs.cli import app, with_default_refine
from tests.conftest import invoke, run

SESSIONS = Path(__file__).parents[2] / "sessions"


def test_a_bench_prints_its_figures_as_json_like_every_other_verb(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    kept = tmp_path / "figures.json"
    monkeypatch.setattr("flowrec.bench.solver.measure", lambda: {"rows": [1]})
    assert run(["bench", "solver", "--json", "--out", kept]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["rows"] == [1]
    assert printed["machine"]["cores"]
    assert json.loads(kept.read_text()) == printed


@pytest.mark.parametrize("words", [[], ["record"], ["bench", "plan"]])
def test_help_is_asked_for_in_short(words: list[str]) -> None:
    assert invoke(*words, "-h").output == invoke(*words, "--help").output != ""


def test_the_help_of_replay_and_export_lists_every_method_of_every_table_with_its_summary() -> None:
    helps = [invoke(verb, "--help", env={"COLUMNS": "200"}).output for verb in ("replay", "export")]
    shown = " ".join("".join(helps).split())
    for target in (*REPLAYED.values(), "flowrec.exports.formats:EXPORTS"):
        module, _, table = target.partition(":")
        for name, method in getattr(importlib.import_module(module), table).items():
            assert f"{name}: {method.summary}" in shown


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["record", "--nosuch"], "--nosuch"),
        (["replay"], "SESSION"),
        (["nosuch"], "nosuch"),
        (["record", "--split", "3"], "--split 2GB,10min"),
        (["record", "--split", "2GB,3GB"], "one size, one time, or both"),
        (["record", "--snapshot", "30s,10s,5s"], "--snapshot 30s,10s"),
        (["record", "--goal", "1,2,3"], "--goal 4400,1500"),
        (["replay", SESSIONS / "golden.mcap", "--verify", "--refly"], "--verify"),
        (["replay", SESSIONS / "golden.mcap", "--verify", "--from", "nan"], "'--from': nan"),
        (["bench", "flow", "--outliers", "inf"], "'--outliers'"),
        (["bench", "plan", "--trips", "0"], "'--trips'"),
        (["cut", "a.mcap", "--from", "5s"], "'--from'"),
        (["--timeout", "-1", "methods"], "'--timeout'"),
    ],
)
def test_wrong_usage_is_told_in_one_line_that_names_the_help(
    words: list[object], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("flowrec: ")
    assert said in line
    assert line.endswith("--help")


def test_the_help_of_every_verb_ends_with_examples_that_can_be_typed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("lab.toml", "a.mcap", "a_replay_001.mcap", "a.mcap.partial", "b.mcap", "sweep.parquet"):
        Path(name).touch()
    group = get_command(app)
    verbs = {name: verb for name, verb in group.commands.items() if name not in ("bench", "calibrate", "emulate")}  # type: ignore[attr-defined]
    assert len(verbs) > 15
    for name, verb in verbs.items():
        begin, *examples = verb.epilog.split("\n\n")
        assert begin == "Examples:" and examples
        for example in examples:
            program, first, *words = shlex.split(example)
            assert (program, first) == ("flowrec", name)
            verb.make_context(name, with_default_refine(words))


def test_the_goal_of_an_example_can_be_reached() -> None:
    examples = get_command(app).commands["record"].epilog.split("\n\n")  # type: ignore[attr-defined]
    (example,) = [shlex.split(each) for each in examples if "--goal" in each]
    assert run([*example[1:], "--dry-run"]) == 0


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        ("flowrec rec", "record recover"),
        ("flowrec replay a.mcap --plan astar_t", "astar_time"),
        ("flowrec export a.mcap --format r", "rrd"),
        ("flowrec record --set plan.method = astar_t", "astar_time"),  # as bash breaks plan.method=astar_t
    ],
)
def test_a_shell_completes_verbs_methods_and_settings(
    words: str, offered: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("_FLOWREC_COMPLETE", "complete_bash")
    monkeypatch.setattr(completion, "_key", "")  # of a process that completes once
    monkeypatch.setenv("COMP_WORDS", words)
    monkeypatch.setenv("COMP_CWORD", str(len(words.split()) - 1))
    run([])
    assert capsys.readouterr().out.split() == offered.split()


def test_the_help_of_calibrate_coils_names_the_section_that_it_writes() -> None:
    shown = invoke("calibrate", "coils", "--help", env={"COLUMNS": "160"}).output
    assert "(section coils)" in " ".join(shown.split())


def test_calibrate_prints_where_the_encoding_has_no_plus_minus_sign(monkeypatch: pytest.MonkeyPatch) -> None:
    printed = io.TextIOWrapper(io.BytesIO(), encoding="ascii", write_through=True)
    monkeypatch.setattr(sys, "stdout", printed)
    try:
        assert run(["calibrate", "coils", SESSIONS / "coils.csv"]) == 0
    except UnicodeEncodeError as error:
        pytest.fail(str(error))
    assert b"b_x" in printed.buffer.getvalue()  # type: ignore[attr-defined]


def test_a_table_given_to_calibrate_itself_is_fitted_and_the_new_command_is_named(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run(["calibrate", SESSIONS / "coils.csv", "--json"]) == 0
    said = capsys.readouterr()
    assert said.err.count("\n") == 1 and "flowrec calibrate coils" in said.err and '"mt_per_a"' in said.out
    assert run(["calibrate", "coil", SESSIONS / "coils.csv"]) == 2
    assert "coil" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("file", "said"),
    [(SESSIONS / "chips" / "y_junction.toml", "--set chip.path="), ("own.yaml", "YAML"), ("run.mcap", "session")],
)
def test_what_is_given_as_a_configuration_and_is_none_is_told_apart(
    file: Path | str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("own.yaml", "run.mcap"):
        Path(name).write_text("chip:\n  name: straight\n")
    assert run(["record", "--dry-run", file]) == 2
    assert said in capsys.readouterr().err


def test_a_byte_order_mark_is_no_part_of_a_configuration(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "own.toml").write_bytes(b"\xef\xbb\xbf[chip]\nname = 'straight'\n")
    assert run(["record", "--dry-run", tmp_path / "own.toml"]) == 0
    assert 'name = "straight"' in capsys.readouterr().out


@pytest.mark.slow("a bench of planners")
def test_planners_that_are_not_installed_are_left_out_and_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if "find_spec" in vars(plan):  # as on an installation without the extra
        monkeypatch.setattr(plan, "find_spec", lambda _name: None)
    try:
        figures = plan.measure(None, trips=1, tree_channels=1, side_px=128, quick=True)
    except Exception as error:  # noqa: BLE001 - what a user would see
        pytest.fail(str(error))
    assert "rrt" not in figures["summary"]
    assert "time_field" in figures["summary"]
    assert "rrt, rrt_star" in capsys.readouterr().err


@pytest.mark.slow("replays a mission and fits a network")
def test_a_refinement_that_changes_nothing_says_why(
    session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "again.mcap"
    assert run(["replay", session, "--refine", "--out", out]) == 0
    assert "--set refine.pi_unet.start=fvm" in " ".join(capsys.readouterr().err.split())


def test_a_bar_that_stands_names_no_time_left() -> None:
    assert terminal.time_left(12.4, stands_s=0.2) == "12 s left"
    assert terminal.time_left(1.0, stands_s=5.0) == ""
    assert terminal.time_left(None, stands_s=0.0) == ""


@pytest.mark.slow("replays a session four times")
def test_a_replay_states_the_path_of_its_session(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out = tmp_path / "again.mcap"
    assert run(["replay", SESSIONS / "golden.mcap", "--out", out, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["out"] == str(out)
    assert run(["replay", SESSIONS / "golden.mcap", "--out", out, "--overwrite"]) == 0
    assert "".join(capsys.readouterr().err.split()).find(f"->{out}") > 0
    beside = tmp_path / "golden.mcap"
    shutil.copy(SESSIONS / "golden.mcap", beside)
    assert run(["replay", beside, "--json"]) == 0
    made = tmp_path / "golden_replay_001.mcap"
    assert json.loads(capsys.readouterr().out)["out"] == str(made) and made.is_file()
    assert run(["replay", beside, "--verify"]) == 3  # other numerics
    assert len(list(tmp_path.glob("golden_replay*"))) == 1


def test_the_names_in_a_table_are_readable_beside_a_value_that_fills_many_lines() -> None:
    printed = io.StringIO()
    words = [f"robot.setting_{number}=1.5" for number in range(60)]
    terminal.table("a.mcap", ("", "value"), [("derived", " ".join(words))], to=printed)
    assert "derived" in printed.getvalue()
    assert [word for word in words if word not in printed.getvalue()] == []
