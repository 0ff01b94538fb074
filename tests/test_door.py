"""`import flowrec` is the door: it costs nothing, opens sessions that only read, and runs the verbs."""

from __future__ import annotations

import ast
import doctest
import inspect
import subprocess
import sys
import textwrap
from pathlib import Path
from types import FunctionType

import numpy as np
import pytest

import flowrec
from flowrec.core import SessionError, Tick, UsageError
from tests.conftest import HANG_S, until
from tests.short_missions import LONG, SMALL, set_words

ROOT = Path(__file__).parents[1]
GOLDEN = ROOT / "sessions" / "golden.mcap"


def imported_by(code: str) -> set[str]:
    """Names of the modules that a new interpreter has after running `code`."""
    words = [sys.executable, "-c", f"{code}\nimport sys; print(*sys.modules)"]
    return set(subprocess.run(words, check=True, capture_output=True, text=True, cwd=ROOT).stdout.split())


def test_importing_flowrec_imports_nothing_else() -> None:
    found = imported_by("import flowrec")
    assert {name for name in found if name.startswith("flowrec")} == {"flowrec", "flowrec.core", "flowrec.core.version"}
    assert not found & {"numpy", "mcap", "pydantic"}


def test_opening_a_session_and_its_outcome_need_no_array_library() -> None:
    code = f"import flowrec; s = flowrec.open({str(GOLDEN)!r}); s.outcome, s.duration_s, s.topics, s.provenance"
    assert not imported_by(code) & {"numpy", "scipy", "torch", "pydantic", "foxglove"}


def test_reading_ticks_needs_no_stage() -> None:
    code = f"import flowrec; next(flowrec.open({str(GOLDEN)!r}).ticks())"
    found = imported_by(code)
    assert "numpy" in found
    assert not found & {"torch", "scipy.stats", "rerun", "filterpy", "flowrec.stages.pipeline", "flowrec.stages.config"}


def test_every_public_name_is_there_documented_and_known_to_type_checkers() -> None:
    tree = ast.parse(Path(flowrec.__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
    declared = {alias.asname for node in tree.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert declared == set(flowrec.__all__) <= set(dir(flowrec))
    assert (Path(flowrec.__file__).parent / "py.typed").is_file()
    for name in flowrec.__all__:
        assert inspect.getdoc(getattr(flowrec, name)), name


def test_a_configuration_is_named_by_a_path_or_by_text(tmp_path: Path) -> None:
    path = tmp_path / "my.toml"
    path.write_text("camera.width_px = 160")
    assert flowrec.load_config(str(path)) == flowrec.load_config(path) != flowrec.load_config()


@pytest.mark.slow("records, replays and refines as the documentation says: ten seconds")
def test_the_examples_of_the_documentation_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    session, chip = flowrec.open(GOLDEN), ROOT / "sessions" / "chips" / "y_junction"
    Path("a.mcap").symlink_to(GOLDEN)
    for end in (".png", ".toml"):
        Path("chip").with_suffix(end).write_bytes(chip.with_suffix(end).read_bytes())
    Path("measured.csv").write_text("x_um,y_um,u_um_s,v_um_s\n1000,2000,200,0\n1500,2000,210,2\n")
    Path("my.toml").write_text(
        "\n".join(['mission.phases = ["plan"]', "[camera]", "width_px = 160", "height_px = 128"])
    )
    texts = {name: inspect.getdoc(getattr(flowrec, name)) or "" for name in flowrec.__all__}
    codes = {
        name: "".join(example.source for example in doctest.DocTestParser().get_examples(text))
        for name, text in texts.items()
        if ">>> " in text
    }
    assert set(codes) == {"replay", "refine", "solve", "RunLog"}
    _, block = (flowrec.__doc__ or "").split("\n\n    import flowrec\n")
    codes["flowrec"] = textwrap.dedent(block.rpartition("\n\n")[0])
    for code in codes.values():
        exec(code, {"flowrec": flowrec, "mask": session.chip.mask})
    assert Path("b.mcap").is_file()


def test_every_attribute_of_a_session_is_documented() -> None:
    for name, member in vars(flowrec.Session).items():
        if not name.startswith("_"):
            assert inspect.getdoc(member), name


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="nosuch"):
        flowrec.nosuch  # type: ignore[attr-defined]  # noqa: B018


def test_a_session_gives_all_that_a_notebook_shows() -> None:
    with flowrec.open(GOLDEN) as session:
        ticks = list(session.ticks(with_frames=False))
        assert session.outcome["outcome"] == "reached"
        assert session.outcome["ticks"] == len(ticks)
        assert session.config.mission.phases
        assert session.chip.mask.any()
        assert session.duration_s == pytest.approx((ticks[-1].stamp_ns - ticks[0].stamp_ns) / 1e9)
        middle_s = ticks[len(ticks) // 2].stamp_ns / 1e9
        assert session.at(middle_s, with_frames=False).stamp_ns == ticks[len(ticks) // 2].stamp_ns
        assert next(session.ticks(middle_s)).stamp_ns == ticks[len(ticks) // 2].stamp_ns
        assert session.last.stamp_ns == ticks[-1].stamp_ns
        assert next(iter(session.frames)).image.ndim == 2
        assert sum(1 for _ in session.frames) == session.topics["/camera/frame"]
        assert [event.text for event in session.events]
        assert {"assumed", "refined", "true"} == set(session.fields)
        assert session.fields["true"].velocity_um_s.shape == (*session.chip.mask.shape, 2)
        assert session.calibration.to_px(np.zeros((1, 2))).shape == (1, 2)
        assert session.provenance["flowrec"]
        assert len(list(session.messages("route"))) == session.topics["/plan/route"]
        assert flowrec.info(session)["outcome"] == "reached"


def test_a_time_outside_of_a_session_is_refused_with_its_times() -> None:
    with pytest.raises(UsageError, match=r"golden\.mcap runs from 0"):
        flowrec.open(GOLDEN).at(1e6)


def test_the_verbs_take_a_session_or_a_path() -> None:
    session = flowrec.open(GOLDEN)
    assert flowrec.compare(session, str(GOLDEN)).identical
    assert flowrec.check(session).word == flowrec.check(GOLDEN).word == "good"
    done = flowrec.replay(session, flowrec.Change(plan="astar_paper"))
    assert done.replayed.route is not None
    assert done.replayed.route.method == "astar_paper"


def test_opening_and_reading_leaves_the_folder_as_it_is(session: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in session.parent.iterdir()}
    with flowrec.open(session) as opened:
        assert sum(1 for _ in opened.ticks()) == opened.outcome["ticks"]
        assert flowrec.check(opened).word == "good"
    assert {path: path.stat().st_mtime_ns for path in session.parent.iterdir()} == before


@pytest.mark.parametrize("name", ["nowhere.mcap", "a_folder", "text.mcap"])
def test_what_is_no_session_is_refused_in_one_line(name: str, tmp_path: Path) -> None:
    (tmp_path / "a_folder").mkdir()
    (tmp_path / "text.mcap").write_text("not a session")
    with pytest.raises(SessionError, match=name) as caught:
        flowrec.open(tmp_path / name)
    assert "\n" not in str(caught.value)


@pytest.mark.slow("a real recording in a process of its own")
def test_a_finished_part_can_be_read_while_another_process_records_the_next_one(tmp_path: Path) -> None:
    sets = set_words((*LONG, "recording.split_s=0.5"))
    out = tmp_path / "run.mcap"
    words = [sys.executable, "-m", "flowrec", "record", "--realtime", "--duration", "60", "--out", out, *sets]
    process = subprocess.Popen([*map(str, words)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        part = tmp_path / "run.part002.mcap"
        until(part.exists)
        with flowrec.open(part) as session:
            ticks = list(session.ticks())
            assert len(ticks) > 5
            assert all(isinstance(tick, Tick) for tick in ticks)
            assert session.at(session.last.stamp_ns / 1e9).stamp_ns == ticks[-1].stamp_ns
        with pytest.raises(SessionError, match="just now"):
            flowrec.open(out)
    finally:
        process.terminate()
        assert process.wait(timeout=HANG_S) == 0
    assert flowrec.open(out).outcome["outcome"] == "stopped"


def test_a_recording_can_be_opened_by_what_record_returns(tmp_path: Path) -> None:
    config = flowrec.load_config(None, [*SMALL, "duration_s=1"])
    assert isinstance(config, flowrec.Config)
    recorded = flowrec.record(config, tmp_path / "short.mcap")
    assert flowrec.open(recorded.path).outcome["ticks"] == recorded.report.ticks
    assert isinstance(flowrec.record, FunctionType)


def test_what_a_session_holds_is_printed_for_people_and_a_misspelt_name_is_answered_with_the_nearest(
    session: Path,
) -> None:
    opened = flowrec.open(session)
    shown = repr(opened.fields).splitlines()
    assert [line.split()[0] for line in shown] == ["assumed", "refined", "true"]
    share = opened.fields["refined"].error_share
    assert share is not None and "flow by assimilate: 320 x 256 pixels of 20 um" in shown[1]
    assert shown[1].endswith(f"states an error of {100 * share:.1f} %>")
    with pytest.raises(KeyError, match=r"'refind'.* 'assumed', 'refined', 'true'"):
        opened.fields["refind"]
    with pytest.raises(flowrec.FlowrecError, match=r"'trak'.* 'track'"):
        opened.table("trak")
    with pytest.raises(AttributeError) as caught:
        flowrec.opne  # noqa: B018
    assert (caught.value.name, caught.value.obj) == ("opne", flowrec), "of which Python makes: did you mean 'open'?"


def test_every_column_of_every_table_of_a_session_is_explained(session: Path) -> None:
    opened = flowrec.open(session)
    told = flowrec.info(session, tables=True)
    assert len(told.columns) == len([path for path in opened.topics if not path.startswith("/view/")])
    for title, columns in told.columns.items():
        name = title.partition(" ")[0]
        assert [column.name for column in columns] == opened.table(name).column_names
        assert [column.name for column in columns if not (column.meaning or column.unit)] == []
