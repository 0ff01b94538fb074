"""Messages from the run to the console's process, besides the ticks."""

from __future__ import annotations

from typing import NamedTuple

from flowrec.view import Scene

STAYS = "flowrec: shows its pages how the run ended"  # what the process says last; it ends by itself a moment later


class Begin(NamedTuple):
    """The first.

    Attributes
    ----------
    token : that a browser must know.
    name : of the session's file.
    rerun_port : of Rerun's server on this machine; None without one.
    """

    token: str
    name: str
    scene: Scene
    rerun_port: int | None


class CommandReply(NamedTuple):
    """Answer of the run to a command.

    Attributes
    ----------
    ticket : number of the command, as the server counts them.
    refusal : why the run does not do it; '' where it has taken it.
    """

    ticket: int
    refusal: str


class RunEnded(NamedTuple):
    """The last: how the run ended, and where its file is."""

    outcome: str
    files: str = ""
    good: bool = False  # it reached its end, or was ended on purpose
