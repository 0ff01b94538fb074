"""The methods of a stage as a table, a row per method. `--help`, errors, README, tests and benches iterate the rows.

A package of others brings rows of its own (CONTRIBUTING: Bring your own planner). Of these a table knows the names; it
imports one when it is asked for.
"""

from __future__ import annotations

import difflib
import inspect
import pkgutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, is_dataclass
from typing import Any

from flowrec.core.errors import UsageError
from flowrec.core.outside import Outside, entry_points_of, the_one

OWN = "flowrec"  # the package that our rows come from
_ALIKE = 0.4  # least likeness of two names, as difflib counts it, of which one may be meant by the other


@dataclass(frozen=True, slots=True)
class Method:
    """One row."""

    name: str  # value of the setting that selects the method
    target: str  # "module:name" of what implements it, imported when the method is first used
    summary: str  # what it does, in one line
    # names of the settings of the stage that this method reads. A setting that no row names is for all methods.
    options: tuple[str, ...] = ()
    extra: str = ""  # extra of pyproject.toml that installs what the method needs, "" if it needs none
    # what the method requires of other stages, or of its own inputs, besides what all methods get
    needs: tuple[str, ...] = ()
    provides: tuple[str, ...] = ()  # what the method states in its result besides what all methods state
    source: Outside | None = None  # the package of others that the row is of; None: it is ours
    settings: Any = None  # of a row of others: the frozen dataclass of its settings, a section named by the row

    def load(self) -> Any:
        """Import the object that implements the method. Raises UsageError: a package of `extra` is not installed."""
        try:
            return pkgutil.resolve_name(self.target)
        except ModuleNotFoundError as error:
            if not self.extra:
                raise
            raise UsageError(
                f"method {self.name} needs {error.name}, which is not installed: pip install 'flowrec[{self.extra}]'"
            ) from error

    def build(self, stage: Any) -> Any:
        """The method with its settings, which the settings of its stage hold."""
        if self.source is not None:
            return self.section(stage)
        return self.load()(**{option: getattr(stage, option) for option in self.options})

    def section(self, stage: Any) -> Any:
        """The section of its settings, its only option, in those of its stage: it is the method itself.

        Raises UsageError: it is of a package of others, and the settings are not there or of another version.
        """
        found = getattr(stage, self.options[0], None)
        if self.source is not None and not isinstance(found, self.settings):
            raise UsageError(
                f"{self.name} is of the package {self.source}, whose settings are not those given; make the "
                f"configuration by flowrec.load_config(None, ['...method={self.name}'])"
            )
        return found


@dataclass(frozen=True, slots=True)
class NoSettings:
    """The settings of a row that has none."""


@dataclass(frozen=True, slots=True)
class ListedMethod:
    """A row for `flowrec methods`."""

    setting: str
    name: str
    summary: str
    package: str  # it comes from, with its version unless it is ours
    extra: str = ""
    fault: str = ""  # why it can not be used, "" if it can


class Methods(Mapping[str, Method]):
    """The rows of one stage by name, in order of declaration; also the annotation of the setting that selects one.

    `method: Annotated[str, PLANNERS] = "time_field"` accepts the names of the rows, and those that other packages
    declare. It iterates over our rows only; `names` and `listed` have all.

    Parameters
    ----------
    setting : as typed, for instance plan.method.
    group : of the entry points by which others add rows; "": they can not.
    verb : the method of a row's class that does the work. A class with `of` or `write` makes objects, and its settings,
        if it has any, are its attribute `Settings`; any other is itself the frozen dataclass of its settings.
    """

    def __init__(self, setting: str, *rows: Method, group: str = "", verb: str = "") -> None:
        self.setting, self.group, self.verb = setting, group, verb
        self._rows = {row.name: row for row in rows}
        self._others: dict[str, Method] = {}

    def __getitem__(self, name: str) -> Method:
        """The row of a name; UsageError, with the nearest name, if there is none or its package can not be used."""
        row = self._rows.get(name) or self.outside(name)
        if row is None:
            names = self.names()
            raise UsageError(f"{self.setting} = {name!r}: must be one of {', '.join(names)}{nearest_of(name, names)}")
        return row

    def __iter__(self) -> Iterator[str]:
        return iter(self._rows)

    def __len__(self) -> int:
        return len(self._rows)

    def __contains__(self, name: object) -> bool:
        return name in self._rows or name in entry_points_of(self.group)

    def __hash__(self) -> int:
        return hash(self.setting)

    def own(self, name: object) -> bool:
        """True if a name is that of one of our rows."""
        return name in self._rows

    @property
    def makes_objects(self) -> bool:
        """True if a row makes a device, a rig or a writer of files; else it is part of a stage, which a replay runs."""
        return self.verb in ("of", "write")

    def outside(self, name: str) -> Method | None:
        """The row of a package of others; None if no package declares one of that name, or it is one of ours.

        Raises UsageError: the package can not be imported, or what it declares is no row of this table.
        """
        if name in self._rows:
            return None
        if name not in self._others:
            source = the_one(self.group, name)
            if source is None:
                return None
            self._others[name] = self._row(source)
        return self._others[name]

    def names(self) -> list[str]:
        """All names, ours first."""
        return [*self._rows, *(name for name in entry_points_of(self.group) if name not in self._rows)]

    def usable(self) -> list[str]:
        """Names of all rows, ours first, without those of packages that can not be used."""
        return [row.name for row in self.list_rows() if not row.fault]

    def list_rows(self) -> Iterator[ListedMethod]:
        """All rows, ours first, with those that can not be used."""
        for row in self._rows.values():
            yield ListedMethod(self.setting, row.name, row.summary, OWN, row.extra)
        for name, sources in entry_points_of(self.group).items():
            for source in sources:
                summary = fault = ""
                try:
                    if name in self._rows:
                        raise source.refusal(f"and the name is taken by {OWN}")
                    the_one(self.group, name)
                    summary = self._row(source).summary
                except UsageError as error:
                    fault = str(error)
                yield ListedMethod(self.setting, name, summary, str(source), fault=fault)

    def lack_of(self, found: Any) -> str:
        """Fault of the object of an entry point as a relative clause about its package; "" if it is a row."""
        fits = isinstance(found, type) and callable(getattr(found, self.verb, None))
        return "" if fits else f"but no class with the method {self.verb} that {self.group} need"

    def _row(self, source: Outside) -> Method:
        """The row that an entry point declares: the class, whose name is that of the entry point."""
        found = source.load()
        if lack := self.lack_of(found):
            raise source.refusal(lack)
        if not source.name.isidentifier():
            raise source.refusal("whose name can be no section of a configuration: use letters, digits and _")
        settings = getattr(found, "Settings", NoSettings) if self.makes_objects else found
        if not is_dataclass(settings) or not settings.__dataclass_params__.frozen:  # type: ignore[attr-defined]
            raise source.refusal("whose settings are no frozen dataclass")
        try:
            settings()
        except TypeError as error:
            raise source.refusal(f"whose settings must all have defaults ({error})") from error
        return Method(
            source.name,
            source.target,
            (inspect.getdoc(found) or "").partition("\n")[0].rstrip("."),
            options=(source.name,),
            needs=tuple(getattr(found, "needs", ())),
            provides=tuple(getattr(found, "provides", ())),
            source=source,
            settings=settings,
        )

    def __get_pydantic_core_schema__(self, _source: Any, _handler: Any) -> Any:
        """The names, for the validation of a configuration."""
        from pydantic_core import core_schema

        def known_name(value: object) -> object:
            if not isinstance(value, str) or value not in self:
                raise ValueError(f"must be one of {', '.join(self.names())}")
            return value

        return core_schema.no_info_plain_validator_function(known_name)


# The methods that a replay can change, by the name of the option and of the argument, and their tables.
REPLAYED = {
    "refine": "flowrec.stages.refine.refiner:REFINERS",
    "plan": "flowrec.stages.planning.planner:PLANNERS",
    "observer": "flowrec.stages.estimation.observer:OBSERVERS",
    "controller": "flowrec.stages.control.controller:CONTROLLERS",
}


def nearest_of(name: object, names: Sequence[str]) -> str:
    """Text about the name that is most like another, for errors; '' if none is like it."""
    near = difflib.get_close_matches(str(name), names, 1, _ALIKE)
    return f"; the nearest is {near[0]}" if near else ""


def table_at(target: str) -> Methods:
    """The table at "module:name"."""
    return pkgutil.resolve_name(target)
