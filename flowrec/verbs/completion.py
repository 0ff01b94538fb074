"""Completion of settings in a shell: their names, choices and defaults.

To import them takes a second, so they are kept in a file of the user's caches until flowrec or a package changes.
"""

import contextlib
import json
import os
import sysconfig
from pathlib import Path

_STAGES = Path(__file__).parents[1] / "stages"
_BASH = "_FLOWREC_COMPLETE"  # typer's variable; its value names the shell
_key = ""  # that is stated before the word to complete: bash takes KEY, = and VALUE for words of their own


def complete_setting(incomplete: str) -> list[str]:
    """Completions of KEY=VALUE: the keys that begin so, or the values of the only one."""
    found = _values_by_key()
    if _key:
        return [each for each in found.get(_key, ()) if each.startswith(incomplete)]
    key, equals, value = incomplete.partition("=")
    keys = [name for name in found if name == key or (not equals and name.startswith(key))]
    if len(keys) != 1:
        return keys
    return [f"{keys[0]}={each}" for each in found.get(keys[0]) or [value] if each.startswith(value)]


def complete_section(incomplete: str) -> list[str]:
    """Completions of a section or a key."""
    keys = list(_values_by_key())
    sections = (key[:end] for key in keys for end in (key.find("."), key.rfind(".")) if end > 0)
    return [name for name in dict.fromkeys((*sections, *keys)) if name.startswith(incomplete)]


def leave_out_key() -> None:
    """Complete VALUE alone of KEY = VALUE, which are three words for bash; other words and shells stay as they are."""
    global _key  # noqa: PLW0603 - of this process, which completes once
    if os.environ.get(_BASH) != "complete_bash":
        return
    words, at = os.environ.get("COMP_WORDS", "").split(), int(os.environ.get("COMP_CWORD", "0"))
    equals = next((place for place in (at, at - 1) if 0 < place < len(words) and words[place] == "="), None)
    if equals is not None:
        _key = words[equals - 1]
        words[equals - 1 :] = words[equals + 1 : at + 1]
        os.environ |= {"COMP_WORDS": " ".join(words), "COMP_CWORD": str(equals - 1)}


def _values_by_key() -> dict[str, list[str]]:
    """Settings with the values to offer: choices, or the default if it is one word."""
    place = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    file = Path(place, "flowrec", "settings.json")
    changed = [path.stat().st_mtime_ns for path in (*_STAGES.rglob("*.py"), Path(sysconfig.get_path("purelib")))]
    state = f"{_STAGES} {len(changed)} {max(changed)}"
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        kept = json.loads(file.read_text(encoding="utf-8"))
        if kept["state"] == state:
            return dict(kept["settings"])
    from flowrec.stages import setting_rows

    found = {row.key: _values(row.valid, row.default) for row in setting_rows()}
    with contextlib.suppress(OSError):  # without a cache the next completion takes as long as this one
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps({"state": state, "settings": found}), encoding="utf-8")
    return found


def _values(valid: str, default: object) -> list[str]:
    """Values to offer for a setting."""
    if isinstance(default, bool):
        return ["true", "false"]
    if valid.startswith("one of "):
        return [] if "packages" in valid else valid.removeprefix("one of ").split(", ")
    text = str(default)
    return [text] if isinstance(default, str | int | float) and text and " " not in text else []
