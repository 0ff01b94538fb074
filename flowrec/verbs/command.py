"""Verbs as commands: options, help, --json, output and exit status of a command follow from the function of a verb.

A verb is a function with `verb` above it. A parameter that is annotated as an option or an argument of typer is one of
its command, too; of a union the terminal has the first type. The value of one with the mark `Supplied` is
made for the call. Every other parameter is Python's alone. The command line imports the modules of all verbs, so these
import what takes long within their functions, and do without `from __future__ import annotations`: types that are
imported for the type checker alone stand in quotes.

A result has `as_json()`, and `lines()` or `show()`, which prints, and may have `exit_status`. Where the command tells
something else than the function returns, `result` makes a `Told` of it.
"""

from __future__ import annotations

import inspect
import json
import os
import re
from collections.abc import Callable, Iterable, Iterator
from copy import copy
from types import NoneType, UnionType
from typing import Annotated, Any, NamedTuple, Self, TypeVar, Union, get_args, get_origin

import typer
from typer.core import TyperCommand
from typer.models import ParameterInfo

from flowrec.core import Ended, FlowrecError, UsageError, printable, table_at
from flowrec.verbs.options import HELP_SETTINGS, AsJson, Asked, FiniteNumbers, Supplied

_Function = TypeVar("_Function", bound=Callable[..., Any])
_SECTION = re.compile(r"^\w+\n-{3,}$|^>>> ", re.MULTILINE)  # of a docstring: what is Python's begins there
_NO_NUMBER = re.compile(r"Input should be a valid (number|integer), unable to parse string as an? \w+")
_TOLD_WITHIN_S = 0.3  # of a run that was stopped: a frozen terminal must not delay the exit


class MethodsOf(NamedTuple):
    """Mark of an option that names a row of a table, "module:name": help and completion list the rows."""

    table: str


class MisuseError(UsageError):
    """Arguments that mean nothing or do not go together: at the terminal, wrong usage, which names the help."""

    def __init__(self, text: str, option: str = "") -> None:
        super().__init__(text)
        self.option = option  # which is wrong


class Told(NamedTuple):
    """Output of a command: JSON, lines and exit status.

    Attributes
    ----------
    as_json, show : make the JSON and print for people; None: there is none.
    exit_status : of the command; a function of what is known once it is printed.
    remarks : lines to stderr, in any case.
    after : with what the command goes on.
    ends_at_once : the process ends without the shutdown of Python, which takes half a second.
    """

    as_json: Callable[[], Any] | None = None
    show: Callable[[], object] | None = None
    exit_status: int | Callable[[], int] = 0
    remarks: Callable[[], Iterable[str]] = tuple
    after: Callable[[], object] = tuple
    ends_at_once: bool = False

    @classmethod
    def of(cls, found: Any, **asked: Any) -> Self:
        """A result that has what it tells as methods, or is one itself; `asked` comes first in the JSON, as text."""
        if isinstance(found, cls):
            return found
        as_json, show = getattr(found, "as_json", None), getattr(found, "show", None)
        named = {name: str(value) for name, value in asked.items()}
        return cls(
            (lambda: named | as_json()) if named and as_json is not None else as_json,
            show or (lambda: print_lines(found.lines())),
            lambda: getattr(found, "exit_status", 0),
        )


class Verb(NamedTuple):
    """Properties of the command of a verb besides its options."""

    parameters: tuple[inspect.Parameter, ...]  # of the function, with options and marks
    examples: tuple[str, ...]  # what a person may type, at the end of the help
    with_json: bool  # it has --json
    result: Callable[[Asked, Any], Told]  # makes what is told of the arguments and what the function returned
    # makes the JSON of an error, of the arguments and the error; None: an error is a line on stderr
    refused: Callable[[Asked, FlowrecError], dict[str, Any]] | None


def verb(
    *examples: str,
    with_json: bool = True,
    result: Callable[[Asked, Any], Told] = lambda _asked, found: Told.of(found),
    refused: Callable[[Asked, FlowrecError], dict[str, Any]] | None = None,
) -> Callable[[_Function], _Function]:
    """Declare a function as a verb; its documentation takes over the help of its options. See `Verb`."""

    def declare(function: _Function) -> _Function:
        found = inspect.signature(function)
        parameters = tuple(found.parameters.values())
        for each in parameters:
            if str(each.annotation).startswith("Annotated["):
                raise TypeError(f"{function.__name__}: the option {each.name} is text; see the head of this file")
        function.verb = Verb(parameters, examples, with_json, result, refused)  # type: ignore[attr-defined]
        function.__doc__ = _documentation(function)
        plain = [each.replace(annotation=_plain(each.annotation)) for each in parameters]
        function.__signature__ = found.replace(parameters=plain)  # type: ignore[attr-defined]
        return function

    return declare


def add_verb(app: typer.Typer, function: Callable[..., Any], name: str | None = None) -> None:
    """Add the command of a verb to an app, by default under the function's name."""
    examples = function.verb.examples  # type: ignore[attr-defined]
    epilog = "\n\n".join(["Examples:", *examples]) if examples else None
    told, *_ = _SECTION.split(inspect.getdoc(function) or "", maxsplit=1)
    app.command(name or function.__name__, cls=_VerbCommand, help=told.rstrip(), epilog=epilog)(_command(function))


class _VerbCommand(FiniteNumbers, TyperCommand):
    """A verb whose help names the methods of its options; the tables are imported when the help is printed."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        tables = getattr(self.callback, "tables", {})
        for parameter in self.params:
            if parameter.name in tables:
                rows = table_at(tables[parameter.name]).list_rows()
                parts = (f"{row.name}: {row.summary}" for row in rows if not row.fault)
                parameter.help = f"{parameter.help} " + "; ".join(parts) + "."  # type: ignore[attr-defined]
        super().format_help(ctx, formatter)


def _options(function: Callable[..., Any]) -> Iterator[tuple[inspect.Parameter, Any, ParameterInfo, list[Any]]]:
    """The parameters of a verb that are its command's: with their type at the terminal, their option, other marks."""
    for each in function.verb.parameters:  # type: ignore[attr-defined]
        if get_origin(each.annotation) is Annotated:
            kind, *marks = get_args(each.annotation)
            for option in (mark for mark in marks if isinstance(mark, ParameterInfo)):
                yield each, _at_terminal(kind), option, [mark for mark in marks if mark is not option]


def _plain(annotation: Any) -> Any:
    return get_args(annotation)[0] if get_origin(annotation) is Annotated else annotation


def _at_terminal(kind: Any) -> Any:
    if get_origin(kind) not in (Union, UnionType):
        return kind
    first = get_args(kind)[0]
    return first | None if NoneType in get_args(kind) else first


def _command(function: Callable[..., Any]) -> Callable[..., None]:
    """A function with the options of a verb, for typer."""
    declared: Verb = function.verb  # type: ignore[attr-defined]
    parameters, tables = [], dict[str, str]()
    for each, kind, declared_option, marks in _options(function):
        option = copy(declared_option)
        for mark in marks:
            if isinstance(mark, MethodsOf):
                tables[each.name], option.autocompletion = mark.table, _completion(mark.table)
        parameters.append(each.replace(kind=inspect.Parameter.KEYWORD_ONLY, annotation=Annotated[kind, option]))
    if declared.with_json:
        as_json = inspect.Parameter("as_json", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=AsJson)
        parameters.append(as_json)
    supplied = {
        each.name: mark.make
        for each in declared.parameters
        for mark in get_args(each.annotation)[1:]
        if isinstance(mark, Supplied)
    }

    returns = str(inspect.signature(function).return_annotation)

    def call(asked: Asked, as_json: bool) -> Any:
        """The result of the function, or the partial one if it was ended."""
        try:
            return function(**asked, **{name: make() for name, make in supplied.items()})
        except Ended as ended:
            # Of a verb that is a part of this one, as the check before a report, the result is none of this one.
            if type(ended.result).__name__ not in re.findall(r"\w+", returns):
                raise
            return ended.result
        except FlowrecError as error:
            if declared.refused is None or not as_json:
                raise
            refusal = declared.refused(asked, error)
            typer.echo(json.dumps(refusal))
            raise typer.Exit(refusal.get("exit_status", error.exit_status)) from error

    def command(as_json: bool = False, **asked: Any) -> None:
        try:
            _tell(declared.result(asked, call(asked, as_json)), as_json)
        except MisuseError as error:
            raise typer.BadParameter(str(error), param_hint=error.option or None) from error

    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {each.name: each.annotation for each in parameters}
    command.tables = tables  # type: ignore[attr-defined]
    return command


# click's class, which typer has in its own package since 0.29.
CommandLineError: Any = typer.BadParameter.__base__


def usage_line(error: Any) -> str:
    """The line about a command line that typer refuses; '' if the help was printed instead."""
    # Of a choice it is in several lines; of a value that pydantic has refused it begins with its own words.
    message = printable(" ".join(error.format_message().split()).replace("Value error, ", "")).rstrip(".")
    message = _NO_NUMBER.sub(r"a \1 is wanted, without its unit", message).replace("Input should be", "it must be")
    verb = error.ctx.command_path if error.ctx is not None else "flowrec"
    return f"flowrec: {message}; see {verb} --help\n" if message else ""


def print_lines(lines: Iterable[str]) -> None:
    """Print each line as it comes, on stdout."""
    for line in lines:
        typer.echo(printable(line))


def _tell(told: Told, as_json: bool) -> None:
    """Print what is told and end the command by its exit status."""

    def tell() -> None:
        if as_json and told.as_json is not None:
            typer.echo(json.dumps(told.as_json()))
        elif told.show is not None:
            told.show()
        for line in told.remarks():
            from flowrec.core import say  # late: rich

            say(line)

    if told.ends_at_once:
        from flowrec.core import said_within

        said_within(_TOLD_WITHIN_S, tell)
    else:
        tell()
        told.after()
    status = told.exit_status() if callable(told.exit_status) else told.exit_status
    if told.ends_at_once:
        os._exit(status)
    if status:
        raise typer.Exit(status)


def _completion(table: str) -> Callable[[str], list[str]]:
    """Shell completion for the name of a row."""

    def complete(incomplete: str) -> list[str]:
        return [name for name in table_at(table).names() if name.startswith(incomplete)]

    return complete


def _documentation(function: Callable[..., Any]) -> str:
    """The docstring of a verb with the help of its options among the parameters."""
    helps = {each.name: getattr(option, "help", None) or "" for each, _, option, _ in _options(function)}
    text = inspect.getdoc(function) or ""
    if not helps:
        return text
    lines = "\n".join(f"{name} : {told}" for name, told in helps.items())
    head = "Parameters\n----------\n"
    if head in text:
        return text.replace(head, f"{head}{lines}\n", 1)
    found = re.search(r"^\w+\n-{3,}$", text, re.MULTILINE)
    at = found.start() if found is not None else len(text)
    return f"{text[:at].rstrip()}\n\n{head}{lines}\n\n{text[at:]}".rstrip()


def outside_verb(name: str) -> Any:
    """The verb of a name that a package of others brings, as a command for typer; None if none does.

    Raises UsageError: its package can not be imported, or declares no function.
    """
    from flowrec.core import VERBS, the_one

    source = the_one(VERBS, name)
    if source is None:
        return None
    found = source.load()
    if isinstance(found, type) or not callable(found):
        raise source.refusal("which declares it as a verb, but it is no function")
    app = typer.Typer(add_completion=False, **HELP_SETTINGS)
    app.command(name)(found)
    command = typer.main.get_command(app)
    command.name = name
    return command
