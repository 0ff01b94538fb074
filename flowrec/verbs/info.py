"""`flowrec info`: facts about a session, from its head and index only.

The configuration is read as plain TOML, and topics by their names in the file: importing stages and messages takes
long.
"""

import json
import struct
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flowrec.core import ChipError, name_of, of_text, outside_facts, seconds, text_of_figure
from flowrec.verbs.command import verb
from flowrec.verbs.options import SessionFile

if TYPE_CHECKING:
    from flowrec.store import Column, Part, Session


_PNG_SIZE = struct.Struct(">II")  # width and height
_PNG_SIZE_AT = 16  # bytes, after the signature and the head of the first part
_STATED = ("seed", "world", "operator", "sample", "notes")  # in the provenance
_OF_SOURCE = ("source_", "times_", "coil_log_")  # of a movie; in the provenance
# Shown with another fact, or not at all.
_WITHIN_OTHERS = ("note", "parts", "commit", "local_changes", "chip_width_um", "chip_height_um", "chip_openings")
_NOT_SHOWN = ("wall_ns", "monotonic_ns")
_DRIVES = ("speed_um_s", "pressure_pa")  # of an opening
_STAGES = ("observer", "refine", "plan", "control")


class Facts(dict[str, Any]):
    """Facts about a session by name; numbers have their unit in the name, None means unknown.

    Attributes
    ----------
    path : of the session.
    topics : messages, by topic.
    columns : of each table, by its name, if they were asked for.
    """

    path: Path
    topics: dict[str, int]
    columns: "dict[str, tuple[Column, ...]]"

    def as_json(self) -> dict[str, Any]:
        tables = {name: [asdict(column) for column in columns] for name, columns in self.columns.items()}
        return {"session": str(self.path), "facts": self, "topics": self.topics} | (
            {"tables": tables} if tables else {}
        )

    def show(self) -> None:
        """Print the known facts and the topics as tables; or the columns of the tables, if these were asked for."""
        from flowrec.core import table

        for name, columns in self.columns.items():
            cells = [(column.name, column.unit, column.meaning) for column in columns]
            table(name, ("column", "unit", "meaning"), cells, text="meaning")
        if self.columns:
            return
        rows = facts_for_people(self)
        doubtful = [number for number, (name, _) in enumerate(rows) if name == "doubts"]
        table(self.path.name, ("", "value"), rows, amber=doubtful)
        table("Topics", ("topic", "messages"), [(name, str(count)) for name, count in self.topics.items()])


@verb("flowrec info a.mcap --json", "flowrec info a.mcap --tables", "flowrec info s3://lab/runs/a.mcap")
def info(
    session: SessionFile,
    tables: Annotated[
        bool, typer.Option("--tables", help="Explain the tables that session.table and export make: columns and units.")
    ] = False,
) -> Facts:
    """Show how a session ended, its length, content, settings and provenance.

    Returns
    -------
    Facts by name, with the unit in the name; None means unknown. No message is read but the keyframes of the parts.

    Raises
    ------
    SessionError : there is no session.
    """
    from flowrec.store import Session

    session = Session.of(session)
    path, run, header = session.path, session.run, session.header
    outcome, phases = run.outcome, session.setting("mission", "phases")
    provenance = header.provenance
    facts = {
        "outcome": outcome.get("outcome", "unknown"),
        "note": outcome.get("note") or outcome.get("reason", ""),  # the second is that of a failed run
        "duration_s": session.duration_s,
        "size_bytes": sum(file.size_bytes for file in run.files),
        "parts": len(run.files) if run.in_parts else None,
        **_chip(session),
        "rig": _name(session.setting("rig")),
        "phases": [str(phase) for phase in phases] if isinstance(phases, list) else [],
        **{stage: _name(session.setting(stage, "method")) for stage in _STAGES},
        "recorded": provenance.get("wall_time", "unknown"),
        "flowrec": provenance.get("flowrec", "?"),
        "commit": provenance.get("git_commit"),
        "local_changes": _local_changes(provenance),
        **of_text({key: provenance[key] for key in _STATED if key in provenance}),
        "derived": _derived_settings(provenance.get("derived", "{}")),
        **({"outside": packages} if (packages := outside_facts(provenance)) else {}),
        "piece": _piece(run.part, path) if run.part is not None else None,
        "replay_of": header.parent.get("file", "?") if header.parent else None,
        **of_text({key: text for key, text in provenance.items() if key.startswith(_OF_SOURCE)}),
    }
    for key, code in provenance.items():
        if key.startswith("weights."):
            facts["weights"] = f"{key.removeprefix('weights.')} {code[:16]}"
    if session.setting("recording", "region") == "robot" and "frames_windows" not in outcome:
        facts["frames_windows"] = "most images hold what the tracker read, and are black elsewhere"
    added = session.notes
    facts["notes_added"] = [note.text for note in added if note.text]
    facts["tags"] = list(dict.fromkeys(tag for note in added for tag in note.tags))
    recorded_figures = of_text(outcome)
    told = Facts(facts | {key: value for key, value in recorded_figures.items() if key not in (*facts, "reason")})
    told.path, told.topics, told.columns = path, session.topics, {}
    if tables:
        from flowrec.store import columns_of

        known = session.reader.topics
        named = {known.by_path[path].field: path for path in session.topics if path in known.by_path}
        told.columns = {f"{name} ({path})": columns_of(name, known) for name, path in named.items()}
    return told


def facts_for_people(facts: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The known facts of `info` as names and text."""
    width_um, height_um = facts.get("chip_width_um"), facts.get("chip_height_um")
    size = f", {width_um / 1000:.2f} x {height_um / 1000:.2f} mm" if width_um and height_um else ""
    changed = ", with local changes" if facts["local_changes"] else ""
    words = {
        "outcome": facts["outcome"] + _in_brackets(facts["note"]),
        "size_bytes": text_of_figure("size_bytes", facts["size_bytes"])
        + (f" in {facts['parts']} parts" if facts["parts"] else ""),
        "chip": f"none (open field){size}"
        if facts["chip_openings"] is None
        else f"{facts['chip']}{size}, {facts['chip_openings']} openings",
        "recorded": facts["recorded"][:19].replace("T", " "),
        "phases": " -> ".join(facts["phases"]) or "?",
        "observer": ", ".join(facts[stage] for stage in _STAGES),
        "derived": ", ".join(f"{key} = {value}" for key, value in facts["derived"].items()),
        "outside": "; ".join(
            f"{key} of {of['package']} {of['version']}, sha256 {of.get('sha256', '')[:16]}"
            for key, of in facts.get("outside", {}).items()
        ),
        "flowrec": facts["flowrec"] + _in_brackets((facts["commit"] or "")[:10] + changed),
    }
    words |= {"notes_added": "; ".join(facts["notes_added"]), "tags": ", ".join(facts["tags"])}
    words |= {key: str(code)[:16] for key, code in facts.items() if key.endswith("_sha256")}
    names = {"observer": "stages", "flowrec": "by flowrec", "outside": "other packages"}
    return [
        (names.get(key, name_of(key)), words.get(key) or text_of_figure(key, value))
        for key, value in facts.items()
        if key not in (*_WITHIN_OTHERS, *_NOT_SHOWN, *_STAGES[1:]) and value not in (None, "", {}, [])
    ]


def _piece(part: "Part", path: Path) -> str:
    from flowrec.store import run_path

    text = f"{part.kind} {part.number} of the run {run_path(path).stem}" + _in_brackets(part.why)
    return text if part.keyframe_ns is None else f"{text}, goes on from {seconds(part.keyframe_ns):.2f} s"


def _chip(session: "Session") -> dict[str, Any]:
    """Name, size and number of openings; the number is None if the chip is still, see Chip.is_still."""
    from flowrec.store import toml_table

    header = session.header
    table, png = toml_table(header.chip_toml, f"{session.path}: chip.toml inside"), header.chip_png
    facts: dict[str, Any] = {"chip": str(table.get("name", "?"))}
    scale_um = table.get("um_per_px")
    if isinstance(scale_um, float) and len(png) >= _PNG_SIZE_AT + _PNG_SIZE.size:
        width_px, height_px = _PNG_SIZE.unpack_from(png, _PNG_SIZE_AT)
        facts |= {"chip_width_um": width_px * scale_um, "chip_height_um": height_px * scale_um}
    openings = table.get("opening")
    if not isinstance(openings, list):
        return facts | {"chip_openings": 0}
    driven = any(isinstance(each, dict) and any(each.get(key) for key in _DRIVES) for each in openings)
    # The mask is looked at only where nothing drives a flow; it may be damaged.
    with suppress(ChipError):
        return facts | {"chip_openings": len(openings) if driven or not session.chip.is_still else None}
    return facts | {"chip_openings": len(openings)}


def _local_changes(provenance: Mapping[str, str]) -> bool | None:
    """True if the code differed from its commit; None if the commit is unknown. Older files state a difference only."""
    if "git_commit" not in provenance:
        return None
    return provenance.get("git_changed", str("git_diff" in provenance)) == "True"


def _derived_settings(text: str) -> dict[str, Any]:
    """Derived settings by key; none if the text is damaged."""
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def _name(setting: Any) -> str:
    return "?" if setting is None else str(setting)


def _in_brackets(text: str) -> str:
    return f" ({text})" if text else ""
