"""What is built of a checkout says which commit it was made of."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

from tests.extras import EXTRA_OF

ROOT = Path(__file__).parents[1]
GIT = ("git", "-c", "user.name=test", "-c", "user.email=test@localhost", "-c", "commit.gpgsign=false")


def git(folder: Path, *words: str) -> str:
    return subprocess.run([*GIT, *words], cwd=folder, check=True, capture_output=True, text=True).stdout.strip()


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("checkout")
    for name in ("pyproject.toml", "README.md", "LICENSE", "hatch_build.py", ".gitignore"):
        if (ROOT / name).exists():
            shutil.copy(ROOT / name, folder)
    (folder / "flowrec" / "core").mkdir(parents=True)
    for name in (
        "__init__.py",
        "__init__.pyi",
        "core/__init__.py",
        "core/__init__.pyi",
        "core/provenance.py",
        "core/version.py",
    ):
        shutil.copy(ROOT / "flowrec" / name, folder / "flowrec" / name)
    shutil.copytree(ROOT / "flowrec" / "bench" / "training", folder / "flowrec" / "bench" / "training")
    git(folder, "init", "--quiet")
    git(folder, "add", ".")
    git(folder, "commit", "--quiet", "--message", "a commit")
    return folder


def built(checkout: Path, kind: str, out: Path) -> dict[str, object]:
    pytest.importorskip("hatchling")
    subprocess.run([sys.executable, "-m", "hatchling", "build", "-t", kind, "-d", out], cwd=checkout, check=True)
    (file,) = out.iterdir()
    if kind == "sdist":
        with tarfile.open(file) as archive:
            found = [name for name in archive.getnames() if name.endswith("/flowrec/_build.json")]
            content = archive.extractfile(found[0]) if found else None
            return json.load(content) if content is not None else {}
    with zipfile.ZipFile(file) as wheel:
        inside = "flowrec/_build.json"
        return json.loads(wheel.read(inside)) if inside in wheel.namelist() else {}


@pytest.mark.parametrize("kind", ["wheel", "sdist"])
def test_a_build_holds_its_commit(kind: str, checkout: Path, tmp_path: Path) -> None:
    assert built(checkout, kind, tmp_path) == {"git_commit": git(checkout, "rev-parse", "HEAD"), "git_changed": False}


def test_a_wheel_leaves_the_training_out_and_an_sdist_has_it(checkout: Path, tmp_path: Path) -> None:
    built(checkout, "wheel", tmp_path / "wheel")
    built(checkout, "sdist", tmp_path / "sdist")
    (wheel,), (sdist,) = (tmp_path / "wheel").iterdir(), (tmp_path / "sdist").iterdir()
    with zipfile.ZipFile(wheel) as files, tarfile.open(sdist) as archive:
        names = [files.namelist(), archive.getnames()]
    assert [any("bench/training/train.py" in name for name in each) for each in names] == [False, True]


def test_a_build_of_changed_sources_says_so(checkout: Path, tmp_path: Path) -> None:
    (checkout / "flowrec" / "new.py").write_text("")
    try:
        assert built(checkout, "wheel", tmp_path).get("git_changed") is True
    finally:
        (checkout / "flowrec" / "new.py").unlink()


def test_a_package_without_git_tells_the_commit_that_it_was_built_from(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from flowrec.core.provenance import provenance

    room = sys.modules[provenance.__module__]

    monkeypatch.setattr(room, "PACKAGE", tmp_path)
    assert "git_commit" not in provenance()
    (tmp_path / "_build.json").write_text('{"git_commit": "0123abcd", "git_changed": true}')
    said = provenance()
    assert (said.get("git_commit"), said.get("git_changed")) == ("0123abcd", "True")


def test_all_has_every_extra_and_what_a_skip_names_is_in_no_extra_of_the_default_suite() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]

    def within(name: str) -> set[str]:
        found = [re.fullmatch(r"flowrec\[(.+)\]", each) for each in extras[name]]
        inner = {extra for each in found if each for extra in each[1].split(",")}
        return {name}.union(*map(within, inner))

    assert within("all") == extras.keys() - {"test", "dev", "docs"}
    assert within("dev") == extras.keys()
    assert not within("test") & set(EXTRA_OF.values()) and set(EXTRA_OF.values()) <= extras.keys()
