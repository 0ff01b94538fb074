"""`flowrec export`: every format of the table."""

from __future__ import annotations

import csv
import json
import os
import resource
import shutil
from importlib import import_module
from itertools import islice
from pathlib import Path

import pytest

import flowrec
from flowrec.core import OutputError, SessionError, UsageError
from flowrec.exports import EXPORTS
from flowrec.verbs.view import view
from tests.conftest import invoke
from tests.store.made_up import write_session

GOLDEN = Path(__file__).parents[2] / "sessions" / "golden.mcap"


@pytest.fixture(params=list(EXPORTS))
def any_export(request: pytest.FixtureRequest) -> str:
    """The name of each format in turn."""
    name: str = request.param
    return name


@pytest.fixture(scope="module")
def brief(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first ticks of the golden session: what is made of it again and again need not be long."""
    path, session = tmp_path_factory.mktemp("brief") / "brief.mcap", flowrec.open(GOLDEN)
    return write_session(path, islice(session.ticks(), 10), session.header, outcome={"outcome": "stopped"})


def test_the_ending_of_an_output_names_its_format_and_one_that_names_none_is_asked_for(
    brief: Path, tmp_path: Path
) -> None:
    assert flowrec.export(brief, tmp_path / "a.csv") == tmp_path / "a.csv"
    assert (tmp_path / "a.csv" / "track.csv").exists()
    assert flowrec.export(brief, tmp_path).suffix == ".rrd"  # a folder names none: what the view opens
    for name in ("tables", "a.h5"):
        with pytest.raises(UsageError, match=rf"{name}: .*--format: rrd, "):
            flowrec.export(brief, tmp_path / name)


def test_an_export_replaces_an_earlier_export_of_the_same_session_and_no_other_file(
    any_export: str, brief: Path, tmp_path: Path
) -> None:
    session = Path(shutil.copy(brief, tmp_path))
    made = flowrec.export(session, file_format=any_export)
    assert made.parent == tmp_path
    assert made.stem.startswith(session.stem)
    assert flowrec.export(session, file_format=any_export) == made
    assert set(tmp_path.iterdir()) - {tmp_path / ".flowrec_exports.json"} == {session, made}
    changed = next(path for path in made.rglob("*") if path.is_file()) if made.is_dir() else made
    with changed.open("ab") as file:
        file.write(b"my annotation")
    with pytest.raises(OutputError, match="exists already"):
        flowrec.export(session, file_format=any_export)
    assert changed.read_bytes().endswith(b"my annotation")
    assert flowrec.export(session, file_format=any_export, overwrite=True) == made
    assert not changed.read_bytes().endswith(b"my annotation")
    if made.is_dir():
        (changed.parent / "precious").touch()
        for overwrite in (False, True):
            with pytest.raises(OutputError, match="flowrec export"):
                flowrec.export(session, file_format=any_export, overwrite=overwrite)
    else:
        made.unlink()
        made.write_bytes(b"precious")
        with pytest.raises(OutputError, match="exists already"):
            flowrec.export(session, file_format=any_export)


def test_an_unknown_format_is_an_error_that_names_the_formats(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"--format = 'cvs': .*rrd"):
        flowrec.export(GOLDEN, tmp_path / "x.cvs", file_format="cvs")
    assert not list(tmp_path.iterdir())


def test_a_format_whose_library_is_not_installed_says_what_installs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    import importlib

    def absent(name: str) -> object:
        raise ModuleNotFoundError("No module named 'pyarrow'", name="pyarrow")

    monkeypatch.setattr(importlib, "import_module", absent)
    with pytest.raises(UsageError, match=r"pip install 'flowrec\[export\]'"):
        EXPORTS["parquet"].load()


@pytest.fixture(scope="module")
def tables(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The folders of the golden session in both formats of tables."""
    folder = tmp_path_factory.mktemp("tables")
    return {name: flowrec.export(GOLDEN, folder / name, file_format=name) for name in ("parquet", "csv")}


def test_other_programs_read_the_tables_with_stamps_to_the_nanosecond(tables: dict[str, Path]) -> None:
    import duckdb
    import pandas

    track = list(flowrec.open(GOLDEN).messages("track"))
    stamps, x_um = [each.stamp_ns for each in track], [float(each.position_um[0]) for each in track]
    parquet, text = tables["parquet"] / "track.parquet", tables["csv"] / "track.csv"
    for frame in (pandas.read_parquet(parquet), pandas.read_csv(text)):
        assert frame["stamp_ns"].tolist() == stamps
        assert frame["position_x_um"].tolist() == pytest.approx(x_um, rel=1e-14)
    for file in (parquet, text):
        rows = duckdb.sql(f"select stamp_ns, position_x_um from '{file}' order by stamp_ns").fetchall()
        assert rows == list(zip(stamps, x_um, strict=True))
    with text.open(newline="", encoding="utf-8") as lines:
        read = list(csv.DictReader(lines))
    assert [(int(row["stamp_ns"]), float(row["position_x_um"])) for row in read] == list(zip(stamps, x_um, strict=True))
    assert json.loads(read[0]["roi_px"]) == track[0].roi_px.tolist()


def test_no_text_of_a_csv_is_a_formula_and_each_can_be_had_back_exactly(tmp_path: Path) -> None:
    import pyarrow

    from flowrec.exports.tabular import CsvExport

    run = ("=", "+", "-", "@", "\t", "\r", "\uff1d", "\uff0b", "\uff0d", "\uff20")
    texts = [*(f"{begin}1+1" for begin in run), "'", "'=1", "plain = 1", '"=1"', "", None]
    batch = pyarrow.record_batch({"text": pyarrow.array(texts, pyarrow.string()), "number": [-1.5] * len(texts)})
    exporter = CsvExport()
    with exporter.open_writer(tmp_path / "a.csv", exporter.select(batch.schema)) as writer:
        writer.write_batch(exporter.select(batch))
    with (tmp_path / "a.csv").open(newline="", encoding="utf-8") as lines:
        rows = list(csv.DictReader(lines))
    assert [row["text"].removeprefix("'") for row in rows] == [text or "" for text in texts]
    assert not any(row["text"].startswith(run) for row in rows)
    assert {row["number"] for row in rows} == {"-1.5"}


def test_the_data_package_names_every_file_and_column_with_unit_and_meaning(tables: dict[str, Path]) -> None:
    import pandas

    for name, folder in tables.items():
        package = json.loads((folder / "datapackage.json").read_text(encoding="utf-8"))
        files = {each["path"]: each for each in package["resources"]}
        assert set(files) | {"datapackage.json", "flowrec_export.json"} == {path.name for path in folder.iterdir()}
        read = pandas.read_parquet if name == "parquet" else pandas.read_csv
        for path, described in files.items():
            if "schema" in described:
                columns = [each["name"] for each in described["schema"]["fields"]]
                assert columns == list(read(folder / path).columns)
                assert all(each["description"] for each in described["schema"]["fields"])
    units = {each["name"]: each.get("unit") for each in files["track.csv"]["schema"]["fields"]}
    assert units["position_x_um"] == "um" and units["seen"] is None
    field = flowrec.open(GOLDEN).fields["refined"]
    table = pandas.read_parquet(tables["parquet"] / "field_refined.parquet")
    row, column = (table[["y_um", "x_um"]].to_numpy() / field.um_per_px).round().astype(int)[100]
    assert table[["u_um_s", "v_um_s"]].to_numpy()[100].tolist() == field.velocity_um_s[row, column].tolist()


def test_a_disk_that_is_full_halfway_leaves_nothing_and_is_an_error_of_one_line(
    any_export: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    suffix = EXPORTS[any_export].load().suffixes[0]
    _, most = limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, most))
    try:
        with pytest.raises(SessionError, match=r"can not be written \(.*\); choose another place$") as failed:
            flowrec.export(GOLDEN, tmp_path / f"a{suffix}", file_format=any_export)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert "\n" not in str(failed.value)
    assert not list(tmp_path.iterdir())
    said = capfd.readouterr().err
    assert "Traceback" not in said


def test_a_format_with_a_suffix_is_written_into_an_existing_folder(tmp_path: Path) -> None:
    assert flowrec.export(GOLDEN, tmp_path, file_format="zarr") == tmp_path / "golden.zarr"
    assert flowrec.export(GOLDEN, tmp_path, file_format="zarr") == tmp_path / "golden.zarr"
    with pytest.raises(OutputError, match="flowrec export"):
        flowrec.export(GOLDEN, tmp_path, file_format="csv", overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["golden.zarr"]


def test_the_verb_takes_the_folder_as_a_word_and_says_what_it_made(tmp_path: Path) -> None:
    done = invoke("export", GOLDEN, tmp_path / "t", "--format", "parquet", "--json")
    facts = json.loads(done.stdout)
    nbytes = sum(path.stat().st_size for path in (tmp_path / "t").iterdir())
    covered = facts.pop("covered")
    assert covered["whole"] and covered["unit"] == "s"
    assert facts == {"session": str(GOLDEN), "parquet": str(tmp_path / "t"), "bytes": nbytes}


def test_view_keeps_the_recording_of_an_unchanged_session_and_writes_that_of_a_changed_one(
    brief: Path, tmp_path: Path
) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(brief.read_bytes())
    rrd = path.with_suffix(".rrd")

    def written_anew(overwrite: bool = False) -> bool:
        before_ns = rrd.stat().st_mtime_ns if rrd.exists() else 0
        view(path, no_open=True, overwrite=overwrite)
        return rrd.stat().st_mtime_ns != before_ns

    assert written_anew() and not written_anew() and written_anew(overwrite=True)
    os.utime(path)  # as if it were another one of that size
    assert written_anew() and not written_anew()
    rrd.write_bytes(rrd.read_bytes()[:-100])
    with pytest.raises(OutputError):  # it is no longer ours to replace
        view(path, no_open=True)
    rrd.unlink()
    assert written_anew()


def test_an_export_is_kept_until_what_it_is_made_of_or_the_code_that_made_it_has_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    exporting = import_module("flowrec.exports.export")  # whose function has its name
    code, session = tmp_path / "code" / "a.py", tmp_path / "s.mcap"
    code.parent.mkdir()
    for file in (code, session):
        file.write_text("x")
    monkeypatch.setattr(exporting, "PACKAGE", code.parent)
    known = {exporting._made_from((session,))}
    assert known == {exporting._made_from((session,))} and exporting._made_from(()) == ""
    changes = (
        lambda: code.write_text("xy"),
        lambda: session.write_text("xy"),
        lambda: os.utime(session, ns=(1, 1)),
        lambda: code.with_name("b.py").write_text("x"),
        session.unlink,
    )
    for number, change in enumerate(changes, 2):
        change()
        known.add(exporting._made_from((session,)))
        assert len(known) == number
