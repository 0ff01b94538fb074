"""Reading a configuration file, apart from what it means: without a heavy import, a wrong one is refused at once."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from flowrec.errors import UsageError

_NOT_TOML = {
    ".yaml": "YAML",
    ".yml": "YAML",
    ".json": "JSON",
    ".mcap": "a session",
    ".png": "the mask of a chip (--set chip.path=...)",
    ".npz": "a vessel case (--set chip.path=...)",
}


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a configuration.

    Raises
    ------
    UsageError : there is no such file, it can not be read, or is no TOML.
    """
    begin = "flowrec record --dry-run > my.toml writes one to begin with"
    kind = _NOT_TOML.get(path.suffix.lower())
    if kind is not None:
        raise UsageError(f"{path}: is {kind} by its name, and a configuration is a TOML file; {begin}")
    try:
        tree = tomllib.loads(path.read_text(encoding="utf-8-sig"))  # with or without a byte-order mark
    except FileNotFoundError as error:
        raise UsageError(f"{path}: no such configuration; {begin}") from error
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"{path}: can not be read as a TOML configuration ({error})") from error
    except (ValueError, RecursionError) as error:
        raise UsageError(f"{path}: not valid TOML ({error}); mend that line") from error
    return tree
