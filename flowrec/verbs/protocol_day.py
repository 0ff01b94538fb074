"""Means of the rows of `flowrec doctor --protocol`: a configuration, its sessions, and hands."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from flowrec.core import FlowrecError, interrupted_too, say, start_child
from flowrec.physics import load_chip
from flowrec.stages import Config, ResolvedConfig, resolve
from flowrec.store import Session
from flowrec.verbs.protocol_hands import ProtocolHand, free_path


class Day:
    """Configuration, files and hands with which the rows measure.

    `config`: resolved on its chip.

    Parameters
    ----------
    asked : the configuration; `file` and `sets` are what it was made of.
    folder : for the sessions.
    """

    def __init__(
        self, asked: Config, file: Path | None, sets: Mapping[str, Any], folder: Path, hand: ProtocolHand
    ) -> None:
        self.asked, self.folder = asked, folder
        self.hand: ProtocolHand = hand
        self.config: ResolvedConfig = resolve(asked, load_chip(asked.chip))
        self.sessions: dict[str, Path] = {}  # by name of the run
        given = (f"{key}={json.dumps(value)}" for key, value in sets.items())
        self._words = [*([str(file)] if file is not None else []), *_as_options(given)]

    def new_path(self, name: str) -> Path:
        """A name for a session that no file has."""
        return free_path(self.folder, name, ".mcap")

    def start(self, session: Path, *sets: str) -> subprocess.Popen[bytes]:
        """Start `flowrec record` in a process of its own, as a person in another terminal would."""
        words = ["record", *self._words, "--out", str(session), *_as_options(sets)]
        say(f"  flowrec {' '.join(words)}")
        return start_child(
            "flowrec", *words, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
        )

    def run(self, name: str, *sets: str) -> Session:
        """The session of a run, which is recorded once. Raises FlowrecError: it was refused; what the recorder said."""
        if name not in self.sessions:
            path = self.new_path(name)
            process = self.start(path, *sets)
            with interrupted_too(process):
                said = process.communicate()[1].decode(errors="replace").strip().splitlines()
            if not path.exists():
                raise FlowrecError(
                    f"flowrec record: {said[-1].removeprefix('flowrec: ') if said else 'it says nothing'}"
                )
            self.sessions[name] = path
        return Session(self.sessions[name])


def _as_options(sets: Iterable[str]) -> list[str]:
    return [word for each in sets for word in ("--set", each)]
