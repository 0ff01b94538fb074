"""What the stretches of a survey were worth, compared to what was expected of them.

Observations that lower the squared relative error of a flow from a^2 to b^2 move its most probable value: over all
observations that may be made, the mean square of that move is a^2 - b^2 (law of total variance). A model that is wrong
promises falls that do not come true: its stated error stays, and its map does not move. While one of the two does what
was expected, looking is still of use: a map that moves although its stated error does not fall is one that was doubted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flowrec.messages import Route

Floats = NDArray[np.float64]
MOST_PLACES = 500  # of a map of which the move is taken; it is as smooth as the modes of the flow
_STATED, _EXPECTED, _MOVED = range(3)  # columns of `Route.stretch_errors`


@dataclass(frozen=True, slots=True, eq=False)
class SurveyMemory:
    """What a survey has to go by when it chooses its next stretch.

    Attributes
    ----------
    errors : (m, 3) of the stretches so far, as in `Route.stretch_errors`.
    flow_um_s : (k, 2) most probable flow now, in some places.
    stated : relative error of the flow now.
    moved : by which the most probable flow has changed since the choice before, relative.
    """

    errors: Floats
    flow_um_s: Floats
    stated: float
    moved: float

    @classmethod
    def of(cls, present: Route | None, mean_um_s: Floats, stated: float) -> SurveyMemory:
        """The memory in the present route, and what is believed now: flow (n, 2) and error."""
        flow = mean_um_s[:: len(mean_um_s) // MOST_PLACES + 1]
        before = None if present is None else present.survey_flow_um_s
        if present is None or before is None or present.stretch_errors is None or before.shape != flow.shape:
            return cls(np.zeros((0, 3)), flow, stated, 0.0)
        square = float((flow**2).sum())
        moved = np.sqrt(float(((flow - before) ** 2).sum()) / max(square, 1e-300))
        return cls(present.stretch_errors, flow, stated, float(moved))

    def trust(self, count: int) -> float:
        """How far the latest `count` stretches have kept what was expected of them: 0 to 1, the better of two ratios.

        The error has fallen by the difference of the least errors that were stated before them and since, because each
        observation moves what is stated up or down. The map has moved by what the stretches before the latest one have
        shown: a stretch is chosen when the one before it is not yet travelled.
        """
        rows = len(self.errors)
        if not 0 < count < rows:
            return 1.0
        stated, expected = np.append(self.errors[:, _STATED], self.stated), self.errors[:, _EXPECTED]
        first = rows + 1 - count
        fall = float(stated[:first].min() - stated[first:].min())
        expected_fall = float((stated[:-1] - expected)[-count:].sum())
        moves = np.append(self.errors[:, _MOVED], self.moved)[-count:]
        expected_squares = (stated[:-1] ** 2 - expected**2)[-count - 1 : -1]
        ratios = (
            fall / max(expected_fall, 1e-300),
            float((moves**2).sum()) / max(float(expected_squares.sum()), 1e-300),
        )
        return min(max(*ratios, 0.0), 1.0)

    def remembered(self, route: Route, expected: float) -> Route:
        """The route with this memory and one more stretch, after which an error is expected."""
        errors = np.concatenate([self.errors, [[self.stated, expected, self.moved]]])
        return replace(route, stretch_errors=errors, survey_flow_um_s=self.flow_um_s)
