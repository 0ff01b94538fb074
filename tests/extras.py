"""Tests of an extra: where one of its packages is missing they skip, and say which extra has it."""

from __future__ import annotations

from importlib.util import find_spec

import pytest

# Packages that `.[test]` does not install, by the extra of pyproject.toml that does.
EXTRA_OF = {
    "dask": "cluster",
    "datafusion": "catalog",
    "h5py": "movies",
    "mm_test_adapters": "dev",
    "moto": "dev",
    "nbformat": "dev",
    "nd2": "movies",
    "nidaqmx": "ni",
    "ompl": "ompl",
    "playwright": "dev",
    "pylsl": "streams",
    "pymmcore_plus": "mmcore",
    "pypylon": "pylon",
    "pyxdf": "movies",
    "skfmm": "dev",
    "viva_genicam": "genicam",
}


def why(module: str) -> str:
    """The reason of a skip; .ci/run knows it by its beginning."""
    return f"needs an extra: pip install 'flowrec[{EXTRA_OF[module]}]' for {module}"


def needs(module: str) -> pytest.MarkDecorator:
    """A mark for tests and parameters."""
    return pytest.mark.skipif(find_spec(module) is None, reason=why(module))
