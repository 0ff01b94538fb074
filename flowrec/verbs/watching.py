"""Displays of a run while it is recorded: the live view in Rerun, and the console in a browser."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from flowrec.console import Console, RunEnded
from flowrec.core import FlowrecError, View, say
from flowrec.physics import Chip
from flowrec.run import RunControl, Sink
from flowrec.stages import Pipeline, ResolvedConfig

if TYPE_CHECKING:
    from flowrec.view import LiveView


class Watching:
    """Context in which a run is shown; both parts may be absent, and the console needs a live view for its Rerun."""

    def __init__(
        self,
        view: View,
        scene: tuple[ResolvedConfig, Chip, Pipeline, Path],
        control: RunControl | None,
        remarks: Callable[[], dict[str, Any]],
    ) -> None:
        """Start what is asked for.

        Parameters
        ----------
        scene : settings, chip and pipeline of the run, and the path of its session.
        control : what the console steers; None: no console.
        remarks : what the console shows besides ticks; asked in another thread.
        """
        self._live: LiveView | None = None
        self._console: Console | None = None
        live = view in ("spawn", "serve")
        if not live and control is None:
            return
        # Imported here because importing Rerun takes a second and most runs do not need it.
        from flowrec.exports import scene_of
        from flowrec.view import LiveView

        shown = scene_of(*scene)
        self._live = LiveView(shown, "spawn" if view == "spawn" else "serve")
        if live:
            say(self._live.message)
        if control is not None:
            camera = scene[0].camera
            shown = replace(shown, image_px=(camera.width_px, camera.height_px))
            port = self._live.port if self._live.pid is not None else None
            self._console = Console(control, shown, scene[3].name, port, remarks, say)
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
