"""Output on the terminal: lines, progress bars and tables. A run never waits for it."""

from __future__ import annotations

import shlex
import sys
import time
from collections.abc import Container, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO, cast

from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from flowrec.core.coverage import Coverage
from flowrec.core.errors import printable
from flowrec.core.system.endings import Ended
from flowrec.core.system.stderr import Outlet

_STALE_S = 1.0  # without an advance, an estimate of the time left no longer holds

outlet = Outlet()
# In a notebook lines are text, and nothing moves.
console = Console(
    file=cast(TextIO, outlet),
    highlight=False,
    force_jupyter=False,
    force_terminal=False if "ipykernel" in sys.modules else None,
)


def shell_word(path: Path | str) -> str:
    """A path in a command that a line suggests: as a shell takes it."""
    return shlex.quote(str(path))


def say(text: str) -> None:
    """Print a line on stderr; stdout is for results and --json."""
    console.print(escape(printable(text)), soft_wrap=True)


def warn(text: str) -> None:
    """Print a warning on stderr."""
    console.print(f"[yellow]warning:[/yellow] {escape(printable(text))}", soft_wrap=True)


class Progress:
    """Takes how far work is, and shows it nowhere.

    `done`: how much of the total is done, as it was said last.
    """

    done: float = 0.0

    def __call__(self, done: float) -> None:
        """Set how much of the total is done."""
        self.done = done

    def stage(self, name: str) -> None:
        """Name the step that is being done, which may take long; '': nothing in particular."""


_looked_at: list[Coverage] = []


def looked_at() -> list[Coverage]:
    """Coverages of the work whose bars have ended since the last call, in order."""
    found = list(_looked_at)
    _looked_at.clear()
    return found


@contextmanager
def progress(what: str, total: float, unit: str = "parts") -> Iterator[Progress]:
    """A progress bar, which takes how much of `total` is done. Prints nothing without a terminal.

    An interruption by Ctrl-C or a signal leaves it as `Ended`, with how far the work was; of bars within each other the
    outer one says it. `unit`: of the total, as of `Coverage`.
    """
    with _show_bar(what, total) as shown:
        try:
            yield shown
            _looked_at.append(Coverage(min(shown.done, total), total, unit))
        except KeyboardInterrupt as error:
            ended = Ended.of(error)
            ended.covered = Coverage(min(shown.done, total), total, unit, stopped=ended.why, status=ended.status)
            raise ended from error.__cause__


@contextmanager
def _show_bar(what: str, total: float) -> Iterator[Progress]:
    if not console.is_terminal:
        yield Progress()
        return
    from rich import progress as progress_bar
    from rich.progress import BarColumn, ProgressColumn, Task, TextColumn, TimeElapsedColumn

    advanced_s = time.monotonic()

    class Left(ProgressColumn):
        def render(self, task: Task) -> Text:
            return Text(time_left(task.time_remaining, time.monotonic() - advanced_s))

    class Shown(Progress):
        def __call__(self, done: float) -> None:
            nonlocal advanced_s
            super().__call__(done)
            advanced_s = time.monotonic()
            bar.update(task, completed=done)

        def stage(self, name: str) -> None:
            bar.update(task, description=f"{what}: {name}" if name else what, refresh=True)

    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TimeElapsedColumn(), Left())
    bar = progress_bar.Progress(*columns, console=console, transient=True)
    with bar:
        task = bar.add_task(what, total=total)
        yield Shown()


def time_left(estimate_s: float | None, stands_s: float) -> str:
    """The time that work will still take, as text; '' if it is not known or work has not advanced lately.

    Parameters
    ----------
    estimate_s : estimated from its rate.
    stands_s : time since it last advanced.
    """
    if estimate_s is None or stands_s > _STALE_S:
        return ""
    return f"{estimate_s:.0f} s left"


def table(
    title: str,
    columns: Sequence[str],
    rows: Iterable[Sequence[str]],
    to: TextIO | None = None,
    text: str = "",
    amber: Container[int] = (),
) -> None:
    """Print a table on stdout, or on `to`; where a column is named `text`, only it and the first one are folded.

    Rows with a number in `amber` are doubtful and have that colour.
    """
    to = to or sys.stdout
    shown = Table(title=escape(printable(title)), title_justify="left", title_style="bold")
    for number, column in enumerate(columns):
        words = number == 0 or column == text
        shown.add_column(
            column,
            justify="left" if words else "right",
            overflow="fold",
            no_wrap=bool(text) and text in columns and not words,
        )
    for number, row in enumerate(rows):
        shown.add_row(*(escape(printable(cell)) for cell in row), style="yellow" if number in amber else None)
    Console(file=to, highlight=False, width=width(to)).print(shown)


def width(to: TextIO | None = None) -> int:
    """Characters of a line on stdout, or on `to`."""
    to = to or sys.stdout
    # In a log rich takes 80 columns; 110 hold each row of the widest table on one line.
    return Console(file=to).width if to.isatty() else 110
