"""The methods of a stage as a table, a row per method. `--help`, errors, README, tests and benches iterate the rows."""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from flowrec.errors import UsageError


@dataclass(frozen=True, slots=True)
class Method:
    """One row.

    Attributes
    ----------
    name : value of the setting that selects the method.
    target : "module:name" of what implements it, imported when the method is first used.
    summary : what it does, in one line.
    options : names of the settings of the stage that this method reads. A setting that no row names is for all methods.
    extra : extra of pyproject.toml that installs what the method needs, "" if it needs none.
    needs : what the method requires of other stages, or of its own inputs, besides what all methods get.
    provides : what the method states in its result besides what all methods state.
    """

    name: str
    target: str
    summary: str
    options: tuple[str, ...] = ()
    extra: str = ""
    needs: tuple[str, ...] = ()
    provides: tuple[str, ...] = ()

    def load(self) -> Any:
        """What implements the method.

        Raises
        ------
        UsageError : a package of `extra` is not installed.
        """
        module, _, name = self.target.partition(":")
        try:
            return getattr(importlib.import_module(module), name)
        except ModuleNotFoundError as error:
            if not self.extra:
                raise
            raise UsageError(
                f"method {self.name} needs {error.name}, which is not installed: pip install 'flowrec[{self.extra}]'"
            ) from error


class Methods(Mapping[str, Method]):
    """The rows of one stage by name, in order of declaration; also the annotation of the setting that selects one.

    `method: Annotated[str, PLANNERS] = "time_field"` accepts the names of the rows only.
    """

    def __init__(self, setting: str, *rows: Method) -> None:
        self.setting = setting  # as typed, for instance plan.method
        self._rows = {row.name: row for row in rows}

    def __getitem__(self, name: str) -> Method:
        """The row of a name; UsageError, with the nearest name, if there is none."""
        row = self._rows.get(name)
        if row is None:
            near = difflib.get_close_matches(str(name), self._rows, 1, 0.0)[0]
            raise UsageError(
                f"{self.setting} = {name!r}: must be one of {', '.join(self._rows)}; the nearest is {near}"
            )
        return row

    def __iter__(self) -> Iterator[str]:
        return iter(self._rows)

    def __len__(self) -> int:
        return len(self._rows)

    def __contains__(self, name: object) -> bool:
        return name in self._rows

    def __hash__(self) -> int:
        return hash(self.setting)

    def __get_pydantic_core_schema__(self, _source: Any, _handler: Any) -> Any:
        """The names as a literal, for the validation of a configuration."""
        from pydantic_core import core_schema

        return core_schema.literal_schema(list(self._rows))
