"""Attendance of a run: nobody, or a person at the terminal with signals, keys, a status line and progress bars."""

from __future__ import annotations

import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from typing import TYPE_CHECKING

import numpy as np
from rich.markup import escape
from rich.text import Text

from flowrec.core import Event, Level, Phase, Progress, Tick, console, outlet, printable, progress, say, seconds
from flowrec.run import RunControl

if TYPE_CHECKING:
    from rich.live import Live

    from flowrec.run import DiskMonitor, Watchdog
    from flowrec.store import SessionWriter

_PERIOD_S = 0.12  # of the status line: faster ones can not be read
_CLOSE_TIMEOUT_S = 0.3  # for the last events to be shown
_EVENTS_LIMIT = 1000  # that wait to be shown
_COLOURS: dict[str, str] = {Level.WARNING: "yellow", Level.ERROR: "red"}
_QUEUE_SHOWN_MB = 1.0  # a smaller queue of the writer is usual
_NOTE_SHOWN = 60  # characters of a long note, from its end


class Unattended:
    """A run that is a function call, in any thread: it takes no signals and no keys and prints no progress.

    `run_control`: controls the run from another thread, for example `run_control.stop("enough")`.
    """

    def __init__(self, run_control: RunControl | None = None) -> None:
        self.run_control = run_control if run_control is not None else RunControl()

    def end_on_signals(
        self, watchdog: Watchdog | None = None, give_up: Callable[[], str] = lambda: ""
    ) -> AbstractContextManager[None]:
        """Context in which signals end the run in an orderly way; see Signals."""
        return nullcontext()

    def show_run(self, writer: SessionWriter, disk: DiskMonitor) -> AbstractContextManager[Callable[[Tick], None]]:
        """Context in which the loop runs; yields a function that takes every tick."""
        return nullcontext(lambda _tick: None)

    def progress(self, what: str, total: float) -> AbstractContextManager[Progress]:
        """Context of long work; yields what takes how much of `total` is done."""
        return nullcontext(Progress())

    @property
    def note(self) -> str | None:
        """The note that a person is typing; None without one."""
        return None


class AtTerminal(Unattended):
    """A run of the command line, in the main thread."""

    def __init__(self) -> None:
        super().__init__()
        self._typed_note: Callable[[], str | None] = lambda: None
        self._leave_terminal: Callable[[], None] = lambda: None

    def end_on_signals(
        self, watchdog: Watchdog | None = None, give_up: Callable[[], str] = lambda: ""
    ) -> AbstractContextManager[None]:
        handled: AbstractContextManager[None] = nullcontext()
        if sys.platform != "win32":
            from flowrec.run import Signals

            handled = Signals(self.run_control, watchdog, give_up, lambda: self._leave_terminal()).handle()
        return handled

    @contextmanager
    def show_run(self, writer: SessionWriter, disk: DiskMonitor) -> Iterator[Callable[[Tick], None]]:
        with ExitStack() as stack:
            help_text = ""
            if sys.platform != "win32":
                from flowrec.run import HELP, keyboard_of

                terminal = stack.enter_context(keyboard_of(self.run_control))
                if terminal is not None:
                    keyboard, self._leave_terminal = terminal
                    self._typed_note = lambda: keyboard.note
                    help_text = HELP
            status = StatusLine(lambda: writer.bytes_written, lambda: disk.text, self._typed_note)
            stack.enter_context(status.show())
            if help_text:
                say(help_text)
            yield status

    def progress(self, what: str, total: float) -> AbstractContextManager[Progress]:
        return progress(what, total)

    @property
    def note(self) -> str | None:
        return self._typed_note()


class StatusLine:
    """Shows phase, frame rate, latency, drops, queue, file and disk of a running session, and its events.

    On a terminal one line is updated in place; elsewhere (a log, CI) only the events are printed. A thread
    prints: the loop only appends its tick, so a terminal that is frozen or closed does not delay it.

    Parameters
    ----------
    file_bytes : of the session so far.
    disk : state of the disk as text.
    note : the note that a person is typing; None without one.
    """

    def __init__(self, file_bytes: Callable[[], int], disk: Callable[[], str], note: Callable[[], str | None]) -> None:
        self._file_bytes = file_bytes
        self._disk = disk
        self._note = note
        self._arrivals: deque[float] = deque(maxlen=120)
        self._latency_ms: deque[float] = deque(maxlen=240)
        self._events: deque[Event] = deque(maxlen=_EVENTS_LIMIT)
        self._last: Tick | None = None

    @contextmanager
    def show(self) -> Iterator[StatusLine]:
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
        self._arrivals.append(time.perf_counter())
        if tick.timing is not None:
            self._latency_ms.append(tick.timing.total_ms)
        if tick.event is not None and (self._last is None or tick.event is not self._last.event):
            self._events.append(tick.event)
        self._last = tick

    def _show(self, over: threading.Event) -> None:
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
        mission, timing = tick.mission, tick.timing
        phase = mission.phase if mission is not None else Phase.START
        wait = f" ({mission.wanted.replace('_', ' ')} ...)" if mission is not None and mission.wanted else ""
        limit_um_s = mission.speed_limit_um_s if mission is not None else None
        arrivals, latencies = list(self._arrivals), list(self._latency_ms)
        span = arrivals[-1] - arrivals[0] if len(arrivals) > 1 else 0.0
        rate = (len(arrivals) - 1) / span if span > 0 else 0.0
        latency = np.percentile(latencies, [50, 99]) if latencies else (0.0, 0.0)
        queue_mb, drops = (timing.queue_mb, timing.dropped_frames) if timing is not None else (0.0, 0)
        error = tick.demand.error_um if tick.demand is not None else float("nan")
        # The most important first: what does not fit into the line is left out from the end.
        every = [
            "HELD" if mission is not None and mission.held_since_ns is not None else "",
            f"{phase}{wait}",
            f"limit {limit_um_s:g} um/s" if limit_um_s is not None else "",
            f"{seconds(tick.stamp_ns):.1f} s",
            f"{drops} images dropped" if drops else "",
            f"error {error:.0f} um" if np.isfinite(error) else "no route",
            f"queue {queue_mb:.0f} MB" if queue_mb >= _QUEUE_SHOWN_MB else "",
            self._disk(),
            f"{rate:.0f} images/s",
            f"tick {latency[0]:.1f} ms",
            f"p99 {latency[1]:.1f} ms",
            f"file {self._file_bytes() / 1e6:.0f} MB",
        ]
        parts = [part for part in every if part]
        fits = [k for k in range(1, len(parts) + 1) if len("  ".join(parts[:k])) < console.width]
        return Text("  ".join(parts[: max(fits, default=1)]), style="bold", no_wrap=True, overflow="ellipsis")


def _print(event: Event) -> None:
    colour = _COLOURS.get(event.level, "cyan")
    text = escape(printable(event.text))
    console.print(f"[dim]{seconds(event.stamp_ns):8.2f} s[/dim]  [{colour}]{text}[/{colour}]", soft_wrap=True)
