"""The cache of compiled kernels: never of old sources, outside the installation, and not needed."""

from __future__ import annotations

import ast
import importlib
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

import flowrec
from flowrec.core.system import numba_setup
from flowrec.core.system.numba_setup import kernel_files

PACKAGE = Path(flowrec.__file__).parent

INNER = """
from flowrec.core.system.numba_setup import compiled
@compiled
def number():
    return {value}
"""
OUTER = """
from flowrec.inner import number
from flowrec.core.system.numba_setup import compiled
@compiled
def twice():
    return 2 * number()
"""


def run(code: str, package: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    kept = {name: value for name, value in os.environ.items() if name not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")}
    return subprocess.run(
        [sys.executable, "-P", "-B", "-c", code],
        env=kept | {"PYTHONPATH": str(package.parent)} | environment,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A small copy of flowrec, with a kernel that calls one of another file."""
    copy = tmp_path / "installed" / "flowrec"
    (copy / "core" / "system").mkdir(parents=True)
    system = ("__init__.py", "numba_setup.py", "regular_file.py")
    own = ("__init__.py", "__init__.pyi", "version.py", "errors.py", *(f"system/{each}" for each in system))
    for name in ("__init__.py", "__init__.pyi", *(f"core/{each}" for each in own)):
        (copy / name).write_bytes((PACKAGE / name).read_bytes())
    (copy / "inner.py").write_text(INNER.format(value=3))
    (copy / "outer.py").write_text(OUTER)
    return copy


TWICE = "from flowrec.outer import twice; print(twice(), sum(twice.dispatcher.stats.cache_hits.values()))"


@pytest.mark.slow("compiles kernels in processes of its own")
def test_a_kernel_is_compiled_once_and_anew_after_a_change_of_another_file_that_it_calls(
    package: Path, tmp_path: Path
) -> None:
    home = str(tmp_path)
    assert run(TWICE, package, HOME=home).stdout.split() == ["6", "0"]
    assert run(TWICE, package, HOME=home).stdout.split() == ["6", "1"]
    (package / "inner.py").write_text(INNER.format(value=4))
    assert run(TWICE, package, HOME=home).stdout.split() == ["8", "0"]
    assert len(list((tmp_path / ".cache" / "flowrec").iterdir())) == 2
    assert not list(package.rglob("*.nbi"))


@pytest.mark.slow("compiles kernels in processes of its own")
def test_kernels_need_neither_a_writable_home_nor_a_writable_installation(package: Path, tmp_path: Path) -> None:
    (package / "__pycache__").write_text("permissions do not bind root, so a file is where the folder would be")
    temporary = tmp_path / "tmp"
    temporary.mkdir()
    for _ in range(2):
        done = run(TWICE, package, HOME="/proc/nowhere", TMPDIR=str(temporary))
        assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["6", "1"]
    (folder,) = temporary.glob("flowrec-*/numba-*")
    folder.chmod(0o777)  # what others may write into is not run
    done = run(TWICE, package, HOME="/proc/nowhere", TMPDIR=str(temporary))
    assert done.stdout.split() == ["6", "0"]


@pytest.mark.slow("compiles kernels in a process of its own")
def test_the_folder_that_numba_was_told_is_used_and_what_nobody_has_used_for_long_is_removed(
    package: Path, tmp_path: Path
) -> None:
    told = tmp_path / "told"
    old, recent, other = (told / name for name in ("numba-0123", "numba-4567", "of-another-program"))
    for folder in (old, recent, other):
        folder.mkdir(parents=True)
    for folder in (old, other):
        os.utime(folder, (time.time() - 40 * 86_400,) * 2)
    assert run(TWICE, package, HOME=str(tmp_path), NUMBA_CACHE_DIR=str(told)).stdout.split() == ["6", "0"]
    assert not (tmp_path / ".cache").exists()
    assert not old.exists()
    assert recent.exists() and other.exists()
    assert len(list(told.iterdir())) == 3


def test_kernels_count_as_cached_from_when_a_rehearsal_has_kept_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for place, kept in ((tmp_path / "cache", True), (None, False)):
        monkeypatch.setattr(numba_setup, "_places", lambda place=place: iter([place] if place else []))
        numba_setup._cache_folder.cache_clear()
        try:
            assert not numba_setup.kernels_cached()
            numba_setup.keep_kernels()
            assert numba_setup.kernels_cached() == kept, "where nothing can be written, each process compiles"
        finally:
            numba_setup._cache_folder.cache_clear()


def test_kernels_take_from_other_files_only_what_the_key_of_the_cache_knows() -> None:
    known = {path.relative_to(PACKAGE.parent).with_suffix("").as_posix().replace("/", ".") for path in kernel_files()}
    assert {
        "flowrec.stages.planning.kernels",
        "flowrec.stages.vision.disc_fit",
        "flowrec.rigs.simulated.bodies",
    } <= known
    for name in sorted(known - {"flowrec.core.system.numba_setup"}):
        module = importlib.import_module(name)
        assert module.__file__ is not None
        imported = {
            alias.asname or alias.name: statement.module
            for statement in ast.walk(ast.parse(Path(module.__file__).read_text()))
            if isinstance(statement, ast.ImportFrom)
            for alias in statement.names
        }
        for kernel in vars(module).values():
            if getattr(kernel, "__module__", "") == name and hasattr(kernel, "py_func"):
                for used in set(kernel.py_func.__code__.co_names) & set(imported):
                    # Of a kernel that came through a door the file that defines it.
                    source = getattr(vars(module)[used], "__module__", None) or imported[used] or ""
                    assert source in known or not source.startswith("flowrec"), f"{name}.{kernel.__name__} uses {used}"


def test_every_kernel_is_compiled_by_the_one_decorator() -> None:
    for path in PACKAGE.rglob("*.py"):
        assert path == PACKAGE / "core" / "system" / "numba_setup.py" or "njit" not in path.read_text()
