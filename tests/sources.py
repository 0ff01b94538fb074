"""The package's sources as syntax trees, which several tests read: parsed once a process."""

import ast
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "flowrec"  # not where it is installed: a wheel leaves some of them out


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))
