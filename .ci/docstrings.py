"""Docstrings of the house for mkdocstrings: `name : meaning` becomes numpydoc's name and its indented meaning."""

import re

import griffe

_HEADS = ("Parameters", "Attributes", "Raises", "Returns")
_ITEM = re.compile(r"^(\*{0,2}[\w, .*]+?) : (.+)$")


def of_numpydoc(text: str) -> str:
    """The docstring as numpydoc writes it, where the second part of an item is its type."""
    lines, inside, result = text.splitlines(), False, []
    for number, line in enumerate(lines):
        if line.strip() in _HEADS and number + 1 < len(lines) and set(lines[number + 1].strip()) == {"-"}:
            inside = True
        found = _ITEM.match(line) if inside else None
        result += [found[1], f"    {found[2]}"] if found else [line]
    return "\n".join(result)


class HouseDocstrings(griffe.Extension):
    """Rewrites each docstring before it is parsed."""

    def on_object(self, *, obj: griffe.Object, **_kwargs: object) -> None:
        """Every module, class, function and attribute as it is loaded."""
        if obj.docstring is not None:
            obj.docstring.value = of_numpydoc(obj.docstring.value)
