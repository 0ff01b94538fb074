"""The viewer's window and its pictures."""

from __future__ import annotations

import subprocess
from pathlib import Path

import cv2
import pytest

from flowrec.errors import FlowrecError
from flowrec.messages import Tick
from flowrec.view import Scene, open_viewer, screenshot, viewer, write_rrd
from flowrec.view.screenshot import screenshot as take


def test_without_a_screen_there_is_a_line_that_says_how_to_see_the_file(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert "rerun session.rrd" in open_viewer(tmp_path / "session.rrd")


def test_the_window_is_bound_to_this_machine(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    started: list[list[str]] = []

    class Started:
        returncode: int | None = None

        def __init__(self, command: list[str], **_: object) -> None:
            started.append(command)

    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(subprocess, "Popen", Started)
    assert open_viewer(tmp_path / "session.rrd") == ""
    (command,) = started
    assert command[1:3] == ["--bind", "127.0.0.1"]
    assert command[-1] == str(tmp_path / "session.rrd")


def test_a_screenshot_shows_all_views_without_complaint(tmp_path: Path, scene: Scene, ticks: list[Tick]) -> None:
    write_rrd(tmp_path / "session.rrd", scene, ticks)
    try:
        problems = screenshot(tmp_path / "session.rrd", tmp_path / "out" / "shot.png", time_s=1.5, size=(1280, 800))
    except FlowrecError as error:
        if "no graphics" not in str(error):
            raise
        pytest.skip(str(error))
    assert problems == []
    picture = cv2.imread(str(tmp_path / "out" / "shot.png"))
    assert picture is not None
    assert picture.shape == (800, 1280, 3)
    camera = picture[100:400, 40:480]
    assert camera.std() > 10  # not blank


def test_a_screenshot_of_nothing_or_without_a_viewer_is_refused_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(FlowrecError, match="no such file"):
        take(tmp_path / "none.rrd", tmp_path / "shot.png")
    (tmp_path / "some.rrd").touch()
    monkeypatch.setattr(viewer, "executable", lambda: None)
    with pytest.raises(FlowrecError, match="pip install rerun-sdk"):
        take(tmp_path / "some.rrd", tmp_path / "shot.png")
