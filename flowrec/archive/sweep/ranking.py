"""Ranking of settings: means over the same sessions, and paired differences with their intervals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flowrec.archive.sweep.replay_process import Row
from flowrec.core import UsageError, name_of, text_of_figure

# The figures by which settings are ranked, in order of preference; the smallest is the best.
RANKED_BY = ("refined_flow_error", "residual_um_s", "travel_time_on_replayed_map_s")
RECORDED, ASSUMED = "as recorded", "assumed flow (null model)"
INTERVAL = "Student's t over sessions, 95 % each; not corrected for the number of settings"


@dataclass(frozen=True, slots=True)
class Ranked:
    """Settings, or a reference that every session has."""

    settings: str  # as text
    mean: float | None  # of the figure over the common sessions; None without any
    # mean of its difference from the first of the ranking, paired by session; None for the first itself
    difference: float | None
    interval: tuple[float, float] | None  # of the difference, 95 %; None for fewer than two sessions
    values: tuple[float, ...]  # of the common sessions, in the same order for every setting
    failed: int = 0  # tasks that ended with an error
    cpu_s: float | None = None  # mean of a task; None of a reference

    def as_json(self) -> dict[str, Any]:
        """All of it but the values."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__ if name != "values"}


@dataclass(frozen=True, slots=True)
class Ranking:
    """The settings of a sweep, the best first."""

    figure: str  # by which they are ranked; '' where no task has one
    sessions: int  # the number of sessions with that figure in every setting: the common sessions
    of_sessions: int  # the number of all sessions
    rows: tuple[Ranked, ...]

    @classmethod
    def of(cls, rows: Sequence[Row], figure: str | None = None) -> Ranking:
        """Rank the settings of some rows.

        Of a session that was replayed by several versions with the same settings, the last row counts. A setting that
        has the figure in no session is last and does not narrow the common sessions. `figure`: by which they are
        ranked; None: the first of RANKED_BY that a row has. Raises UsageError: no row has that figure as a number.
        """
        by_settings: dict[str, dict[str, Row]] = {}
        for row in rows:
            by_settings.setdefault(settings_text(row), {})[row["content"]] = row
        contents = {row["content"] for row in rows}
        figure = figure if figure is not None else _first_figure(rows)
        values = {
            text: {content: each for content, row in own.items() if (each := _number(row, figure, 1)) is not None}
            for text, own in by_settings.items()
        }
        if figure and not any(values.values()):
            named = sorted({name for row in rows for name in row.get("figures") or {}})
            raise UsageError(f"--by {figure}: no replay states it as a number; known are {', '.join(named)}")
        common = sorted(set.intersection(*(set(own) for own in values.values() if own))) if figure else []
        found = [(text, [own[content] for content in common] if own else []) for text, own in values.items()]
        found += _references(by_settings, figure, common).items()
        found.sort(key=lambda each: np.mean(each[1]) if each[1] else math.inf)
        best = found[0][1] if found else []
        ranked = []
        for number, (text, own_values) in enumerate(found):
            own = by_settings.get(text, {}).values()
            cpu_s = [row["cpu_s"] for row in own if row.get("cpu_s") is not None and not row.get("error")]
            mean = float(np.mean(own_values)) if own_values else None
            difference, interval = _paired_difference(own_values, best) if number and own_values else (None, None)
            failed = sum(bool(row.get("error")) for row in own)
            mean_cpu_s = float(np.mean(cpu_s)) if cpu_s else None
            ranked.append(Ranked(text, mean, difference, interval, tuple(own_values), failed, mean_cpu_s))
        return cls(figure, len(common), len(contents), tuple(ranked))

    def cells(self) -> tuple[list[str], list[list[str]]]:
        """Names of the columns and the rows, as text for people."""
        columns = ["settings", name_of(self.figure) or "figure", "more than the first", "95 %", "failed", "CPU"]
        return columns, [
            [
                each.settings,
                text_of_figure(self.figure, each.mean),
                text_of_figure(self.figure, each.difference),
                " to ".join(text_of_figure(self.figure, end) for end in each.interval)
                if each.interval is not None
                else "-",
                str(each.failed or "-"),
                text_of_figure("cpu_s", each.cpu_s),
            ]
            for each in self.rows
        ]

    @property
    def note(self) -> str:
        """One sentence on the content of the table."""
        if not self.figure:
            return "No task has a figure to rank by."
        return (
            f"Means of the {name_of(self.figure)} over the {self.sessions} of {self.of_sessions} sessions that have it "
            f"in every setting; differences paired by session; intervals: {INTERVAL}."
        )

    def as_json(self) -> dict[str, Any]:
        return {
            "figure": self.figure,
            "sessions": self.sessions,
            "of_sessions": self.of_sessions,
            "interval": INTERVAL,
            "settings": [each.as_json() for each in self.rows],
        }


def settings_text(row: Row) -> str:
    """The settings of a replay in a line."""
    settings = ", ".join(f"{key}={value}" for key, value in row["settings"].items())
    return settings + (" (reflown)" if row.get("refly") else "") or "none"


def _first_figure(rows: Sequence[Row]) -> str:
    return next((name for name in RANKED_BY if any(_number(row, name, 1) is not None for row in rows)), "")


def _number(row: Row, figure: str, side: int) -> float | None:
    """A recorded (0) or replayed (1) figure, if it is a number."""
    value = (row.get("figures") or {}).get(figure, (None, None))[side]
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def _references(by_settings: dict[str, dict[str, Row]], figure: str, common: Sequence[str]) -> dict[str, list[float]]:
    """Values of a figure that the recorded sessions state, where all of the common ones do.

    The recorded figure may depend on the replay (the residual is on its observations): it is that of the first setting.
    """
    own = next((rows for rows in by_settings.values() if all(content in rows for content in common)), {})
    asked = {RECORDED: figure, ASSUMED: "assumed_flow_error" if figure == "refined_flow_error" else ""}
    found = {}
    for text, name in asked.items():
        values = [value for each in common if name and (value := _number(own[each], name, 0)) is not None]
        if values and len(values) == len(common):
            found[text] = values
    return found


def _paired_difference(values: Sequence[float], best: Sequence[float]) -> tuple[float, tuple[float, float] | None]:
    """Mean difference and its 95 % interval."""
    from scipy.special import stdtrit

    differences = np.subtract(values, best)
    mean, count = float(differences.mean()), len(differences)
    if count < 2:
        return mean, None
    half = float(stdtrit(count - 1, 0.975) * differences.std(ddof=1) / math.sqrt(count))
    return mean, (mean - half, mean + half)
