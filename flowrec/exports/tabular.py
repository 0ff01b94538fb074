"""The export formats parquet and csv: a table a topic, streamed, with a datapackage.json that explains each column.

Besides the topics there are a table of each flow field and one of the observed flow, with a row a place. Each column
has its name, type, unit and meaning by the Data Package standard; they come from the metadata of the Arrow schema, so
from the declarations of the messages. https://datapackage.org/standard/data-package/
"""

from __future__ import annotations

import json
import re
from abc import abstractmethod
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute
import pyarrow.csv
import pyarrow.parquet

from flowrec.core import SAMPLES, SessionError, __version__, seconds, summary_of
from flowrec.exports.formats import TimeProgress
from flowrec.stages import observations_of_others
from flowrec.store import Session, field_values, observed_flow, sample_batches, sample_schema

_RUN = "^[=+\\-@\t\r'＝＋－＠]"  # what a text begins with that a spreadsheet may take for a formula
_LEVEL = 1  # of zstd: a quarter of the time of level 3 for a tenth more bytes
_TYPES = (
    (pa.types.is_boolean, "boolean"),
    (pa.types.is_integer, "integer"),
    (pa.types.is_floating, "number"),
    (pa.types.is_timestamp, "datetime"),
    (pa.types.is_string, "string"),
)
_MEDIA_TYPES = {".parquet": "application/vnd.apache.parquet", ".csv": "text/csv"}


class _Tables:
    """Base of both formats: implements flowrec.exports.formats.Exporter but for the writer of a file."""

    suffixes = ("",)
    folder = True
    suffix: str
    remark = ""  # on the texts of its tables

    @abstractmethod
    def open_writer(self, path: Path, schema: pa.Schema) -> Any:
        """A writer of record batches with that schema, as a context manager with `write_batch`."""

    def select(self, table: pa.RecordBatch | pa.Table | pa.Schema) -> Any:
        """The columns that the format holds."""
        return table

    def write(self, session: Session, part: Path, progress: TimeProgress) -> None:
        topics = [topic for topic in session.reader.topics.topics if session.topics.get(topic.path)]
        if not topics:
            raise SessionError(f"{session.path}: holds no messages, so there are no tables; see flowrec info")
        begin_s = seconds(session.run.first_ns)
        resources: list[dict[str, Any]] = []
        with ExitStack() as stack:
            writers: dict[str, Any] = {}
            for topic in topics:
                name, schema = _file_stem(topic.field) + self.suffix, self.select(session.schema(topic.field))
                writers[topic.field] = stack.enter_context(self.open_writer(part / name, schema))
                resources.append(_resource(name, schema, f"{summary_of(topic.type)}; {topic.path}, a row a message"))
            for field, batch in session.batches(list(writers)):
                writers[field].write_batch(self.select(batch))
                progress(batch.column("time_s")[-1].as_py() - begin_s)
        for name, table, meaning in _places(session):
            with self.open_writer(part / (name + self.suffix), table.schema) as writer:
                for batch in table.to_batches():
                    writer.write_batch(batch)
            resources.append(_resource(name + self.suffix, table.schema, meaning))
        if SAMPLES in session.reader.topics.by_path:
            name, schema = "stream_samples" + self.suffix, sample_schema()
            with self.open_writer(part / name, schema) as writer:
                for batch in sample_batches(session.reader):
                    writer.write_batch(self.select(batch))
            resources.append(_resource(name, schema, "the samples of the streams of other programs, a row each"))
        _write_datapackage(part, session, resources, self.remark)


def _file_stem(topic: str) -> str:
    """File stem of the table of a topic: its field or, of an extra one, its path with dots, so all differ."""
    return f"extra{topic.replace('/', '.')}" if topic.startswith("/") else topic


def _places(session: Session) -> Iterator[tuple[str, pa.Table, str]]:
    """Name, table and description of what has a row a place, as it was last known."""
    for name, field in session.fields.items():
        meaning = f"the {name} flow field, at the centres of the fluid pixels; method {field.method}"
        yield f"field_{name}", field_values(field, session.chip.mask), meaning
    last = session.reader.tick_before(session.run.last_ns, with_frames=False)
    meaning = "the latest observations of the flow{}, a row each, as flowrec.refine reads them"
    if last.observations is not None:
        yield "observed_flow", observed_flow(last.observations), meaning.format("")
    for number, observations in sorted(observations_of_others(last).items()):
        yield f"observed_flow.robot.{number}", observed_flow(observations), meaning.format(f" by robot {number}")
    if last.tracer_flow is not None:
        yield "observed_flow.tracers", observed_flow(last.tracer_flow), meaning.format(" by tracers")


class ParquetExport(_Tables):
    """Parquet, compressed; https://parquet.apache.org. Arrays are nested lists."""

    suffix = ".parquet"
    advice = "a table a topic, which datapackage.json explains, for pandas.read_parquet, DuckDB and others, is in"

    def open_writer(self, path: Path, schema: pa.Schema) -> Any:
        return pyarrow.parquet.ParquetWriter(path, schema, compression="zstd", compression_level=_LEVEL)


class CsvExport(_Tables):
    """CSV by RFC 4180, UTF-8, numbers exact; an array is a cell with a JSON array, rasters are left out.

    The last flow field of each kind is in a table by itself, with a row a pixel. NaN and infinities are `nan` and
    `inf`, in arrays `NaN` and `Infinity`; what is not stated is an empty cell. An apostrophe is put before a text that
    a spreadsheet might run, and before one that begins with an apostrophe: a reader takes the first one away.
    https://owasp.org/www-community/attacks/CSV_Injection
    """

    suffix = ".csv"
    remark = (
        " A text that begins with = + - @, a tab, a return or an apostrophe has one more apostrophe before it, so that "
        "no spreadsheet runs it."
    )
    advice = "a table a topic, which datapackage.json explains, for spreadsheets and everything else, is in"

    def open_writer(self, path: Path, schema: pa.Schema) -> Any:
        return pyarrow.csv.CSVWriter(path, pa.schema([_text(field) for field in schema]))

    def select(self, table: pa.RecordBatch | pa.Table | pa.Schema) -> Any:
        schema = table if isinstance(table, pa.Schema) else table.schema
        kept = [field for field in schema if not _is_raster(field.type)]
        if table is schema:
            return pa.schema(kept, metadata=schema.metadata)
        cells = [_cells(table.column(field.name)) for field in kept]
        return pa.RecordBatch.from_arrays(cells, schema=pa.schema([_text(field) for field in kept]))


def _cells(column: pa.Array) -> pa.Array:
    """A column as it is written."""
    if pa.types.is_nested(column.type):
        return pa.array([None if cell is None else json.dumps(cell) for cell in column.to_pylist()], pa.string())
    if not pa.types.is_string(column.type):
        return column
    marked = pyarrow.compute.binary_join_element_wise("'", column, "")
    return pyarrow.compute.if_else(pyarrow.compute.match_substring_regex(column, _RUN), marked, column)


def _text(field: pa.Field) -> pa.Field:
    return pa.field(field.name, pa.string()) if pa.types.is_nested(field.type) else field


def _is_raster(kind: pa.DataType) -> bool:
    """True if the cells of a column are arrays of float32: fields on the pixels of the chip, and looks of the robot."""
    while pa.types.is_nested(kind):
        kind = kind.value_type
    return bool(pa.types.is_float32(kind))


def _write_datapackage(folder: Path, session: Session, tables: list[dict[str, Any]], remark: str) -> None:
    """Write the description of a folder of tables, and beside it the settings and the chip of the session.

    `tables`: the description of each file.
    """
    header = session.header
    (folder / "config.toml").write_text(header.config_toml, encoding="utf-8")
    (folder / "chip.toml").write_text(header.chip_toml, encoding="utf-8")
    (folder / "chip.png").write_bytes(header.chip_png)
    others = [
        {"name": "config", "path": "config.toml", "description": "settings of the run"},
        {"name": "chip", "path": "chip.png", "description": "mask of the chip: white is fluid"},
        {"name": "chip_openings", "path": "chip.toml", "description": "scale, openings and fluid of the chip"},
    ]
    package = {
        "$schema": "https://datapackage.org/profiles/2.0/datapackage.json",
        "name": re.sub(r"[^a-z0-9._-]", "_", session.path.stem.lower()) or "session",
        "title": f"flowrec session {session.path.name}",
        "description": (
            "Chip frame: origin at the centre of the mask's pixel (0, 0), x right, y down. stamp_ns and time_s are "
            f"times on the session clock.{remark}"
        ),
        "sources": [{"title": session.path.name, "path": session.path.name}],
        "provenance": dict(session.provenance),
        "outcome": dict(session.outcome),
        "exported_by": f"flowrec {__version__}",
        "resources": tables + others,
    }
    (folder / "datapackage.json").write_text(json.dumps(package, indent=1), encoding="utf-8")


def _resource(name: str, schema: pa.Schema, description: str) -> dict[str, Any]:
    path = Path(name)
    return {
        "name": path.stem,
        "path": name,
        "format": path.suffix[1:],
        "mediatype": _MEDIA_TYPES[path.suffix],
        "description": description,
        "schema": {"fields": [_field(each) for each in schema]},
    }


def _field(field: pa.Field) -> dict[str, str]:
    kind = next((name for is_kind, name in _TYPES if is_kind(field.type)), "array")
    metadata = field.metadata or {}
    found = {"name": field.name, "type": kind}
    found |= {"unit": metadata[b"unit"].decode()} if metadata.get(b"unit") else {}
    return found | {"description": metadata.get(b"meaning", b"").decode()}
