"""An output folder appears as a whole, and replaces nothing but what flowrec itself exported from the same session."""

from __future__ import annotations

import errno
import shutil
from pathlib import Path

import pytest

from flowrec.core import OutputError, OutputFolder, SessionError
from flowrec.core.system.output_folder import MARKER

FACTS = {"format": "parquet", "session_key": "1"}


def made(path: Path, content: str = "1", **options: object) -> Path:
    with OutputFolder(path, FACTS, **options).new_folder() as part:  # type: ignore[arg-type]
        assert part.parent == path.parent and not any(part.iterdir())
        (part / "track.parquet").write_text(content)
    return path


def contents(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in folder.rglob("*") if path.is_file()}


def test_an_export_of_the_same_session_is_replaced_as_a_whole(tmp_path: Path) -> None:
    folder = made(tmp_path / "a")
    (made(folder, "2") / "track.parquet").read_text()
    assert contents(folder) | {MARKER: ""} == {"track.parquet": "2", MARKER: ""}
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_folder_with_anything_that_flowrec_did_not_write_stays_even_with_overwrite(
    tmp_path: Path, overwrite: bool
) -> None:
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "thesis.tex").write_text("precious")
    with pytest.raises(OutputError, match="mine: "):
        made(mine, overwrite=overwrite)
    added = made(tmp_path / "a")
    (added / "figure.png").write_text("precious")
    with pytest.raises(OutputError, match=r"a: .*figure\.png"):
        made(added, "2", overwrite=overwrite)
    assert contents(mine) == {"thesis.tex": "precious"}
    assert contents(added)["figure.png"] == "precious" and contents(added)["track.parquet"] == "1"


def test_an_export_of_another_session_is_replaced_with_overwrite_only(tmp_path: Path) -> None:
    folder = made(tmp_path / "a")
    other = OutputFolder(folder, FACTS | {"session_key": "2"})
    with pytest.raises(OutputError, match="exists already"), other.new_folder():
        raise AssertionError("no work before the check")
    with OutputFolder(folder, FACTS | {"session_key": "2"}, overwrite=True).new_folder() as part:
        (part / "b.csv").touch()
    assert set(contents(folder)) == {"b.csv", MARKER}


def test_a_failure_leaves_the_earlier_export_and_nothing_else(tmp_path: Path) -> None:
    folder = made(tmp_path / "a")

    def fail(failure: BaseException) -> None:
        with OutputFolder(folder, FACTS).new_folder() as part:
            (part / "half.parquet").write_text("half")
            raise failure

    for failure in (OSError(errno.ENOSPC, "No space left on device"), ValueError("another"), KeyboardInterrupt()):
        with pytest.raises(SessionError if isinstance(failure, OSError) else type(failure)) as caught:
            fail(failure)
        if caught.type is SessionError:
            assert str(caught.value).startswith(f"{folder}: ")
        assert contents(folder)["track.parquet"] == "1" and [path.name for path in tmp_path.iterdir()] == ["a"]


def test_a_folder_that_holds_the_session_or_is_a_link_is_never_replaced(tmp_path: Path) -> None:
    folder = made(tmp_path / "a")
    session = folder / "track.parquet"  # by its name an own file, but it is what the command reads
    with pytest.raises(OutputError, match="is read by this command"):
        made(folder, inputs=(session,), overwrite=True)
    link = tmp_path / "link"
    link.symlink_to(folder)
    with pytest.raises(OutputError, match="link: "):
        made(link, overwrite=True)
    shutil.rmtree(folder)
    with pytest.raises(OutputError, match="none"):
        made(tmp_path / "none" / "a")
    with pytest.raises(OutputError, match=r"\.zarr"):
        made(tmp_path / "a", suffixes=(".zarr",))
