"""`flowrec doctor --protocol`: walks through the ten measurements of a lab's first day, and keeps what it found.

The folder has the sessions, and a line for each result in protocol.jsonl, so that an interrupted protocol goes on where
it was: what has passed with the same configuration stands. The results go as a note to the session of the mission. No
file is ever replaced.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from flowrec.core import FlowrecError, UsageError, append_line, say, table
from flowrec.stages import Config, ResolvedConfig, to_toml
from flowrec.store import Session
from flowrec.verbs.protocol_day import Day
from flowrec.verbs.protocol_hands import ProtocolHand
from flowrec.verbs.protocol_rows import ROWS, ProtocolRow

PASSED, FAILED, NOT_DONE = "pass", "fail", "not done"
RESULTS = "protocol.jsonl"
_TAG = "protocol"


class RowResult(NamedTuple):
    """Result of a row.

    Attributes
    ----------
    value, limit : in the unit of the row; None where it was not done.
    text : what was measured, or why it was not.
    session : name of the file that it was read from; '' without one.
    measured : when, UTC.
    """

    row: str
    result: str
    value: float | None = None
    limit: float | None = None
    text: str = ""
    session: str = ""
    measured: str = ""


class DayProtocol(NamedTuple):
    """The protocol as far as it has come."""

    results: tuple[RowResult, ...]  # of each row, in order
    session: Path | None  # of the mission, which has them as a note; None: there is none yet
    folder: Path  # of all its files

    @property
    def exit_status(self) -> int:
        """0 all passed, 1 something failed, 3 something is not done."""
        found = {each.result for each in self.results}
        return 1 if FAILED in found else 3 if NOT_DONE in found else 0

    def as_json(self) -> dict[str, Any]:
        """For JSON: each row with what to mount, the command, the limit and the result."""
        rows = []
        for row, result in self._rows():
            told = {name: getattr(row, name) for name in ("what", "unit", "mount", "command", "passes", "why")}
            value = {name: _plain(getattr(result, name)) for name in ("value", "limit")}
            rows.append(result._asdict() | value | told)
        return {"folder": str(self.folder), "session": str(self.session) if self.session else None, "rows": rows}

    def show(self) -> None:
        """Print the rows, what those need that are not done, and where the results are."""
        cells = [
            (each.row, _amount(each.value, row.unit), _amount(each.limit, row.unit), each.result, each.text)
            for row, each in self._rows()
        ]
        columns = ("", "value", "at most", "", "what was measured")
        table(f"Protocol in {self.folder}", columns, cells, text=columns[-1])
        for row, each in self._rows():
            if each.result == NOT_DONE:
                for line in (f"{row.name}: {row.mount}", row.command, f"passes: {row.passes}; {row.why}"):
                    say(line)
        if self.session is not None:
            say(f"the results are a note of {self.session}: flowrec note {self.session}")

    def as_note(self) -> str:
        """The results as text, a line each."""
        return "\n".join(_line(row, each) for row, each in self._rows())

    def _rows(self) -> list[tuple[ProtocolRow, RowResult]]:
        return list(zip(ROWS, self.results, strict=True))


def walk(
    asked: Config,
    file: Path | None,
    sets: Mapping[str, Any],
    folder: Path,
    hand: ProtocolHand,
    only: Iterable[str] = (),
) -> DayProtocol:
    """Measure what has not passed yet, in order.

    `only`: names of the rows that are measured, again if they have passed; (): all that have not. Raises UsageError:
    there is no such row. FlowrecError : the configuration describes no lab.
    """
    unknown = set(only) - {row.name for row in ROWS}
    if unknown:
        raise UsageError(f"--only {min(unknown)}: there are {', '.join(row.name for row in ROWS)}")
    folder.mkdir(parents=True, exist_ok=True)
    day = Day(asked, file, sets, folder, hand)
    kept, key = folder / RESULTS, _key(day.config)
    results = _read(kept, key)
    # A run is taken over only where nothing that was read of it has failed.
    failed = {each.session for each in results.values() if each.result != PASSED}
    for each in results.values():
        if each.result == PASSED and each.session not in failed and each.row not in only:
            day.sessions.setdefault(each.session.rpartition(".")[0].rstrip("_0123456789"), folder / each.session)
    day.sessions.pop("", None)
    news = False
    for row in ROWS:
        known = results.get(row.name)
        if (row.name not in only) if only else (known is not None and known.result == PASSED):
            continue
        found = _measure(row, day)
        results[row.name] = found
        say(_line(row, found))
        if found.measured:
            news = True
            append_line(kept, json.dumps({"configuration": key, **found._asdict()}).encode())
    every = tuple(results.get(row.name, RowResult(row.name, NOT_DONE, text="not measured yet")) for row in ROWS)
    mission = results.get("mission")
    session = folder / mission.session if mission is not None and mission.session else None
    done = DayProtocol(every, session, folder)
    if session is not None and news:
        Session(session).add_note(done.as_note(), [_TAG])
    return done


def _measure(row: ProtocolRow, day: Day) -> RowResult:
    """Measure a row; what stands against it is the text of one that is not done."""
    if not day.hand.ready(row.what, row.mount):
        return RowResult(row.name, NOT_DONE, text="nobody has mounted it: --answer mounted=yes, or a terminal")
    say(f"{row.name}: {row.what}")
    now = datetime.now(UTC).isoformat(timespec="seconds")
    try:
        found = row.measure(day)
    except FlowrecError as error:
        return RowResult(row.name, NOT_DONE, text=str(error), measured=now)
    result = PASSED if found.value <= found.limit else FAILED
    session = found.session.name if found.session is not None else ""
    return RowResult(row.name, result, found.value, found.limit, found.text, session, now)


def _key(config: ResolvedConfig) -> str:
    """Tells a configuration from others, wherever its devices are connected."""
    lab = replace(config.lab, device="", serial=replace(config.lab.serial, port=""))
    return hashlib.sha256(to_toml(replace(config, lab=lab)).encode()).hexdigest()[:16]


def _read(file: Path, key: str) -> dict[str, RowResult]:
    """The latest result of each row with this configuration; a line that was cut off is left out."""
    found: dict[str, RowResult] = {}
    for line in file.read_text(encoding="utf-8").splitlines() if file.exists() else ():
        try:
            values = json.loads(line)
        except ValueError:
            continue
        if isinstance(values, dict) and values.pop("configuration", None) == key:
            found[str(values["row"])] = RowResult(**values)
    return found


def _line(row: ProtocolRow, found: RowResult) -> str:
    amount = (
        "" if found.value is None else f"{_amount(found.value, row.unit)} (at most {_amount(found.limit, row.unit)}), "
    )
    return f"{found.row:10s} {found.result:8s} {amount}{found.text}"


def _amount(value: float | None, unit: str) -> str:
    return "" if value is None else f"{value:.3g} {unit}"


def _plain(value: float | None) -> float | None:
    return value if value is None or math.isfinite(value) else None
