"""How a Python process of ours is started: same interpreter, same flowrec, nothing of the user's folder on its path."""

from __future__ import annotations

import os
import sys
from pathlib import Path


def command(module: str, *words: str) -> list[str]:
    """What runs a module of ours as a program."""
    return [sys.executable, "-P", "-m", module, *words]


def environment() -> dict[str, str]:
    """Its environment: it finds modules where this process does, except in the working directory.

    There a file of the user, as filterpy.py, would shadow a library. Where flowrec itself is imported from the working
    directory (a checkout), that stays.
    """
    home = str(Path(__file__).resolve().parents[2])
    here = Path.cwd()
    kept = [place for place in sys.path if place and (place == home or Path(place).resolve() != here)]
    return os.environ | {"PYTHONPATH": os.pathsep.join(kept if home in kept else [home, *kept])}
