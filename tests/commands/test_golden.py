"""The golden session: recorded once, replayed by every version since."""

from __future__ import annotations

from pathlib import Path

import pytest

from flowrec.commands import replay as verb
from flowrec.commands.replay import Change
from flowrec.store.reader import SessionReader

GOLDEN = Path(__file__).parents[2] / "sessions" / "golden.mcap"


def test_the_golden_session_is_small_and_says_nothing_of_the_machine_it_was_made_on() -> None:
    assert GOLDEN.stat().st_size < 3_000_000
    facts = SessionReader(GOLDEN).header.provenance
    assert not {"host", "user", "platform", "git_diff"} & set(facts)


@pytest.mark.parametrize("from_s", [None, 3.0])
def test_the_golden_session_replays_the_same(from_s: float | None) -> None:
    done = verb.replay(GOLDEN, Change(), from_s=from_s, verify=True)
    same, lines = done.same, done.lines()
    assert same, lines
    assert done.recorded.mission is not None
    assert done.recorded.mission.outcome == "reached"
