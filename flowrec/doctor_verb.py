"""The verb `flowrec doctor`, and the same look at a lab for `flowrec record --dry-run`; with late imports."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flowrec.bench.verbs import AsJson, Sets
from flowrec.errors import UsageError

if TYPE_CHECKING:
    from flowrec.config import Config


def doctor(
    config: Annotated[Path | None, typer.Argument(help="Configuration (TOML) of the lab.")] = None,
    rig: Annotated[str | None, typer.Option(help="Rig to look at: lab.")] = None,
    sets: Sets = None,
    folder: Annotated[
        Path | None, typer.Option(help="Where sessions are written; by default the present folder.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Look at camera, coils, disk and viewer before a run: what is ready, and what to do about the rest."""
    from flowrec.commands import doctor as verb
    from flowrec.config import load_config

    settings = [*(sets or []), *([f"rig={rig}"] if rig is not None else [])]
    wrong = ""
    try:
        chosen = load_config(config, settings, {"rig": "--rig"})
    except UsageError as error:
        from flowrec.commands.doctor_settings import of_devices

        chosen, wrong = of_devices(config, settings, error), str(error)
    found = []
    for finding in verb.diagnose(chosen, config, folder, wrong):
        found.append(finding)
        if not as_json:
            typer.echo(verb.line_of(finding))
    if as_json:
        typer.echo(json.dumps(verb.as_json(found)))
    raise typer.Exit(int(any(finding.level == verb.FAILURE for finding in found)))


def look_at_lab(chosen: Config, file: Path | None, out: Path | None) -> bool:
    """Print what the doctor finds to stderr; whether something has failed."""
    from flowrec.commands import doctor as verb
    from flowrec.terminal import say

    failed = False
    for finding in verb.diagnose(chosen, file, out.parent if out is not None else None):
        say(verb.line_of(finding))
        failed |= finding.level == verb.FAILURE
    say("nothing was energised")
    return failed
