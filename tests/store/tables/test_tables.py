"""Tables: each message is a row, each number is in a column that says its unit and meaning."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import flowrec
from flowrec.core import (
    BY_FIELD,
    TOPICS,
    Applied,
    Currents,
    Estimate,
    SessionError,
    Tick,
    as_read,
    message_fields,
    summary_of,
    unit_of,
)
from flowrec.store import Session, SessionWriter, WriterOptions, columns_of
from flowrec.store.tables import Tables
from tests.store.drafts import made_up
from tests.store.hostile import STATE, file_of, with_message
from tests.store.made_up import HEADER, encode, write_session

GOLDEN = Path(__file__).parents[3] / "sessions" / "golden.mcap"


def same(cell: Any, value: Any) -> bool:
    """Whether a cell of Python values holds a number, a text or an array, bit for bit, NaN among them."""
    if value is None or cell is None:
        return cell is value
    return bool(np.array_equal(np.asarray(cell, np.asarray(value).dtype), value, equal_nan=not isinstance(value, str)))


def rows_of(topic: str, messages: list[Any]) -> list[dict[str, Any]]:
    names = [each.name for each in message_fields(BY_FIELD[topic].type)]
    cells = [[getattr(message, name) for name in names] for message in messages]
    plain = [[tuple(c) if isinstance(c, np.ndarray) and c.ndim == 1 else c for c in row] for row in cells]
    found = list(Tables(10**18).batches((topic, tuple(row)) for row in plain))
    return [row for _, batch in found for row in batch.to_pylist()]


def differences(topic: str, rows: list[dict[str, Any]], messages: list[Any]) -> list[str]:
    assert len(rows) == len(messages)
    found = []
    for row, message in zip(rows, messages, strict=True):
        for column in columns_of(topic):
            if column.field:
                value = getattr(message, column.field)
                value = value if column.component is None else value[column.component]
                if not same(row[column.name], value):
                    found.append(f"{topic}.{column.name}: {row[column.name]} where {value} belongs")
    return found


def test_the_meaning_of_a_column_is_its_own_and_not_that_of_its_topic_or_a_part_of_a_sentence() -> None:
    for topic in TOPICS:
        leans = re.compile(rf"([xyz]: )?({re.escape(summary_of(topic.type))}|of|the same|where|enums|None|NaN)\b")
        assert [column.name for column in columns_of(topic.field) if leans.match(column.meaning)] == []


READ = [topic.field for topic in TOPICS if topic.field != "frame"]


def test_a_table_holds_every_number_of_the_messages_and_their_stamps_to_the_nanosecond() -> None:
    session = flowrec.open(GOLDEN)
    for topic in READ:
        messages = list(session.messages(topic))
        table = session.table(topic)
        assert differences(topic, table.to_pylist(), messages) == []
        assert table["stamp_ns"].to_pylist() == [message.stamp_ns for message in messages], topic
        assert table["time_s"].to_pylist() == [message.stamp_ns / 1e9 for message in messages], topic
        assert table["wall_time"].null_count == len(messages)  # this file does not state when its clock was 0


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_nan_and_infinity_stay_what_they_are_and_what_is_not_stated_is_empty(bad: float) -> None:
    for topic in READ:
        assert_kept(topic, bad)


def assert_kept(topic: str, bad: float) -> None:
    message = made_up(BY_FIELD[topic].type, 10**9, 3, np.random.default_rng(0))
    floats = [each for each in message_fields(type(message)) if each.is_float]
    worse = {
        each.name: bad if each.dtype is None else np.full_like(getattr(message, each.name), bad)
        for each in floats
        if each.dtype is None or getattr(message, each.name) is not None
    }
    empty = {each.name: None for each in message_fields(type(message)) if each.optional}
    with as_read():
        messages = [message, dataclasses.replace(message, **worse), dataclasses.replace(message, **empty)]
    rows = rows_of(topic, messages)
    assert differences(topic, rows, messages) == []
    assert [row["wall_time"].value for row in rows] == [10**9 + 10**18] * 3


def test_a_table_of_other_than_three_coils_has_a_numbered_column_a_coil_and_one_that_changes_is_an_error(
    tmp_path: Path,
) -> None:
    given = np.arange(6.0)
    for coils, names in ((1, "1"), (2, "xy"), (3, "xyz"), (6, "123456")):
        path = tmp_path / f"{coils}.mcap"
        with SessionWriter(path, HEADER, WriterOptions(block=True)) as writer:
            for number in (1, 2):
                currents = given[:coils] * number
                applied = Applied(number, 1.0, 0.0, 1.0, currents, np.zeros(2))
                sent = Currents(number, 1.0, 0.0, 1.0, 0.0, currents, False, voltages_v=currents)
                writer.write(Tick(number, applied=applied, currents=sent))
        with flowrec.open(path) as session:
            for topic in ("applied", "currents"):
                table = session.table(topic)
                columns = [name for name in table.column_names if name.startswith("currents_")]
                assert columns == [f"currents_{name}_a" for name in names]
                assert [table[name][1].as_py() for name in columns] == (2.0 * given[:coils]).tolist()
                assert table.schema == session.schema(topic)
            assert session.table("currents")["voltages_v"].to_pylist()[1] == (2.0 * given[:coils]).tolist()
    write_session(
        tmp_path / "a.mcap",
        (
            Tick(stamp_ns, applied=Applied(stamp_ns, 1.0, 0.0, 1.0, given[:coils], np.zeros(2)))
            for stamp_ns, coils in ((1, 3), (2, 2), (3, 4))
        ),
    )
    with pytest.raises(SessionError, match="/coils/applied: currents_a has not 3 numbers in each message"):
        flowrec.open(tmp_path / "a.mcap").table("applied")


def test_the_table_of_the_images_has_the_stamp_of_each_without_reading_one(monkeypatch: pytest.MonkeyPatch) -> None:
    session = flowrec.open(GOLDEN)
    stamps = [frame.stamp_ns for frame in session.frames]
    monkeypatch.setattr("flowrec.store.mcap_reader.McapReader.content", lambda *_: pytest.fail("read"))
    table = flowrec.open(GOLDEN).table("frame")
    assert table["stamp_ns"].to_pylist() == stamps
    assert set(table["bits"].to_pylist()) == {8}


def test_every_column_has_a_meaning_and_the_unit_that_its_name_ends_in() -> None:
    for topic in TOPICS:
        for field in Tables(0).schema(topic.field):
            assert field.metadata[b"meaning"], f"{topic.field}.{field.name}"
            assert field.metadata[b"unit"].decode() == unit_of(field.name)
        names = Tables(0).schema(topic.field).names
        assert len(set(names)) == len(names)
    meanings = {each.name: each.meaning for each in message_fields(Estimate)}
    assert meanings["flow_um_s"] == "the disturbance: flow velocity at the robot"
    slopes = "gradient of the flow at the robot (3,): dvx/dx, dvx/dy, dvy/dx; dvy/dy = -dvx/dx. (0,): not known"
    assert meanings["slopes_per_s"] == slopes
    units = [unit_of(name) for name in ("x_um", "u_um_s", "stamp_ns", "viscosity_mpa_s", "nis", "wall_time", "gas")]
    assert units == ["um", "um/s", "ns", "mPa*s", "", "", ""]
    ratios = [unit_of(name) for name in ("slew_a_s", "mt_per_a", "a_per_v", "v_per_v", "points_per_px", "rate_1_s")]
    assert ratios == ["A/s", "mT/A", "A/V", "1", "1/px", "1/s"]


def test_a_message_that_makes_no_sense_is_an_error_in_a_table_too(tmp_path: Path) -> None:
    estimate = made_up(Estimate, 10**9, 0, np.random.default_rng(0))
    assert isinstance(estimate, Estimate)
    for payload, why in (
        (encode(dataclasses.replace(estimate, position_um=np.zeros(0))), r"position_um has the shape \(0,\)"),
        (b"\xff\xff\xff", "damaged Estimate"),
    ):
        path = file_of(
            tmp_path, with_message(STATE, lambda sent, data=payload: dataclasses.replace(sent, payload=data))
        )
        with pytest.raises(SessionError, match=why):
            Session(path).table("estimate")
    with pytest.raises(SessionError, match="there is no topic 'tracks'; did you mean 'track'"):
        flowrec.open(GOLDEN).table("tracks")


def test_a_run_in_parts_has_the_table_of_the_whole(tmp_path: Path) -> None:
    from flowrec.stages import load_config
    from tests.short_missions import SMALL

    whole = flowrec.record(load_config(None, [*SMALL, "duration_s=0.4", "recording.split_s=0.1"]), tmp_path / "a.mcap")
    session = flowrec.open(whole.path)
    assert len(session.run.files) > 2
    table = session.table("estimate")
    stamps = [message.stamp_ns for message in session.messages("estimate")]
    assert table["stamp_ns"].to_pylist() == stamps
    assert session.table("frame")["stamp_ns"].to_pylist() == [frame.stamp_ns for frame in session.frames]
    start = session.header.start_unix_ns
    assert table["wall_time"].cast("int64").to_pylist() == [start + stamp for stamp in stamps]
