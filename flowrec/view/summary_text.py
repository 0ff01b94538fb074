"""The text panel of the viewer: what the session wanted and how it ended, as Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import rerun as rr

from flowrec.chip.registration import on_chip
from flowrec.errors import printable
from flowrec.messages import FlowField
from flowrec.summary import Row, comparison_for_people

_MARKDOWN = str.maketrans({character: f"\\{character}" for character in "\\`*_{}[]()<>#+!|~"})
_LETTERS = 200  # of one cell: names and notes come from the file


def summary_document(columns: Sequence[str], rows: Iterable[Row], remarks: Iterable[str]) -> rr.TextDocument:
    """A table with one or two columns of values, then the remarks as paragraphs.

    Rows are key and values, as flowrec.summary reads them; of one column the second value is not shown.
    """
    cells = [[name, *values[: len(columns)]] for name, *values in comparison_for_people(rows)]
    lines = [[_cell(each) for each in row] for row in (["", *columns], *cells)]
    lines.insert(1, ["---"] + ["---:"] * len(columns))
    table = "\n".join("| " + " | ".join(line) + " |" for line in lines)
    text = "\n\n".join([table, *map(_cell, remarks)])
    return rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)


def registration_remark(refined: FlowField | None) -> str:
    """That the picture is moved, and by how much; '' without a registration."""
    if refined is None or refined.registration is None:
        return ""
    height, width = refined.pressure_pa.shape
    middle_um = 0.5 * refined.um_per_px * np.array([width - 1.0, height - 1.0])
    x_um, y_um = (on_chip(refined.registration, middle_um) - middle_um).tolist()
    return (
        f"The refinement found another registration: image and robot are drawn moved by ({x_um:.1f}, {y_um:.1f}) um in "
        "the middle of the chip, and turned as it states, so that they lie on the chip, route and map."
    )


def _cell(text: str) -> str:
    """Text as it is, without Markdown, HTML or control characters."""
    return printable(text)[:_LETTERS].translate(_MARKDOWN)
