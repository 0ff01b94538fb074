"""Hands of `flowrec doctor --protocol`, which mount, read instruments and pull cables: of a person, answers, a twin."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from flowrec.core import UsageError, say

if TYPE_CHECKING:
    from flowrec.rigs import EmulatedInstruments

MOUNTED = "mounted"  # the answer by which nobody is asked


class ProtocolHand(Protocol):
    """Hands and eyes, which a program does not have; `sees_zero`: somebody looks at an ammeter."""

    sees_zero: bool

    def ready(self, what: str, mount: str) -> bool:
        """Have it mounted; False: the row is left out."""

    def read(self, key: str, question: str) -> str:
        """The answer to a question; '': there is none."""

    def number(self, key: str) -> float | None:
        """A number that was answered before; None: it is to be measured."""

    def zero_after_s(self, way: str, since_ns: int, within_s: float) -> float:
        """Time from a moment on the monotonic clock until the coils have no current; inf: they still have one."""

    def pull_cable(self, *, pulled: bool) -> None:
        """Pull the cable of the camera, or plug it in again."""


class Answers:
    """Nobody but answers that were given with the command; without `mounted=yes` nothing is run."""

    sees_zero = False

    def __init__(self, given: Iterable[str]) -> None:
        self._given = {}
        for text in given:
            key, equals, value = text.partition("=")
            if not equals:
                raise UsageError(f"--answer {text!r}: expected key=value, as in --answer mounted=yes")
            self._given[key.strip()] = value.strip()

    def ready(self, what: str, mount: str) -> bool:
        return self._given.get(MOUNTED) == "yes"

    def read(self, key: str, question: str) -> str:
        return self._given.get(key, "")

    def number(self, key: str) -> float | None:
        text = self._given.get(key)
        try:
            return None if text is None else float(text)
        except ValueError:
            raise UsageError(f"--answer {key}={text}: a time in s is wanted") from None

    def zero_after_s(self, way: str, since_ns: int, within_s: float) -> float:
        raise UsageError("nobody looks at an ammeter")

    def pull_cable(self, *, pulled: bool) -> None:
        raise UsageError("nobody can pull a cable")


class Person(Answers):
    """A person at the terminal, with the answers that were given before."""

    sees_zero = True

    def ready(self, what: str, mount: str) -> bool:
        say(f"{what}: {mount}")
        return super().ready(what, mount) or _ask("Enter when it is ready, s to leave it out: ") != "s"

    def read(self, key: str, question: str) -> str:
        return super().read(key, question) or _ask(f"{question}: ")

    def zero_after_s(self, way: str, since_ns: int, within_s: float) -> float:
        text = _ask(f"{way}: after how many seconds did the ammeter read zero? (never: inf) ")
        try:
            return float(text)
        except ValueError:
            raise UsageError(f"{text!r} is no number of seconds") from None

    def pull_cable(self, *, pulled: bool) -> None:
        _ask(f"{'Pull the cable of the camera' if pulled else 'Plug the camera in again'}, then Enter: ")


class EmulatedHand(Answers):
    """The instruments of an emulated lab: nothing has to be mounted."""

    sees_zero = True

    def __init__(self, instruments: EmulatedInstruments, folder: Path) -> None:
        super().__init__([f"{MOUNTED}=yes"])
        self._instruments, self._folder = instruments, folder

    def read(self, key: str, question: str) -> str:
        table = free_path(self._folder, "field", ".csv")
        self._instruments.field_table(table)
        return str(table)

    def zero_after_s(self, way: str, since_ns: int, within_s: float) -> float:
        return self._instruments.zero_after_s(since_ns, within_s)

    def pull_cable(self, *, pulled: bool) -> None:
        self._instruments.pull_cable(pulled=pulled)


def hand_of(answers: Iterable[str], *, asks: bool) -> ProtocolHand:
    """A person, if somebody sits at the terminal and may be asked, or the answers alone."""
    return Person(answers) if asks and sys.stdin.isatty() and sys.stderr.isatty() else Answers(answers)


def free_path(folder: Path, name: str, suffix: str) -> Path:
    """The name, or the name with a number: a path that neither a file nor the unfinished file of a session has."""
    numbered = (folder / f"{name}{f'_{number:03d}' if number > 1 else ''}{suffix}" for number in range(1, 10_000))
    return next(path for path in numbered if not path.exists() and not path.with_name(path.name + ".partial").exists())


def _ask(question: str) -> str:
    """The answer of a person; UsageError if the terminal is closed (Ctrl-D)."""
    sys.stderr.write(question)
    sys.stderr.flush()
    line = sys.stdin.readline()
    if not line:
        raise UsageError("the terminal is closed: nobody has answered")
    return line.strip()
