"""Statements of older files in other words than today's, which are turned into these when a file is opened.

The rest of what is older stands where today's is declared: settings that moved in stages/config.py; a field of a
message, a setting or a fact of the head that came later has a default there, which means "as before".
"""

from __future__ import annotations

import re
from collections.abc import Mapping

FORMER_RECORDS = frozenset({"flowrec.view"})  # metadata records that are not written any more
_REPEATED = ("duration", "frames_dropped")  # sentence on the times of the ticks; a second count of dropped images
_FLOW_ERROR = re.compile(r"(\d{1,6}\.\d) % of the true flow \((\w{1,20})\)")


def outcome_of_today(recorded: Mapping[str, str]) -> dict[str, str]:
    """The outcome of a file with the keys and values of today's; other sentences of the first release stay text.

    The first release counted dropped images under two names, of which the larger count is complete.
    """
    found = {key: text for key, text in recorded.items() if key not in _REPEATED}
    counts = [recorded[key] for key in ("dropped_frames", "frames_dropped") if key in recorded]
    if "frames_dropped" in recorded and all(text.isdecimal() and len(text) < 20 for text in counts):
        found["dropped_frames"] = str(max(map(int, counts)))
    for name in ("assumed", "refined"):
        stated = _FLOW_ERROR.fullmatch(found.get(f"{name}_flow_error", ""))
        if stated is not None:
            found |= {f"{name}_flow_error": repr(float(stated[1]) / 100), f"{name}_method": stated[2]}
    return found
