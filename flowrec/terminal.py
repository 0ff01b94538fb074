"""The terminal: lines, status line, progress bars and tables. A run never waits for it."""

from __future__ import annotations

import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, TextIO, cast

from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from flowrec.enums import Level, Phase
from flowrec.errors import printable
from flowrec.system.stderr import Outlet
from flowrec.units import seconds

if TYPE_CHECKING:  # what only a running session needs is imported then: a table is to be there at once
    from rich.live import Live

    from flowrec.messages import Event, Tick

_EXPLAIN_AFTER_S = 2.0  # without a tick
_PERIOD_S = 0.12
_CLOSE_TIMEOUT_S = 0.3  # for the last events to be shown
_EVENTS_LIMIT = 1000
_COLOURS: dict[str, str] = {Level.WARNING: "yellow", Level.ERROR: "red"}
_STALE_S = 1.0  # without an advance, an estimate of the time left no longer holds
_NOTE_SHOWN = 60  # characters of a long note, from its end

outlet = Outlet()
console = Console(file=cast(TextIO, outlet), highlight=False)


def say(text: str) -> None:
    """Print a line on stderr; stdout is for results and --json."""
    console.print(escape(printable(text)), soft_wrap=True)


def warn(text: str) -> None:
    """Print a warning on stderr."""
    console.print(f"[yellow]warning:[/yellow] {escape(printable(text))}", soft_wrap=True)


class StatusLine:
    """Phase, frame rate, latency, drops, queue, file and disk of a running session; events as they come.

    On a terminal one line is updated in place; elsewhere (a log, CI) only the events are printed. Threads do the
    printing: the loop only hands over its tick, and a terminal that is frozen or gone does not delay it.

    Parameters
    ----------
    file_bytes : of the session so far.
    disk : state of the disk as text.
    note : the note that a person is typing; None without one.
    """

    def __init__(
        self,
        file_bytes: Callable[[], int],
        disk: Callable[[], str] = lambda: "",
        note: Callable[[], str | None] = lambda: None,
    ) -> None:
        self._file_bytes = file_bytes
        self._disk = disk
        self._note = note
        self._arrivals: deque[float] = deque(maxlen=120)
        self._latency_ms: deque[float] = deque(maxlen=240)
        self._events: deque[Event] = deque(maxlen=_EVENTS_LIMIT)
        self._last: Tick | None = None

    @contextmanager
    def shown(self) -> Iterator[StatusLine]:
        """Context in which the line is shown."""
        over = threading.Event()
        with outlet.aside():
            thread = threading.Thread(target=self._show, args=(over,), name="status", daemon=True)
            thread.start()
            try:
                yield self
            finally:
                over.set()
                thread.join(_CLOSE_TIMEOUT_S)

    def __call__(self, tick: Tick) -> None:
        """Take one tick."""
        self._arrivals.append(time.perf_counter())
        if tick.timing is not None:
            self._latency_ms.append(tick.timing.total_ms)
        if tick.event is not None and (self._last is None or tick.event is not self._last.event):
            self._events.append(tick.event)
        self._last = tick

    def _show(self, over: threading.Event) -> None:
        began, explained = time.perf_counter(), False
        with ExitStack() as stack:
            live: Live | None = None
            if console.is_terminal:
                from rich.live import Live

                live = stack.enter_context(Live(Text("starting"), console=console, auto_refresh=False, transient=True))
            while True:
                last = over.wait(_PERIOD_S)
                while self._events:
                    _print(self._events.popleft())
                if last:
                    return
                arrivals = list(self._arrivals)
                if not explained and time.perf_counter() - max([began, *arrivals[-1:]]) > _EXPLAIN_AFTER_S:
                    explained = True
                    say("working ... (the first run after an installation compiles its numerics, some 20 s in all)")
                if live is not None and self._last is not None:
                    live.update(self.text(self._last), refresh=True)

    def text(self, tick: Tick) -> Text:
        """The status line for a tick."""
        note = self._note()
        if note is not None:
            line = Text("note: ", style="bold", no_wrap=True, overflow="ellipsis")
            line.append(f"{note[-_NOTE_SHOWN:]}_", style="bold yellow")
            line.append("   Enter keeps it, Esc drops it", style="dim")
            return line
        import numpy as np

        mission, timing = tick.mission, tick.timing
        phase = mission.phase if mission is not None else Phase.START
        wait = f" ({mission.wanted.replace('_', ' ')} ...)" if mission is not None and mission.wanted else ""
        arrivals, latencies = list(self._arrivals), list(self._latency_ms)
        span = arrivals[-1] - arrivals[0] if len(arrivals) > 1 else 0.0
        rate = (len(arrivals) - 1) / span if span > 0 else 0.0
        latency = np.percentile(latencies, [50, 99]) if latencies else (0.0, 0.0)
        queue_mb, drops = (timing.queue_mb, timing.dropped_frames) if timing is not None else (0.0, 0)
        error = tick.demand.error_um if tick.demand is not None else float("nan")
        parts = [
            *(["HELD"] if mission is not None and mission.held_since_ns is not None else []),
            f"{phase}{wait}",
            f"t {seconds(tick.stamp_ns):.1f} s",
            f"{rate:.0f} fps",
            f"tick {latency[0]:.1f}/{latency[1]:.1f} ms (median/p99)",
            f"error {error:.0f} um" if np.isfinite(error) else "no route",
            f"drops {drops}",
            f"queue {queue_mb:.0f} MB",
            f"file {self._file_bytes() / 1e6:.0f} MB",
            self._disk(),
        ]
        return Text("  ".join(parts), style="bold", no_wrap=True, overflow="ellipsis")


def _print(event: Event) -> None:
    colour = _COLOURS.get(event.level, "cyan")
    text = escape(printable(event.text))
    console.print(f"[dim]{seconds(event.stamp_ns):8.2f} s[/dim]  [{colour}]{text}[/{colour}]", soft_wrap=True)


@contextmanager
def progress(what: str, total: float) -> Iterator[Callable[[float], None]]:
    """A progress bar; the yielded function takes how much of `total` is done. Prints nothing without a terminal."""
    if not console.is_terminal:
        yield lambda _done: None
        return
    from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn, TimeElapsedColumn

    advanced_s = time.monotonic()

    class Left(ProgressColumn):
        def render(self, task: Task) -> Text:
            return Text(time_left(task.time_remaining, time.monotonic() - advanced_s))

    def advance(done: float) -> None:
        nonlocal advanced_s
        advanced_s = time.monotonic()
        bar.update(task, completed=done)

    bar = Progress(TextColumn(what), BarColumn(), TimeElapsedColumn(), Left(), console=console, transient=True)
    with bar:
        task = bar.add_task(what, total=total)
        yield advance


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


def table(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table on stdout."""
    shown = Table(title=escape(printable(title)), title_justify="left", title_style="bold")
    for number, column in enumerate(columns):
        shown.add_column(column, justify="left" if number == 0 else "right", overflow="fold")
    for row in rows:
        shown.add_row(*(escape(printable(cell)) for cell in row))
    # In a log, where rich would take 80 columns, the widest table still keeps a row on a line.
    Console(file=sys.stdout, highlight=False, width=None if sys.stdout.isatty() else 110).print(shown)
