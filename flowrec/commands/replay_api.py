"""`flowrec.replay`: replay a session from Python and get its tables, its session and what it changed."""

from __future__ import annotations

import html
import shutil
import tempfile
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import fields
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flowrec.commands.interactive import Unattended
from flowrec.commands.replay import Change
from flowrec.commands.replay import replay as replay_verb
from flowrec.commands.replay_result import Replayed
from flowrec.errors import UsageError
from flowrec.replay_figures import before_after
from flowrec.session import Session
from flowrec.summary import Row, comparison_for_people

if TYPE_CHECKING:
    import pandas
    import pyarrow as pa


class BeforeAfter(tuple[Row, ...]):
    """Rows of key, recorded and replayed value; the keys carry the unit. As text and in a notebook it is a table."""

    __slots__ = ()

    def to_pandas(self) -> pandas.DataFrame:
        """The columns recorded and replayed, a row a key; UsageError if pandas is not installed."""
        try:
            import pandas
        except ModuleNotFoundError as error:
            raise UsageError("to_pandas needs pandas, which is not installed: pip install 'flowrec[export]'") from error
        columns = {"recorded": [row[1] for row in self], "replayed": [row[2] for row in self]}
        return pandas.DataFrame(columns, index=pandas.Index([row[0] for row in self], name="quantity"), dtype=object)

    def __str__(self) -> str:
        shown = [("", "recorded", "replayed"), *comparison_for_people(self)]
        widths = [max(len(row[column]) for row in shown) for column in range(3)]
        return "\n".join(f"{a:<{widths[0]}}  {b:>{widths[1]}}  {c:>{widths[2]}}" for a, b, c in shown)

    def _repr_html_(self) -> str:
        rows = "".join(
            "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>"
            for row in comparison_for_people(self)
        )
        return f"<table><tr><th></th><th>recorded</th><th>replayed</th></tr>{rows}</table>"


class Replay(Replayed):
    """A `Replayed`, with all messages of the replay.

    Attributes
    ----------
    result : the replay as a session, without images unless they were asked for. Without `out` it is a temporary file,
        which goes when this object goes.
    before_after : what the replay changed: errors, routes, times, commands.
    """

    _path: Path

    @classmethod
    def of(cls, done: Replayed, path: Path) -> Replay:
        """A finished replay and its file."""
        made = cls(**{each.name: getattr(done, each.name) for each in fields(Replayed)})
        made._path = path
        return made

    @cached_property
    def result(self) -> Session:
        return Session(self._path)

    def table(self, topic: str) -> pa.Table:
        """All messages of one topic of the replay, as `Session.table`."""
        return self.result.table(topic)

    @cached_property
    def before_after(self) -> BeforeAfter:
        return BeforeAfter(before_after(self))


def replay(
    session: Session | Path | str,
    change: Change | None = None,
    from_s: float | None = None,
    verify: bool = False,
    out: Path | str | None = None,
    overwrite: bool = False,
    frames: bool = False,
    control: Unattended | None = None,
    *,
    refine: str | None = None,
    plan: str | None = None,
    observer: str | None = None,
    controller: str | None = None,
    sets: Sequence[str] | Mapping[str, Any] = (),
) -> Replay:
    """Replay a session, in any thread, the same or with other methods and settings; the recording is only read.

    >>> done = flowrec.replay("a.mcap", refine="assimilate", sets={"robot.um_per_rev": 24})
    >>> print(done.before_after)
    >>> done.table("estimate").to_pandas()

    Parameters
    ----------
    change : methods and settings as one object, instead of the names below.
    from_s : session time in s to start at.
    verify : compute the results of the worker again, too, and compare the files with their digests.
    out : session file of the replay; None: a temporary one.
    overwrite : `out` may replace an existing file.
    frames : copy the camera's images to the replay.
    control : who attends the replay; None: nobody, it takes no signals and shows no progress.
    refine, plan, observer, controller : names of methods; None: as recorded.
    sets : settings, as {"refine.pi_unet.steps": 200} or ["refine.pi_unet.steps=200"].

    Raises
    ------
    UsageError : a change that is not possible, or a time outside of the session.
    SessionError : the session can not be read or replayed, or `out` not be written.
    """
    if isinstance(sets, str):
        raise UsageError(f"sets = {sets!r}: give a list, as [{sets!r}], or a dictionary")
    texts = tuple(f"{key}={_toml(value)}" for key, value in sets.items()) if isinstance(sets, Mapping) else tuple(sets)
    named = Change(refine, plan, observer, controller, texts)
    if change is not None and named != Change():
        raise UsageError("change and the names of methods or settings: give one of them")
    folder = Path(tempfile.mkdtemp(prefix="flowrec-replay-")) if out is None else None
    path = folder / f"{Session.of(session).path.stem}_replay.mcap" if folder is not None else Path(out or "")
    try:
        done = replay_verb(session, change or named, from_s, verify, path, overwrite, frames, control)
    except BaseException:
        _remove(folder)
        raise
    made = Replay.of(done, path)
    weakref.finalize(made, _remove, folder)
    return made


def _remove(folder: Path | None) -> None:
    if folder is not None:
        shutil.rmtree(folder, ignore_errors=True)


def _toml(value: Any) -> str:
    """A value as --set takes it."""
    return str(value).lower() if isinstance(value, bool) else str(value)
