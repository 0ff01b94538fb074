"""Commands of an operator to a run: one table for the keys of the terminal and the buttons of the console.

What comes from another process comes as words and numbers (`obey`), never as objects.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from flowrec.core import Action, FlowrecError
from flowrec.run.control import LONGEST_TEXT, RunControl

LONGEST_NOTE = LONGEST_TEXT
NOTE = "note"  # the command with a text
GOAL, SPEED, HAND, OUTPUT = "goal", "speed", "hand", "output"  # commands with numbers


@dataclass(frozen=True, slots=True)
class OperatorCommand:
    """A command without numbers."""

    name: str  # a word that identifies it
    key: str  # of the terminal and of the console's page
    words: str  # what the key does, in the terminal's line of keys and on the console's button
    meaning: str  # what it does to the robot and the run
    # takes the control, a text (only a note has one) and how the command was given: a key, or `console`. False, and
    # nothing is done, while too many events wait; None of a command that need not wait.
    give: Callable[[RunControl, str, str], bool | None]


def _note(control: RunControl, text: str, _by: str) -> bool:
    return not text.strip() or control.request(Action.NOTE, text.strip())


COMMANDS = {
    row.name: row
    for row in (
        OperatorCommand(
            "stop",
            "q",
            "stop",
            "The field ramps down, then the run ends.",
            lambda control, _text, by: control.stop(f"stopped by the operator ({by})"),
        ),
        OperatorCommand(
            "mark",
            "m",
            "mark",
            "A numbered mark at this moment of the recording.",
            lambda control, _text, _by: control.mark(),
        ),
        OperatorCommand(NOTE, "n", "note", "A text at this moment of the recording.", _note),
        OperatorCommand(
            "hold",
            " ",
            "hold, go on",
            "The robot is held in its place, or goes on.",
            lambda control, _text, _by: control.toggle_hold(),
        ),
        OperatorCommand(
            "end",
            "e",
            "end observing",
            "The observation ends; its refinement begins.",
            lambda control, _text, by: control.request(Action.END, f"ended by the operator ({by})"),
        ),
        OperatorCommand(
            "zero",
            "!",
            "zero field at once",
            "The field is off on the next tick; the run ends.",
            lambda control, _text, by: control.stop(f"operator: zero field ({by})", zero=True),
        ),
    )
}
BY_KEY = {row.key: row for row in COMMANDS.values()}
HELP = "keys: " + "   ".join(f"{'space' if row.key == ' ' else row.key} {row.words}" for row in COMMANDS.values())


def obey(control: RunControl, words: dict[str, Any]) -> str:
    """Give a command of the console to the run; why it does not take it, '' where it does.

    `words`: `command`, and `x_um` and `y_um` of a goal, `limit_um_s` of a speed (None: no limit), `name` and `value` of
    an output, of a hand what `_steer` takes, else `text`.
    """
    try:
        name = words["command"]
        if name in (GOAL, SPEED, HAND, OUTPUT) and control.reason:
            return f"the run ends: {control.reason}"
        taken: bool | None = True
        if name == GOAL:
            control.set_goal(float(words["x_um"]), float(words["y_um"]))
        elif name == HAND:
            return _steer(control, words)
        elif name == OUTPUT:
            control.set_output(str(words["name"]), float(words["value"]))
        elif name == SPEED:
            limit = words["limit_um_s"]
            control.limit_speed(None if limit is None else float(limit))
        else:
            taken = COMMANDS[name].give(control, str(words["text"]), "console")
    except FlowrecError as error:  # a place or speed that no run could have
        return str(error)
    except (KeyError, TypeError, ValueError) as error:
        return f"not understood: {error!r}"
    return "too many commands wait for their tick; give it again" if taken is False else ""


def _steer(control: RunControl, words: dict[str, Any]) -> str:
    """Take a sample of a hand: `page`, `press`, `x`, `y` and `by`; or where it is not `held`, `page` and `why`."""
    page = str(words["page"])
    if not words["held"]:
        control.hand.let_go(page, str(words["why"]))
        return ""
    return control.hand.steer(page, int(words["press"]), float(words["x"]), float(words["y"]), str(words["by"]))
