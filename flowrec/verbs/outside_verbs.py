"""The verbs that packages of others bring, as commands."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import typer

from flowrec.core import UsageError
from flowrec.verbs.options import HELP_WIDTH

if TYPE_CHECKING:
    from flowrec.core import Outside


def verb_names() -> list[str]:
    """The verbs that installed packages bring."""
    from flowrec.core import VERBS, entry_points_of

    return list(entry_points_of(VERBS))


def verb(name: str) -> Any:
    """The verb of a name, as a command for typer; None if no package brings it.

    Raises
    ------
    UsageError : its package can not be imported, or declares no function.
    """
    from flowrec.core import VERBS, the_one

    source = the_one(VERBS, name)
    if source is None:
        return None
    app = typer.Typer(
        add_completion=False,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"], "max_content_width": HELP_WIDTH},
        rich_markup_mode=None,
    )
    app.command(name)(_function(source))
    command = typer.main.get_command(app)
    command.name = name
    return command


def verb_for_help(name: str) -> Any:
    """Command of an outside verb for the list of verbs; if it can not be used, one whose help states the fault."""
    try:
        return verb(name)
    except UsageError as error:
        return typer.core.TyperCommand(name, help=f"Can not be used: {error}")


def _function(source: Outside) -> Any:
    found = source.load()
    if isinstance(found, type) or not callable(found):
        raise source.refusal("which declares it as a verb, but it is no function")
    return found
