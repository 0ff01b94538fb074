"""Two sessions, or a recording and its replay, are the same only where every element of every message is."""

from __future__ import annotations

import json
import re
from dataclasses import make_dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from flowrec.core import Demand, Ended, FlowField, Tick, as_read
from flowrec.core.topics import topics_of
from flowrec.stages import load_config, to_toml
from flowrec.store import SessionHeader
from flowrec.verbs.compare import compare
from flowrec.verbs.comparison import Comparison
from tests.conftest import answered
from tests.rewritten import edit_of_head, rewrite
from tests.store.made_up import HEADER, ticks_of, write_session

NAN, INF = float("nan"), float("inf")


def demand(pairs: list[list[float]], error_um: float = 0.0) -> Tick:
    with as_read():
        said = Demand(0, np.zeros(2), np.zeros(2), 0.0, error_um, False, np.array(pairs).reshape(-1, 2))
    return Tick(stamp_ns=0, demand=said)


@pytest.mark.parametrize(
    ("recorded", "replayed", "same"),
    [
        ([[1e4, 1e-3]], [[1e4, 5e-3]], False),
        ([[1e4, 1.0]], [[1e4 * (1.0 + 1e-7), 1.0]], True),
        ([[1e4, 1.0]], [[1e4 * (1.0 + 1e-5), 1.0]], False),
        ([[1e4, 0.0]], [[1e4, 1e-9]], True),
        ([[INF, 1.0]], [[INF, 2.0]], False),
        ([[INF, 1.0]], [[INF, 1.0]], True),
        ([[INF, 1.0]], [[-INF, 1.0]], False),
        ([[NAN, 1.0]], [[NAN, 1.0]], True),
        ([[NAN, 1.0]], [[INF, 1.0]], False),
        ([[NAN, 1.0]], [[1.0, NAN]], False),
        ([[1.0, 1.0]], [[1.0, NAN]], False),
        ([[1e308, 1.0]], [[-1e308, 1.0]], False),
        ([[1.0, 1.0]], [[1.0, 1.0], [1.0, 1.0]], False),
    ],
)  # fmt: skip
def test_arrays_are_compared_element_by_element(
    recorded: list[list[float]], replayed: list[list[float]], same: bool
) -> None:
    comparison = Comparison()
    comparison.add(demand(recorded), demand(replayed))
    assert comparison.same is same


@pytest.mark.parametrize(("recorded", "replayed", "same"), [(NAN, NAN, True), (NAN, 1.0, False), (INF, NAN, False)])
def test_single_numbers_that_are_not_finite_are_compared_too(recorded: float, replayed: float, same: bool) -> None:
    comparison = Comparison()
    comparison.add(demand([], recorded), demand([], replayed))
    assert comparison.same is same


@pytest.mark.parametrize("wrong", [NAN, INF, -INF])
def test_a_number_that_is_not_finite_outweighs_every_difference_within_tolerance(wrong: float) -> None:
    recorded, slightly = demand([[1.0, 1.0]], 1e4), demand([[1.0, 1.0]], 1e4 * (1.0 + 1e-7))
    for sides in ((recorded, demand([[1.0, wrong]], 1e4 * (1.0 + 1e-7))), (demand([[1.0, wrong]], 1e4), slightly)):
        comparison = Comparison()
        comparison.add(*sides)
        assert not comparison.same and comparison.first is not None and comparison.first.field == "sent_um_s"


def test_a_message_that_only_one_side_has_is_a_difference() -> None:
    comparison = Comparison()
    comparison.add(demand([]), Tick(stamp_ns=0))
    assert not comparison.same


def test_the_first_difference_names_the_element_and_both_values_the_recorded_one_first() -> None:
    comparison = Comparison()
    comparison.add(demand([[1.0, 2.0], [3.0, 4.0]]), demand([[1.0, 2.0], [3.5, 4.0]]))
    assert str(comparison.first) == "/control/demand at 0.000 s: sent_um_s[1, 0] recorded 3.0, replayed 3.5"


def small_session(path: Path, ticks: list[Tick], parent: bool = False, sets: tuple[str, ...] = ()) -> Path:
    parents = {"file": "a.mcap", "sha256": ""} if parent else {}
    config = load_config(None, sets)
    header = SessionHeader(to_toml(config), HEADER.chip_png, HEADER.chip_toml, HEADER.provenance, parents)
    return write_session(path, ticks, header, leave_out=config.recording.leave_out)


@pytest.fixture
def ticks() -> list[Tick]:
    return list(ticks_of(20))


def test_images_of_another_size_are_a_difference(tmp_path: Path, ticks: list[Tick]) -> None:
    first = small_session(tmp_path / "a.mcap", ticks)
    second = small_session(tmp_path / "b.mcap", list(ticks_of(20, shape=(40, 64))))
    status, said = answered("compare", first, second)
    assert status == 3
    assert "uint8 of shape (48, 64)" in said


def test_one_message_that_differs_is_told_with_its_number_of_ticks(tmp_path: Path, ticks: list[Tick]) -> None:
    first = small_session(tmp_path / "a.mcap", ticks)
    estimate = ticks[7].estimate
    assert estimate is not None
    here = estimate.position_um + np.array([0.0, 1.0])
    ticks[7] = replace(ticks[7], estimate=replace(estimate, position_um=here))
    second = small_session(tmp_path / "b.mcap", ticks)
    status, said = answered("compare", first, second, "--json")
    found = json.loads(said)
    assert status == 3
    assert found["different_ticks"] == 1 and not found["same"]
    assert found["topics"]["/robot/estimate"]["different"] == 1
    assert found["topics"]["/robot/estimate"]["identical"] == 19
    assert found["first"]["index"] == [1]
    assert found["first"]["second"] == pytest.approx(found["first"]["first"] + 1.0)


def test_a_tick_that_only_one_session_has_is_a_difference_of_that_tick_alone(tmp_path: Path, ticks: list[Tick]) -> None:
    first = small_session(tmp_path / "a.mcap", ticks)
    second = small_session(tmp_path / "b.mcap", ticks[:9] + ticks[10:])
    status, said = answered("compare", first, second, "--json")
    assert status == 3
    assert json.loads(said)["ticks"] == 20
    # The tick after it holds the state that the missing one would have brought, in new messages of its own.
    assert json.loads(said)["different_ticks"] == 1


def test_images_that_a_replay_did_not_copy_are_told_with_what_leaves_them_out(
    tmp_path: Path, ticks: list[Tick]
) -> None:
    first = small_session(tmp_path / "a.mcap", ticks)
    second = small_session(tmp_path / "b.mcap", [replace(tick, frame=None) for tick in ticks], parent=True)
    status, said = answered("compare", first, second)
    assert status == 3
    assert re.search(r"/camera/frame\s.*a\.mcap, 20 ", said)
    assert "--ignore parent,/camera/frame leaves them out" in said
    status, said = answered("compare", first, second, "--ignore", "parent,/camera/frame,drawings")
    assert status == 0, said
    assert "without parent, /camera/frame, drawings" in said.splitlines()[-1]


@pytest.mark.slow("compares two missions whole")
def test_what_is_in_one_session_only_is_one_line_a_topic(tmp_path: Path, ticks: list[Tick]) -> None:
    first = small_session(tmp_path / "a.mcap", ticks)
    second = small_session(tmp_path / "b.mcap", ticks, sets=("recording.leave_out=['/truth/*']",))
    status, said = answered("compare", first, second, "--json")
    found = json.loads(said)
    assert status == 3 and not found["same"]
    assert found["apart"] == {"/truth/robot": "only in a.mcap, 20 messages", "/truth/flow": "only in a.mcap, 1 message"}
    assert found["head"]["configuration"].keys() == {"recording.leave_out"}
    status, said = answered("compare", first, second, "--ignore", "truth", "--ignore", "configuration.recording")
    assert status == 0, said


def test_a_byte_copy_is_one_line(tmp_path: Path, ticks: list[Tick]) -> None:
    first = small_session(tmp_path / "a.mcap", ticks)
    (tmp_path / "b.mcap").write_bytes(first.read_bytes())
    status, said = answered("compare", first, tmp_path / "b.mcap")
    assert status == 0
    assert said == f"a.mcap and b.mcap: identical byte for byte ({first.stat().st_size / 1e6:.1f} MB)\n"


def test_another_origin_is_a_difference_that_can_be_left_out(tmp_path: Path, ticks: list[Tick]) -> None:
    first = small_session(tmp_path / "a.mcap", ticks)
    rewrite(first, tmp_path / "b.mcap", edit_head=edit_of_head("flowrec.provenance", host="elsewhere"), redigest=True)
    status, said = answered("compare", first, tmp_path / "b.mcap")
    assert status == 3
    assert "provenance 1 of 3 DIFFERENT: host (lab, elsewhere)" in " ".join(said.split())
    assert "DIFFERENT in provenance (" in said.splitlines()[-1]
    assert answered("compare", first, tmp_path / "b.mcap", "--ignore", "provenance.host")[0] == 0
    assert answered("compare", first, tmp_path / "b.mcap", "--only", "/robot/*")[0] == 0
    status, said = answered("compare", first, tmp_path / "b.mcap", "--ignore", "provenace")
    assert status != 0 and "0 of" not in said


def test_a_comparison_that_is_stopped_says_what_it_compared(tmp_path: Path, ticks: list[Tick]) -> None:
    first = small_session(tmp_path / "a.mcap", ticks)
    rewrite(first, tmp_path / "b.mcap")
    seen: list[float] = []

    def stopped_at_the_seventh(done_s: float) -> None:
        seen.append(done_s)
        if len(seen) == 7:
            raise KeyboardInterrupt

    with pytest.raises(Ended) as stopped:
        compare(first, tmp_path / "b.mcap", progress=stopped_at_the_seventh)
    found = stopped.value.result
    assert (found.same, found.identical, found.exit_status) == (None, None, 130)
    assert found.lines()[-1].startswith("stopped after 7 of 20 ticks (SIGINT: Ctrl-C); those are identical")
    assert found.as_json()["covered"]["whole"] is False


@pytest.mark.slow("replays a mission")
def test_a_replay_differs_from_its_recording_by_nature_only_and_this_is_said(session: Path, tmp_path: Path) -> None:
    assert answered("replay", session, "--out", tmp_path / "again.mcap", "--json")[0] == 0
    status, said = answered("compare", session, tmp_path / "again.mcap", "--json")
    found = json.loads(said)
    assert status == 3
    assert found["by_nature"] == ["provenance", "parent", "outcome", "diagnostics", "/camera/frame"]
    status, said = answered("compare", session, tmp_path / "again.mcap", "--ignore", ",".join(found["by_nature"]))
    assert status == 0, said
    assert "ticks: identical" in said


def test_a_field_of_tick_without_a_topic_is_an_error() -> None:
    wider = make_dataclass("Tick", [("extra", FlowField | None, None)], bases=(Tick,), frozen=True)
    with pytest.raises(TypeError, match=r"Tick\.extra"):
        topics_of(wider)
