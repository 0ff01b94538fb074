"""Options that several verbs have, what a report needs, and how the help lists commands."""

from __future__ import annotations

import importlib.util
import math
import pkgutil
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, Union

import typer
from typer.core import TyperGroup

from flowrec.core import UsageError, stopped_in_one_line
from flowrec.verbs.completion import complete_setting

if TYPE_CHECKING:
    from flowrec.stages import Config
    from flowrec.store import Session

AnySession = Union[Path, str, "Session"]


OF_FOLDER = Path("flowrec.toml")  # a configuration that is used where none is named


def readable_toml(file: Path | None) -> Path | None:
    """Return the file, or that of the folder; refuse one that is no TOML, before imports that take a second."""
    if file is None and OF_FOLDER.is_file():
        from flowrec.core import say

        say(f"{OF_FOLDER}: its settings are used")
        file = OF_FOLDER
    if file is not None:
        from flowrec.core import read_toml

        read_toml(file)
    return file


def known_session(named: Path) -> Path:
    """Return the path; refuse a session that is not there before the imports, which take longer than to look."""
    from flowrec.store import existing_session

    return existing_session(named)


AsConfig = Union[Path, str, "Config", None]
SessionFile = Annotated[
    AnySession, typer.Argument(metavar="SESSION", callback=known_session, help="Session (.mcap), or its URL.")
]

_SET = typer.Option(
    "--set",
    metavar="KEY=VALUE",
    help="Change one setting, as in --set control.method=ff_fb.",
    autocompletion=complete_setting,
)
Sets = Annotated[list[str] | Mapping[str, Any] | None, _SET]
SetTexts = Annotated[list[str] | None, _SET]
SessionOut = Annotated[
    Path | str | None, typer.Option("--out", "-o", help="Session file; by default named by date and sample.")
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an existing output file.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout.")]

# Verbs that rooms above this one bring: "module:name", imported by name so that no arrow leads upwards.
ABOVE = {
    "sweep": "flowrec.archive.verbs:sweep",
    "push": "flowrec.archive.verbs:push",
    "catalog": "flowrec.archive.verbs:catalog",
    "find": "flowrec.archive.verbs:find",
    "report_sweep": "flowrec.archive.sweep.sweep_report:report_sweep",
    "bench": "flowrec.bench.bench_verb:bench",
}

OUR_VERBS: set[str] = set()  # names of the commands: cli.py adds them, and no package of others may take one
HELP_WIDTH = 110  # characters, on a terminal as wide as that
HELP_SETTINGS: dict[str, Any] = {  # of an app of typer
    "context_settings": {"help_option_names": ["-h", "--help"], "max_content_width": HELP_WIDTH},
    "pretty_exceptions_enable": False,
    "rich_markup_mode": None,  # frames around the help would take as long to draw as all the rest
}
HTML = (".html", ".htm")
_PACKAGES = {"matplotlib": "matplotlib", "jinja2": "Jinja2"}  # of the extra `report`
_LONGEST_DESCRIPTION = 1000  # characters: longer than any


Asked = Mapping[str, Any]  # the arguments of a call, by name


class Supplied(NamedTuple):
    """Mark of a parameter that no option sets: at the terminal `make` makes its value for the call."""

    make: Callable[[], Any]


def _at_terminal() -> Any:
    from flowrec.verbs.interactive import AtTerminal

    return AtTerminal()


def _bar() -> Any:
    from flowrec.core import progress

    return progress


Bar = Callable[[str, float, str], AbstractContextManager[Callable[[float], None]]]  # what is done, total, unit
BAR = Supplied(_bar)
ATTENDED = Supplied(_at_terminal)  # of the parameter `control`: a person attends a command, and nobody a call
OF_A_CALL = Supplied(lambda: None)  # of what only a program can give
AS_THE_COMMAND = Supplied(lambda: True)  # of what a command does otherwise than a call


class WholeDescriptions(TyperGroup):
    """Commands whose list in the help has the whole first sentence of each, in as many lines as it takes."""

    def command_for_help(self, ctx: Any, name: str) -> Any:
        """A command for the list of them."""
        return self.get_command(ctx, name)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        named = [(name, self.command_for_help(ctx, name)) for name in self.list_commands(ctx)]
        rows = [
            (name, command.get_short_help_str(_LONGEST_DESCRIPTION))
            for name, command in named
            if command is not None and not command.hidden
        ]
        with formatter.section("Commands"):
            formatter.write_dl(rows)


class FiniteNumbers:
    """Base of a command whose options take no number that is NaN or infinite: no work can be done with one."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        left: list[str] = super().parse_args(ctx, args)  # type: ignore[misc]
        for option in self.params:  # type: ignore[attr-defined]
            value = ctx.params.get(option.name)
            if isinstance(value, float) and not math.isfinite(value):
                raise typer.BadParameter(f"{value:g} is no number to work with; give a finite one", ctx, option)
        return left


class Stoppable:
    """Base of a command or a group that a signal leaves as StoppedError; Typer's own end is 130, and says nothing."""

    def make_context(self, *args: Any, **named: Any) -> Any:
        with stopped_in_one_line():
            return super().make_context(*args, **named)  # type: ignore[misc]

    def invoke(self, ctx: Any) -> Any:
        with stopped_in_one_line():
            return super().invoke(ctx)  # type: ignore[misc]


def require_packages() -> None:
    """Raise UsageError where a package of the extra `report` is not installed."""
    for module, package in _PACKAGES.items():
        if importlib.util.find_spec(module) is None:
            raise UsageError(f"a report needs {package}, which is not installed: pip install 'flowrec[report]'")


def from_above(name: str) -> Any:
    """A verb of ABOVE."""
    return pkgutil.resolve_name(ABOVE[name])
