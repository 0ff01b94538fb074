"""What a person types: right commands do their job, wrong ones get one line and an exit status."""

from __future__ import annotations

import contextlib
import io
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from flowrec.verbs.cli import with_default_refine
from tests.conftest import run


def flowrec(*words: object) -> subprocess.CompletedProcess[str]:
    """The command in this process, and what it prints."""
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
        status = run(words)
    return subprocess.CompletedProcess(words, status, out.getvalue(), err.getvalue())


def one_line_error(done: subprocess.CompletedProcess[str], status: int, *words: str) -> None:
    assert done.returncode == status, done.stderr
    assert "Traceback" not in done.stderr
    line = done.stderr.strip().splitlines()[-1]
    for word in words:
        assert word in line, line


@pytest.fixture
def mask(tmp_path: Path):  # type: ignore[no-untyped-def]
    def make(image: np.ndarray, toml: str = "um_per_px = 20.0\n") -> Path:
        path = tmp_path / "own.png"
        cv2.imwrite(str(path), image)
        path.with_suffix(".toml").write_text(toml)
        return path

    return make


def test_refine_without_a_method_is_pi_unet_wherever_it_stands() -> None:
    assert with_default_refine(["replay", "a.mcap", "--refine"])[-1] == "pi_unet"
    assert with_default_refine(["replay", "--refine", "a.mcap"])[2] == "pi_unet"
    named = ["replay", "a.mcap", "--refine", "assimilate", "--plan", "x"]
    assert with_default_refine(named) == named


@pytest.mark.parametrize(
    ("words", "status", "said"),
    [
        (["record", "nowhere.toml"], 2, ["nowhere.toml"]),
        (["record", "--set", "contrl.method=vector"], 2, ["contrl", "control"]),
        (["record", "--set", "chip.path=nowhere.npz"], 2, ["nowhere.npz"]),
        (["record", "--goal", "0,0"], 2, ["goal"]),
        (["replay", "nowhere.mcap"], 1, ["nowhere.mcap"]),
        (["info", "nowhere.mcap"], 1, ["nowhere.mcap"]),
        (["record", "--set", "chip.um_per_px=-3"], 2, ["chip.um_per_px"]),
    ],
)
def test_bad_usage_gets_one_line_and_a_status(words: list[str], status: int, said: list[str]) -> None:
    one_line_error(flowrec(*words), status, *said)


def test_masks_that_hold_no_channel_are_refused_and_leave_nothing_behind(mask, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    walled = np.zeros((80, 100), np.uint8)
    walled[30:50, 10:90] = 255
    for image in (np.zeros((80, 100), np.uint8), np.full((80, 100), 255, np.uint8), walled):
        out = tmp_path / "out.mcap"
        done = flowrec("record", "--set", f"chip.path={mask(image)}", "--out", out)
        one_line_error(done, 2, "own.png")
        assert not list(tmp_path.glob("out.mcap*"))


def test_files_that_are_no_session_are_told_apart(session: Path, tmp_path: Path) -> None:
    text = tmp_path / "text.mcap"
    text.write_text("not an mcap")
    one_line_error(flowrec("replay", text), 1, "text.mcap", "MCAP")
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(session.read_bytes()[: session.stat().st_size // 2])
    one_line_error(flowrec("info", cut), 1, "cut.mcap")
    one_line_error(flowrec("record", "--out", session), 2, "exists")
    one_line_error(flowrec("record", "--out", tmp_path / "no" / "such" / "a.mcap"), 2, "no such directory")


HEAVY = {"torch", "rerun", "filterpy", "matplotlib", "numba", "scipy.sparse", "scipy.stats"}
STAGES = {"numpy", "scipy", "cv2"}


@pytest.mark.parametrize(
    ("lines", "unwanted"),
    [
        (
            ["--version", "record nosuch.toml", "ls .", "info nosuch.mcap", "replay --verify nosuch.mcap"]
            + [f"{verb} nosuch.mcap" for verb in ("view", "export", "report", "recover", "calibrate motion")],
            HEAVY | STAGES,
        ),
        (["record --set robot.nosuch=1"], HEAVY | {"flowrec.verbs.mission_run", "flowrec.verbs.preparation"}),
    ],
)
def test_a_verb_imports_no_library_that_it_does_not_need(lines: list[str], unwanted: set[str]) -> None:
    code = f"""if True:
        import contextlib, sys
        from flowrec.verbs.cli import main
        for line in {lines!r}:
            sys.argv = ["flowrec", *line.split()]
            with contextlib.suppress(SystemExit):
                main()
            print("modules", *sys.modules)
    """
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False).stdout
    imported = [set(line.split()) for line in said.splitlines() if line.startswith("modules ")]
    assert len(imported) == len(lines) and "flowrec.verbs.cli" in imported[0]
    assert {line: found & unwanted for line, found in zip(lines, imported, strict=True) if found & unwanted} == {}


@pytest.mark.parametrize("words", [(), ("calibrate",), ("bench",)])
def test_a_command_alone_prints_its_help_in_lines(words: tuple[str, ...]) -> None:
    done = flowrec(*words)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith(f"Usage: {' '.join(('flowrec', *words))} [OPTIONS]")
    assert "\\n" not in done.stdout


@pytest.mark.parametrize("words", [(), ("calibrate",), ("bench",)])
def test_the_help_cuts_no_description_on_a_narrow_terminal(
    words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    text = flowrec(*words, "--help").stdout
    assert "..." not in text.partition("Commands:")[2]
    assert max(map(len, text.splitlines())) <= 80
