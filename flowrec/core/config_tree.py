"""Settings as nested tables: `key=value` texts, registration files, and errors that name the nearest valid value.

config.py makes the typed configuration of such a tree of settings.
"""

from __future__ import annotations

import difflib
import os
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, is_dataclass
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from flowrec.core.errors import UsageError
from flowrec.core.methods import Methods, nearest_of
from flowrec.core.ranges import Fault, hints, named_section, range_of
from flowrec.core.system.toml_file import parse_toml, read_toml

REGISTRATION = "camera.registration"
# Settings that name files; in a TOML their paths begin at its folder.
FILES = (
    "chip.path",
    "camera.registration",
    "movie.path",
    "movie.times",
    "movie.coils",
    "start.field",
    "lab.device_config",
)
IMAGE_SIZE = ("width_px", "height_px")
_SHOWN = 40  # characters of a value
NAME = "NAME"  # of a section that a person names, where settings are listed
_NAME_LIMIT = 40


@dataclass(frozen=True, slots=True)
class Origin:
    """Origin of settings, for errors: the typed flag or the file."""

    file: str
    flags: Mapping[str, str] = field(default_factory=dict)  # by key

    def __call__(self, *keys: str) -> str:
        """The flag that set a key, a part of it or its section; the file if none did."""
        for key in keys:
            for typed, flag in self.flags.items():
                if f"{typed}.".startswith(f"{key}.") or f"{key}.".startswith(f"{typed}."):
                    return flag
        return self.file


def _value(text: str) -> Any:
    """A value in TOML syntax; a bare word is a string, so that shells need no double quoting."""
    try:
        return parse_toml(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text
    except ValueError as error:  # a number or text beyond all measure
        raise UsageError(f"--set ...={text[:_SHOWN]}: {error}") from error


def settings_of(sets: Mapping[str, Any] | Iterable[str]) -> dict[str, Any]:
    """Settings by key, as in {"robot.um_per_rev": 24}: values as they are, or texts `key=value` of a command line.

    The value of a text is TOML, or a bare word. Of numpy and of paths the plain value is taken. Raises UsageError: a
    text has no `=`, or a value is of a type that no setting has.
    """
    if isinstance(sets, str):
        raise UsageError(f"sets = {sets!r}: give a list, as [{sets!r}], or a dictionary")
    if isinstance(sets, Mapping):
        return {key: _plain(key, value) for key, value in sets.items()}
    found: dict[str, Any] = {}
    for text in sets:
        key, equals, value = text.partition("=")
        if not (equals and key.strip()):
            raise UsageError(f"--set {text!r}: expected key=value, as in --set control.method=ff_fb")
        found.pop(key.strip(), None)  # the last of two counts, also over one of the keys within
        found[key.strip()] = _value(value.strip())
    return found


def _plain(key: str, value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _plain(f"{key}.{name}", inner) for name, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(key, inner) for inner in value]
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if hasattr(value, "tolist"):  # of numpy
        return value.tolist()
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise UsageError(
        f"{key} = {str(value)[:_SHOWN]}: is of the type {type(value).__name__}; give a number, a text, a truth value, "
        "or a list or a dictionary of these"
    )


def apply_sets(tree: dict[str, Any], sets: Mapping[str, Any]) -> dict[str, str]:
    """Put each setting into the tree; returns the flag by key."""
    for setting, value in sets.items():
        section, (*keys, last) = tree, setting.split(".")
        for key in keys:
            section = section.setdefault(key, {})
            if not isinstance(section, dict):
                raise UsageError(f"--set {setting}: {key!r} is a value, not a section")
        section[last] = value
    return dict.fromkeys(sets, "--set")


def take_registration(tree: dict[str, Any], sets: Mapping[str, Any]) -> None:
    """Put the settings of a registration file, which the tree or one of `sets` names, before those of the tree."""
    camera = tree.get("camera", {})
    path = sets.get(REGISTRATION, camera.get("registration") if isinstance(camera, dict) else None)
    if not isinstance(path, str) or not path or not isinstance(camera, dict):
        return
    stated = read_toml(Path(path)).get("camera")
    if not isinstance(stated, dict) or not {"um_per_px", "angle_deg", "width_px", "height_px"} <= stated.keys():
        raise UsageError(f"{path}: is no registration; flowrec calibrate image PICTURE -o {path} makes one")
    for key in IMAGE_SIZE:
        value = sets.get(f"camera.{key}", camera.get(key, stated[key]))
        if value != stated[key]:
            raise UsageError(
                f"{path}: is of images {stated['width_px']} x {stated['height_px']}, and camera.{key} = {value}; take "
                "a picture with the size and region of the run, and register it"
            )
    tree["camera"] = camera | stated


def place_paths(tree: dict[str, Any], file: Path) -> None:
    """Let the relative paths in the tree of a file begin at the folder of the file, wherever the command is run.

    Raises UsageError: there is no such file in that folder, but one in the working directory: which is meant is not
    guessed.
    """
    for key in FILES:
        section, _, name = key.partition(".")
        table = tree.get(section)
        path = table.get(name) if isinstance(table, dict) else None
        if not isinstance(path, str) or not path or ":/" in path or Path(path).is_absolute():  # ":/": a URL
            continue
        placed = file.parent / path
        plain = Path(os.path.normpath(placed))
        if plain.exists() and plain.resolve() == placed.resolve():  # without `..`, unless a link makes a difference
            placed = plain
        if not placed.exists() and Path(path).exists():
            here = Path(os.path.relpath(path, file.parent)).as_posix()
            raise UsageError(
                f"{file}: {key} = {path!r} is not in the folder of this file, where its paths begin, but in the "
                f"working directory; write {name} = {here!r}"
            )
        table[name] = str(placed)  # type: ignore[index]


def type_error(root: type, key: str, value: Any, complaint: str) -> str:
    """The error text for a value of the wrong type, with the nearest valid value."""
    known = dict(_all_hints(root))
    declared = _as_declared(root, key)
    while declared not in known and "." in declared:  # a place in a tuple
        key, declared = key.rpartition(".")[0], declared.rpartition(".")[0]
    hint = known.get(declared)
    names, valid = _names_of(hint), range_of(hint)
    if names:
        return f"{key} = {value!r}: must be one of {', '.join(names)}{nearest_of(value, names)}"
    if _is_list(hint):
        wanted = "a list is wanted" if valid is None else f"a list is wanted, of numbers {valid}"
        return f"{key} = {value!r}: {wanted} ({complaint.replace('tuple', 'list')})"
    if valid is not None and isinstance(value, (int, float)):
        if value in valid:
            return f"{key} = {value!r}: must be a whole number {valid}; the nearest is {round(value)}"
        return str(Fault(key, value, valid))
    if isinstance(value, str) and valid is not None:
        return f"{key} = {value!r}: is no number; one {valid} is wanted, without its unit"
    return f"{key} = {value!r}: {complaint}" + (f"; a number {valid} is wanted" if valid is not None else "")


def _is_list(hint: Any) -> bool:
    """True for a setting that takes several values."""
    return any(get_origin(part) in (tuple, list) for part in (hint, *get_args(hint)))


def _as_declared(root: type, key: str) -> str:
    """A key with NAME in place of the name that a person has given to a section."""
    first, _, rest = key.partition(".")
    name, dot, last = rest.partition(".")
    return f"{first}.{NAME}{dot}{last}" if name and named_section(hints(root).get(first)) is not None else key


def _names_of(hint: Any) -> list[str]:
    """The names that a setting can take; empty if it takes other values."""
    if get_origin(hint) is Literal:
        return list(map(str, get_args(hint)))
    if isinstance(hint, Methods):
        return hint.names()
    return [name for part in get_args(hint) for name in _names_of(part)]


def refuse_unknown(
    tree: Mapping[str, Any], root: type, origin: Origin, section: type | None = None, prefix: str = ""
) -> None:
    """Raise UsageError for the first key of a tree that the configuration `root` does not have.

    Parameters
    ----------
    section, prefix : of `root`, which the tree is of; None: all of it.
    """
    known = hints(section or root)
    for key, value in tree.items():
        name = prefix + key
        if key not in known:
            given = name.split(".")[1] if _as_declared(root, name) != name else NAME
            near = nearest_settings(_as_declared(root, name), [each for each, _ in _all_hints(root)])
            near = [each.replace(f".{NAME}.", f".{given}.") for each in near]
            all_of = (
                f"known here: {', '.join(prefix + each for each in known)}" if prefix else "flowrec settings lists all"
            )
            hint = f"did you mean {' or '.join(near)}?" if near else all_of
            raise UsageError(f"{origin(name)}: unknown key {name}; {hint}")
        inner = known[key]
        if is_dataclass(inner) and isinstance(inner, type):
            if not isinstance(value, dict):
                raise UsageError(f"{origin(name)}: {name} is a section, not a value; set one of its keys")
            refuse_unknown(value, root, origin, inner, f"{name}.")
        elif (named := named_section(inner)) is not None:
            _refuse_unnamed(value, root, origin, named, name)


def _refuse_unnamed(value: Any, root: type, origin: Origin, kind: type, key: str) -> None:
    """Raise UsageError if the sections below a key are no sections of this kind, each with a name."""
    if not isinstance(value, dict):
        raise UsageError(f"{origin(key)}: {key} is no value; write a section [{key}.{NAME}] for each")
    for name, section in value.items():
        if not (isinstance(name, str) and name.isascii() and name.isidentifier() and len(name) <= _NAME_LIMIT):
            raise UsageError(
                f"{origin(key)}: {key}.{str(name)[:_SHOWN]}: name it with letters, digits and _, as in {key}.pump"
            )
        if not isinstance(section, dict):
            raise UsageError(f"{origin(key)}: {key}.{name} is a section with settings, not a value")
        refuse_unknown(section, root, origin, kind, f"{key}.{name}.")


def nearest_settings(name: str, keys: Sequence[str]) -> list[str]:
    """The keys that a wrong one may mean: up to three with the same last part, else the one that is most alike."""
    same = [key for key in keys if key.rpartition(".")[2] == name.rpartition(".")[2]]
    return same[:3] or difflib.get_close_matches(name, keys, 1, 0.6)


def _all_hints(section: type, prefix: str = "") -> Iterable[tuple[str, Any]]:
    """Every key of the configuration with its type, sections included."""
    for key, inner in hints(section).items():
        yield prefix + key, inner
        if is_dataclass(inner) and isinstance(inner, type):
            yield from _all_hints(inner, f"{prefix}{key}.")
        elif (named := named_section(inner)) is not None:
            yield from _all_hints(named, f"{prefix}{key}.{NAME}.")


def without_none(value: Any) -> Any:
    """A tree without the settings that are None, which TOML has no word for."""
    if isinstance(value, dict):
        return {key: without_none(inner) for key, inner in value.items() if inner is not None}
    if isinstance(value, (list, tuple)):
        return [without_none(inner) for inner in value]
    return value
