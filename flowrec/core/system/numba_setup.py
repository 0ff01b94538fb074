"""Compilation of kernels by numba with a cache on disk; the type checker sees their Python types.

numba keys a cached kernel by the file that it is in, and not by the kernels of other files that it calls: after a
change of one of those it would keep using the old code. So the cache is a folder whose name holds a hash of all files
with kernels. It lies outside the installation, which may be read-only.

numba is imported by the first call of a kernel: it takes a quarter of a second, which most commands do not need.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import logging
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar, cast

from flowrec.core.system.regular_file import make_own_folder, own_temporary_folder

Function = TypeVar("Function", bound=Callable[..., Any])

_PACKAGE = Path(__file__).parents[2]
_DECORATED = "\n@compiled\n"  # in a file with kernels
_OWN = Path("core", "system", "numba_setup.py")
_PREFIX = "numba-"
_COMPLETE = "complete"
_UNUSED_DAYS = 30.0  # then a cache of other sources is removed


def compiled(function: Function) -> Function:
    """The function in machine code; the first call of a new installation takes seconds, later ones load the cache.

    What a kernel takes from other files of flowrec, it must take from files with kernels: the cache is keyed by those.
    A kernel assigns element by element: what is assigned to a slice or a row, `np.where` and `np.interp` take two
    seconds more to compile, most of it for messages that are never shown, and `max` of an array half a second. An array
    that may be written and one that may not are two kinds, for each of which a kernel is compiled.
    """
    return cast(Function, Kernel(function))


class Kernel:
    """A function that numba compiles, also where another kernel calls it.

    `py_func`: the function in Python.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        functools.update_wrapper(self, function)
        self.py_func = function

    def __call__(self, *given: Any) -> Any:
        return self.dispatcher(*given)

    @functools.cached_property
    def dispatcher(self) -> Any:
        """The function as numba compiles it for each signature."""
        import numba

        _register()
        config: Any = numba.config  # it makes its attributes as it is imported
        folder = _cache_folder()
        before, config.CACHE_DIR = config.CACHE_DIR, folder  # for this kernel only, not for those of other packages
        try:
            return numba.njit(cache=bool(folder))(self.py_func)
        finally:
            config.CACHE_DIR = before


@functools.cache
def _register() -> None:
    """Tell numba that a kernel which is called by another is what it compiles of it, and not to log how."""
    from numba.extending import typeof_impl

    # pymmcore_plus sets the level of the root logger to DEBUG. Then the messages of numba's passes take a third of a
    # compilation. A level that somebody chose for numba stays.
    if logging.getLogger("numba").level == logging.NOTSET:
        logging.getLogger("numba").setLevel(logging.WARNING)

    @typeof_impl.register(Kernel)
    def _(kernel: Kernel, context: Any) -> Any:
        return typeof_impl(kernel.dispatcher, context)


def kernels_cached() -> bool:
    """True if `keep_kernels` has said that a run finds its kernels in the cache."""
    folder = _cache_folder()
    return bool(folder) and Path(folder, _COMPLETE).exists()


def keep_kernels() -> None:
    """Note that the kernels of a run are in the cache; does nothing where nothing can be written."""
    if folder := _cache_folder():
        with contextlib.suppress(OSError):  # the next run compiles what is missing, and notes it
            Path(folder, _COMPLETE).touch()


def kernel_files() -> list[Path]:
    """The files of flowrec with kernels, and the one that compiles them."""
    found = (path for path in _PACKAGE.rglob("*.py") if _DECORATED in path.read_text(encoding="utf-8"))
    return sorted({_PACKAGE / _OWN, *found})


@functools.cache
def _cache_folder() -> str:
    """Folder in which kernels are cached; '' where nothing can be written, then they are compiled in every process."""
    state = hashlib.sha256(f"{sys.version} {version('numba')}".encode())
    for path in kernel_files():
        state.update(path.read_bytes())
    for place in _places():
        folder = place / f"{_PREFIX}{state.hexdigest()[:16]}"
        with contextlib.suppress(OSError):
            if not folder.exists():
                _remove_unused(place)
            make_own_folder(folder)  # else another user could write code there that this process runs
            tempfile.TemporaryFile(dir=folder).close()
            os.utime(folder)
            return str(folder)
    return ""


def _places() -> Iterator[Path]:
    """Candidates for the cache: numba's own setting, the user's caches, the folder of temporary files."""
    if told := os.environ.get("NUMBA_CACHE_DIR", ""):
        yield Path(told).absolute()
    home = os.environ.get("XDG_CACHE_HOME", "")
    if not os.path.isabs(home):  # noqa: PTH117 - unset, or to be ignored by the XDG specification
        home = os.path.expanduser("~/.cache")  # noqa: PTH111 - which raises nothing where there is no home
    if os.path.isabs(home):  # noqa: PTH117
        yield Path(home, "flowrec")
    yield own_temporary_folder()


def _remove_unused(place: Path) -> None:
    """Remove the caches of other sources that have not been used for a while."""
    for other in place.glob(f"{_PREFIX}*"):
        with contextlib.suppress(OSError):
            if time.time() - other.stat().st_mtime > _UNUSED_DAYS * 86_400:
                shutil.rmtree(other)
