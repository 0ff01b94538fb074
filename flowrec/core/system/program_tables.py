"""Tables in files of other programs: variables of MATLAB (.mat), streams of the Lab Streaming Layer (.xdf).

Both become a header and rows of numbers, as a CSV would hold them. Of MATLAB the columns are the vectors of equal
length among the variables, or in one struct; of a matrix with as many rows, its columns NAME_1, NAME_2, ... Of XDF they
are the channels of all streams of numbers, held from sample to sample on the clock of the recording (column time_s).
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flowrec.core.errors import UsageError
from flowrec.core.system.bounded_process import BoundedProcess

_Rows = list[tuple[int, list[Any]]]
_Columns = dict[str, NDArray[Any]]

_MAT_5, _MAT_73, _XDF = b"MATLAB 5.0", b"MATLAB 7.3", b"XDF:"
HEAD_BYTES = 16
_CPU_S, _CPU_S_PER_MB = 20.0, 2.0  # limit of the process that reads a file
_LARGEST_MATRIX = 64  # columns; what has more is an image
_LIMIT_ROWS = 1 << 23
_OF_MATLAB = "vectors of equal length, as in save('log.mat', 'time_s', 'frequency_hz', 'heading_deg', 'amplitude_mt')"


def program_of(head: bytes) -> str:
    """The program whose file begins so: mat, mat7.3 or xdf; '' of others."""
    named = {_MAT_5: "mat", _MAT_73: "mat7.3", _XDF: "xdf"}
    return next((name for magic, name in named.items() if head.startswith(magic)), "")


def program_rows(path: Path, program: str) -> _Rows:
    """Header and rows of the table in a file, each with its number from 1.

    Raises UsageError: one line: a missing package, a damaged file, no table in it.
    """
    reads, package = _READERS[program]
    if importlib.util.find_spec(package) is None:
        raise UsageError(f"{path}: needs {package}: pip install 'flowrec[movies]', or save it as CSV")
    limit_s = _CPU_S + _CPU_S_PER_MB * path.stat().st_size / 1e6
    with BoundedProcess(str(path), limit_s) as process:
        return process.call(_rows, path, reads)


def _rows(path: Path, reads: Callable[[Path], _Columns]) -> _Rows:
    columns = reads(path)
    numbers = np.column_stack([np.asarray(column, np.float64) for column in columns.values()])
    if len(numbers) > _LIMIT_ROWS:
        raise UsageError(f"{path}: {len(numbers)} rows; at most {_LIMIT_ROWS} are read: save every tenth one")
    return [(1, list(columns)), *((number, row) for number, row in enumerate(numbers.tolist(), 2))]


def _mat_columns(path: Path) -> _Columns:
    """Columns of a file of MATLAB up to version 7."""
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    try:
        found = loadmat(path, squeeze_me=False, struct_as_record=True)
    except (MatReadError, ValueError, TypeError, OSError, EOFError, NotImplementedError, KeyError, IndexError) as error:
        raise _reading_error(path, error) from error
    variables = {name: value for name, value in found.items() if not name.startswith("__")}
    groups: dict[str, Mapping[str, Any]] = {"": variables}
    for name, value in variables.items():
        if isinstance(value, np.ndarray) and value.dtype.names and value.size == 1:
            groups[name] = {field: value[field].item() for field in value.dtype.names}
    return _longest(path, groups)


def _mat73_columns(path: Path) -> _Columns:
    """Columns of a file of MATLAB 7.3, which is HDF5; it stores matrices transposed."""
    import h5py

    def values(group: Any) -> dict[str, Any]:
        return {
            name: each[()].T
            for name, each in group.items()
            if isinstance(each, h5py.Dataset)
            and each.attrs.get("MATLAB_class", b"double") != b"char"
            and each.ndim == 2
        }

    try:
        with h5py.File(path) as file:
            groups: dict[str, Mapping[str, Any]] = {"": values(file)}
            structs = {name: each for name, each in file.items() if isinstance(each, h5py.Group)}
            groups |= {name: values(each) for name, each in structs.items() if not name.startswith("#")}
    except (OSError, RuntimeError, ValueError, KeyError, TypeError) as error:
        raise _reading_error(path, error) from error
    return _longest(path, groups)


def _longest(path: Path, groups: Mapping[str, Mapping[str, Any]]) -> _Columns:
    """The columns of equal length that are the most numbers, among those of each group."""
    best: _Columns = {}
    for group in groups.values():
        by_length: dict[int, _Columns] = {}
        for name, value in group.items():
            for key, column in _as_columns(name, value).items():
                by_length.setdefault(len(column), {})[key] = column
        for columns in by_length.values():
            if len(columns) >= 2 and _numbers(columns) > _numbers(best):
                best = columns
    if not best:
        raise UsageError(
            f"{path}: holds no table: {_OF_MATLAB}; of a MATLAB table save table2struct(T, 'ToScalar', true)"
        )
    return best


def _numbers(columns: _Columns) -> int:
    return sum(len(column) for column in columns.values())


def _as_columns(name: str, value: Any) -> _Columns:
    """A vector as a column, a matrix as its columns; nothing of what is no number, or of a single one."""
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiub" or value.ndim != 2 or value.size < 2:
        return {}
    if 1 in value.shape:
        return {name: value.ravel()}
    if value.shape[1] > _LARGEST_MATRIX:
        return {}
    return {f"{name}_{number}": column for number, column in enumerate(value.T, 1)}


def _xdf_columns(path: Path) -> _Columns:
    """Channels of all streams of numbers at the times of all samples, from the first time at which each has one."""
    import logging

    import pyxdf

    logging.getLogger("pyxdf").setLevel(logging.CRITICAL)  # it prints what it corrects; a fault is raised
    try:
        streams, _ = pyxdf.load_xdf(str(path))
    except Exception as error:  # of a damaged file the library raises what happens
        raise _reading_error(path, error) from error
    numeric = [each for each in streams if isinstance(each["time_series"], np.ndarray) and len(each["time_stamps"])]
    if not numeric:
        raise UsageError(
            f"{path}: {len(streams)} streams, none of them with numbers; record the coils as a stream of them"
        )
    labelled = [(_labels(each), each) for each in numeric]
    every = [label for labels, _ in labelled for label in labels]
    begin_s = max(float(each["time_stamps"][0]) for each in numeric)
    times_s = np.unique(np.concatenate([each["time_stamps"] for each in numeric]))
    times_s = times_s[times_s >= begin_s]
    columns: _Columns = {"time_s": times_s}
    for labels, each in labelled:
        held = np.asarray(each["time_series"])[np.searchsorted(each["time_stamps"], times_s, "right") - 1]
        stream = str(each["info"]["name"][0])
        columns |= {
            label if every.count(label) == 1 else f"{stream} {label}": held[:, place]
            for place, label in enumerate(labels)
        }
    return columns


def _labels(stream: Any) -> list[str]:
    """Names of the channels; NAME_1, NAME_2, ... where the stream does not name them."""
    count, name = np.asarray(stream["time_series"]).shape[1], str(stream["info"]["name"][0])
    try:
        channels = stream["info"]["desc"][0]["channels"][0]["channel"]
        labels = [str(channel["label"][0]) for channel in channels]
    except (KeyError, IndexError, TypeError):
        labels = []
    return labels if len(labels) == count else [f"{name}_{number}" for number in range(1, count + 1)]


def _reading_error(path: Path, error: Exception) -> UsageError:
    said = " ".join(str(error).split())[:200]
    return UsageError(f"{path}: can not be read ({said or type(error).__name__}); save it again, or as CSV")


_READERS: dict[str, tuple[Callable[[Path], _Columns], str]] = {
    "mat": (_mat_columns, "scipy"),
    "mat7.3": (_mat73_columns, "h5py"),
    "xdf": (_xdf_columns, "pyxdf"),
}
