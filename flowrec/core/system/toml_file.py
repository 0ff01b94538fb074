"""Read a TOML file within bounded memory and time, without heavy imports, so that a wrong file is refused at once."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from flowrec.core.errors import UsageError
from flowrec.core.system.outputs import MOVIE_FILES
from flowrec.core.system.regular_file import refuse_irregular

_NOT_TOML = {
    ".yaml": "YAML",
    ".yml": "YAML",
    ".json": "JSON",
    ".mcap": "a session",
    ".png": "the mask of a chip (--set chip.path=...)",
    ".npz": "a vessel case (--set chip.path=...)",
    **dict.fromkeys((".csv", ".xlsx"), "a table (--coils takes the log of the coils)"),
    **dict.fromkeys(MOVIE_FILES, "a movie (flowrec init, flowrec import)"),
}


# Ours have 10 kB. Each dot may open a table of a kilobyte, and a key with many costs the square of them in time.
_LIMIT_CHARACTERS, _LIMIT_DOTS, _LIMIT_DOTS_IN_A_ROW = 1 << 19, 20_000, 2_000
_INTEGERS = 1 << 64  # one bit more than those of TOML, whose range a setting's own message tells


def parse_toml(text: str) -> dict[str, Any]:
    """The tables of a TOML text, whoever wrote it, within bounded memory and time.

    Raises
    ------
    ValueError, RecursionError : it is no TOML, or none that flowrec has a use for.
    """
    if len(text) > _LIMIT_CHARACTERS:
        raise ValueError(f"{len(text)} characters, more than {_LIMIT_CHARACTERS}")
    if text.count(".") > _LIMIT_DOTS:
        raise ValueError(f"{text.count('.')} dots, more than {_LIMIT_DOTS}")
    if any(line.count(".") > _LIMIT_DOTS_IN_A_ROW for line in text.splitlines()):
        raise ValueError(f"a line with more than {_LIMIT_DOTS_IN_A_ROW} dots")
    tree = tomllib.loads(text)
    _refuse_long(tree)
    return tree


def _refuse_long(value: Any) -> None:
    """Raise ValueError for a whole number beyond the 64 bits of TOML: Python reads it, and computes with no float."""
    if isinstance(value, (dict, list)):
        for inner in value.values() if isinstance(value, dict) else value:
            _refuse_long(inner)
    elif isinstance(value, int) and not -_INTEGERS <= value < _INTEGERS:
        raise ValueError(f"a whole number of {value.bit_length()} bits; TOML has 64")


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a configuration. Raises UsageError: there is no such file, it can not be read, or is no TOML."""
    begin = "flowrec record --dry-run > my.toml writes one to begin with"
    kind = _NOT_TOML.get(path.suffix.lower())
    if kind is not None:
        raise UsageError(f"{path}: is {kind} by its name, and a configuration is a TOML file; {begin}")
    refuse_irregular(path)
    try:
        if path.stat().st_size > 4 * _LIMIT_CHARACTERS:
            raise ValueError(f"{path.stat().st_size} bytes, more than {4 * _LIMIT_CHARACTERS}")
        tree = parse_toml(path.read_text(encoding="utf-8-sig"))  # with or without a byte-order mark
    except FileNotFoundError as error:
        raise UsageError(f"{path}: no such configuration; {begin}") from error
    except OSError as error:
        raise UsageError(f"{path}: can not be read as a TOML configuration ({error.strerror or error})") from error
    except UnicodeDecodeError as error:
        raise UsageError(f"{path}: is no text in UTF-8 (byte {error.start}); save it so, or name a TOML") from error
    except tomllib.TOMLDecodeError as error:
        raise UsageError(f"{path}: not valid TOML ({error}); mend that line") from error
    except (ValueError, RecursionError) as error:
        raise UsageError(f"{path}: is no TOML that flowrec has a use for ({error}); {begin}") from error
    return tree
