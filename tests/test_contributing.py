"""What CONTRIBUTING states is compared with the code, and its recipes are carried out on a copy."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from numba.core.caching import _CacheLocator

import flowrec
from flowrec.core.system.numba_setup import _cache_folder, kernel_files
from flowrec.stages import CONTROLLERS, OBSERVERS, PLANNERS, REFINERS

ROOT = Path(__file__).parents[1]
PACKAGE = Path(flowrec.__file__).parent  # where its kernels are compiled for
GUIDE = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
RECIPES = dict(re.findall(r"^### (Add .+?)\n(.*?)(?=^##)", GUIDE, re.M | re.S))


def blocks(text: str, kind: str) -> list[str]:
    """The contents of the fenced blocks of one kind."""
    return [content for label, content in re.findall(r"^```(\w*)\n(.*?)^```$", text, re.M | re.S) if label == kind]


ONE_AFTER_THE_OTHER = """
import json, sys
from flowrec.verbs.cli import main
for sys.argv in json.loads(sys.argv[1]):
    try:
        main()
    except SystemExit as end:
        if end.code:
            sys.exit(f"{' '.join(sys.argv)}: {end.code}")
"""


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """A copy of flowrec that recipes may change."""
    for folder in (PACKAGE, ROOT / "sessions"):
        shutil.copytree(folder, tmp_path / "copy" / folder.name, ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path / "copy"


def outside_of(copy: Path) -> dict[str, str]:
    """The environment of commands in the copy."""
    return os.environ | {"GIT_CEILING_DIRECTORIES": str(copy.parent), "PYTHONPATH": str(copy)}


def apply(name: str, copy: Path) -> None:
    (change,) = blocks(RECIPES[name], "diff")
    run(["git", "apply", "--recount", "-"], f"{name}: the change does not apply", copy, outside_of(copy), change)


def test_the_recipes_apply_to_a_copy_of_flowrec_which_can_be_imported(copy: Path) -> None:
    for name in RECIPES:
        apply(name, copy)
    code = """
from flowrec.stages.config import load_config
from flowrec.core.topics import BY_FIELD
load_config(None, ["plan.method=breadth_first", "sampler.least_flow_um_s=40"])
assert "speed" in BY_FIELD
"""
    run([sys.executable, "-c", code], "all recipes", copy, outside_of(copy))


@pytest.mark.slow("flies and verifies a mission with each recipe, in processes of its own: a minute")
@pytest.mark.usefixtures("mission")  # has compiled most kernels, which the processes below would compile again
def test_the_commands_of_the_recipes_work(copy: Path) -> None:
    caches = copy.parent / "caches"
    share_kernels(copy, caches)
    outside = outside_of(copy) | {"XDG_CACHE_HOME": str(caches), "NUMBA_CACHE_DIR": ""}
    for name, text in RECIPES.items():
        apply(name, copy)
        (commands,) = blocks(text, "sh")
        words = [command.split() for command in commands.splitlines()]
        assert {program for program, *_ in words} == {"flowrec"}
        run([sys.executable, "-c", ONE_AFTER_THE_OTHER, json.dumps(words)], name, copy, outside)


def share_kernels(copy: Path, caches: Path) -> None:
    """Give the copy the kernels that are compiled already, half a minute of work; numba files them by their folder."""
    used = Path(_cache_folder())
    for folder in {path.parent for path in kernel_files()}:
        names = [
            _CacheLocator.get_suitable_cache_subpath(str(each / "kernels.py"))
            for each in (folder, copy / folder.relative_to(PACKAGE.parent))
        ]
        if (used / names[0]).is_dir():
            shutil.copytree(used / names[0], caches / "flowrec" / used.name / names[1])


def run(command: list[str], what: str, folder: Path, environment: dict[str, str], given: str = "") -> None:
    done = subprocess.run(
        command, input=given, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, f"{what}\n{done.stdout}\n{done.stderr}"


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


def test_readme_lists_the_methods_of_every_stage_as_the_tables_do() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    for table in (REFINERS, PLANNERS, OBSERVERS, CONTROLLERS):
        (line,) = re.findall(rf"^\| `{table.setting}` \|.*$", readme, re.M)
        listed = [f"`{row.name}` ({row.summary}" for row in table.values()]
        assert [entry for entry in listed if entry not in line] == []
        assert len(re.findall(r"`[a-z_]+` \(", line)) == len(listed)


def test_every_command_of_readme_is_typed_by_a_script_of_ci() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert set(re.findall(r"^```(\w*)\n.*?^```$", readme, re.M | re.S)) == {"sh", "console", "python"}
    (install,) = blocks(readme, "sh")  # the others are typed by .ci/readme
    typed = (ROOT / ".ci" / "run").read_text(encoding="utf-8").replace("--quiet ", "")
    commands = [line.partition("#")[0].strip() for line in install.splitlines() if line.startswith("pip ")]
    assert len(commands) == 2 and [command for command in commands if command not in typed] == []


def test_the_python_example_of_readme_runs(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    (example,) = blocks((ROOT / "README.md").read_text(encoding="utf-8"), "python")
    monkeypatch.chdir(ROOT / "sessions")
    exec(example.replace("a.mcap", "golden.mcap"), {})
    assert capsys.readouterr().out.startswith("reached time_field")


def test_every_file_that_contributing_and_readme_name_exists() -> None:
    texts = (GUIDE, (ROOT / "README.md").read_text(encoding="utf-8"))
    named = {name for text in texts for name in re.findall(r"`([a-z_./0-9]+\.(?:py|toml|mcap))`", text)}
    made = {"a.mcap", "flowrec.toml", "utils.py"}  # of an example; of a user; that there is none
    assert [
        name for name in sorted(named - made) if not ((ROOT / name).exists() or (ROOT / "flowrec" / name).exists())
    ] == []
