"""Displays of a run while it is recorded: the live view in Rerun, and the console in a browser.

The run itself hands its ticks over to them, or another process reads them from its file (`watch`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self

from flowrec.console import Console, RunEnded, refuse_without_packages
from flowrec.core import FlowrecError, Tick, UsageError, View, of_text, say, seconds
from flowrec.physics import Chip
from flowrec.run import RemoteControl, Sink
from flowrec.stages import ResolvedConfig

if TYPE_CHECKING:
    from flowrec.view import LiveView


class Watching:
    """Context in which a run is shown; both parts may be absent, and the console needs a live view for its Rerun."""

    def __init__(
        self,
        view: View,
        scene: tuple[ResolvedConfig, Chip, Path],
        obey: Callable[[dict[str, Any]], str] | None,
        remarks: Callable[[], dict[str, Any]],
    ) -> None:
        """Start what is asked for.

        Parameters
        ----------
        scene : settings and chip of the run, and the path of its session.
        obey : takes the commands of the console; None: there is no console.
        remarks : what the console shows besides ticks; asked in another thread.
        """
        self._live: LiveView | None = None
        self._console: Console | None = None
        live = view in ("spawn", "serve")
        if not live and obey is None:
            return
        # Imported here because importing Rerun takes a second and most runs do not need it.
        from flowrec.exports import scene_of
        from flowrec.view import LiveView

        shown = scene_of(*scene)
        self._live = LiveView(shown, "spawn" if view == "spawn" else "serve")
        if live:
            say(self._live.message)
        if obey is not None:
            camera = scene[0].camera
            shown = replace(shown, image_px=camera.size_px)
            port = self._live.port if self._live.pid is not None else None
            self._console = Console(obey, shown, scene[2].name, port, remarks, say)
            say(self._console.message)
            if self._console.tunnel:
                say(self._console.tunnel)

    @property
    def sinks(self) -> list[Sink]:
        """Sinks that show the ticks."""
        return [sink for sink in (self._live, self._console) if sink is not None]

    def close(self, ended: RunEnded, timeout_s: float | None = None) -> None:
        """Let the pages show how the run ended and where its file is; end what nobody watches any more."""
        limit = {} if timeout_s is None else {"timeout_s": timeout_s}
        if self._console is not None:  # first: its browsers are viewers of the live view's server
            self._console.close(ended, **limit)
        if self._live is not None:
            self._live.close(**limit)
            if self._live.afterwards:
                say(self._live.afterwards)
                self._live.afterwards = ""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _kind: object, error: BaseException | None, _traceback: object) -> None:
        self.close(RunEnded(f"failed: {error}" if isinstance(error, FlowrecError) else "failed"))


def watch(path: Path | None, mode: Literal["spawn", "serve"], *, console: bool = False) -> None:
    """Show a run that another process records, from the beginning of its file until it ends or Ctrl-C.

    `console`: serve a page that steers it, too.

    Raises
    ------
    UsageError : no run is named, and there is not exactly one; a package of the console is missing.
    SessionError : it is not being recorded, or its file is damaged.
    FlowrecError : it takes no commands from here.
    """
    from flowrec.store import GrowingRun, live_runs

    if console:
        refuse_without_packages()
    if path is None:
        runs = live_runs()
        if len(runs) != 1:
            there = ": name one of " + ", ".join(str(run.path) for run in runs) if runs else ""
            raise UsageError(f"--live: {len(runs) or 'no'} runs are being recorded{there}")
        path = runs[0].path
    run = GrowingRun(path)
    obey = RemoteControl(run.path).obey if console else None
    config = run.header.config(f"{run.path}: config.toml inside")
    remarks = {"duration_s": config.duration_s}
    last = Tick()
    ended = RunEnded("this page was closed; the run goes on", good=True)
    shown = Watching(mode, (config, run.header.chip(), run.path), obey, lambda: remarks)
    try:
        say(f"{run.path}: Ctrl-C ends the view, not the run")
        for tick in run.ticks():
            for sink in shown.sinks:
                sink.write(tick)
            last = tick
        ended = RunEnded.of(of_text(run.outcome), last.refined, str(run.path))
        say(f"{run.path}: the run has ended at {seconds(max(last.stamp_ns, 0)):.1f} s: {ended.outcome}")
    finally:
        shown.close(ended)
