"""What flowrec offers to those who use it, as text: verbs, options, settings, methods, topics, columns, names, words.

    python -m tests.perf.interface > before.txt     # two listings are compared by diff

A change that only moves code leaves it unchanged.
"""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import pkgutil
import re
from collections.abc import Iterator
from typing import Any, get_type_hints

import typer

import flowrec
from flowrec.core import declarations, enums, methods, topics
from flowrec.stages import config
from flowrec.store import table_columns as columns
from flowrec.verbs import cli


def verbs(command: Any, name: str) -> Iterator[str]:
    yield f"verb {name}: {command.help.splitlines()[0] if command.help else ''}"
    for each in command.params:
        names = "/".join([*each.opts, *each.secondary_opts])
        kind = plain(each.type_descriptor)
        shown = "" if callable(each.default) else repr(each.default)
        told = getattr(each, "help", "") or ""
        yield f"  {each.param_type_name} {names} {kind} n={each.nargs} default={shown} {told}"
    for child in sorted(getattr(command, "commands", {})):
        yield from verbs(command.commands[child], f"{name} {child}")


def settings(kind: type, prefix: str = "") -> Iterator[str]:
    hints = get_type_hints(kind, include_extras=True)
    for field in dataclasses.fields(kind):
        hint, value = hints[field.name], field.default
        if field.default_factory is not dataclasses.MISSING:
            value = field.default_factory()
        if dataclasses.is_dataclass(hint):
            yield from settings(hint, f"{prefix}{field.name}.")
        else:
            yield f"setting {prefix}{field.name} = {plain(value)}: {plain(hint)}"


def plain(value: object) -> str:
    return re.sub(r"\bflowrec\.[\w.]*\.(\w+)", r"\1", re.sub(r" at 0x[0-9a-f]+", "", str(value)))


def tables() -> Iterator[str]:
    found = {}
    for each in pkgutil.walk_packages(flowrec.__path__, "flowrec."):
        if ".training" in each.name or each.name.endswith("__main__"):
            continue
        try:
            values = vars(importlib.import_module(each.name))
        except ModuleNotFoundError:  # of an extra; tables stand in modules that need none
            continue
        for name, value in values.items():
            if isinstance(value, methods.Methods):
                found[name] = value
    for name in sorted(found):
        for key, row in found[name].items():
            values = (
                {f.name: getattr(row, f.name) for f in dataclasses.fields(row)}
                if dataclasses.is_dataclass(row)
                else row
            )
            yield f"method {name} {key}: {plain({k: str(v).rpartition(':')[2] for k, v in values.items()})}"


def messages() -> Iterator[str]:
    for topic in topics.TOPICS:
        yield f"topic {topic.path} {topic.type.__name__} {plain(topic.source)} {topic.role}"
        for each in declarations.message_fields(topic.type):
            yield f"  field {plain(each)}"
        for column in columns.columns_of(topic.field):
            yield f"  column {column}"


def names() -> Iterator[str]:
    for name in sorted(flowrec.__all__):
        value = getattr(flowrec, name)
        try:
            signature = plain(inspect.signature(value))
        except (TypeError, ValueError):
            signature = ""
        yield f"name flowrec.{name}{signature}"
        if inspect.isclass(value):
            for member in sorted(each for each in dir(value) if not each.startswith("_")):
                found = inspect.getattr_static(value, member)
                yield f"  {name}.{member}{plain(inspect.signature(found)) if inspect.isfunction(found) else ''}"


def words() -> Iterator[str]:
    for name, value in sorted(vars(enums).items()):
        if inspect.isclass(value) and value.__module__ == enums.__name__:
            yield f"enum {name}: {[str(getattr(v, 'value', v)) for v in value] if hasattr(value, '__iter__') else ''}"


def main() -> None:
    group = typer.main.get_command(cli.app)
    for part in (verbs(group, "flowrec"), settings(config.Config), tables(), messages(), names(), words()):
        print("\n".join(part))


if __name__ == "__main__":
    main()
