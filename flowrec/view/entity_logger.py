"""One session's hand in a recording stream: where its entities go, and how it is told from another session's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from flowrec.view import colours
from flowrec.view import entities as e


@dataclass(frozen=True, slots=True)
class Style:
    """How one of up to two sessions in one view is told from the other."""

    word: str
    path: colours.Rgb
    robot: colours.Rgb
    width: float  # the recorded one is broad and below, so that both are seen where they coincide
    label_at: float  # share of the path


_STYLES = {
    "": Style("", colours.CYAN, colours.ORANGE, 1.4, 0.06),
    "recorded": Style("recorded ", colours.ORANGE, colours.ORANGE, 2.6, 0.06),
    "replayed": Style("replayed ", colours.CYAN, colours.CYAN, 1.2, 0.25),
}


class Pen:
    """Logs entities below `prefix`: '', 'recorded' or 'replayed'."""

    def __init__(self, stream: rr.RecordingStream, prefix: str) -> None:
        self.stream = stream
        self.prefix = prefix
        self.style = _STYLES[prefix]
        self._names: dict[str, str] = {}

    def log(self, entity: str, *what: rr.AsComponents, static: bool = False) -> None:
        """Log what an entity is from now on, or (static) always."""
        path = self._names.get(entity)
        if path is None:
            path = self._names[entity] = e.under(self.prefix, entity)
        self.stream.log(path, what[0], *what[1:], static=static)


def label(at: NDArray[np.float64], text: str, colour: colours.Rgb) -> rr.Points2D:
    """A word that stays readable at any zoom, just below a point (2,) of the picture plane."""
    return rr.Points2D([at], labels=[text], show_labels=True, colors=colour, radii=rr.Radius.ui_points(0.0))
