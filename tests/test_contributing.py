"""CONTRIBUTING and README state facts about the code; here they are compared with it, and the recipes are carried out."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
GUIDE = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
RECIPES = dict(re.findall(r"^### (Add .+?)\n(.*?)(?=^##)", GUIDE, re.M | re.S))


def blocks(text: str, kind: str) -> list[str]:
    """The contents of the fenced blocks of one kind."""
    return re.findall(rf"^```{kind}\n(.*?)^```", text, re.M | re.S)


@pytest.mark.parametrize("name", RECIPES)
def test_a_recipe_applies_to_a_copy_of_flowrec_and_its_command_works(name: str, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    for folder in ("flowrec", "sessions"):
        shutil.copytree(ROOT / folder, copy / folder, ignore=shutil.ignore_patterns("__pycache__"))
    (change,), (commands,) = blocks(RECIPES[name], "diff"), blocks(RECIPES[name], "sh")
    applied = subprocess.run(
        ["git", "apply", "--recount", "--verbose", "-"],
        input=change,
        cwd=copy,
        env=os.environ | {"GIT_CEILING_DIRECTORIES": str(tmp_path)},  # the copy is no repository, nor in one
        capture_output=True,
        text=True,
        check=False,
    )
    assert applied.returncode == 0, applied.stderr
    for command in commands.splitlines():
        program, *arguments = command.split()
        assert program == "flowrec"
        done = subprocess.run(
            [sys.executable, "-m", "flowrec", *arguments],
            cwd=copy,
            env=os.environ | {"PYTHONPATH": str(copy)},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"


def test_there_are_recipes_for_a_message_a_planner_and_a_setting() -> None:
    assert [name.split(" ")[2] for name in RECIPES] == ["message", "planner", "setting"]


def test_the_map_names_every_file_and_nothing_else() -> None:
    (drawn,) = [block for block in blocks(GUIDE, "") if block.startswith("flowrec/\n")]
    named: set[str] = set()
    room = ""
    for line in drawn.splitlines()[1:]:
        first, _, rest = line.strip().partition("  ")
        if first.endswith("/"):
            room = first
        elif first.endswith(".py"):
            room = ""
            named.add(first)
            continue
        else:
            rest = line
        named |= {f"{room}{name}.py" for name in re.findall(r"[a-z_0-9/]+", re.sub(r"\(.*?\)", "", rest))}
    files = {path.relative_to(ROOT / "flowrec").as_posix() for path in (ROOT / "flowrec").rglob("*.py")}
    assert named == {name for name in files if not name.endswith("__init__.py")}
