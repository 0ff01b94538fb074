"""Packages of others: what an installed one declares as entry points of a group such as `flowrec.planners`.

They are looked for when a name is none of ours, and when names are listed: to import importlib.metadata and to scan the
installed packages takes 50 ms.
"""

from __future__ import annotations

import functools
import hashlib
import importlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.machinery import BYTECODE_SUFFIXES, all_suffixes
from pathlib import Path
from typing import Any

from flowrec.core.errors import UsageError

VERBS = "flowrec.verbs"
FACT = "outside."  # of keys of a session's provenance, followed by the section of the configuration


@dataclass(frozen=True, slots=True)
class Outside:
    """An entry point of a package.

    Attributes
    ----------
    name : by which a setting or the command line selects it.
    target : "module:name" of the object.
    package, version : of the distribution, as pip names them.
    """

    name: str
    target: str
    package: str
    version: str

    def __str__(self) -> str:
        return f"{self.package} {self.version}"

    def load(self) -> Any:
        """The object. Raises UsageError: one line that names the package, whatever its import raises."""
        module, _, path = self.target.partition(":")
        try:
            return functools.reduce(getattr, path.split("."), importlib.import_module(module))
        except (Exception, SystemExit) as error:  # the code of others
            why = f"{type(error).__name__}: {str(error).partition(chr(10))[0]}"
            raise self.refusal(f"which can not be imported ({why})") from error

    def refusal(self, why: str) -> UsageError:
        """The error that it can not be used; `why` is a relative clause about the package."""
        return UsageError(f"{self.name} ({self.target}) is of the package {self}, {why}; mend or uninstall it")

    @property
    def sha256(self) -> str:
        """Hash of all code of the package that the module belongs to, or of the module where it is a single file."""
        words = self.target.partition(":")[0].split(".")
        named = (importlib.import_module(".".join(words[: count + 1])) for count in range(len(words)))
        file = Path(next(module.__file__ for module in named if module.__file__))  # a namespace has no file
        digest = hashlib.sha256()
        for path in _code(file.parent) if file.stem == "__init__" else [file]:
            digest.update(f"{path.relative_to(file.parent).as_posix()} {path.stat().st_size}\n".encode())
            digest.update(path.read_bytes())
        return digest.hexdigest()

    def facts(self) -> dict[str, str]:
        """Its facts for the head of a session."""
        return {"package": self.package, "version": self.version, "target": self.target, "sha256": self.sha256}


def _code(folder: Path) -> Iterator[Path]:
    """The files in a folder that Python imports, in order."""
    endings = tuple(set(all_suffixes()) - set(BYTECODE_SUFFIXES))
    return (path for path in sorted(folder.rglob("*")) if path.name.endswith(endings) and path.is_file())


@functools.cache
def entry_points_of(group: str) -> dict[str, tuple[Outside, ...]]:
    """The entry points of a group by name; more than one where several packages declare the same name."""
    if not group:
        return {}
    from importlib.metadata import entry_points

    found: dict[str, tuple[Outside, ...]] = {}
    for entry in sorted(entry_points(group=group), key=lambda each: each.name):
        package, version = (entry.dist.name, entry.dist.version) if entry.dist is not None else ("?", "?")
        each = Outside(entry.name, entry.value.partition("[")[0].strip(), package, version)
        found[entry.name] = (*found.get(entry.name, ()), each)
    return found


def the_one(group: str, name: str) -> Outside | None:
    """The entry point of a name; None if no package declares it. Raises UsageError: several packages declare it."""
    several = entry_points_of(group).get(name, ())
    if len(several) > 1:
        raise UsageError(f"{name} is declared by {' and by '.join(map(str, several))}; uninstall all but one of them")
    return several[0] if several else None


def outside_facts(provenance: Mapping[str, str]) -> dict[str, dict[str, str]]:
    """Facts in the head of a session about each section of others; what is damaged is left out."""
    found = {}
    for key, text in provenance.items():
        if key.startswith(FACT):
            try:
                fact = json.loads(text)
            except (ValueError, RecursionError):
                continue
            if isinstance(fact, dict) and all(isinstance(fact.get(word), str) for word in ("package", "version")):
                found[key.removeprefix(FACT)] = {str(word): str(value) for word, value in fact.items()}
    return found
