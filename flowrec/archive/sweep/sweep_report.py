"""The page of a sweep: `flowrec report sweep.parquet`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flowrec.archive.sweep.ranking import Ranking, settings_text
from flowrec.archive.sweep.replay_process import Row
from flowrec.archive.sweep.results import read_rows
from flowrec.core import Output, UsageError, name_of, say, text_of_figure, with_micro
from flowrec.verbs import HTML, require_packages

if TYPE_CHECKING:
    from flowrec.exports import SweepPage

_LISTED = 60  # failed replays and settings on the page
_ROW_MM, _MARGIN_MM = 7.0, 14.0


def report_sweep(sweep: Path, out: Path | None = None, overwrite: bool = False) -> Path:
    """Write the page of a sweep: one HTML file that needs no network and no script.

    Raises UsageError: a package of the extra `report` is not installed; SessionError: the file can not be read, or the
    page not be written.

    Parameters
    ----------
    sweep : a file of `flowrec sweep` (.parquet).
    out : the page (.html); by default SWEEP_report.html beside it.
    """
    require_packages()
    from flowrec.exports import render, style

    output = Output(out or sweep.with_name(f"{sweep.stem}_report.html"), HTML, (sweep,), overwrite)
    output.check()
    rows = read_rows(sweep)
    if not rows:
        raise UsageError(f"{sweep}: holds no replay")
    with style.drawing():
        page = _page(sweep.name, rows, Ranking.of(rows))
    text = render(page)
    with output.new_file() as part:
        part.write_text(text, encoding="utf-8")
    say(f"{output.path} written; open it in a browser, print it, or send it as it is")
    return output.path


def _page(name: str, rows: Sequence[Row], ranking: Ranking) -> SweepPage:
    from flowrec.exports import ReportTable, SweepPage

    failed = [row for row in rows if row["error"]]
    verdicts = Counter(verdict for row in {row["content"]: row for row in rows}.values() if (verdict := row["verdict"]))
    versions = sorted({f"{row['flowrec']} with numerics {row['numerics_version']}" for row in rows})
    columns, cells = ranking.cells()
    tables = []
    if failed:
        lines = [(row["session"], settings_text(row), row["error"]) for row in failed[:_LISTED]]
        note = f"The first {_LISTED} of {len(failed)}." if len(failed) > _LISTED else ""
        tables.append(ReportTable("Replays that have failed", lines, ("session", "settings", "error"), note))
    if verdicts:
        counts = [(word, str(count)) for word, count in verdicts.most_common()]
        tables.append(ReportTable("Sessions by the verdict of flowrec check", counts, ("verdict", "sessions")))
    return SweepPage(
        name=name,
        outcome=_outcome(ranking.figure, cells),
        good=not failed,
        note=ranking.note,
        about=f"{len(rows)} replays of {ranking.of_sessions} sessions, {len(failed)} failed; "
        f"by flowrec {', '.join(versions)}",
        figure=_figure(ranking),
        ranking=ReportTable("Ranking", [[*map(with_micro, row)] for row in cells], columns, narrow_columns=3),
        tables=tables,
    )


def _outcome(figure: str, cells: Sequence[Sequence[str]]) -> str:
    """The first of the ranking with its figure, and by how much the next one is behind it."""
    if not figure:
        return "No ranking."
    (first, value, *_), *others = cells
    text = f"First: {first}, {name_of(figure)} {value}."
    for settings, _, more, interval, *_ in (each for each in others[:1] if each[2] != "-"):
        text += f" Next: {settings}, {more} more" + (f" (95 %: {interval})." if interval != "-" else ".")
    return with_micro(text)


def _figure(ranking: Ranking) -> Any:
    """Plot of each setting's difference from the best one, with its interval and every session."""
    from flowrec.exports import Drawn, as_uri, style

    name, title = "differences", "Difference from the first of the ranking"
    shown_rows = [each for each in ranking.rows if each.difference is not None][:_LISTED]
    if not shown_rows:
        return Drawn(name, title, why_not="fewer than two settings have the figure in the same sessions")
    narrow, wide = (as_uri(style.as_svg(_draw(ranking, shown_rows, width), title)) for width in style.WIDTHS_MM)
    caption = (
        f"{name_of(ranking.figure).capitalize()} of each setting minus that of {ranking.rows[0].settings}, in the same "
        f"session: every session (small), mean and 95 % interval (large; Student's t). Right of the line is worse. "
        f"{ranking.sessions} sessions."
    )
    alt = "; ".join(f"{each.settings}: {text_of_figure(ranking.figure, each.difference)} more" for each in shown_rows)
    return Drawn(name, title, caption, alt, narrow, wide)


def _draw(ranking: Ranking, rows: Sequence[Any], width_mm: float) -> Any:
    import numpy as np

    from flowrec.exports import style

    percent = ranking.figure.endswith("_error")
    scale = 100.0 if percent else 1.0
    unit = "%" if percent else text_of_figure(ranking.figure, 0.0).partition(" ")[2]
    figure = style.new_figure(width_mm, _MARGIN_MM + _ROW_MM * len(rows))
    ax = figure.subplots()
    ax.axvline(0.0, color=style.QUIET, lw=0.6)
    for at, each in enumerate(rows):
        differences = scale * np.subtract(each.values, ranking.rows[0].values)
        # Sessions one above the other, in their order: no two dots hide each other.
        above = at + np.linspace(-0.28, 0.28, len(differences))
        ax.plot(differences, above, ".", color=style.QUIET, alpha=0.6, ms=4.0, mew=0.0)
        mean = scale * each.difference
        low, high = (scale * end for end in each.interval) if each.interval is not None else (mean, mean)
        ax.errorbar(
            mean, at, xerr=[[mean - low], [high - mean]], fmt="o", ms=3.5, color=style.BLUE, capsize=2.0, lw=1.0
        )
    ax.set_yticks(range(len(rows)), [each.settings for each in rows])
    ax.set_ylim(len(rows) - 0.5, -0.5)
    ax.set_xlabel(with_micro(f"difference of the {name_of(ranking.figure)} ({unit})"))
    return figure
