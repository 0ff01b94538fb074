"""What the fields of messages mean: the comments beside their declarations, which are the only place that tells it."""

from __future__ import annotations

import ast
import functools
import inspect
import io
import sys
import textwrap
import tokenize


@functools.cache
def meanings(message_type: type) -> dict[str, str]:
    """The meaning of each field of a message type, by name.

    It is the comment in the lines above the field, followed by the one behind it; a field without either has the
    first sentence of its type's docstring.
    """
    whole = summary_of(message_type)
    try:
        source = textwrap.dedent(inspect.getsource(message_type))
    except OSError:  # installed without sources
        return {}
    comments = {
        token.start[0]: token.string.lstrip("# ").rstrip()
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT
    }
    (declared,) = ast.parse(source).body
    assert isinstance(declared, ast.ClassDef)
    found = {}
    for statement in declared.body:
        if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
            above = statement.lineno
            while above - 1 in comments and source.splitlines()[above - 2].lstrip().startswith("#"):
                above -= 1
            own = range(statement.lineno, (statement.end_lineno or statement.lineno) + 1)
            lines = [comments[line] for line in (*range(above, statement.lineno), *own) if line in comments]
            found[statement.target.id] = sys.intern(" ".join(lines)) or whole
    return found


def summary_of(message_type: type) -> str:
    """The first sentence of the docstring of a message type."""
    text = " ".join((message_type.__doc__ or "").split("\n\n")[0].split())
    return text.split(". ")[0].rstrip(".")
