"""`flowrec emulate NAME`: verbs that start devices which this computer does not have."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple, Union

import typer

from flowrec.core import say
from flowrec.verbs.command import add_verb, verb
from flowrec.verbs.options import Overwrite, Sets, WholeDescriptions

if TYPE_CHECKING:
    from flowrec.verbs.emulated_lab import EmulatedLab
    from flowrec.verbs.protocol import DayProtocol

_SLICE_S = 0.5  # of the wait for Ctrl-C


class Flown(NamedTuple):
    """A mission that was flown on emulated devices, or none."""

    session: Path | None = None
    exit_status: int = 0  # of the recorder
    latency: str = ""

    def as_json(self) -> dict[str, str | None]:
        return {"session": str(self.session) if self.session else None, "latency": self.latency}

    def show(self) -> None:
        """Print the chain of latency."""
        if self.latency:
            say(f"latency, median and (95 %): {self.latency}")


@verb("flowrec emulate lab", "flowrec emulate lab --fly a.mcap", "flowrec emulate lab --protocol first_day")
def lab(
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="TOML", help="Configuration of the devices, removed at the end.")
    ] = Path("emulated_lab.toml"),
    fly: Annotated[
        Path | None, typer.Option(metavar="SESSION", help="Record one mission on them, and end them after it.")
    ] = None,
    camera_delay_ms: Annotated[
        float, typer.Option(metavar="MS", min=0.0, max=500.0, help="Time from the end of an exposure to its image.")
    ] = 12.0,
    sets: Sets = None,
    world: Annotated[
        list[str] | None,
        typer.Option(metavar="KEY=VALUE", help="Change a setting of the world alone: a defect that is to be found."),
    ] = None,
    protocol: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Run the protocol of flowrec doctor on them, and end them after it."),
    ] = None,
    only: Annotated[
        list[str] | None, typer.Option(metavar="ROW", help="With --protocol: this measurement alone.")
    ] = None,
    overwrite: Overwrite = False,
) -> "Union[Flown, DayProtocol]":  # noqa: UP007 - as text
    """Emulate the devices of a lab and a robot in flow between them; flowrec record runs on them as on yours.

    The camera is a stream of images on the loopback. The amplifier is the firmware, compiled, behind a pseudo terminal.
    Between them a simulated robot is moved by what the amplifier puts out, never by what the recorder commands. A robot
    is put back to its start when there has been no field for some seconds.

    Raises
    ------
    RigError : nothing can compile the firmware; a device does not start.
    UsageError, OutputError : settings that describe no lab; the file may not be written.
    """
    from flowrec.core import MCAP, Output
    from flowrec.verbs.emulated_lab import emulated_lab

    if fly is not None:  # before a compilation
        Output(fly, MCAP, (), overwrite).check()
    with emulated_lab(out, 1e-3 * camera_delay_ms, sets or (), overwrite, world or ()) as made:
        if protocol is not None:
            from flowrec.stages import load_config
            from flowrec.verbs.protocol import walk
            from flowrec.verbs.protocol_hands import EmulatedHand

            hand = EmulatedHand(made.instruments, protocol)
            return walk(load_config(made.file), made.file, {}, protocol, hand, only or ())
        if fly is not None:
            return _fly(made, fly, overwrite)
        say(f"camera at {made.camera}, amplifier at {made.port}; {made.file} has the settings that use them")
        say(f"in another terminal: flowrec record {made.file}")
        say("Ctrl-C ends the devices")
        while True:
            time.sleep(_SLICE_S)


def _fly(made: "EmulatedLab", session: Path, overwrite: bool) -> Flown:
    """Record a mission in a process of its own, as a person in another terminal would."""
    from flowrec.core import interrupted_too, start_child

    words = ["record", str(made.file), "--out", str(session), *(["--overwrite"] if overwrite else [])]
    say(f"flowrec {' '.join(words)}")
    began_s = time.time()
    recorder = start_child("flowrec", *words, stdin=None, stdout=None)
    with interrupted_too(recorder):
        status = recorder.wait()
    if not session.exists() or session.stat().st_mtime < began_s:  # refused; a file of before stays
        return Flown(None, status)
    from flowrec.store import Session

    return Flown(session, status, str(Session(session).outcome.get("latency", "")))


emulate = typer.Typer(cls=WholeDescriptions, help="Start emulated devices on this computer.", no_args_is_help=True)
add_verb(emulate, lab)
