"""What a person sees on the terminal while a run goes on, and the small tables at its end."""

from __future__ import annotations

import shutil
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from flowrec.errors import printable
from flowrec.units import seconds

if TYPE_CHECKING:  # what only a running session needs is imported then: a table is to be there at once
    from rich.live import Live

    from flowrec.messages import Tick

_PATIENCE_S = 2.0  # without a tick, then a person wants to know why

console = Console(stderr=True, highlight=False)


def say(text: str) -> None:
    """One line for the person at the terminal (stderr: stdout is for --json)."""
    console.print(escape(printable(text)), soft_wrap=True)


def warn(text: str) -> None:
    """One line that something is not as it should be."""
    console.print(f"[yellow]warning:[/yellow] {escape(printable(text))}", soft_wrap=True)


class StatusLine:
    """Phase, frame rate, latency, drops, queue, file and disk of a running session; events as they come.

    On a terminal one line is kept up to date; elsewhere (a log, CI) only the events are printed.
    """

    def __init__(self, folder: Path, file_bytes: Callable[[], int]) -> None:
        self._folder = folder
        self._file_bytes = file_bytes
        self._arrivals: deque[float] = deque(maxlen=120)
        self._latency_ms: deque[float] = deque(maxlen=240)
        self._shown = 0.0
        self._live: Live | None = None
        self._last: Tick | None = None

    @contextmanager
    def shown(self) -> Iterator[StatusLine]:
        """Keep the line on the screen for the length of the context."""
        over = threading.Event()
        threading.Thread(target=self._explain_waiting, args=(over,), name="status", daemon=True).start()
        try:
            if not console.is_terminal:
                yield self
                return
            from rich.live import Live

            with Live(Text("starting"), console=console, refresh_per_second=8, transient=True) as live:
                self._live = live
                yield self
        finally:
            over.set()
            self._live = None

    def _explain_waiting(self, over: threading.Event) -> None:
        """Say once why nothing moves: after an installation numba compiles each part when it is first used."""
        began = time.perf_counter()
        while not over.wait(0.5):
            if time.perf_counter() - max([began, *list(self._arrivals)[-1:]]) > _PATIENCE_S:
                say("working ... (the first run after an installation compiles its numerics, some 20 s in all)")
                return

    def __call__(self, tick: Tick) -> None:
        """Take note of one tick."""
        now = time.perf_counter()
        self._arrivals.append(now)
        if tick.timing is not None:
            self._latency_ms.append(tick.timing.total_ms)
        if tick.event is not None and (self._last is None or tick.event is not self._last.event):
            colour = {"warning": "yellow", "error": "red"}.get(tick.event.level, "cyan")
            text = escape(printable(tick.event.text))
            console.print(f"[dim]{seconds(tick.stamp_ns):8.2f} s[/dim]  [{colour}]{text}[/{colour}]", soft_wrap=True)
        self._last = tick
        if self._live is not None and now - self._shown > 0.12:
            self._shown = now
            self._live.update(self.text(tick))

    def text(self, tick: Tick) -> Text:
        """The line itself."""
        import numpy as np

        mission, timing = tick.mission, tick.timing
        phase = mission.phase if mission is not None else "start"
        wait = f" ({mission.wanted.replace('_', ' ')} ...)" if mission is not None and mission.wanted else ""
        span = self._arrivals[-1] - self._arrivals[0] if len(self._arrivals) > 1 else 0.0
        rate = (len(self._arrivals) - 1) / span if span > 0 else 0.0
        latency = np.percentile(self._latency_ms, [50, 99]) if self._latency_ms else (0.0, 0.0)
        free_gb = shutil.disk_usage(self._folder).free / 1e9
        queue_mb, drops = (timing.queue_mb, timing.dropped_frames) if timing is not None else (0.0, 0)
        error = tick.demand.error_um if tick.demand is not None else float("nan")
        parts = [
            f"{phase}{wait}",
            f"t {seconds(tick.stamp_ns):.1f} s",
            f"{rate:.0f} fps",
            f"tick {latency[0]:.1f}/{latency[1]:.1f} ms (median/p99)",
            f"error {error:.0f} um" if np.isfinite(error) else "no route",
            f"drops {drops}",
            f"queue {queue_mb:.0f} MB",
            f"file {self._file_bytes() / 1e6:.0f} MB",
            f"disk {free_gb:.0f} GB left",
        ]
        return Text("  ".join(parts), style="bold", no_wrap=True, overflow="ellipsis")


@contextmanager
def progress(what: str, total: float) -> Iterator[Callable[[float], None]]:
    """A bar for long work; the yielded function takes how much is done. Silent where there is no terminal."""
    if not console.is_terminal:
        yield lambda _done: None
        return
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    bar = Progress(
        TextColumn(what), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn(), console=console, transient=True
    )
    with bar:
        task = bar.add_task(what, total=total)
        yield lambda done: bar.update(task, completed=done)


def table(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table for people on stdout."""
    shown = Table(title=escape(printable(title)), title_justify="left", title_style="bold")
    for number, column in enumerate(columns):
        shown.add_column(column, justify="left" if number == 0 else "right", overflow="fold")
    for row in rows:
        shown.add_row(*(escape(printable(cell)) for cell in row))
    # In a log, where rich would take 80 columns, the widest table still keeps a row on a line.
    Console(file=sys.stdout, highlight=False, width=None if sys.stdout.isatty() else 110).print(shown)
