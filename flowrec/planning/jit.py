"""How kernels are compiled: by numba, cached on disk, with their Python types kept for the type checker."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

from numba import njit

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """The function in machine code; the first call of a new installation takes seconds, later ones load the cache."""
    return cast(Function, njit(cache=True)(function))
