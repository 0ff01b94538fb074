import contextlib
import dataclasses
from dataclasses import dataclass

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from flowrec.core import (
    TOPICS,
    Event,
    FlowField,
    Frame,
    Matrix,
    Message,
    OperatorEvent,
    SessionError,
    Track,
    as_read,
    defaulted_fields,
    message_fields,
)
from flowrec.core.declarations import Vector, array_fields
from flowrec.store import codec
from flowrec.store.channels import message_codec
from tests.store.made_up import decode, encode

TYPES = sorted({topic.type for topic in TOPICS}, key=lambda kind: kind.__name__)
TEXTS = st.text(st.characters(exclude_categories=("Cs",)), max_size=20)


def bits_of(array):
    """Any bit pattern, so NaNs of every kind, infinities, -0 and denormals are among them."""
    return hnp.arrays(np.dtype(f"u{array.dtype.itemsize}"), array.shape).map(lambda bits: bits.view(array.dtype))


@dataclass(frozen=True, slots=True, eq=False)
class Maybe(Message):
    stamp_ns: int
    number: float | None
    count: int | None
    word: str | None
    vector: Vector | None
    matrix: Matrix | None


@st.composite
def messages(draw, kind):
    dtypes = dict(array_fields(kind))
    values = {}
    for form in message_fields(kind):
        if form.optional and draw(st.booleans()):
            values[form.name] = None
        elif kind is OperatorEvent and form.is_float:  # finite numbers as JSON; of a goal there are none or two
            finite = st.floats(allow_nan=False, allow_infinity=False)
            values[form.name] = draw(finite) if form.kind is float else np.array(draw(st.lists(finite, max_size=3)))
        elif form.name in dtypes:
            dims = {"vector": (1, 1), "array": (0, 3)}[form.kind] if kind is not Frame else (2, 2)
            shape = draw(hnp.array_shapes(min_dims=dims[0], max_dims=dims[1], min_side=0, max_side=4))
            values[form.name] = draw(bits_of(np.empty(shape, dtypes[form.name])))
        elif kind is Frame and form.name == "bits":
            values[form.name] = 8  # of other depths: test_frame_encodings.py
        elif kind is Frame and form.name == "index":
            values[form.name] = draw(st.integers(0, 2**32 - 1))
        elif kind in (Frame, Event, OperatorEvent) and form.kind is int:
            values[form.name] = draw(st.integers(-(10**17), 2**63 - 1))  # Timestamp: 64 bit of seconds
        else:
            values[form.name] = draw(
                {
                    int: st.integers(-(2**63), 2**63 - 1),
                    float: st.floats(allow_nan=True, allow_infinity=True, allow_subnormal=True),
                    bool: st.booleans(),
                    str: TEXTS,
                }[form.kind]
            )
    with as_read():
        return kind(**values)


@pytest.mark.parametrize("kind", [Maybe, *TYPES], ids=lambda kind: kind.__name__)
def test_every_message_comes_back_bit_for_bit_from_the_bytes_that_protobuf_itself_would_write(kind):
    @settings(max_examples=15)
    @given(messages(kind))
    def round_trip(message):
        _, sequence, parts = codec.encode_record(message, message_codec(kind))
        payload = b"".join(parts)
        again = decode(kind, memoryview(payload), sequence or 0)
        assert again.same_as(message)
        for name in (field.name for field in dataclasses.fields(kind)):
            mine, theirs = getattr(message, name), getattr(again, name)
            assert type(mine) is type(theirs)
            if isinstance(mine, float):
                assert np.float64(mine).tobytes() == np.float64(theirs).tobytes()
            if isinstance(mine, np.ndarray):
                assert (mine.dtype, mine.shape) == (theirs.dtype, theirs.shape) and not theirs.flags.writeable
        if kind is not Frame:
            parsed = message_codec(kind).schema.wire.FromString(payload)
            assert parsed.SerializeToString(deterministic=True) == payload

    round_trip()


def test_protobuf_itself_reads_large_arrays_that_bypass_it_in_any_number():
    rng = np.random.default_rng(0)
    for sides in ((8, 9), (90, 100), (300, 200)):  # none, some and all of the arrays are large
        velocity, pressure = rng.normal(size=(*sides, 2)), rng.normal(size=sides)
        for std in (None, velocity.copy(), velocity.copy(order="F")):
            field = FlowField(7, 1, "fvm", 2.0, velocity, pressure, std, np.arange(3.0), 1.0, 998.0, "a note")
            parsed = message_codec(FlowField).schema.wire.FromString(encode(field))
            assert (parsed.stamp_ns, parsed.method, parsed.note) == (7, "fvm", "a note")
            assert parsed.HasField("std_um_s") == (std is not None)
            for name in (
                ("velocity_um_s", "pressure_pa") if std is None else ("velocity_um_s", "pressure_pa", "std_um_s")
            ):
                array, sent = getattr(parsed, name), getattr(field, name)
                assert (tuple(array.shape), array.dtype, array.data) == (sent.shape, "<f4", sent.tobytes())
            assert decode(FlowField, encode(field)).same_as(field)
            assert decode(FlowField, parsed.SerializeToString()).same_as(field)


@pytest.mark.parametrize("level", ["info", "warning", "error", "debug", "fatal", "", "odd: level", "flowrec."])
def test_event_levels_come_back_whatever_they_are(level):
    event = Event(5, level, "x")
    assert decode(Event, encode(event)).same_as(event)


def test_an_action_with_colons_is_not_confused_with_its_text():
    for action, text in (("a: b", "c: d"), ("", ": "), ("operator.", "operator.x: ")):
        event = OperatorEvent(5, action, text)
        assert decode(OperatorEvent, encode(event)).same_as(event)


def test_an_event_with_numbers_that_are_none_of_an_operator_is_damaged():
    log = message_codec(OperatorEvent).schema.wire
    assert decode(OperatorEvent, log(name="operator.goal", message="goal: ").SerializeToString()).goal_um.size == 0
    for forged in ('{"goal_um": [[1, 2]]}', '{"goal_um": "x"}', '{"speed_limit_um_s": null}', '{"a": 1}', "[1]", "{"):
        with pytest.raises(SessionError, match="damaged"):
            decode(OperatorEvent, log(name="operator.goal", file=forged).SerializeToString())


def test_half_a_character_is_spelled_out_instead_of_ending_the_run():
    assert decode(Event, encode(Event(1, "info", "a\ud800b"))).text == r"a\ud800b"


def test_a_value_that_can_not_be_stored_is_told_with_type_and_stamp():
    flat = Track(7, True, np.zeros((2, 2)), 1.0, 0, 1.0, np.zeros(4))
    for message in (flat, Frame(7, -1, np.zeros((2, 2), np.uint8)), dataclasses.replace(flat, score=None)):
        with pytest.raises(SessionError, match=f"a {type(message).__name__} at 7 ns can not be stored"):
            encode(message)


def test_optional_scalars_and_arrays_keep_the_difference_between_nothing_and_zero():
    nothing = Maybe(0, None, None, None, None, None)
    zero = Maybe(0, 0.0, 0, "", np.zeros(0), np.zeros((0, 3)))
    for message in (nothing, zero):
        assert decode(Maybe, encode(message)).same_as(message)


@pytest.mark.parametrize("kind", TYPES, ids=lambda kind: kind.__name__)
def test_schemas_stand_on_their_own(kind):
    schema = message_codec(kind).schema
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
        pool.Add(file)  # refuses a file before what it depends on
    assert pool.FindMessageTypeByName(schema.name).full_name == schema.name


def test_vectors_are_packed_doubles_that_viewers_can_plot():
    (file,) = descriptor_pb2.FileDescriptorSet.FromString(message_codec(Track).schema.data).file
    position = next(field for field in file.message_type[0].field if field.name == "position_um")
    assert (position.type, position.label) == (position.TYPE_DOUBLE, position.LABEL_REPEATED)


@settings(max_examples=200)
@given(st.sampled_from(TYPES), st.binary(max_size=60))
def test_rubbish_is_a_session_error_or_a_message(kind, rubbish):
    with contextlib.suppress(SessionError):
        assert isinstance(decode(kind, rubbish), kind)


# The depth of a frame is no field of its schema, but in the metadata of the channel; events are of foxglove's Log.
OLDER = [kind for kind in TYPES if defaulted_fields(kind) and kind not in (Frame, OperatorEvent)]


@pytest.mark.parametrize("kind", OLDER, ids=lambda kind: kind.__name__)
def test_a_file_made_before_a_field_existed_is_read_with_its_default(kind):
    needed = {
        form.name: {"vector": np.zeros(2), "array": np.zeros((2, 2))}.get(form.kind)
        if form.kind in ("vector", "array")
        else form.kind(1)
        for form in message_fields(kind)
        if form.name not in defaulted_fields(kind)
    }
    plain = kind(**needed)
    wire = codec.schema_of(kind).wire.FromString(encode(plain))
    for name in defaulted_fields(kind):
        wire.ClearField(name)
    assert decode(kind, wire.SerializeToString()).same_as(plain)
