"""`flowrec settings`: meaning, unit, range and default of each setting."""

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flowrec.core import UsageError
from flowrec.verbs.command import verb
from flowrec.verbs.completion import complete_section

if TYPE_CHECKING:
    from flowrec.stages import SettingRow


class ExplainedSettings(tuple["SettingRow", ...]):
    """Settings, a row each."""

    __slots__ = ()

    def as_json(self) -> list[dict[str, Any]]:
        return [asdict(row) for row in self]

    def lines(self) -> list[str]:
        return [line for row in self for line in row.lines()]


class SettingSections(dict[str, str]):
    """Subjects of the sections of the settings, by name."""

    def as_json(self) -> dict[str, str]:
        return dict(self)

    def show(self) -> None:
        from flowrec.core import table

        table("Settings", ("section", "what it is about"), self.items(), text="what it is about")
        typer.echo("flowrec settings SECTION explains its settings; record --dry-run prints those of a run")


@verb("flowrec settings", "flowrec settings plan", "flowrec settings mission.goal")
def settings(
    about: Annotated[
        str | None,
        typer.Argument(
            metavar="[SECTION|KEY|WORD]",
            help="Explain this setting, all of a section, or those that have a word in name or text.",
            autocompletion=complete_section,
        ),
    ] = None,
) -> "ExplainedSettings | SettingSections":
    """Explain the settings: meaning, unit, range, default, and the methods that read each.

    Raises
    ------
    UsageError : there is no such setting.
    """
    from flowrec.core import nearest_settings
    from flowrec.stages import Config, section_summary, setting_rows

    rows = [*setting_rows()]
    if about is None:
        from flowrec.core import hints

        sections = {row.key.partition(".")[0] for row in rows if "." in row.key}
        kinds = {name: kind for name, kind in hints(Config).items() if name in sections}
        single = ", ".join(row.key for row in rows if "." not in row.key)
        return SettingSections(
            {name: section_summary(kind) for name, kind in kinds.items()} | {single: "of the whole run"}
        )
    found = [row for row in rows if row.key == about or row.key.startswith(f"{about}.")] or _with_words(about, rows)
    if not found:
        keys = [row.key for row in rows]
        sections = {key[:end] for key in keys for end in (key.rfind("."), key.find(".")) if end > 0}
        near = " or ".join(nearest_settings(about, [*keys, *sorted(sections)]))
        hint = f"did you mean {near}? flowrec settings lists all" if near else "try another word, or flowrec settings"
        raise UsageError(f"{about}: no such setting, and none with these words; {hint}")
    return ExplainedSettings(found)


def _with_words(about: str, rows: list["SettingRow"]) -> list["SettingRow"]:
    """Settings with all these words in their names, then those with them in their meaning."""
    words = about.lower().replace("_", " ").split()

    def has_words(text: str) -> bool:
        return all(word in text.lower().replace("_", " ") for word in words)

    named = [row for row in rows if has_words(row.key)]
    return named + [row for row in rows if row not in named and has_words(row.meaning)]
