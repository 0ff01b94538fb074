"""Ticks of a made-up run: nothing in them means anything, everything in them is recorded."""

import time
from collections.abc import Iterator
from dataclasses import fields, replace

import numpy as np

from flowrec.core import (
    Applied,
    Currents,
    Demand,
    Estimate,
    Event,
    FlowField,
    Frame,
    Mission,
    Observations,
    OperatorEvent,
    Route,
    SessionError,
    Tick,
    Timing,
    Track,
    Truth,
)
from flowrec.store import SessionHeader, SessionWriter, WriterOptions, codec
from flowrec.store.channels import message_codec
from flowrec.store.write_queue import Entry


def encode(message, schema=""):
    """A message as bytes, in the schema where it has several."""
    return b"".join(codec.encode_record(message, message_codec(type(message), schema)).payload)


def entry_of(stamp_ns, *messages, **given):
    """An entry of the write queue with messages of a tick, which are named as their types are."""
    encoded = {
        type(each).__name__.lower(): each
        if isinstance(each, Frame)
        else codec.encode_record(each, message_codec(type(each)), START_UNIX_NS)
        for each in messages
    }
    return Entry(stamp_ns, encoded, **given)


def decode(kind, payload, sequence=0, schema=""):
    """Its inverse."""
    return codec.decode(kind, message_codec(kind, schema), payload, sequence)


PERIOD_NS = 16_666_667
START_UNIX_NS = 1_790_000_000_123_456_789
HEADER = SessionHeader(
    config_toml='name = "made up"\n',
    chip_png=b"\x89PNG not really",
    chip_toml="um_per_px = 2.0\n",
    provenance={"host": "lab", "operator": "Zoë", "seed": "7"},
    weights={"unet.safetensors": bytes(range(256))},
    start_unix_ns=START_UNIX_NS,
)


def field_of(stamp_ns: int, rng: np.random.Generator, *, shape: tuple[int, int] = (24, 32)) -> FlowField:
    velocity = rng.normal(0.0, 50.0, (*shape, 2))
    velocity[:3] = 0.0
    return FlowField(
        stamp_ns, 1, "fvm", 2.0, velocity, rng.normal(size=shape), None, np.array([50.0, 0.0]), 1.0, 998.0, "made up"
    )


def ticks_of(count: int, *, shape: tuple[int, int] = (48, 64), seed: int = 0, images: int = 16) -> Iterator[Tick]:
    rng = np.random.default_rng(seed)
    # A few images in turn: making noise takes longer than recording it.
    pictures = [np.clip(rng.normal(120.0, 3.0, shape), 0, 255).astype(np.uint8) for _ in range(images)]
    tick = Tick()
    for number in range(count):
        now = 1_000_000_000 + number * PERIOD_NS
        here = np.array([300.0 + number * 0.5, 300.0 + np.sin(number / 9.0)])  # within the image
        nis = float("nan") if number % 7 == 0 else 1.0
        news = {
            "frame": Frame(now, number, pictures[number % images]),
            "applied": Applied(now, 7.0, 0.1, 3.0, np.array([1.0, 2.0, 0.0]), np.array([0.1, 0.0])),
            "track": Track(now, number % 7 != 0, here, 0.9, 0, 4.5, np.array([0.0, 0.0, 64.0, 48.0])),
            "estimate": Estimate(now, here, rng.normal(size=2), np.eye(4), nis, here, True),
            "demand": Demand(now, rng.normal(size=2), here, number / 60.0, 0.5, False, rng.normal(size=(4, 2))),
            "currents": Currents(now, 7.0, 0.2, 3.0, 1.0, rng.normal(size=3), False),
            "timing": Timing(now, 1.0, 0.2, 0.3, 0.1, 1.7, 0.0, 0),
            "truth": Truth(now, here, rng.normal(size=2), 40.0, 0),
        }
        if number == 0:
            news["assumed"] = field_of(now, rng)
            news["true_field"] = field_of(now, rng)
            news["event"] = Event(now, "info", "started: µ, 微, \U0001f9ea")
        if number % 50 == 10:
            news["refined"] = field_of(now, rng)
            news["observations"] = Observations(now, rng.normal(size=(3, 2)), rng.normal(size=(3, 2)), np.ones(3))
        if number % 50 == 12:
            points = np.column_stack([np.linspace(0.0, 60.0, 20), np.full(20, 20.0)])
            news["route"] = Route(now, 1, "astar", True, "", points, np.arange(20.0))
            news["mission"] = Mission(now, "navigate", now, 1, "", 0, here, np.array([60.0, 20.0]), False, "", "")
        if number % 50 == 20:
            news["operator"] = OperatorEvent(now, "note", "a: b")
        tick = replace(tick, stamp_ns=now, **news)
        yield tick


def write_session(path, ticks, header=HEADER, outcome=None, **options):
    """Write a session with these options; its path."""
    with SessionWriter(path, header, WriterOptions(**({"block": True} | options))) as writer:
        for tick in ticks:
            writer.write(tick)
        if outcome is not None:
            writer.close(outcome)
    return path


def fails(writer, told, shape=(8, 8)):
    """A writer whose file fails raises an error of one line while the run goes on, and again when it is closed."""
    import pytest  # here, because processes that tests start do without it

    def fly():
        for tick in ticks_of(100_000, shape=shape):  # until the thread has told
            writer.write(tick)
            time.sleep(0.002)

    for call in (fly, writer.close):
        with pytest.raises(SessionError, match=told) as error:
            call()
        assert "\n" not in str(error.value)


def same(one, other, but=()):
    """Whether two ticks hold the same, but for some of their fields."""
    pairs = ((getattr(one, each.name), getattr(other, each.name)) for each in fields(Tick) if each.name not in but)
    return all(mine == theirs or (None not in (mine, theirs) and mine.same_as(theirs)) for mine, theirs in pairs)
