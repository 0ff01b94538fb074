"""The tasks of a sweep: each session with each combination of settings, and the hash by which a task is known."""

from __future__ import annotations

import glob
import hashlib
import itertools
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from flowrec.core import NUMERICS_VERSION, REPLAYED, SessionError, UsageError, __version__
from flowrec.store import SESSION_SUFFIX, Session, UrlPath, run_files, session_path, session_sha256
from flowrec.verbs import read_each, runs_of

if TYPE_CHECKING:
    from flowrec.verbs import Change

_BRACKETS = {"[": 1, "{": 1, "]": -1, "}": -1}

Settings = tuple[tuple[str, str], ...]  # key and value as text, in the order of the grid


@dataclass(frozen=True)
class Task:
    """One replay of a sweep.

    Attributes
    ----------
    session : the file, as an absolute path, or its URL; every worker reads it there.
    content : hash of what the session holds.
    settings : what the replay changes.
    refly : both plans are flown in a simulator, too.
    judge : the session is checked, too, once for all its tasks.
    timeout_s, memory_bytes : limits of the task; None: those of its worker.
    packages : what the settings use of packages of others, with versions and hashes; "": nothing.
    """

    session: str
    content: str
    settings: Settings
    refly: bool = False
    judge: bool = False
    timeout_s: float | None = None
    memory_bytes: int | None = None
    packages: str = ""

    @cached_property
    def key(self) -> str:
        """Hash of content, settings and versions, 32 hexadecimal digits: the same result has the same key."""
        known = [self.content, sorted(self.settings), self.refly, __version__, NUMERICS_VERSION]
        known += [self.packages] if self.packages else []
        return hashlib.sha256(json.dumps(known).encode()).hexdigest()[:32]


def change_of(settings: Settings) -> Change:
    """Settings as `flowrec replay` takes them: the names of methods are its options, all else its --set."""
    from flowrec.verbs import Change  # late: a worker of Dask only hands tasks on

    methods = {key: value for key, value in settings if key in REPLAYED}
    return Change(**methods, sets=tuple(f"{key}={value}" for key, value in settings if key not in REPLAYED))


def combinations(grid: Sequence[str], sets: Sequence[str], columns: Sequence[str] = ()) -> list[Settings]:
    """Every combination of the values of a grid.

    Raises UsageError: a text is no `key=value`, a key is named twice, or a recording fixes it.

    Parameters
    ----------
    grid : texts such as `refine=fvm,assimilate`; a comma within brackets belongs to its value.
    sets : texts `key=value` that hold for all combinations.
    columns : names that a key may not have.
    """
    from flowrec.verbs import FIXED

    axes: dict[str, list[str]] = {}
    for flag, texts in (("--grid", grid), ("--set", sets)):
        for text in texts:
            key, equals, values = (part.strip() for part in text.partition("="))
            found = list(dict.fromkeys(_split(values))) if flag == "--grid" else [values]
            if not key or not equals or not all(found):
                raise UsageError(f"{flag} {text!r}: expected key=value, as in --grid refine=fvm,assimilate")
            if key in axes:
                raise UsageError(f"{flag} {text}: {key} is named twice; name all its values in one --grid")
            if key.split(".")[0] in FIXED:
                raise UsageError(
                    f"{flag} {text}: a replay can not change the {key.split('.')[0]} of a recording; record again"
                )
            if key in columns:
                raise UsageError(f"{flag} {text}: {key} does not change a replay; leave it out")
            axes[key] = found
    return [tuple(zip(axes, values, strict=True)) for values in itertools.product(*axes.values())]


def _split(text: str) -> list[str]:
    """The values between the commas that stand in no bracket."""
    values, depth = [""], 0
    for letter in text:
        depth += _BRACKETS.get(letter, 0)
        if letter == "," and depth == 0:
            values.append("")
        else:
            values[-1] += letter
    return [value.strip() for value in values]


def session_files(places: Sequence[str]) -> list[Path]:
    """The sessions that files, URLs, folders and patterns such as `runs/*.mcap` name, each once; parts as their run.

    Raises UsageError: one of them names no session.
    """
    found: dict[Path, None] = {}
    for place in places:
        if isinstance(at := session_path(place), UrlPath):
            from flowrec.store import files_at  # late: an extra

            files = files_at(at, (SESSION_SUFFIX,))
            if not files:
                raise UsageError(f"{at}: no session (.mcap) is there")
            found |= dict.fromkeys(runs_of(files))
            continue
        folder = Path(place).is_dir()
        whole = glob.escape(place) + f"/*{SESSION_SUFFIX}" if folder else place
        names = [place] if Path(place).is_file() else sorted(glob.glob(whole, recursive=True))  # noqa: PTH207 - text
        files = [Path(name).absolute() for name in names if name.endswith(SESSION_SUFFIX)]
        runs = runs_of(files)
        run = Path(place).absolute()
        if not runs and not (run.name.endswith(SESSION_SUFFIX) and run_files(run)):  # X.mcap may be a run in parts
            raise UsageError(f"{place}: no session (.mcap) is there; name files, folders or patterns as 'runs/*.mcap'")
        found |= dict.fromkeys(runs or [run])
    return list(found)


def content_of(session: Session) -> str:
    """Hash of the content of a session, 32 hexadecimal digits.

    It is made of the digests that its files state of their messages and header, so no message is read. Of files of the
    first release, which state none, it is that of the bytes. Raises SessionError: the session can not be read.
    """
    digests = [file.digest or {"file": session_sha256([file.path])} for file in session.run.files]
    return hashlib.sha256(json.dumps([sorted(each.items()) for each in digests]).encode()).hexdigest()[:32]


@dataclass(frozen=True, slots=True)
class Sessions:
    """The sessions of a sweep."""

    by_content: dict[str, Path]  # one file for each content, by its hash
    # lines of text about files that are not replayed: copies, replays, and what is no whole session
    left_out: list[str]
    unreadable: int  # how many of those are no whole sessions

    @classmethod
    def of(cls, files: Sequence[Path], progress: Callable[[int], None] = lambda _: None) -> Sessions:
        """Read the heads and indexes of files; `progress` takes how many are read.

        Raises UsageError: none of them can be replayed.
        """
        found: dict[str, Path] = {}
        left_out: list[str] = []
        unreadable = 0
        with read_each(_content, files, far=any(isinstance(file, UrlPath) for file in files)) as read:
            for number, (path, content) in enumerate(zip(files, read, strict=True)):
                progress(number)
                if isinstance(content, SessionError):
                    left_out.append(str(content))
                    unreadable += 1
                    continue
                if not content:
                    left_out.append(f"{path.name}: is a replay, and is passed over")
                    continue
                first = found.setdefault(content, path)
                if first is not path:
                    left_out.append(f"{path.name}: holds the same as {first.name}, and is replayed once")
        if not found:
            more = f"; {left_out[0]}" if left_out else ""
            raise UsageError(f"no session that can be replayed is among {len(files)} files{more}")
        return cls(found, left_out, unreadable)


def _content(path: Path) -> str | SessionError:
    """Hash of the content of a session; '' of a replay."""
    try:
        session = Session(path)
        return "" if session.header.parent else content_of(session)
    except SessionError as error:
        return error
