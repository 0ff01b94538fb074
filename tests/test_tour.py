"""README's commands as they stand, in order, in an empty folder: each line that it shows is printed, but for numbers.

They take a minute or two, so the suite leaves them out; .ci/run types them (`pytest -m tour`).
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
NEEDS_A_LAB = "flowrec doctor lab.toml"


def steps() -> list[tuple[str, list[str]]]:
    """Each command of README's consoles with the lines below it."""
    found: list[tuple[str, list[str]]] = []
    for block in re.findall(r"^```console\n(.*?)^```", (ROOT / "README.md").read_text(encoding="utf-8"), re.M | re.S):
        for line in block.splitlines():
            if line.startswith("$ "):
                found.append((line[2:], []))
            else:
                found[-1][1].append(line)
    return found


def pattern(line: str) -> str:
    """A line of README as a regular expression: any number for a number, anything for `...`, any width of a column."""
    text = " ".join(re.sub(r"[\d.]*\d", "0", line).split())
    parts = [re.escape(part.strip()) for part in text.split("...")]
    return r".*".join(parts)


@pytest.mark.tour
def test_what_readme_types_prints_what_readme_shows(tmp_path: Path) -> None:
    (tmp_path / "sessions").symlink_to(ROOT / "sessions")
    commands = [(command, lines) for command, lines in steps() if command != NEEDS_A_LAB]
    assert len(commands) >= 6
    for command, lines in commands:
        _, *words = shlex.split(command)
        done = subprocess.run(
            [sys.executable, "-m", "flowrec", *words],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, f"{command}: {done.stderr}"
        said = done.stdout + done.stderr
        printed = [" ".join(re.sub(r"[\d.]*\d", "0", line).split()) for line in said.splitlines()]
        missing = [line for line in lines if not any(re.search(pattern(line), shown) for shown in printed)]
        assert missing == [], f"{command} does not print these lines of README:\n{said}"
