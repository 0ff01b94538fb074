"""NaN and infinity are refused where a message is made, in every field of every message of a run that excludes them."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flowrec.core import TOPICS, Message, NotFiniteError, Tick, as_read, invalid_numbers, message_fields
from flowrec.store import SessionReader
from tests.store.drafts import made_up
from tests.store.made_up import decode, encode

GOLDEN = Path(__file__).parents[2] / "sessions" / "golden_moderate.mcap"
# Numbers for which NaN or infinity has a meaning; messages.py says which.
MAY_BE = {
    ("Route", "time_to_go_s"),
    *(("Estimate", "nis"), ("Estimate", "measured_um")),
    ("Health", "nis"),
    *(("Mission", "start_um"), ("Mission", "goal_um")),
    *(("Demand", "reference_um"), ("Demand", "error_um")),
    ("Truth", "clearance_um"),
}
NOT_FINITE = (float("nan"), float("inf"), -float("inf"))


@pytest.fixture(scope="module")
def of_a_run() -> dict[str, Message]:
    """A message of each topic by its type: of a recorded run, and what that has none of, made up."""
    rng = np.random.default_rng(0)
    found: dict[str, Message] = {}
    with SessionReader(GOLDEN) as reader:
        last = Tick()
        for tick in reader.ticks():
            last = replace(tick, true_field=tick.true_field or last.true_field, truth=tick.truth or last.truth)
    for topic in TOPICS:
        message = getattr(last, topic.field)
        found.setdefault(topic.type.__name__, message if message is not None else made_up(topic.type, 10**9, 3, rng))
    return found


def spoiled(message: Message) -> Iterator[tuple[str, Any]]:
    """Each field of floating-point numbers, with one of them NaN or infinite."""
    for each in message_fields(type(message)):
        value = getattr(message, each.name)
        if not each.is_float or (each.dtype is not None and (value is None or not value.size)):
            continue
        for number in NOT_FINITE:
            if each.dtype is None:
                yield each.name, number
                continue
            array = np.array(value)
            array.flat[array.size // 2] = number
            yield each.name, array


def test_nan_and_infinity_are_refused_in_every_field_of_every_message_that_does_not_permit_them(
    of_a_run: dict[str, Message],
) -> None:
    tried = set()
    for kind, message in of_a_run.items():
        for name, value in spoiled(message):
            tried.add((kind, name))
            if (kind, name) in MAY_BE:
                replace(message, **{name: value})
                continue
            with pytest.raises(NotFiniteError, match=rf"^{kind} at .* s refused: NaN or infinity in {name}\b"):
                replace(message, **{name: value})
    assert tried >= MAY_BE and len(tried) > 90


def test_what_a_file_holds_is_read_as_it_is_for_those_who_say_what_is_wrong_with_it(
    of_a_run: dict[str, Message],
) -> None:
    for message in (of_a_run["Estimate"], of_a_run["FlowField"], of_a_run["Applied"]):
        for name, value in itertools.islice(spoiled(message), 3):
            with as_read():
                written = encode(replace(message, **{name: value}))
            again = decode(type(message), written)
            assert invalid_numbers(again) == (name,)
            with pytest.raises(NotFiniteError):  # and is refused by whoever makes another message of it
                replace(again)
