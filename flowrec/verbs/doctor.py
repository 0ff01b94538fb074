"""`flowrec doctor`: is the lab ready for a run? And the same look at it for `flowrec record --dry-run`."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Union

import typer

from flowrec.core import UsageError
from flowrec.verbs.command import MisuseError, verb
from flowrec.verbs.options import AS_THE_COMMAND, Sets, readable_toml

if TYPE_CHECKING:
    from flowrec.verbs.diagnosis import Finding
    from flowrec.verbs.protocol import DayProtocol


class Diagnosis:
    """Findings about a lab; each thing is looked at when `lines` comes to it, and `findings` holds those so far."""

    def __init__(self, coming: Iterator["Finding"]) -> None:
        self.findings: list[Finding] = []
        self._coming = coming

    def lines(self) -> Iterator[str]:
        """A line for each finding, as it is found."""
        for finding in self._coming:
            self.findings.append(finding)
            yield finding.line

    @property
    def level(self) -> str:
        """The worst of all findings."""
        from flowrec.verbs.diagnosis import FAILURE, OK, WARNING

        self.findings += self._coming
        levels = {finding.level for finding in self.findings}
        return next((level for level in (FAILURE, WARNING) if level in levels), OK)

    @property
    def exit_status(self) -> int:
        """1 if something has failed."""
        return int(self.level == "failure")

    def as_json(self) -> dict[str, Any]:
        return {"level": self.level, "findings": [one._asdict() for one in self.findings]}


@verb("flowrec doctor lab.toml", "flowrec doctor lab.toml --protocol --folder first_day")
def doctor(
    config: Annotated[
        Path | None, typer.Argument(callback=readable_toml, help="Configuration (TOML) of the lab; else flowrec.toml.")
    ] = None,
    rig: Annotated[str | None, typer.Option(help="Rig to look at: lab.")] = None,
    sets: Sets = None,
    folder: Annotated[
        Path | None, typer.Option(help="Where sessions are written; by default the present folder.")
    ] = None,
    protocol: Annotated[
        bool,
        typer.Option(
            "--protocol",
            help="Measure, in order, what a lab's first day has to show. Makes fields; goes on where it was left.",
        ),
    ] = False,
    answers: Annotated[
        list[str] | None,
        typer.Option(
            "--answer",
            metavar="KEY=VALUE",
            help="With --protocol, instead of a question: mounted=yes, field_table=FILE, zero_kill_s=0.2.",
        ),
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option(metavar="ROW", help="With --protocol: this measurement alone, also again; may be repeated."),
    ] = None,
    at_terminal: Annotated[bool, AS_THE_COMMAND] = False,
) -> "Union[Diagnosis, DayProtocol]":  # noqa: UP007 - as text
    """Look at camera, coils, disk and viewer before a run: what is ready, and what to do about the rest.

    Parameters
    ----------
    at_terminal : a person may be asked; False: only answers count.

    Raises
    ------
    UsageError : the configuration is wrong and does not describe a lab.
    """
    from flowrec.core import settings_of
    from flowrec.stages import load_config

    if not protocol and (answers or only):
        raise MisuseError("--answer and --only are for --protocol")
    settings = settings_of(sets or ()) | ({"rig": rig} if rig is not None else {})
    if protocol:
        from flowrec.verbs.protocol import walk
        from flowrec.verbs.protocol_hands import hand_of

        hand = hand_of(answers or (), asks=at_terminal)
        chosen = load_config(config, settings, {"rig": "--rig"})
        return walk(chosen, config, settings, folder or Path(), hand, only or ())
    from flowrec.verbs.diagnosis import diagnose, of_devices

    wrong = ""
    try:
        chosen = load_config(config, settings, {"rig": "--rig"})
    except UsageError as error:
        chosen, wrong = of_devices(config, settings, error), str(error)
    return Diagnosis(diagnose(chosen, config, folder, wrong))
