"""A stretch of a session as a session of its own: the same ticks, which replay exactly from the first one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import flowrec
from flowrec.core import OutputError, UsageError
from flowrec.stages import load_config
from flowrec.store import Session
from flowrec.verbs import replay_session
from flowrec.verbs.check import check
from flowrec.verbs.cut import cut
from flowrec.verbs.record import record
from tests.short_missions import SMALL


def content(session: Session, from_ns: int, to_ns: int) -> list[tuple[object, ...]]:
    """Of each tick: stamp, pixels, track, applied field, estimate and phase."""
    return [
        (
            tick.stamp_ns,
            tick.frame.image.tobytes(),
            *(repr(getattr(tick, name)) for name in ("track", "applied", "estimate", "demand", "mission")),
        )
        for tick in session.reader.ticks(from_ns)
        if tick.stamp_ns <= to_ns and tick.frame is not None
    ]


@pytest.mark.parametrize(
    ("from_s", "to_s"),
    [(None, 1.0), (2.0, 3.0), pytest.param(4.0, None, marks=pytest.mark.slow("the longest of three stretches"))],
)
def test_a_cut_session_holds_the_ticks_of_its_stretch_and_replays_exactly(
    session: Path, tmp_path: Path, from_s: float | None, to_s: float | None
) -> None:
    done = cut(session, from_s, to_s, tmp_path / "cut.mcap")
    whole, part = flowrec.open(session), flowrec.open(done.path)
    begin, end = 1e9 * (from_s or 0.0), 1e9 * to_s if to_s is not None else whole.run.last_ns
    expected = content(whole, int(begin), int(end))
    first_ns, last_ns = int(expected[0][0]), int(expected[-1][0])  # type: ignore[call-overload]
    assert done.ticks == len(expected) > 20
    assert content(part, first_ns, last_ns) == expected and part.run.last_ns == last_ns
    verdict = replay_session(done.path, verify=True)
    assert verdict.same and verdict.covered.done == done.ticks
    assert check(done.path).exit_status == 0
    again = cut(done.path, done.to_s - 0.5, None, tmp_path / "again.mcap")
    assert replay_session(again.path, verify=True).same, "a stretch of a stretch"


@pytest.mark.slow("records two short missions")
@pytest.mark.parametrize("kept", ["recording.frames=jpeg", "recording.region=robot"])
def test_images_of_a_cut_session_are_those_of_the_session_also_where_these_had_lost_something(
    tmp_path: Path, kept: str
) -> None:
    whole = record(load_config(None, [*SMALL, kept, "duration_s=2"]), tmp_path / "a.mcap").path
    done = cut(whole, 1.0, None, tmp_path / "b.mcap")
    parts = [content(flowrec.open(path), 10**9, 2 * 10**9) for path in (whole, done.path)]
    assert parts[0] == parts[1] and len(parts[0]) > 20
    assert (flowrec.open(done.path).reader.region is None) == ("region" not in kept)


def test_a_cut_replaces_nothing_and_needs_a_stretch_with_a_tick(session: Path, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="is read by this command"):
        cut(session, 1.0, None, session, overwrite=True)
    there = tmp_path / "there.mcap"
    there.write_bytes(b"mine")
    with pytest.raises(OutputError, match="exists already"):
        cut(session, 1.0, None, there)
    assert there.read_bytes() == b"mine"
    part = there.rename(tmp_path / "there.part001.mcap")
    with pytest.raises(OutputError, match=r"there\.part001\.mcap: exists already"):
        cut(session, 1.0, None, there)
    part.rename(there)
    with pytest.raises(UsageError, match="give the first second"):
        cut(session, None, None, tmp_path / "b.mcap")
    stamps = np.array(flowrec.open(session).reader.stamps("applied")) / 1e9
    between = float(0.5 * (stamps[3] + stamps[4]))
    with pytest.raises(UsageError, match="no tick"):
        cut(session, between, between, tmp_path / "b.mcap")
    assert [each.name for each in tmp_path.iterdir()] == ["there.mcap"]
