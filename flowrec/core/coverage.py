"""Coverage of a judgement: the part of all data that was looked at, and the reason if it ended early.

Whatever judges states it: verify, check, compare, refine, import, calibrate, export, sweep, bench. Nothing that was not
looked at is called the same, whole or good.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

_MEGABYTE = 1e6  # bytes
_SIGINT_STATUS = 130  # 128 + the number of SIGINT, as shells count it


@dataclass(frozen=True, slots=True)
class Coverage:
    """Part of all data that was looked at.

    Attributes
    ----------
    done, total : amounts in `unit`; `total` is what was asked for.
    unit : a noun in the plural, or "bytes" or "s".
    part : which part of the whole was asked for, as "from 4.2 s on"; '' for all of it.
    topics, head : topics and parts of the head that were looked at, where they are known by name.
    left_out : what was not looked at, each with the reason.
    stopped : what ended it early, as "SIGINT: Ctrl-C"; '' if nothing did.
    status : exit status of a program that was stopped by that.
    """

    done: float
    total: float
    unit: str = "ticks"
    part: str = ""
    topics: tuple[str, ...] = ()
    head: tuple[str, ...] = ()
    left_out: Mapping[str, str] = field(default_factory=dict)
    stopped: str = ""
    status: int = _SIGINT_STATUS

    @property
    def whole(self) -> bool:
        """True if all data was looked at. What `left_out` names does not count: it was absent, or was not asked for."""
        return not self.stopped and not self.part and self.done >= self.total

    @property
    def amount(self) -> str:
        """As "47 of 1934 ticks"."""
        if self.unit == "bytes":
            amount = f"{self.done / _MEGABYTE:.1f} of {self.total / _MEGABYTE:.1f} MB"
        elif self.unit == "s":
            amount = f"{self.done:.1f} of {self.total:.1f} s"
        else:
            amount = f"{self.done:g} of {self.total:g} {self.unit}"
        return f"{amount} {self.part}".rstrip()

    @property
    def text(self) -> str:
        """The amount, and the reason if it ended early: "stopped after 47 of 1934 ticks (SIGINT: Ctrl-C)"."""
        return f"stopped after {self.amount} ({self.stopped})" if self.stopped else self.amount

    def sentence(self, found: str) -> str:
        """The amount with the result, stated of the part that was looked at alone: "1934 of 1934 ticks: identical".

        `found`: true of what was looked at, such as "identical".
        """
        if not self.stopped:
            return f"{self.amount}: {found}"
        return f"{self.text}; {f'those are {found}' if self.done else 'nothing was looked at'}"

    def as_json(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "done": self.done,
            "total": self.total,
            "unit": self.unit,
            "part": self.part,
            "whole": self.whole,
            "topics": list(self.topics),
            "head": list(self.head),
            "left_out": dict(self.left_out),
            "stopped": self.stopped,
        }
