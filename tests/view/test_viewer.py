"""The viewer's window and its pictures."""

from __future__ import annotations

import subprocess
from pathlib import Path

import cv2
import pytest

from flowrec.core import FlowrecError, Tick
from flowrec.view import Scene, open_viewer, viewer, write_rrd
from flowrec.view.screenshot import screenshot
from tests.conftest import until


def test_without_a_screen_there_is_a_line_that_says_how_to_see_the_file(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert "rerun session.rrd" in open_viewer(tmp_path / "session.rrd")


def test_the_window_is_bound_to_this_machine(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    started: list[list[str]] = []

    class Started:
        def __init__(self, command: list[str], **_: object) -> None:
            started.append(command)

        def wait(self) -> None:
            """It ends at once."""

    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(subprocess, "Popen", Started)
    assert open_viewer(tmp_path / "session.rrd") == ""
    (command,) = started
    assert command[1:3] == ["--bind", "127.0.0.1"]
    assert command[-1] == str(tmp_path / "session.rrd")


def test_the_viewer_is_started_without_its_analytics_and_without_a_way_to_other_hosts(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    program, told = tmp_path / "rerun", tmp_path / "environment"
    program.write_text(f"#!/bin/sh\nenv > {told}.part; mv {told}.part {told}\n")
    program.chmod(0o755)
    monkeypatch.setenv("RERUN_CLI_PATH", str(program))
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setenv("FORCE_RERUN_ANALYTICS", "1")
    monkeypatch.setenv("NO_PROXY", "*")
    assert open_viewer(tmp_path / "session.rrd") == ""
    until(told.exists)
    environment = dict(line.split("=", 1) for line in told.read_text().splitlines() if "=" in line)
    assert environment.get("CI") == "true"
    assert environment["FORCE_RERUN_ANALYTICS"] == environment["TELEMETRY_ENABLED"] == "false"
    assert environment["ALL_PROXY"] == "http://127.0.0.1:9"
    assert environment["NO_PROXY"] == ""


@pytest.mark.slow("draws in the real viewer")
def test_a_screenshot_shows_all_views_without_complaint_and_rerun_takes_no_notes_of_its_use(
    tmp_path: Path, scene: Scene, ticks: list[Tick], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.delenv("XDG_CONFIG_HOME", raising=False)
    write_rrd(tmp_path / "session.rrd", scene, {"": ticks})
    (tmp_path / "out").mkdir()
    try:
        problems = screenshot(tmp_path / "session.rrd", tmp_path / "out" / "shot.png", time_s=1.5, size=(1280, 800))
    except FlowrecError as error:
        if "no graphics" not in str(error):
            raise
        pytest.skip(str(error))
    finally:
        assert not (tmp_path / "home" / ".config" / "rerun" / "analytics.json").exists()
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
        screenshot(tmp_path / "none.rrd", tmp_path / "shot.png")
    (tmp_path / "some.rrd").touch()
    monkeypatch.setattr(viewer, "executable", lambda: None)
    with pytest.raises(FlowrecError, match="pip install rerun-sdk"):
        screenshot(tmp_path / "some.rrd", tmp_path / "shot.png")


def test_a_character_that_the_viewer_can_not_draw_is_not_told_as_a_lack_of_graphics(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    program = tmp_path / "rerun"
    program.write_text("#!/bin/sh\necho 'wgpu adapter backend: Vulkan' 'panicked: No glyph for X' >&2; exit 101\n")
    program.chmod(0o755)
    monkeypatch.setenv("RERUN_CLI_PATH", str(program))
    (tmp_path / "some.rrd").touch()
    with pytest.raises(FlowrecError, match="a character of the file that its font lacks"):
        screenshot(tmp_path / "some.rrd", tmp_path / "shot.png")
