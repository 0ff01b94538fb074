"""The result of `flowrec check`: facts, findings, figures, and the judgement, which follows from the findings."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any, Literal

from flowrec.core import Coverage, Figures, printable

_JUDGEMENTS = {
    "good": (0, "GOOD: {integrity}; can be replayed"),
    "usable": (3, "USABLE: {integrity}; can be replayed, but something was lost or is odd"),
    "bad": (1, "NOT USABLE as it is ({integrity})"),
}
# Never more than this is said: whoever can edit the file can edit its digest.
CONSISTENT = "consistent, unsigned"
NO_DIGEST = "no digest to be consistent with"
DAMAGED = "damaged or edited"
UNFINISHED = "not finished"
_MARKS = {"bad": "!!", "odd": "! "}


class Severity(StrEnum):
    """Severity of a finding."""

    BAD = "bad"  # the session can not be used as it is
    ODD = "odd"  # something was lost or is unusual; the session can be used


@dataclass(frozen=True, slots=True)
class Gap:
    """A time without a frame."""

    at_s: float  # of its beginning, since the first tick
    length_s: float


@dataclass(frozen=True, slots=True)
class CheckFinding:
    """Something wrong or unusual."""

    level: Severity
    about: str
    text: str


@dataclass(slots=True)
class Verdict:
    """Report of `flowrec check`.

    Attributes
    ----------
    path : the file.
    findings : what is wrong or unusual.
    facts : what was examined, as text by name.
    figures : the same in numbers, with the unit in the key.
    topics : messages read, by topic.
    gaps : the longest times without a frame, in order of time; `gap_count` is the number of all.
    parts : the verdicts on the parts of a run that was split.
    covered : how much of the file was read.
    integrity : whether it agrees with itself: one of the words above.
    """

    path: Path
    covered: Coverage
    findings: list[CheckFinding] = field(default_factory=list)
    facts: dict[str, str] = field(default_factory=dict)
    figures: Figures = field(default_factory=dict)
    topics: dict[str, int] = field(default_factory=dict)
    gaps: list[Gap] = field(default_factory=list)
    gap_count: int = 0
    parts: list[Verdict] = field(default_factory=list)
    integrity: str = CONSISTENT

    @property
    def word(self) -> Literal["good", "usable", "bad", "stopped"]:
        """The judgement; none where the file was not read to its end."""
        if self.covered.stopped:
            return "stopped"
        levels = {finding.level for finding in self.findings}
        return "bad" if Severity.BAD in levels else "usable" if levels else "good"

    @property
    def exit_status(self) -> int:
        """0 good, 3 usable but something was lost or is odd, 1 not to be replayed, 130 or 143 stopped."""
        return self.covered.status if self.covered.stopped else _JUDGEMENTS[self.word][0]

    @property
    def judgement(self) -> str:
        """The judgement in a line."""
        if self.covered.stopped:
            found = "with what is below" if self.findings else "without a fault"
            return self.covered.sentence(found)
        return _JUDGEMENTS[self.word][1].format(integrity=self.integrity)

    def odd(self, about: str, text: str) -> None:
        """Add a finding: something was lost or is unusual."""
        self.findings.append(CheckFinding(Severity.ODD, about, printable(text)))

    def bad(self, about: str, text: str) -> None:
        """Add a finding: the session can not be replayed as it is."""
        self.findings.append(CheckFinding(Severity.BAD, about, printable(text)))

    def fact(self, about: str, text: str) -> None:
        """Add a fact."""
        self.facts[about] = printable(text)

    def lines(self) -> list[str]:
        """The verdict as lines of text, the judgement first."""
        lines = [printable(f"{self.path.name}: {self.judgement}")]
        ordered = sorted(self.findings, key=lambda finding: list(_MARKS).index(finding.level))
        lines += [f"  {_MARKS[finding.level]} {finding.text}" for finding in ordered]
        width = max(map(len, self.facts), default=0)
        return [*lines, *(f"  {name:{width}s}  {text}" for name, text in self.facts.items())]

    def as_json(self) -> dict[str, Any]:
        """The whole verdict for JSON."""
        content = asdict(self)
        del content["path"]
        head = {"session": str(self.path), "verdict": self.word, "exit_status": self.exit_status}
        parts = [part.as_json() for part in self.parts]
        return head | content | {"parts": parts, "covered": self.covered.as_json()}
