"""What a viewer finds in an .rrd file."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pyarrow as pa
import pytest
from rerun import RecordingStream
from rerun.chunk import RrdReader

from flowrec.core import RRD, Drops, Health, OperatorEvent, Output, SessionError, Tick
from flowrec.exports import rrd
from flowrec.store import Session
from flowrec.view import Scene, summary_document, write_rrd
from flowrec.view.logger import TickLogger
from flowrec.view.rrd_file import open_stream

NONE, TWO = np.zeros(0), np.zeros(2)


class File:
    """An .rrd read back: rows and timelines by entity, and what its views ask for."""

    def __init__(self, path: Path) -> None:
        reader = RrdReader(path)
        (self.recording,) = reader.recordings()
        (layout,) = reader.blueprints()
        self.rows: dict[str, int] = defaultdict(int)
        self.times: dict[str, set[str]] = defaultdict(set)
        self.columns: dict[str, dict[str, list[object]]] = defaultdict(lambda: defaultdict(list))
        for chunk in reader.stream(store=self.recording):
            self.rows[chunk.entity_path] += chunk.num_rows
            self.times[chunk.entity_path] |= set(chunk.timeline_names)
            batch = chunk.to_record_batch()
            for name in batch.schema.names:
                column = batch.column(name)
                # A duration as a Python object is not exact to the nanosecond.
                whole = column.cast(pa.int64()) if pa.types.is_duration(column.type) else column
                self.columns[chunk.entity_path][name] += whole.to_pylist()
        found: dict[str, dict[str, list[str]]] = defaultdict(dict)
        self.time_axes: dict[str, str] = {}  # by the view
        for chunk in reader.stream(store=layout):
            batch = chunk.to_record_batch()
            if "TimeAxis:view_range" in batch.schema.names:
                self.time_axes[chunk.entity_path] = str(batch.column("TimeAxis:view_range").to_pylist()[-1])
            view = chunk.entity_path.removesuffix("/ViewContents")
            for name in batch.schema.names:
                if name.startswith(("ViewBlueprint:", "ViewContents:query")):
                    found[view][name.split(":")[1]] = batch.column(name).to_pylist()[-1]
        kinds = [view["class_identifier"][0] for view in found.values() if "class_identifier" in view]
        self.over_time = sum(kind in ("TimeSeries", "StateTimeline") for kind in kinds)
        self.panels = [
            chunk.to_record_batch().column("TimePanelBlueprint:play_state").to_pylist()[-1]
            for chunk in reader.stream(store=layout)
            if "TimePanelBlueprint:play_state" in chunk.to_record_batch().schema.names
        ]
        self.views = {
            view["display_name"][0]: [
                term.removeprefix("+ ").replace("$origin", view["space_origin"][0])
                for term in view["query"]
                if not term.startswith("-")
            ]
            for view in found.values()
            if "query" in view
        }

    def holds(self, query: str) -> bool:
        """Whether there is anything below `a/**` or at `a`."""
        if query.endswith("/**"):
            return any(entity.startswith(query[:-2]) for entity in self.rows)
        return self.rows.get(query, 0) > 0


@pytest.fixture(scope="module")
def single(tmp_path_factory: pytest.TempPathFactory, scene: Scene, ticks: list[Tick]) -> File:
    path = tmp_path_factory.mktemp("single") / "session.rrd"
    write_rrd(path, scene, {"": ticks})
    return File(path)


@pytest.fixture(scope="module")
def double(
    tmp_path_factory: pytest.TempPathFactory, scene: Scene, ticks: list[Tick], made_up: Callable[..., Iterator[Tick]]
) -> File:
    path = tmp_path_factory.mktemp("double") / "session.rrd"
    # As a replay comes: without frames, and with another flow, faster in the upper branch.
    again = (replace(tick, frame=None) for tick in made_up(120, seed=1, share=0.9))
    write_rrd(path, scene, {"recorded": ticks, "replayed": again})
    return File(path)


def test_everything_that_a_view_asks_for_is_in_the_file(single: File) -> None:
    camera = "Robot (orange), route (cyan), flow"
    assert {camera, "Assumed flow", "Refined flow", "Uncertainty (1 σ)", "Events"} < set(single.views)
    (lanes,) = (name for name in single.views if name.startswith("Mission"))
    assert lanes == "Mission: survey 0.0 s, refine 0.5 s, navigate 0.6 s"
    assert single.views[lanes] == ["/Mission", "/Robot"]
    empty = {(name, query) for name, queries in single.views.items() for query in queries if not single.holds(query)}
    # Nobody intervened in this run; the operator's words would stand in the same view as the events.
    assert empty == {("Events", "/run/operator")}


def test_everything_that_a_view_of_a_replay_asks_for_is_in_the_file(double: File) -> None:
    assert {"Refined, recorded", "Refined, replayed", "Heading (°)"} < set(double.views)
    empty = {query for queries in double.views.values() for query in queries if not double.holds(query)}
    assert empty == {"/recorded/run/operator", "/replayed/run/operator"}


def test_a_view_that_would_stay_empty_is_left_out(tmp_path: Path, scene: Scene, ticks: list[Tick]) -> None:
    bare = [replace(tick, true_field=None, truth=None, refined=None) for tick in ticks[:5]]
    write_rrd(tmp_path / "bare.rrd", scene, {"": bare})
    views = File(tmp_path / "bare.rrd").views
    assert "Assumed flow" in views
    assert not {
        name for name in views if "True" in name or "efined" in name or "ncertain" in name or "Estimate" in name
    }


def test_the_timelines_are_session_time_to_the_nanosecond_and_frame(
    tmp_path: Path, scene: Scene, ticks: list[Tick]
) -> None:
    late = 123_456_789_123_456_789  # four years, which a float does not hold to the nanosecond
    tick = replace(ticks[7], stamp_ns=late)
    write_rrd(tmp_path / "late.rrd", scene, {"": [tick]})
    file = File(tmp_path / "late.rrd")
    assert set().union(*file.times.values()) == {"session time", "frame"}
    stamps = [stamp for stamp in file.columns["/camera/measured/image"]["session time"] if stamp is not None]
    assert stamps == [late]
    assert file.columns["/camera/measured/image"]["frame"] == [7]


def test_a_replay_without_frames_lies_on_the_frames_of_the_recording(double: File) -> None:
    frames = double.columns["/replayed/camera/robot"]["frame"]
    assert [frame for frame in frames if frame is not None] == list(range(120))


def cells(path: Path) -> set[tuple[str, ...]]:
    """Every value of a recording with its entity, its times and its component."""
    reader = RrdReader(path)
    (recording,) = reader.recordings()
    found = set()
    for chunk in reader.stream(store=recording):
        if chunk.entity_path.startswith("/__"):
            continue
        batch = chunk.to_record_batch()
        columns = {
            name: (column.cast(pa.int64()) if pa.types.is_duration(column.type) else column).to_pylist()
            for name, column in zip(batch.schema.names, batch.columns, strict=True)
            if not name.startswith("rerun.controls")
        }
        for row in range(chunk.num_rows):
            times = str(columns["session time"][row]) if "session time" in columns else ""
            times += f", {columns['frame'][row]}" if "frame" in columns else ""
            found |= {(chunk.entity_path, times, name, str(values[row])) for name, values in columns.items()}
    return {cell for cell in found if cell[-1] != "None"}


@pytest.mark.slow("logs a mission twice")
def test_a_file_holds_what_a_live_viewer_is_sent_row_by_row(tmp_path: Path, scene: Scene, ticks: list[Tick]) -> None:
    ticks = [
        replace(tick, truth=tick.truth if number % 3 else None) for number, tick in enumerate(ticks)
    ]  # fewer lines
    write_rrd(tmp_path / "file.rrd", scene, {"": ticks})
    with open_stream(scene) as stream:
        stream.save(tmp_path / "live.rrd")
        logger = TickLogger(stream, scene)
        for tick in ticks:
            logger.log(tick)
    stream.disconnect()
    file, live = cells(tmp_path / "file.rrd"), cells(tmp_path / "live.rrd")
    assert len(live) > 20 * len(ticks) and file == live


def test_what_is_not_new_is_not_logged_again(single: File) -> None:
    static = 1  # where the map lies
    assert single.rows["/flow/assumed/speed"] == single.rows["/flow/refined/speed"] == 1 + static
    assert single.rows["/camera/flow\\ arrows"] == 2  # assumed, then refined
    assert single.rows["/camera/measured/image"] == 120 + static


def test_title_and_properties_are_those_of_the_scene(single: File) -> None:
    assert single.recording.application_id == "flowrec"
    assert single.columns["/__properties"]["RecordingInfo:name"][-1] == ["a made-up mission"]
    assert single.columns["/__properties/session"]["operator"] == [["nobody"]]


def test_a_file_that_breaks_off_does_not_appear(tmp_path: Path, scene: Scene, ticks: list[Tick]) -> None:
    def breaks_off() -> Iterator[Tick]:
        yield from ticks[:3]
        raise SessionError("damaged")

    with pytest.raises(SessionError, match="damaged"), Output(tmp_path / "half.rrd", RRD).new_file() as part:
        write_rrd(part, scene, {"": breaks_off()})
    assert list(tmp_path.iterdir()) == []


def test_a_place_that_cannot_be_written_is_said_in_one_line(tmp_path: Path, scene: Scene, ticks: list[Tick]) -> None:
    output = Output(tmp_path / "nowhere" / "session.rrd", RRD)
    with (
        pytest.raises(SessionError, match="nowhere"),
        output.new_file() as part,
    ):
        write_rrd(part, scene, {"": ticks})


def test_the_view_opens_at_the_start_and_plays(single: File) -> None:
    assert single.panels == [["Playing"]] or single.panels == [[2]]


def test_all_plots_and_the_lanes_of_states_have_one_time_axis(single: File, double: File) -> None:
    for file in (single, double):
        assert len(file.time_axes) == file.over_time > 5
        assert len(set(file.time_axes.values())) == 1


def test_marks_alarms_and_losses_have_lanes_with_words_and_the_error_ends_with_the_mission(
    tmp_path: Path, scene: Scene, ticks: list[Tick]
) -> None:
    mark = OperatorEvent(ticks[10].stamp_ns, "mark", "bubble <b>")
    drops = Drops(ticks[40].stamp_ns, "/camera/frame", 3, 0, 2)

    def eventful() -> Iterator[Tick]:
        for i, tick in enumerate(ticks[:90]):
            assert tick.mission is not None
            now = tick.stamp_ns
            mission = replace(tick.mission, finished=i >= 60, outcome="reached" if i >= 60 else "")
            health = Health(now, "nis; pulsation" if 20 <= i < 30 else "", 2.0, 0, 0, 0, 0, 0, NONE, NONE, NONE, TWO, 0)
            yield replace(
                tick,
                mission=mission,
                health=health,
                operator=mark if i >= 10 else None,
                drops=drops if i >= 40 else None,
            )

    write_rrd(tmp_path / "eventful.rrd", scene, {"": eventful()})
    file = File(tmp_path / "eventful.rrd")

    def states(lane: str) -> list[object]:
        return [value[0] for value in file.columns[lane]["StateChange:state"] if value]  # type: ignore[index]

    (lanes,) = (name for name in file.views if name.startswith("Mission: survey 0.0 s, refine"))
    assert "reached" in lanes
    assert file.views[lanes] == ["/Mission", "/Observer", "/Operator", "/Recording", "/Robot"]
    assert states("/Mission") == ["Survey", "Refine", "Navigate", "Reached"]
    assert states("/Operator") == ["bubble <b>", ""]
    assert states("/Observer") == ["motion not explained, flow pulsates", ""]
    assert states("/Recording") == ["3 lost, every 2. kept"]
    stamps = [at for at in file.columns["/robot/tracking\\ error"]["session time"] if isinstance(at, int)]
    assert max(stamps) < ticks[60].stamp_ns <= max(file.columns["/camera/robot"]["session time"][1:])  # type: ignore[type-var]


@pytest.mark.parametrize(("outcome", "stated"), [("time over", "time over"), ("replayed", "")])
def test_the_last_tick_of_a_run_that_was_stopped_states_the_outcome_of_its_file(
    ticks: list[Tick], outcome: str, stated: str
) -> None:
    session = cast(Session, SimpleNamespace(outcome={"outcome": outcome}))
    *before, last = rrd._with_end(session, ticks)
    assert len(before) == len(ticks) - 1 and all(a is b for a, b in zip(before, ticks, strict=False))
    assert last.mission is not None and last.estimate is ticks[-1].estimate
    assert (last.mission.outcome, last.mission.finished) == (stated, bool(stated))
    assert not stated or last.mission.since_ns == ticks[-1].stamp_ns


def test_text_of_a_session_is_no_markdown_in_the_summary(tmp_path: Path, scene: Scene, ticks: list[Tick]) -> None:
    summary = summary_document(["a|b"], [("outcome", "[x](http://x) <script> | \x1b[31m", None)], ["*remark*"])
    write_rrd(tmp_path / "s.rrd", scene, {"": ticks[:2]}, summary=summary)
    (text,) = File(tmp_path / "s.rrd").columns["/summary"]["TextDocument:text"][-1]  # type: ignore[misc]
    assert "a\\|b" in text
    assert "\\[x\\]\\(http" in text
    assert "\\<script\\>" in text
    assert "\x1b" not in text
    assert "\\*remark\\*" in text


def test_rerun_is_waited_for_only_as_long_as_the_file_grows(
    tmp_path: Path, scene: Scene, ticks: list[Tick], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where its thread could not write, its own wait may never end; a slow disk is no error."""
    waited: list[float] = []
    really = RecordingStream.flush

    def flush(stream: RecordingStream, *, timeout_sec: float = 1e38) -> None:
        really(stream)  # what Rerun's own thread has to write does not count here
        waited.append(timeout_sec)
        if len(waited) < 3:
            with (tmp_path / next(tmp_path.iterdir()).name).open("ab") as file:
                file.write(b"more")
        raise RuntimeError("timed out")

    monkeypatch.setattr(RecordingStream, "flush", flush)
    write_rrd(tmp_path / "slow.rrd", scene, {"": ticks[:2]})
    assert len(waited) == 3 and max(waited) <= 60.0
