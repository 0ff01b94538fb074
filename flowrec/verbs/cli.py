"""The command line: all verbs, the entry point, and its errors in one line.

A verb is a function in a file of its name; command.py makes its command.

Exit status: 0 done, 1 failed (also when the goal is unreachable, found before the run or during it), 2 bad usage,
3 done but something was lost or differs, 130 stopped by Ctrl-C or a key, 143 by SIGTERM, 129 by a closed terminal.
A recording that is stopped has ended as it was meant to: 0.
"""

from __future__ import annotations

import io
import json
import os
import sys
from typing import Annotated, Any

import typer

import flowrec
from flowrec.core import FlowrecError, StoppedError, UsageError, printable
from flowrec.store import TIMEOUT_KEY, TRAFFIC
from flowrec.verbs.calibrate import calibrate
from flowrec.verbs.check import check
from flowrec.verbs.command import CommandLineError, add_verb, outside_verb, usage_line
from flowrec.verbs.compare import compare
from flowrec.verbs.completion import leave_out_key
from flowrec.verbs.cut import cut
from flowrec.verbs.doctor import doctor
from flowrec.verbs.emulate import emulate
from flowrec.verbs.export import export
from flowrec.verbs.import_movie import import_movie
from flowrec.verbs.info import info
from flowrec.verbs.init import init
from flowrec.verbs.ls import ls
from flowrec.verbs.methods import methods
from flowrec.verbs.new import new
from flowrec.verbs.note import note
from flowrec.verbs.options import HELP_SETTINGS, OUR_VERBS, Stoppable, WholeDescriptions, from_above
from flowrec.verbs.record import record
from flowrec.verbs.recover import recover
from flowrec.verbs.replay import DEFAULT_REFINE, replay
from flowrec.verbs.report import report
from flowrec.verbs.settings import settings
from flowrec.verbs.sign import sign
from flowrec.verbs.view import view


class _Verbs(Stoppable, WholeDescriptions):
    """Our verbs and those of others."""

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        return super().get_command(ctx, cmd_name) or outside_verb(cmd_name)

    def list_commands(self, ctx: Any) -> list[str]:
        from flowrec.core import VERBS, entry_points_of

        return list(dict.fromkeys((*super().list_commands(ctx), *entry_points_of(VERBS))))

    def command_for_help(self, ctx: Any, name: str) -> Any:
        """For one that can not be used, a command whose help states the fault."""
        try:
            return self.get_command(ctx, name)
        except UsageError as error:
            return typer.core.TyperCommand(name, help=f"Can not be used: {error}")


app = typer.Typer(
    cls=_Verbs,
    name="flowrec",
    help="Record, replay and view missions of magnetic micro-robots in flow.",
    no_args_is_help=True,
    **HELP_SETTINGS,
)
app.add_typer(calibrate, name="calibrate")
app.add_typer(emulate, name="emulate")
app.add_typer(from_above("bench"), name="bench")


def _version(asked: bool) -> None:
    if asked:
        typer.echo(f"flowrec {flowrec.__version__}")
        raise typer.Exit


def _timeout(seconds: float | None) -> None:
    if seconds is not None:
        os.environ[TIMEOUT_KEY] = str(seconds)  # processes that a verb starts take it over


@app.callback()
def root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
    timeout: Annotated[
        float | None,
        typer.Option(
            metavar="S",
            min=0.1,
            max=3600.0,
            callback=_timeout,
            help="Time limit of each request for a session at a URL; 30.",
        ),
    ] = None,
) -> None:
    """Record, replay and view missions of magnetic micro-robots in flow."""


add_verb(app, record)
add_verb(app, replay)
add_verb(app, import_movie, "import")
for _verb in (
    *map(from_above, ("sweep", "push", "catalog", "find")),
    *(init, settings, methods, new, doctor, view, export, report, cut, info, ls, note, check, sign, recover, compare),
):
    add_verb(app, _verb)
OUR_VERBS.update(str(each.name) for each in app.registered_commands)
OUR_VERBS.update(str(each.name) for each in app.registered_groups)


def with_default_refine(words: list[str]) -> list[str]:
    """Insert the default method after a `--refine` without one, so that a session path is not taken for the method."""
    full: list[str] = []
    for number, word in enumerate(words):
        full.append(word)
        following = words[number + 1] if number + 1 < len(words) else "-"
        without_method = following.startswith("-") or following.endswith(".mcap")
        if word == "--refine" and without_method:
            full.append(DEFAULT_REFINE)
    return full


def main() -> None:
    """Entry point: run the command line, turn our errors into one line and an exit status."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # the locale's encoding may not have every character
    TRAFFIC.reasons.clear()  # of a call before, in the same process
    leave_out_key()
    try:
        sys.exit(app(args=with_default_refine(sys.argv[1:]), prog_name="flowrec", standalone_mode=False) or 0)
    except CommandLineError as error:
        if type(error).__name__ == "NoArgsIsHelpError":  # typer has moved the class from version to version
            typer.echo(error.ctx.get_help())
            sys.exit(0)
        sys.stderr.write(usage_line(error))
        sys.exit(error.exit_code)
    except FlowrecError as error:
        if isinstance(error, StoppedError) and "--json" in sys.argv:
            print(json.dumps(error.as_json()))
        sys.stderr.write(f"flowrec: {error}\n")
        TRAFFIC.reasons.clear()  # the error says why requests were repeated
        sys.exit(error.exit_status)
    except BrokenPipeError:
        # The reader of the output has ended (flowrec info ... | head).
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except OSError as error:
        where = f"{printable(str(error.filename))}: " if error.filename is not None else "output or files: "
        sys.stderr.write(f"flowrec: {where}{error.strerror or error}; check names, permissions and free space\n")
        sys.exit(1)
    finally:
        if TRAFFIC.line:
            sys.stderr.write(f"{TRAFFIC.line}\n")


if __name__ == "__main__":
    main()
