"""The rows of `flowrec bench paper` as a table, and means of them with their intervals."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flowrec.bench.harness import Results, mean_with_interval, wilson
from flowrec.core import replacing


def write_parquet(rows: Sequence[Results], path: Path) -> None:
    """The rows as a table with all their columns; null where a row has no such value."""
    import pyarrow as pa
    import pyarrow.parquet

    names = list(dict.fromkeys(name for row in rows for name in row))
    columns = {name: [_plain(row.get(name)) for row in rows] for name in names}
    with replacing(path) as part:
        pyarrow.parquet.write_table(pa.table(columns), part, compression="zstd", compression_level=19)


def _plain(value: Any) -> Any:
    """Whole numbers of measured columns as real ones, as a column has one type; a picture or a curve with 4 digits."""
    if isinstance(value, list):
        return np.asarray(value, np.float32)
    return float(value) if isinstance(value, int) and not isinstance(value, bool) else value


def read_parquet(path: Path) -> list[Results]:
    """The rows of a table that `write_parquet` made, without what is null in them."""
    import pyarrow.parquet

    rows = pyarrow.parquet.read_table(path).to_pylist()
    return [{name: value for name, value in row.items() if value is not None} for row in rows]


def select(rows: Iterable[Results], experiment: str, **cell: Any) -> list[Results]:
    """The rows of an experiment in which these values are as given, and that did not fail; in the order of seeds."""
    some = [row for row in rows if row["experiment"] == experiment and not row["failed"]]
    return sorted((row for row in some if all(row[k] == v for k, v in cell.items())), key=lambda row: row["seed"])


def mean_of(rows: Sequence[Results], name: str) -> Results:
    """Mean and bootstrap 95 % interval of a value over rows, and their number; rows without it do not count."""
    values = [row[name] for row in rows if row.get(name) is not None]
    return mean_with_interval(values) | {"count": len(values)}


def share_of(rows: Sequence[Results], name: str) -> Results:
    """Share of the rows in which a value is true, and its Wilson 95 % interval."""
    true = sum(bool(row.get(name)) for row in rows)
    return {"mean": true / max(len(rows), 1), "interval_95": wilson(true, len(rows)), "count": len(rows)}


def as_text(found: Results, template: str = "{:.3f}") -> str:
    """Mean, interval and number of a result of `mean_of`, `share_of` or `compare`; one value alone has no interval."""
    if not found["count"]:
        return "none"
    if found["count"] == 1 and found["interval_95"][0] == found["interval_95"][1]:
        return f"{template.format(found['mean'])} (n 1)"
    low, high = (template.format(each) for each in found["interval_95"])
    return f"{template.format(found['mean'])} ({low} to {high}; n {found['count']})"
