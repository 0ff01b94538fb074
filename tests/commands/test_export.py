"""`flowrec export`: every format of the table."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

import flowrec
from flowrec.cli import app
from flowrec.errors import UsageError
from flowrec.exports.formats import EXPORTS
from flowrec.system.outputs import OutputError

GOLDEN = Path(__file__).parents[2] / "sessions" / "golden.mcap"


@pytest.fixture(params=list(EXPORTS))
def any_export(request: pytest.FixtureRequest) -> str:
    """The name of each format in turn."""
    name: str = request.param
    return name


def test_an_export_replaces_an_earlier_export_of_the_same_session_and_no_other_file(
    any_export: str, tmp_path: Path
) -> None:
    session = Path(shutil.copy(GOLDEN, tmp_path))
    file = flowrec.export(session, file_format=any_export)
    assert file.parent == tmp_path
    assert file.stem == session.stem
    assert file.stat().st_size > 0
    assert flowrec.export(session, file_format=any_export) == file
    file.write_bytes(b"precious")
    with pytest.raises(OutputError, match="exists already"):
        flowrec.export(session, file_format=any_export)
    assert file.read_bytes() == b"precious"


def test_the_help_of_export_lists_every_format_with_its_summary(any_export: str) -> None:
    shown = CliRunner().invoke(app, ["export", "--help"], env={"COLUMNS": "200"}).stdout
    words = " ".join(shown.replace("│", " ").split())
    assert f"{any_export}: {EXPORTS[any_export].summary}" in words


def test_an_unknown_format_is_an_error_that_names_the_formats(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"--format = 'cvs': must be one of .*rrd"):
        flowrec.export(GOLDEN, tmp_path / "x.cvs", file_format="cvs")
    assert not list(tmp_path.iterdir())
