"""Settings as rows with their meaning, for `flowrec settings` and the comments of `record --dry-run`.

The meaning of a setting is the comment of its declaration, above the field or behind it; type, range and unit are those
of the annotation and the name. So each is stated once, where the stage reads it.
"""

from __future__ import annotations

import ast
import functools
import inspect
import io
import re
import textwrap
import tokenize
from collections.abc import Iterator
from dataclasses import MISSING, asdict, dataclass, fields, is_dataclass
from typing import Any, Literal, get_args, get_origin

import tomli_w

from flowrec.core import NAME, Methods, hints, named_section, range_of, unit_of, without_none
from flowrec.stages.config import Config

_WIDTH = 96  # of the comments


@dataclass(frozen=True, slots=True)
class SettingRow:
    """One setting."""

    key: str  # as typed with --set
    default: Any  # its value where nothing else is stated; None: not stated, then derived or not used
    valid: str  # type, range or choices, as text
    unit: str  # that the end of its name states, "" for none
    meaning: str  # of the value, and why the default is what it is
    read_by: tuple[str, ...] = ()  # methods of the stage that read it; none: all

    def lines(self) -> list[str]:
        """As text: the default, the meaning, what is valid and who reads it."""
        told = [
            self.meaning,
            "; ".join([self.facts, *([f"read by {', '.join(self.read_by)}"] if self.read_by else [])]),
        ]
        lines = [line for text in told for line in textwrap.wrap(text, _WIDTH)]
        return [f"{self.key} = {toml_value(self.default)}", *(f"    {line}" for line in lines)]

    @property
    def facts(self) -> str:
        """Type, range or choices, with the unit."""
        return f"{self.valid} {self.unit}".strip() if self.unit != "1" else self.valid


def setting_rows(section: type = Config, prefix: str = "") -> Iterator[SettingRow]:
    """All settings of a settings class and of the sections in it, in order of declaration."""
    found, meanings = hints(section), _meanings(section)
    readers = _readers(section)
    for each in fields(section):
        hint, key = found[each.name], prefix + each.name
        if is_dataclass(hint):
            yield from setting_rows(hint, f"{key}.")  # type: ignore[arg-type]
            continue
        if (named := named_section(hint)) is not None:
            yield from setting_rows(named, f"{key}.{NAME}.")
            continue
        default = each.default if each.default_factory is MISSING else each.default_factory()
        read_by = readers.get(each.name, ())
        meaning = meanings.get(each.name, "")
        if not meaning and any(isinstance(part, Methods) for part in _parts(hint)):
            meaning = f"flowrec methods {key.removesuffix('.method').rpartition('.')[2]} tells what each does"
        yield SettingRow(key, default, _valid(hint), unit_of(each.name), meaning, read_by)


def section_summary(hint: Any) -> str:
    """The first paragraph of what a section, or each of the sections that a person names, says of itself."""
    section = named_section(hint) or hint
    return _for_people(" ".join((inspect.getdoc(section) or "").split("\n\n")[0].split()))


def _for_people(text: str) -> str:
    """A comment as a person who writes TOML reads it: what is None in Python is a key that is not set."""
    return re.sub(r"\bNone\b", "not set", re.sub(r"(^|\. )None\b", r"\1Not set", text))


def toml_value(value: Any) -> str:
    """A value as TOML writes it; `(not set)` for None."""
    if value is None:
        return "(not set)"
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(toml_value, value))}]"
    return tomli_w.dumps({"value": value}).partition("= ")[2].rstrip()


def commented_toml(config: Config, changed_only: bool = False) -> str:
    """A configuration as TOML with the meaning of each setting above it; without the settings that are None.

    With `changed_only`, only the settings that differ from their defaults.
    """
    rows = {row.key: row for row in setting_rows()}
    lines: list[str] = []
    for section, values in _sections(without_none(asdict(config))):
        prefix = f"{section}." if section else ""
        told: list[str] = []
        for name, value in values.items():
            row = rows.get(prefix + name) or rows.get(f"{section.rpartition('.')[0]}.{NAME}.{name}")
            if row is not None and changed_only and toml_value(row.default) == toml_value(value):
                continue
            about = f"{row.meaning} ({row.facts})" if row is not None else ""
            told += [*(f"# {line}" for line in textwrap.wrap(about, _WIDTH)), f"{name} = {toml_value(value)}"]
        if told:
            lines += [*([f"\n[{section}]"] if section else []), *told]
    return "\n".join(lines).lstrip("\n") + "\n"


def _sections(tree: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Each table of nested tables with its own values, outer ones first."""
    yield prefix, {name: value for name, value in tree.items() if not isinstance(value, dict)}
    for name, value in tree.items():
        if isinstance(value, dict):
            yield from _sections(value, f"{prefix}.{name}" if prefix else name)


def _valid(hint: Any) -> str:
    """Type, range or choices of a setting, as text."""
    parts = [hint, *_parts(hint)]
    for part in parts:
        if isinstance(part, Methods):
            return "one of " + (", ".join(part.names()) or "those of other packages")
        if get_origin(part) is Literal:
            return "one of " + ", ".join(map(str, get_args(part)))
    valid = range_of(hint)
    several = "s" if any(get_origin(part) is tuple for part in parts) else ""
    names = {bool: "true or false", str: f"text{several}", int: f"whole number{several}", float: f"number{several}"}
    kind = " or ".join(text for each, text in names.items() if each in parts)
    return " ".join(filter(None, (kind, str(valid or ""))))


def _parts(hint: Any) -> Iterator[Any]:
    for part in get_args(hint):
        yield part
        yield from _parts(part)


def _readers(section: type) -> dict[str, tuple[str, ...]]:
    """Methods that read a setting of a stage, by name of the setting; a setting of no method is for all."""
    found: dict[str, tuple[str, ...]] = {}
    for hint in hints(section).values():
        for table in (part for part in (hint, *_parts(hint)) if isinstance(part, Methods)):
            for option in {option for row in table.values() for option in row.options}:
                names = tuple(row.name for row in table.values() if option in row.options)
                found[option] = names if len(names) < len(table) else ()
    return found


@functools.cache
def _meanings(section: type) -> dict[str, str]:
    """The comments of the fields of a dataclass and its bases, by name; of one made at run time those of its base."""
    found: dict[str, str] = {}
    for base in reversed(section.__mro__):
        if is_dataclass(base) and base.__qualname__ in getattr(inspect.getmodule(base), "__dict__", {}):
            comments = _comments(base).items()
            found |= {name: _for_people(text) for name, text in comments if text or name not in found}
    return found


def _comments(section: type) -> dict[str, str]:
    source = textwrap.dedent(inspect.getsource(section))
    written: dict[int, tuple[str, bool]] = {}  # by line: the text, and whether it is alone there
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            written[token.start[0]] = token.string.lstrip("# ").strip(), not token.line[: token.start[1]].strip()
    found: dict[str, str] = {}
    for node in ast.parse(source).body[0].body:  # type: ignore[attr-defined]
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            first = node.lineno
            while written.get(first - 1, ("", False))[1]:
                first -= 1
            lines = [written[line][0] for line in range(first, (node.end_lineno or first) + 1) if line in written]
            found[node.target.id] = " ".join(lines)
    return found
