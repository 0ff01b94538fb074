"""`flowrec.replay` from Python: in any thread what the verb makes, with tables and what it changed."""

from __future__ import annotations

import gc
import json
import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import flowrec
from flowrec.core import NS_PER_S, TOPICS, Estimate, FlowField, Observations, Tick, UsageError
from flowrec.exports.report.history import History
from flowrec.run import before_after
from flowrec.run.replay_figures import CommandDifference, _residual_um_s
from flowrec.verbs.replay_result import BeforeAfter
from tests.conftest import HANG_S, invoke
from tests.extras import why

GOLDEN = Path(__file__).parents[2] / "sessions" / "golden.mcap"
CHANGE = {"plan.speed_share": 0.7}


def replay_in_notebook(folder: Path) -> None:
    """The replay to a file 2.mcap there."""
    nbformat = pytest.importorskip("nbformat", reason=why("nbformat"))  # seconds, with jsonschema: not in each worker
    from nbclient import NotebookClient

    notebook = nbformat.v4.new_notebook()
    code = f"import flowrec\nflowrec.replay({str(GOLDEN)!r}, plan='astar_length', out='2.mcap').before_after"
    notebook.cells.append(nbformat.v4.new_code_cell(code))
    NotebookClient(notebook, timeout=HANG_S, resources={"metadata": {"path": str(folder)}}).execute()


def payloads(path: Path) -> dict[str, list[tuple[int, bytes]]]:
    """Time on the session clock and bytes of all messages but the diagnostics, by topic, by the mcap library."""
    from mcap.reader import make_reader

    skipped = {topic.path for topic in TOPICS if topic.role.value == "diagnostic"}
    found: dict[str, list[tuple[int, bytes]]] = {}
    start = flowrec.open(path).header.start_unix_ns
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            if channel.topic not in skipped:
                found.setdefault(channel.topic, []).append((message.log_time - start, message.data))
    return found


@pytest.mark.slow("replays a session four times")
@pytest.mark.parametrize("notebook", [False, True])
def test_replays_in_threads_and_in_a_notebook_make_the_bytes_that_the_verb_makes(
    notebook: bool, tmp_path: Path
) -> None:
    by_verb = tmp_path / "verb.mcap"
    words = ["replay", str(GOLDEN), "--plan", "astar_length", "--out", str(by_verb), "--json"]
    done = invoke(*words)
    assert done.exit_code == 0, done.output
    with ThreadPoolExecutor(2) as threads:
        running = [
            threads.submit(flowrec.replay, GOLDEN, plan="astar_length", out=tmp_path / f"{n}.mcap") for n in range(2)
        ]
        if notebook:
            replay_in_notebook(tmp_path)
        replays = [each.result() for each in running]
    made = [each.result.path for each in replays] + [tmp_path / "2.mcap"] * notebook
    expected = payloads(by_verb)
    assert len(expected["/robot/estimate"]) == 107 and "/plan/route" in expected
    stamped = {"/run/events", "/operator/events"}  # hold the time of day, which is that of the replay
    for path in made:
        found = payloads(path)
        assert found.keys() == expected.keys()
        assert [topic for topic in found if topic not in stamped and found[topic] != expected[topic]] == []
        assert len(flowrec.open(path).events) == len(flowrec.open(by_verb).events)
    rows = json.loads(done.stdout)["rows"]
    assert [list(row.values()) for row in rows] == json.loads(
        json.dumps([list(row) for row in replays[0].before_after])
    )


@pytest.mark.slow("replays a mission")
def test_a_replay_has_tables_and_its_temporary_file_goes_with_it() -> None:
    done = flowrec.replay(GOLDEN, sets=CHANGE)
    path = done.result.path
    assert path.is_file() and path.parent != GOLDEN.parent
    table = done.table("estimate")
    assert table.equals(flowrec.open(path).table("estimate")) and table.num_rows == done.report.ticks
    assert done.config.plan.speed_share == 0.7
    frame = done.before_after.to_pandas()
    assert frame.loc["commands_compared", "replayed"] == done.commands.compared
    assert list(frame.columns) == ["recorded", "replayed"]
    assert len(repr(done)) < 200 and done.session.path.name in repr(done)
    shown = done._repr_html_()
    assert shown.startswith(f"<div><b>Replay of {done.session.path.name}: ") and done.covered.text in shown
    assert done.before_after._repr_html_() in shown and " um" not in shown
    assert "planned" in str(done.before_after) or "route length" in str(done.before_after)
    del done, table
    gc.collect()
    assert not path.parent.exists()


def test_text_in_the_comparison_is_escaped_in_html() -> None:
    shown = BeforeAfter([("map", "<script>alert(1)</script>", "fvm")])._repr_html_()
    assert "<script>" not in shown and "&lt;script&gt;" in shown


def test_a_change_is_given_once_and_as_a_list_or_a_dictionary(tmp_path: Path) -> None:
    twice = {"change": flowrec.Change(plan="astar"), "plan": "astar"}
    for wrong, named in (
        (twice, "change"),
        ({"sets": "a=1"}, "a=1"),
        ({"sets": {"plan.clearence_um": 1}}, "clearence_um"),
    ):
        with pytest.raises(UsageError, match=named):
            flowrec.replay(GOLDEN, **wrong)
    assert not list(tmp_path.iterdir())


def test_a_typed_change_reaches_the_replay_without_becoming_text() -> None:
    sets = {"recording.operator": "007", "recording.notes": "true", "plan.speed_share": 0.1 + 0.2}
    recorded = flowrec.open(GOLDEN).config
    typed = flowrec.Change(sets=sets).apply(recorded)
    assert (typed.recording.operator, typed.recording.notes) == ("007", "true")
    assert typed.plan.speed_share == 0.1 + 0.2
    assert flowrec.Change(sets=["plan.speed_share=0.5"]) == flowrec.Change(sets={"plan.speed_share": 0.5})


def test_what_each_map_leaves_of_the_flow_is_told_by_the_observations_of_the_replay() -> None:
    def tick(vx: float, vy: float, *flow_um_s: tuple[float, float]) -> Tick:
        velocity = np.broadcast_to((vx, vy), (8, 9, 2)).astype(np.float32)
        field = FlowField(0, 0, "known", 20.0, velocity, np.zeros((8, 9)), None, np.zeros(1), 1.0, 1000.0, "")
        places = np.array([[40.0, 60.0], [100.0, 80.0]])
        return Tick(assumed=field, observations=Observations(0, places, np.array(flow_um_s), np.ones(2)))

    config = SimpleNamespace(control=SimpleNamespace(method="pursuit"))
    done = SimpleNamespace(
        session=SimpleNamespace(config=config),
        config=config,
        commands=CommandDifference(),
        recorded=tick(30.0, 0.0, (900.0, 0.0), (900.0, 0.0)),
        replayed=tick(33.0, 4.0, (33.0, 0.0), (33.0, 8.0)),
    )
    told = {key: (was, now) for key, was, now in before_after(done)}  # type: ignore[arg-type]
    # Lengths of the misses: 3 and the root of 73 um/s on the recorded map, twice 4 on the other.
    assert told["residual_um_s"] == (pytest.approx(math.sqrt((9.0 + 73.0) / 2.0)), pytest.approx(4.0))


def test_a_map_that_has_found_another_registration_is_compared_where_the_image_shows_its_places() -> None:
    columns = np.broadcast_to(np.arange(9.0)[None, :, None], (8, 9, 2)).astype(np.float32)  # um/s, a pixel 1 more
    field = FlowField(0, 0, "known", 20.0, columns, np.zeros((8, 9)), None, np.zeros(1), 1.0, 1000.0, "")
    field = replace(field, registration=np.array([[1.0, 0.0, 40.0], [0.0, 1.0, 0.0]]))  # two pixels to the right
    seen = Observations(0, np.array([[60.0, 60.0], [80.0, 80.0]]), np.array([[5.0, 5.0], [6.0, 6.0]]), np.ones(2))
    assert _residual_um_s(field, seen) == pytest.approx(0.0, abs=1e-5)
    history = History(0, NS_PER_S)
    history.add(
        Tick(
            1,
            estimate=Estimate(1, np.array([60.0, 60.0]), np.zeros(2), np.eye(4), 1.0, np.zeros(2), True),
            refined=field,
        )
    )
    assert history.curve("map_x_um_s").known == pytest.approx([5.0])
