"""`flowrec methods`: what can be chosen, ours and what packages bring."""

from collections.abc import Iterator
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flowrec.core import UsageError
from flowrec.verbs.command import outside_verb, verb
from flowrec.verbs.options import OUR_VERBS

if TYPE_CHECKING:
    from flowrec.core import ListedMethod


class Rows(tuple["ListedMethod", ...]):
    """Methods, devices, formats and verbs, a row each."""

    __slots__ = ()

    def as_json(self) -> list[dict[str, Any]]:
        return [asdict(row) for row in self]

    def show(self) -> None:
        from flowrec.core import table

        cells = [
            (
                row.setting,
                row.name,
                row.fault or row.summary,
                row.package + (f", extra {row.extra}" if row.extra else ""),
            )
            for row in self
        ]
        broken = [number for number, row in enumerate(self) if row.fault]
        table("Methods", ("setting", "name", "what it does", "package"), cells, text="what it does", amber=broken)


@verb("flowrec methods", "flowrec methods plan --json")
def methods(
    stage: Annotated[
        str | None, typer.Argument(metavar="[STAGE]", help="Only of this stage, such as plan, camera, format or verb.")
    ] = None,
) -> Rows:
    """List the methods, devices, formats and verbs that can be chosen, and the packages that they come from.

    Raises
    ------
    UsageError : there is no such stage.
    """
    rows = list(_rows())
    if stage is not None:
        known = sorted({word for row in rows for word in _words(row)} | {"verb"})
        if stage not in known:
            raise UsageError(f"{stage}: no such stage; there are {', '.join(known)}")
        rows = [row for row in rows if stage in _words(row)]
    return Rows(rows)


def _words(row: "ListedMethod") -> set[str]:
    """The words by which a person may name the stage of a row."""
    return {word for word in row.setting.lstrip("-").split(".") if word not in ("method", "lab", "NAME", "kind")}


def _rows() -> Iterator["ListedMethod"]:
    """All rows of all tables, and the verbs of others."""
    from flowrec.core import OWN, VERBS, ListedMethod, entry_points_of
    from flowrec.exports import EXPORTS
    from flowrec.stages import Config, all_tables

    for _, table in all_tables(Config):
        yield from table.list_rows()
    yield from EXPORTS.list_rows()
    for name, sources in entry_points_of(VERBS).items():
        for source in sources:
            summary = fault = ""
            try:
                if name in OUR_VERBS:
                    raise source.refusal(f"and the name is taken by {OWN}")
                summary = outside_verb(name).get_short_help_str(200)
            except UsageError as error:
                fault = str(error)
            yield ListedMethod("verb", name, summary.rstrip("."), str(source), fault=fault)
