"""Two sessions in one view."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from rerun.chunk import RrdReader

import flowrec
from flowrec.core import SessionError, UsageError
from flowrec.store import Session

GOLDEN = Path(__file__).parents[2] / "sessions" / "golden.mcap"


def test_two_sessions_are_shown_on_one_timeline_with_one_scale(tmp_path: Path) -> None:
    for name in ("one.mcap", "two.mcap"):
        (tmp_path / name).write_bytes(GOLDEN.read_bytes())
    made = flowrec.export(tmp_path / "one.mcap", beside=tmp_path / "two.mcap")
    assert made == tmp_path / "one_and_two.rrd"
    chunks = list(RrdReader(made).stream())
    rows = {chunk.entity_path: chunk for chunk in chunks if not chunk.is_static}
    assert {"/A/camera/robot", "/B/camera/robot", "/A/camera/measured/image"} <= rows.keys()
    assert "/B/camera/measured/image" not in rows
    texts = [chunk for chunk in chunks if chunk.entity_path == "/summary"]
    (text,) = texts[-1].to_record_batch().column("TextDocument:text").to_pylist()[0]
    assert "A: one" in text
    assert "B: two" in text
    assert "refined flow error" in text


def test_two_sessions_of_different_chips_and_other_formats_are_refused_in_one_line(tmp_path: Path) -> None:
    first = Session(GOLDEN)
    other = Session(GOLDEN)
    other.__dict__["chip"] = replace(first.chip, um_per_px=2.0 * first.chip.um_per_px)
    with pytest.raises(SessionError, match="another chip or camera"):
        flowrec.export(first, tmp_path / "pair.rrd", beside=other)
    with pytest.raises(UsageError, match="only rrd shows two sessions"):
        flowrec.export(first, tmp_path / "pair", file_format="csv", beside=other)
    assert list(tmp_path.iterdir()) == []
