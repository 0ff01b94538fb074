"""Extra topics in a file: any declared type passes it bit for bit, and a wrong declaration is refused in one line."""

from __future__ import annotations

import json
import pickle
import string
from collections.abc import Iterator
from dataclasses import MISSING, dataclass, field, make_dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from flowrec.core import (
    Extra,
    Frame,
    Message,
    SessionError,
    Source,
    Tick,
    Topic,
    TopicTable,
    Track,
    UsageError,
    declaration,
    declared_topic,
    message_fields,
    message_of,
)
from flowrec.core.declarations import Shape, Vector
from flowrec.store import (
    Session,
    SessionReader,
    SessionWriter,
    WriterOptions,
    channels,
    part_path,
    recover,
    recover_run,
)
from flowrec.store.channels import left_out
from flowrec.store.run_files import snapshot_path
from flowrec.store.session_file import Snapshot, Split
from tests.store.drafts import made_up
from tests.store.made_up import HEADER, ticks_of, write_session

PATH = "/pump/pressure"
DTYPES = ["float64", "float32", "uint8", "int64", "uint16"]
NAMES = st.text(string.ascii_lowercase, min_size=1, max_size=8).map(lambda word: f"{word}_v")
NUMBERS: dict[type, Any] = {
    int: st.integers(-(2**63), 2**63 - 1),
    float: st.floats(),
    bool: st.booleans(),
    str: st.text(st.characters(exclude_categories=["Cs"]), max_size=20),
}


@dataclass(frozen=True, slots=True, eq=False)
class Pressure(Message):
    """Pressure of the pump."""

    stamp_ns: int
    pressure_pa: float
    flow_ul_s: Annotated[Vector, Shape("n"), "of each channel"] = field(default_factory=lambda: np.zeros(0))


TOPIC = Topic(PATH, Source.RIG, 1e-6, {"pressure_pa": 1e-3}, type=Pressure)
TOPICS = TopicTable([TOPIC, Topic("/lab/robot2", Source.STAGE, 1e-6, type=Track)])


@st.composite
def fields_of_a_type(draw: st.DrawFn) -> tuple[type[Message], list[Message]]:
    """A declared message type, and a few messages of it."""
    declared: list[Any] = [("stamp_ns", int)]
    values: list[Any] = []
    lengths = {"n": draw(st.integers(0, 4)), "m": draw(st.integers(0, 3)), 2: 2}
    may_follow = True  # a field without a default
    for name in draw(st.lists(NAMES, max_size=6, unique=True)):
        kind = draw(st.sampled_from([*NUMBERS, "vector", "array"]))
        optional = kind != "vector" and draw(st.booleans())
        finite = draw(st.booleans())
        default: Any = MISSING
        if kind in NUMBERS:
            hint = Annotated[kind, *([] if finite else [Shape(finite=False)]), "a number"]
            value = (
                NUMBERS[kind] if kind is not float or not finite else st.floats(allow_nan=False, allow_infinity=False)
            )
            default = draw(st.sampled_from([MISSING, kind(0)]))
        else:
            dtype = np.dtype("float64" if kind == "vector" else draw(st.sampled_from(DTYPES)))
            axes = 1 if kind == "vector" else draw(st.integers(1, 3))
            letters = [draw(st.sampled_from(["n", "m", 2])) if kind == "array" else "n" for _ in range(axes)]
            hint = Annotated[np.ndarray[Any, np.dtype[dtype.type]], kind, Shape(*dict.fromkeys(letters)), "numbers"]
            shape = tuple(lengths[each] for each in dict.fromkeys(letters))
            value = st.integers(0, 200).map(lambda number, s=shape, d=dtype: (number + np.zeros(s)).astype(d))
        if optional:
            hint, value = hint | None, st.none() | value
            default = draw(st.sampled_from([MISSING, None]))
        if default is MISSING and not may_follow:
            continue
        may_follow = may_follow and default is MISSING
        declared.append((name, hint) if default is MISSING else (name, hint, field(default=default)))
        values.append(value)
    kind = make_dataclass("Made", declared, bases=(Message,), frozen=True, slots=True, eq=False)
    kind.__doc__ = "A made-up message."
    sent = [kind(10 * number, *(draw(value) for value in values)) for number in range(1, draw(st.integers(2, 5)))]
    return kind, sent


def bits_of(message: Any) -> list[Any]:
    """The values of a message, arrays and floats as their bytes."""
    values = [getattr(message, each.name) for each in message_fields(type(message))]
    return [
        (value.dtype.str, value.shape, value.tobytes())
        if isinstance(value, np.ndarray)
        else np.float64(value).tobytes() if isinstance(value, float) else value
        for value in values
    ]  # fmt: skip


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(made=fields_of_a_type())
def test_any_declared_type_passes_file_and_table_bit_for_bit_and_needs_no_code(
    tmp_path: Path, made: tuple[type[Message], list[Any]]
) -> None:
    kind, sent = made
    topics = TopicTable([Topic("/lab/made", Source.RIG, type=kind)])
    path = tmp_path / "a.mcap"
    write_session(
        path,
        (Tick(message.stamp_ns, extra=Extra({"/lab/made": message})) for message in sent),
        overwrite=True,
        topics=topics,
    )
    with Session(path) as session:
        read = list(session.messages("/lab/made"))
        table = session.table("/lab/made")
    assert [bits_of(each) for each in read] == [bits_of(each) for each in sent]
    assert type(read[0]) is not kind and type(pickle.loads(pickle.dumps(read[0]))) is type(read[0])
    assert all(topics.as_declared(each, "/lab/made").same_as(one) for each, one in zip(read, sent, strict=True))
    assert message_fields(type(read[0])) == tuple(message_fields(kind))
    for each in message_fields(kind):
        column = next((name for name in (each.name, f"made_{each.name}") if name in table.column_names), None)
        if column is not None and each.dtype is None:
            cells = [value if value is None else each.kind(value) for value in table[column].to_pylist()]
            wanted = [getattr(message, each.name) for message in sent]
            assert list(map(repr, cells)) == list(map(repr, wanted))
        elif column is not None:
            flat = [None if cell is None else np.ravel(np.array(cell)) for cell in table[column].to_pylist()]
            wanted = [None if (a := getattr(message, each.name)) is None else a.ravel() for message in sent]
            for cell, array in zip(flat, wanted, strict=True):
                assert (cell is None) is (array is None)
                assert array is None or cell.size == 0 == array.size or np.array_equal(cell.astype(each.dtype), array)
        else:
            assert each.dtype is not None and each.shape is not None and each.shape.lengths in ((2,), (3,))


def sent_ticks(count: int = 60) -> Iterator[Tick]:
    """Ticks with extra messages now and then."""
    rng, extra = np.random.default_rng(0), Extra()
    for number, tick in enumerate(ticks_of(count, shape=(8, 8))):
        if number % 9 == 4:
            extra = extra.with_messages({PATH: Pressure(tick.stamp_ns, rng.random(), rng.random(number % 4))})
        if number % 4 == 1:
            extra = extra.with_messages({"/lab/robot2": made_up(Track, tick.stamp_ns, number, rng)})
        yield replace(tick, extra=extra)


def same_extra(one: Tick, other: Tick) -> bool:
    return one.extra.keys() == other.extra.keys() and all(
        bits_of(one.extra[path]) == bits_of(other.extra[path]) for path in one.extra
    )


def recorded(path: Path, **options: Any) -> list[Tick]:
    ticks = list(sent_ticks())
    write_session(path, ticks, topics=TOPICS, **options)
    return ticks


def recorded_one(path: Path, topic: str, message: Message) -> None:
    options = WriterOptions(block=True, topics=TOPICS, keep_failed=False)
    with SessionWriter(path, HEADER, options) as writer:
        writer.write(Tick(1, extra=Extra({topic: message})))


def test_parts_of_a_run_hold_extra_messages_and_each_begins_with_the_latest_ones(tmp_path: Path) -> None:
    ticks = recorded(tmp_path / "a.mcap", files=Split(seconds=0.25))
    with SessionReader(tmp_path / "a.mcap") as run:
        assert len(run.files) > 3
        assert all(same_extra(one, other) for one, other in zip(ticks, run.ticks(), strict=True))
        assert run.counts[PATH] == 7 and run.counts["/lab/robot2"] == 15
        middle = ticks[33]
        assert same_extra(run.tick_before(middle.stamp_ns), middle)
    with SessionReader(part_path(tmp_path / "a.mcap", 3)) as part:
        first = next(part.ticks())
        before = next(tick for tick in ticks if tick.stamp_ns == part.keyframe_ns)
        assert before.extra[PATH].stamp_ns < before.stamp_ns, "it is held, not new, when the part begins"
        assert same_extra(first, before)


def test_a_snapshot_begins_with_the_extra_messages_that_are_held(tmp_path: Path) -> None:
    ticks = list(sent_ticks())
    options = WriterOptions(block=True, topics=TOPICS, files=Snapshot(before_s=0.1, after_s=0.1))
    with SessionWriter(tmp_path / "a.mcap", HEADER, options) as writer:
        for tick in ticks:
            writer.write(tick)
        writer.close(why="a test")
    with SessionReader(snapshot_path(tmp_path / "a.mcap", len(writer.files))) as snapshot:
        known = {tick.stamp_ns: tick for tick in ticks}
        seen = list(snapshot.ticks())
        assert seen and all(same_extra(tick, known[tick.stamp_ns]) for tick in seen)


def test_a_recovered_session_keeps_extra_messages(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    ticks = recorded(path, flush_s=0.1)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(path.read_bytes()[: path.stat().st_size * 3 // 4])
    done = recover(cut)
    with SessionReader(done.path) as reader:
        kept = list(reader.ticks())
        assert 20 < len(kept) <= len(ticks)
        assert all(same_extra(one, other) for one, other in zip(kept, ticks, strict=False) if one.track is not None)
        assert reader.counts[PATH] >= 2


def test_the_end_of_a_run_whose_last_part_is_gone_holds_the_extra_messages(tmp_path: Path) -> None:
    recorded(tmp_path / "a.mcap", files=Split(seconds=0.25))
    part_path(tmp_path / "a.mcap", 4).unlink()
    recover_run(tmp_path / "a.mcap")
    with SessionReader(tmp_path / "a.mcap") as run, SessionReader(part_path(tmp_path / "a.mcap", 4)) as end:
        assert same_extra(end.tick_before(end.last_ns), run.tick_before(run.last_ns))
        assert len(end.tick_before(end.last_ns).extra) == 2


def test_two_types_of_one_name_are_kept_apart_in_one_file_and_in_one_process(tmp_path: Path) -> None:
    other = make_dataclass(
        "Pressure", [("stamp_ns", int), ("text", str)], bases=(Message,), frozen=True, slots=True, eq=False
    )
    topics = TopicTable([TOPIC, Topic("/lab/pressure", Source.SIMULATOR, type=other)])
    with SessionWriter(tmp_path / "a.mcap", HEADER, WriterOptions(block=True, topics=topics)) as writer:
        writer.write(Tick(1, extra=Extra({PATH: Pressure(1, 2.0), "/lab/pressure": other(1, "high")})))
    extra = Session(tmp_path / "a.mcap").last.extra
    assert (extra[PATH].pressure_pa, extra["/lab/pressure"].text) == (2.0, "high")  # type: ignore[attr-defined]


def test_what_a_replay_needs_of_the_extra_topics_can_not_be_left_out() -> None:
    topics = TopicTable([TOPIC, Topic("/lab/truth", Source.SIMULATOR, type=Pressure)])
    assert left_out(["/lab/*"], topics) == {"/lab/truth"}
    with pytest.raises(UsageError, match=f"a replay needs {PATH}; what can be left out is .*/lab/truth"):
        left_out([PATH], topics)


def test_a_tick_without_extra_topics_shares_one_empty_mapping() -> None:
    assert Tick().extra is Tick(3).extra
    assert message_of(Tick(), PATH) is None and not Tick().extra
    with pytest.raises(TypeError):
        Tick().extra[PATH] = Pressure(0, 1.0)  # type: ignore[index]


def test_a_message_of_a_topic_that_is_not_declared_is_refused_and_one_of_another_type(tmp_path: Path) -> None:
    matrix = Pressure(1, 1.0, np.ones((2, 2)))
    with pytest.raises(SessionError, match=r"/pump/pressure: flow_ul_s has the shape \(2, 2\) where \(n\) belongs"):
        recorded_one(tmp_path / "b.mcap", PATH, matrix)
    for message, path in ((Pressure(1, 1.0), "/pump/other"), (Pressure(1, 1.0), "/lab/robot2")):
        with pytest.raises(SessionError, match=f"no topic {path} of Pressure is declared"):
            recorded_one(tmp_path / "b.mcap", path, message)
    assert not list(tmp_path.iterdir())


class Shapeless(Message):
    """A message type that nobody can record."""


UNFIT: list[tuple[dict[str, Any], str]] = [
    ({"path": "/robot/track"}, "is a topic of flowrec"),
    ({"path": "/view/pressure"}, "is no path of a topic"),
    ({"path": "pump"}, "is no path of a topic"),
    ({"path": "/pump/../x"}, "is no path of a topic"),
    ({"path": "/p" * 100}, "is no path of a topic"),
    ({"source": Source.WORKER}, "its source is WORKER"),
    ({"source": Source.CAMERA}, "its source is CAMERA"),
    ({"type": Frame}, "Frame"),
    ({"type": Shapeless}, "is no dataclass"),
    ({"type": make_dataclass("A", [("x", int)], bases=(Message,))}, "stamp_ns: int"),
    ({"type": make_dataclass("A", [("stamp_ns", int), ("x", Vector)], bases=(Message,))}, "has no shape"),
    ({"type": make_dataclass("A", [("stamp_ns", int), ("x", dict)], bases=(Message,))}, "no wire form"),
    ({"rtol": -1.0}, "tolerances"),
    ({"atols": {"nothing": 1.0}}, "tolerances"),
]


def test_a_topic_that_can_be_none_is_refused_in_one_line_and_so_are_two_of_one_path() -> None:
    for change, said in UNFIT:
        with pytest.raises(UsageError) as refused:
            TopicTable([replace(TOPIC, **change)])
        assert said in str(refused.value) and "\n" not in str(refused.value)
    with pytest.raises(UsageError, match="declared twice"):
        TopicTable([TOPIC, replace(TOPIC, source=Source.STAGE)])


def edited(change: dict[str, Any], of_field: dict[str, Any] | None = None) -> str:
    """The declaration of the pressure with other entries, of the whole and of its last field."""
    stated = json.loads(declaration(TOPIC)) | change
    if of_field is not None:
        stated["fields"][-1] |= of_field
    return json.dumps(stated)


HOSTILE = {
    "not JSON": "{",
    "another value": "[]",
    "nothing": "{}",
    "deep": "[" * 10_000,
    "large": edited({"meaning": "x" * 100_000}),
    "many fields": edited({"fields": [{"name": f"a{n}", "kind": "int", "meaning": ""} for n in range(300)]}),
    "unknown source": edited({"source": "NOBODY"}),
    "a source of ours": edited({"source": "WORKER"}),
    "tolerance": edited({"rtol": -1}),
    "infinite tolerance": edited({}).replace('"rtol": 1e-06', '"rtol": Infinity'),
    "huge tolerance": edited({}).replace('"rtol": 1e-06', '"rtol": 1e999'),
    "tolerance of no field": edited({"atols": {"x": 1.0}}),
    "a name that is no identifier": edited({"type": "a b"}),
    "a field that is no identifier": edited({}, {"name": "a; import os"}),
    "a field of Python": edited({}, {"name": "__init__"}),
    "a field of Message": edited({}, {"name": "same_as"}),
    "a keyword": edited({}, {"name": "class"}),
    "the same name twice": edited({}, {"name": "stamp_ns"}),
    "unknown kind": edited({}, {"kind": "eval"}),
    "an object of Python": edited({}, {"kind": "array", "dtype": "object"}),
    "a text as array": edited({}, {"kind": "array", "dtype": "U10"}),
    "a shape of words": edited({}, {"shape": ["height"]}),
    "negative length": edited({}, {"shape": [-1]}),
    "too many axes": edited({}, {"shape": ["n"] * 20}),
    "no shape": edited({}, {"shape": []}),
    "default of another kind": edited({}, {"default": "words"}),
    "optional is no truth value": edited({}, {"optional": "yes"}),
    "no stamp": edited({"fields": json.loads(declaration(TOPIC))["fields"][1:]}),
    "fields that are none": edited({"fields": [1, 2]}),
}


def test_a_hostile_declaration_is_refused_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, text in HOSTILE.items():
        with pytest.raises(UsageError) as refused:
            declared_topic(PATH, text)
        assert "\n" not in str(refused.value) and len(str(refused.value)) < 500, name
    with pytest.raises(UsageError, match="is a topic of flowrec"):
        declared_topic("/robot/track", declaration(TOPIC))
    monkeypatch.setattr(channels, "declaration", lambda _topic: HOSTILE["unknown kind"])
    recorded(tmp_path / "a.mcap", leave_out=("/view/*",))  # or it would be read to be drawn
    with pytest.raises(SessionError, match=r"a\.mcap: the declaration of '/pump/pressure' is damaged") as broken:
        Session(tmp_path / "a.mcap").last  # noqa: B018
    assert "\n" not in str(broken.value)


def test_a_declaration_of_one_of_our_types_makes_that_type_and_one_like_it_does_not() -> None:
    stated = declaration(Topic("/lab/robot2", Source.RIG, type=Track))
    assert declared_topic("/lab/robot2", stated).type is Track
    other = json.loads(stated)
    other["fields"] = other["fields"][:3]
    assert declared_topic("/lab/robot2", json.dumps(other)).type is not Track
