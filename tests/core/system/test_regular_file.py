"""A pipe or a device where a file belongs is refused in one line: nothing waits for it, and nothing is read of it."""

import contextlib
import os
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from flowrec.archive.catalog import catalog_file
from flowrec.core import FlowrecError, read_table, read_toml
from flowrec.measure.coil_calibration import read_excitations
from flowrec.movies import open_movie
from flowrec.physics import ChipSettings, load_chip
from flowrec.store import SessionReader, notes_content, notes_file, recover
from flowrec.store.notes import append_note
from tests.movies import makers

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="there are no pipes among its files")

READERS = {
    "table.csv": read_table,
    "table.xlsx": read_table,
    "settings.toml": read_toml,
    "movie.avi": open_movie,
    "excitations.csv": read_excitations,
    "chip.png": lambda path: load_chip(ChipSettings(path=str(path))),
    "chip.npz": lambda path: load_chip(ChipSettings(path=str(path))),
    "session.mcap": SessionReader,
    "killed.mcap.partial": recover,
    "session.notes.jsonl": notes_content,
    "catalog.parquet": catalog_file.read,
}


def pipe_at(path: Path) -> None:
    """A named pipe. Whoever opens it, against the promise, finds it empty at once and does not hang."""

    def release() -> None:
        with contextlib.suppress(OSError):
            while True:
                os.close(os.open(path, os.O_WRONLY))

    os.mkfifo(path)
    threading.Thread(target=release, daemon=True).start()


@pytest.mark.parametrize("name", READERS)
def test_a_pipe_is_refused_before_it_is_opened(name, tmp_path):
    pipe_at(tmp_path / name)
    with pytest.raises(FlowrecError, match=rf"{name}: is a pipe"):
        READERS[name](tmp_path / name)


@pytest.mark.parametrize("name", READERS)
def test_a_link_to_a_device_that_never_ends_is_refused(name, tmp_path):
    (tmp_path / name).symlink_to("/dev/zero")
    with pytest.raises(FlowrecError, match=rf"{name}: .*/dev/zero"):
        READERS[name](tmp_path / name)


def test_no_note_is_written_into_a_pipe(tmp_path):
    pipe_at(notes_file(tmp_path / "a.mcap"))
    with pytest.raises(FlowrecError, match="only files"):
        append_note(tmp_path / "a.mcap", "key", "text", (), "me")


def test_a_folder_of_zarr_with_a_pipe_in_it_is_refused(tmp_path):
    path = makers.ome_zarr(tmp_path / "a.zarr", [np.ones((48, 64), np.uint8)] * 2, 0.1)
    chunk = next(each for each in path.rglob("c/**/*") if each.is_file())
    chunk.unlink()
    pipe_at(chunk)
    with pytest.raises(FlowrecError, match="is a pipe"):
        open_movie(path)
