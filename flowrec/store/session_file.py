"""One file of a run while it is written: its head, its end, its two names, and what can go wrong with it."""

from __future__ import annotations

import contextlib
import errno
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from mcap.records import Metadata

from flowrec.errors import SessionError
from flowrec.store.channels import declarations
from flowrec.store.chunk import Sealed
from flowrec.store.frame_encodings import FrameEncoding
from flowrec.store.mcap_writer import McapFile
from flowrec.store.metadata import OUTCOME, PROFILE, VIEW, SessionHeader, records_of
from flowrec.store.paths import PARTIAL_SUFFIX, partial_path, pieces
from flowrec.store.roi import Region
from flowrec.store.segments import Tally
from flowrec.system.outputs import MCAP, check_output, put_in_place, sync_directory, taken
from flowrec.version import __version__


class PieceError(SessionError):
    """A file that can not be written any more; the text says which, and what next."""


@dataclass(frozen=True, slots=True)
class Making:
    """What all files of a run are made with.

    Attributes
    ----------
    path, header : of the run.
    frames : how images travel.
    flush_s, sync_s : how old at most what is not with the operating system, and not kept by the disk, may become.
    overwrite : replace what is there.
    region : which part of most images is kept (region.py); None: all.
    unwanted : topics that are not recorded.
    """

    path: Path
    header: SessionHeader
    frames: FrameEncoding
    flush_s: float
    sync_s: float
    overwrite: bool
    region: Region | None = None
    unwanted: frozenset[str] = frozenset()

    @property
    def sync_every_s(self) -> float:
        """A message waits up to half of the time for the next fsync to begin, and the other half until it is done."""
        return self.sync_s / 2

    @property
    def flush_every_s(self) -> float:
        """Half of the time is left for a thread that gets the processor late, or a slow disk."""
        return 0.5 * min(self.flush_s, self.sync_every_s)

    def said(self, tally: Tally) -> dict[str, str]:
        """What is added to every outcome."""
        if self.frames.lossless:
            return tally.told()
        return tally.told() | {"frames_encoding": f"{self.frames.name}, not lossless: a replay sees other pixels"}


class Piece:
    """A file that is named `PATH.partial` until it is whole, and then gets its name in one step.

    `sync` may run beside the other methods, in a thread of its own.

    Parameters
    ----------
    path : its name.
    header : goes first into it.
    making : what it is made with.

    Attributes
    ----------
    broken : something has failed; what could be written is for `flowrec recover`.

    Raises
    ------
    PieceError : from any method, when the disk refuses.
    """

    def __init__(self, path: Path, header: SessionHeader, making: Making) -> None:
        self.path = path
        self.partial_path = partial_path(path)
        self.broken = False
        self._listed = False
        self._overwrite = making.overwrite
        try:
            self._file = McapFile(self.partial_path, overwrite=making.overwrite)
        except OSError as error:
            raise _not_writable(self.partial_path, error) from error
        try:
            self._file.start(PROFILE, f"flowrec {__version__}")
            for record in (*records_of(header), *declarations(making.frames, making.region)):
                self._file.add(record)
        except OSError as error:
            self._file.close()
            raise _not_writable(self.partial_path, error) from error
        except BaseException:
            self._file.close()
            raise

    @property
    def size(self) -> int:
        """Bytes handed to the operating system."""
        return self._file.size

    def add_chunks(self, sealed: list[Sealed]) -> None:
        """Append chunks, all in one write."""
        with self._told():
            self._file.add_chunks(sealed)

    def sync(self) -> None:
        """Have the disk keep what was appended."""
        with self._told():
            self._file.sync()
            if not self._listed:
                sync_directory(self.partial_path.parent)  # or a power cut leaves content without a name
                self._listed = True

    def finish(self, outcome: Mapping[str, str], top_um_s: float | None) -> None:
        """The outcome, the scale of the views' colours and the summary, down to the disk; then the name."""
        with self._told():
            if top_um_s is not None:
                self._file.add(Metadata(VIEW, {"speed_scale_um_s": repr(top_um_s)}))
            self._file.add(Metadata(OUTCOME, dict(outcome)))
            self._file.add_digest()
            self._file.finish()
            self._file.sync()
            try:
                put_in_place(self.partial_path, self.path, overwrite=self._overwrite)
            except (FileExistsError, IsADirectoryError) as error:
                raise taken(self.path, f" (the finished session stays in {self.partial_path})") from error

    def close(self) -> None:
        """Close the file as it is."""
        self._file.close()

    def spoiled(self, error: SessionError) -> PieceError:
        """What to raise for a message that can not be stored."""
        self.broken = True
        return PieceError(f"{self.path}: {error}; `flowrec recover {self.partial_path}` keeps what came before")

    @contextlib.contextmanager
    def _told(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self.broken = True
            raise _disk_failed(self.partial_path, error) from error
        except BaseException:
            self.broken = True
            raise


def refuse_if_taken(path: Path, *, overwrite: bool, inputs: Iterable[Path] = ()) -> None:
    """Refuse the output X.mcap as `check_output` does, and any piece of that run, finished or not, in the same way.

    Raises
    ------
    OutputError : as `check_output`.
    PieceError : remains of a run are there, which `overwrite` would remove.
    """
    there = pieces(path)
    check_output(path, MCAP, inputs=inputs, overwrite=overwrite, also=(*there, partial_path(path)))
    if overwrite:
        return
    for piece in there:
        if not piece.name.endswith(PARTIAL_SUFFIX):
            raise taken(piece)
        raise PieceError(
            f"{piece}: is left from a run that did not finish; `flowrec recover {piece}`"
            " saves it, another --out or --overwrite goes on without it"
        )


def _not_writable(path: Path, error: OSError) -> PieceError:
    if isinstance(error, FileNotFoundError):
        return PieceError(f"{path.parent}: no such directory; make it, or choose another place with --out")
    if isinstance(error, BlockingIOError):
        return PieceError(f"{path}: is being written by another process just now; choose another name with --out")
    return PieceError(f"{path}: can not be made ({error.strerror}); choose another place with --out")


def _disk_failed(path: Path, error: OSError) -> PieceError:
    if error.errno == errno.ENOENT:
        return PieceError(f"{path}: is gone, it or its directory was removed or renamed; look for it there")
    what = "the disk is full" if error.errno in (errno.ENOSPC, errno.EDQUOT) else f"writing failed ({error.strerror})"
    return PieceError(f"{path}: {what}; free some space, then `flowrec recover {path}` saves what was recorded")
