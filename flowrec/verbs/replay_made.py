"""Products of `flowrec replay`: a session, its tables, a list of changes, and flights of both plans."""

from __future__ import annotations

import html
import shutil
import tempfile
import weakref
from collections.abc import Sequence
from dataclasses import fields
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flowrec.core import Row, UsageError, comparison_for_people, say, table, warn
from flowrec.run import before_after
from flowrec.store import Session
from flowrec.verbs.interactive import Unattended
from flowrec.verbs.replay_change import Change
from flowrec.verbs.replay_report import Outputs, refinement_remarks
from flowrec.verbs.replay_report import refly as refly_both
from flowrec.verbs.replay_result import Replayed
from flowrec.verbs.session_replay import replay_session

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
    file : the session of the replay; None if none was written.
    result : the same, open, without images unless they were asked for. Without `out` it is a temporary file, which goes
        when this object goes.
    before_after : what the replay changed: errors, routes, times, commands; and how both plans were flown.
    """

    file: Path | None
    _reflown: list[Row]

    @classmethod
    def of(cls, done: Replayed, file: Path | None, reflown: Sequence[Row] = ()) -> Replay:
        """A finished replay, its file, and rows about the flights of both plans."""
        made = cls(**{each.name: getattr(done, each.name) for each in fields(Replayed)})
        made.file, made._reflown = file, list(reflown)
        return made

    @cached_property
    def result(self) -> Session:
        if self.file is None:
            raise UsageError("this verification wrote no session: it only compares")
        return Session(self.file)

    def table(self, topic: str) -> pa.Table:
        """All messages of one topic of the replay, as `Session.table`."""
        return self.result.table(topic)

    @cached_property
    def before_after(self) -> BeforeAfter:
        return BeforeAfter([*before_after(self), *self._reflown])

    @property
    def _remarks(self) -> list[str]:
        return [*self.packages, *refinement_remarks(self)]

    def changes_as_json(self) -> dict[str, Any]:
        """Changes of the replay, for JSON."""
        report = self.report
        figures = {"wall_s": report.wall_s, "duration_s": report.duration_s, "ticks": report.ticks}
        rows = [dict(zip(("quantity", "recorded", "replayed"), row, strict=True)) for row in self.before_after]
        doubts = {"doubts": "; ".join(self.doubts)} if self.doubts else {}
        return {"refinement": self._remarks, "rows": rows} | figures | {"covered": self.covered.as_json()} | doubts

    def show_changes(self, name: str) -> None:
        """Print what the replay changed, and what is doubtful of it."""
        report = self.report
        table(f"Replay of {name}", ("", "recorded", "replayed"), comparison_for_people(self.before_after))
        length = f"({report.duration_s:.1f} s) replayed in {report.wall_s:.1f} s"
        of_these = "; the figures are of those" if self.covered.stopped else ""
        say(f"{self.covered.text} {length}{of_these} -> {self.file}")
        for line in self._remarks:
            say(line)
        for doubt in self.doubts:
            warn(f"doubtful: {doubt}")


def make_replay(
    session: Session | Path | str,
    change: Change,
    from_s: float | None,
    out: Path | None,
    *,
    verify: bool,
    overwrite: bool,
    frames: bool,
    control: Unattended | None,
    numbered: bool,
    refly: bool,
    rrd: bool,
) -> Replay:
    """Replay a session and write all outputs; parameters and errors as of `flowrec.replay`.

    Of a replay that was stopped nothing but its session is made.
    """
    session = Session.of(session)
    if verify and numbered and out is None:
        return Replay.of(replay_session(session, change, from_s, verify=True, control=control), None)
    folder = Path(tempfile.mkdtemp(prefix="flowrec-replay-")) if out is None and not numbered else None
    try:
        file = folder / f"{session.path.stem}_replay.mcap" if folder is not None else out
        outputs = Outputs.of(session.path, file, overwrite, refly=refly, rrd=rrd)
        file = outputs.session.path
        done = replay_session(session, change, from_s, verify, file, overwrite, frames, control)
        rows: list[Row] = []
        if outputs.refly is not None and not done.covered.stopped:
            rows = refly_both(done, outputs.refly)
        if outputs.rrd is not None and not done.covered.stopped:
            from flowrec.exports import export  # late: it imports Rerun

            export(file, overwrite=overwrite)
    except BaseException:
        _remove(folder)
        raise
    made = Replay.of(done, file, rows)
    weakref.finalize(made, _remove, folder)
    return made


def _remove(folder: Path | None) -> None:
    if folder is not None:
        shutil.rmtree(folder, ignore_errors=True)
