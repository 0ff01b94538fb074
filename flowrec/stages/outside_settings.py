"""Settings of the methods and devices that other packages bring: sections of the configuration named by them.

A section stands beside the setting that selects it: plan.method = "straight" has [plan.straight], lab.camera = "twin"
[lab.twin], rig = "stage" [stage]. It is a field of that name in a class that is made of ours, so that types, ranges,
errors, TOML and `asdict` treat it like our own.

The head of a session states each section's package. There a section that no installed package can read stays a plain
table: the session can be read, and only a replay that needs the package refuses.
"""

from __future__ import annotations

import functools
import json
import types
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, get_args

from pydantic import TypeAdapter, ValidationError

from flowrec.core import (
    FACT,
    NAME,
    MadeType,
    Methods,
    Origin,
    Outside,
    Source,
    Topic,
    UsageError,
    arguments_of,
    hints,
    named_section,
    outside_facts,
    refuse_unknown,
    remember_call,
)

_TABLE = dict[str, Any]  # the type of a section that can not be read
Section = tuple[str, Methods, str, Any]  # selecting setting, its table, name of the row, settings
_Fields = tuple[tuple[str, Any], ...]  # names and types


@functools.cache
def _with_fields(base: type, more: _Fields) -> type:
    """A frozen dataclass like `base` with more fields."""

    def fill(namespace: dict[str, Any]) -> None:
        namespace |= {"__module__": base.__module__, "__qualname__": base.__qualname__, "__doc__": base.__doc__}
        namespace["__annotations__"] = dict(more)
        namespace |= {name: field(default_factory=dict if kind is _TABLE else kind) for name, kind in more}

    made: type = dataclass(frozen=True, slots=True)(
        types.new_class(base.__name__, (base,), {"metaclass": MadeType}, fill)
    )
    remember_call(made, _with_fields, base, more)
    return made


@functools.cache
def tables(root: type) -> tuple[tuple[str, Methods], ...]:
    """The settings of a configuration class that select a row of a table to which others may add, by key."""
    named = f".{NAME}."  # sections that a person names have the settings of others as a table of their own
    return tuple((key, table) for key, table in all_tables(root) if table.group and named not in key)


@functools.cache
def all_tables(root: type) -> tuple[tuple[str, Methods], ...]:
    """The settings of a configuration class that select a row of a table, by key."""
    found: list[tuple[str, Methods]] = []
    for key, hint in hints(root).items():
        inner = [(key, hint)]
        if isinstance(hint, type) and hasattr(hint, "__dataclass_fields__"):
            inner = [(f"{key}.{name}", each) for name, each in hints(hint).items()]
        elif (named := named_section(hint)) is not None:
            inner = [(f"{key}.{NAME}.{name}", each) for name, each in hints(named).items()]
        found += [(full, table) for full, each in inner for table in _tables_in(each)]
    return tuple(found)


def _tables_in(hint: Any) -> Iterator[Methods]:
    for part in (hint, *get_args(hint)):
        if isinstance(part, Methods):
            yield part
        elif part is not hint:
            yield from _tables_in(part)


def with_row(stage: Any, table: Methods, name: str) -> Any:
    """The settings of a stage that select the row of a name; one of others has its default settings.

    >>> with_row(Planner(), PLANNERS, "lab_kit_steps").plan(...)

    Raises UsageError: there is no such row, or its package can not be used.
    """
    row, selector = table[name], table.setting.rpartition(".")[2]
    if row.source is None:
        return replace(stage, **{selector: name})
    of_stage: type = type(stage)
    kind = _with_fields(of_stage, ((name, row.settings),))
    return kind(**{each.name: getattr(stage, each.name) for each in fields(stage)} | {selector: name})


def key_of_section(setting: str, name: str) -> str:
    """Key of the section with the settings of a row."""
    section = setting.rpartition(".")[0]
    return f"{section}.{name}" if section else name


def extend_config(root: Any, tree: Mapping[str, Any], recorded: Callable[[str], bool] | None = None) -> Any:
    """The configuration class with the sections of all rows of others that a tree of settings names.

    Raises UsageError: a package can not be used, or its name is taken.

    Parameters
    ----------
    root : our configuration class.
    recorded : whether a section is one of a session, which has to be readable without its package.
    """
    more: dict[str, dict[str, Any]] = {}
    unread: dict[str, dict[str, Any]] = {}  # the selecting settings whose package is not there, with their types
    for setting, table in tables(root):
        section, _, selector = setting.rpartition(".")
        given = tree.get(section) if section else tree
        if not isinstance(given, Mapping):
            continue
        known = hints(hints(root)[section] if section else root)
        chosen = _names(given.get(selector))
        for name in [
            *chosen,
            *(key for key, value in given.items() if key not in known and isinstance(value, Mapping)),
        ]:
            if table.own(name):
                continue
            where = key_of_section(setting, name)
            kind: Any = None
            if recorded is not None and recorded(where):
                kind = _readable(table, name, given.get(name)) or _TABLE
            elif (row := table.outside(name)) is not None:
                kind = row.settings
                before = more.get(section, {}).get(name)
                if name in known or (before is not None and before is not kind):
                    assert row.source is not None, "a row of others"
                    raise row.source.refusal(f"and the section {where} of its settings is taken")
            if kind is _TABLE and name in chosen:
                several = not isinstance(given[selector], str)
                unread.setdefault(section, {})[selector] = tuple[str, ...] if several else str
            if kind is not None and name not in known:
                found = more.setdefault(section, {})
                found[name] = found.get(name, kind) if kind is _TABLE else kind  # of another table of the section
    fields_of_root = dict[str, Any]()
    for section, found in more.items():
        found.update(sorted(unread.get(section, {}).items()))
        if section:
            fields_of_root[section] = _with_fields(hints(root)[section], tuple(found.items()))
        else:
            fields_of_root |= found
    return _with_fields(root, tuple(fields_of_root.items())) if more else root


def _names(chosen: Any) -> list[str]:
    """The rows that a selecting setting names: one, or several of a list."""
    return [each for each in (chosen if isinstance(chosen, list | tuple) else [chosen]) if isinstance(each, str)]


def _readable(table: Methods, name: str, given: Any) -> Any:
    """The settings of the row of a name, if its package is there and takes those that are given; else None."""
    try:
        row = table.outside(name)
        if row is None:
            return None
        refuse_misfit(row.settings, given, name)
    except UsageError:
        return None
    return row.settings


def refuse_misfit(settings: type, given: Any, where: str) -> None:
    """Raise UsageError if settings do not take the keys and types of a recorded section."""
    given = given if isinstance(given, Mapping) else {}
    refuse_unknown(given, settings, Origin(where))
    try:
        TypeAdapter(settings).validate_python(given)
    except ValidationError as error:
        first = error.errors()[0]
        raise UsageError(f"{where}.{'.'.join(map(str, first['loc']))}: {first['msg']}") from error


def like(kind: Any, config: Any) -> Any:
    """A configuration class with the sections of others that a configuration has."""
    made_of = arguments_of(type(config))
    return _with_fields(kind, made_of[1]) if made_of else kind


def our_class(config: Any) -> Any:
    """Our class that the class of a configuration is made of."""
    return (arguments_of(type(config)) or (type(config),))[0]


def _holder(config: Any, section: str) -> Any:
    """The settings of a section; '' is the whole configuration."""
    return getattr(config, section) if section else config


def sections(config: Any) -> Iterator[Section]:
    """The sections of others in a configuration."""
    for setting, table in tables(our_class(config)):
        section = setting.rpartition(".")[0]
        holder = _holder(config, section)
        ours = {each.name for each in fields(our_class(holder))}
        for each in fields(holder):
            settings = getattr(holder, each.name)
            # Of which table a section is that can not be read and is not selected, nobody knows.
            if each.name not in ours and (isinstance(settings, dict) or each.name in table):
                yield setting, table, each.name, settings


def of_stages(config: Any) -> Iterator[Section]:
    """The sections, as `sections` gives them, whose rows the stages of a run use; devices and inputs are no stages."""
    for setting, table, name, settings in sections(config):
        section, _, selector = setting.rpartition(".")
        if table.makes_objects or name not in _names(getattr(_holder(config, section), selector)):
            continue
        if isinstance(settings, dict) or _source_of(settings) in (None, Source.STAGE.name):
            yield setting, table, name, settings


def _source_of(settings: Any) -> str | None:
    """Source of the messages of an extra topic; None for a row that is no topic."""
    topic = getattr(settings, "topic", None)
    return topic.source.name if isinstance(topic, Topic) else None


def _of_stage(fact: Mapping[str, str] | None) -> bool:
    """True if a row is part of a stage, by what the head of a session states of it: messages of inputs are recorded."""
    return fact is None or fact.get("source") in (None, Source.STAGE.name)


def facts_of(
    config: Any,
    recorded: Mapping[str, str] = types.MappingProxyType({}),
    of: Callable[[Any], Iterator[Section]] = sections,
) -> dict[str, str]:
    """Facts on the packages of others for the head of a session; of one that is not installed, the `recorded` ones."""
    facts: dict[str, str] = {}
    for setting, table, name, settings in of(config):
        key = FACT + key_of_section(setting, name)
        if isinstance(settings, dict):
            facts |= {key: recorded[key]} if key in recorded else {}
        elif (row := table.outside(name)) is not None and row.source is not None:
            source = _source_of(settings)
            facts[key] = json.dumps(row.source.facts() | ({"source": source} if source is not None else {}))
    return facts


def needed_packages(config: Any, provenance: Mapping[str, str]) -> list[str]:
    """The packages of others, with their versions, that a replay of a session needs, as its head states them."""
    known = outside_facts(provenance)
    found = (known.get(key_of_section(setting, name)) for setting, _, name, _ in of_stages(config))
    return sorted({f"{fact['package']} {fact['version']}" for fact in found if fact is not None and _of_stage(fact)})


def other_packages(config: Any, provenance: Mapping[str, str]) -> list[str]:
    """Differences of a replay's stages from the recorded ones in packages of others: a line each.

    Raises UsageError: a package that a stage needs is not installed, or does not take the recorded settings.
    """
    lines, known = [], outside_facts(provenance)
    for setting, table, name, settings in of_stages(config):
        key = key_of_section(setting, name)
        was = known.get(key, {})
        if not _of_stage(was):
            continue
        recorded = f"{was.get('package')} {was.get('version')}"
        install = f"pip install {was.get('package')}=={was.get('version')}"
        row = table.outside(name)
        if row is None:
            raise UsageError(f"{setting} = {name} is of the package {recorded}, which is not installed: {install}")
        assert row.source is not None, "a row of others"
        if isinstance(settings, dict):
            try:
                refuse_misfit(row.settings, settings, key)
                why = "are not valid"
            except UsageError as error:
                why = f"are not those of {row.source} ({error})"
            raise UsageError(f"{setting} = {name}: its settings by the package {recorded} {why}: {install}")
        lines += [f"{setting} = {name}: {text}"] if was and (text := _difference(was, row.source)) else []
    return lines


def _difference(was: Mapping[str, str], now: Outside) -> str:
    """Difference between the installed package and the recorded one, in words; "" if there is none."""
    recorded = f"{was['package']} {was['version']}"
    if recorded != str(now):
        return f"recorded with {recorded}, replayed with {now}"
    code = now.sha256
    if was.get("sha256") == code:
        return ""
    return f"recorded with other code of {recorded}: sha256 {was.get('sha256', '')[:16]}, now {code[:16]}"
