"""Information gained on the stretches of a survey, compared with the predicted gain.

Observations that lower the squared relative error of a flow from a^2 to b^2 move its most probable value: over all
observations that may be made, the mean square of that move is a^2 - b^2 (law of total variance). A model that is wrong
promises falls that do not come true: its stated error stays, and its map does not move. While one of the two does what
was expected, looking is still of use: a map that moves although its stated error does not fall is one that was doubted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from flowrec.core import Floats, Route

MOST_PLACES = 500  # of a map of which the move is taken; it is as smooth as the modes of the flow
_STATED, _EXPECTED, _MOVED, _PROGRESS, _END = range(5)  # columns of `Route.stretches`


@dataclass(frozen=True, slots=True, eq=False)
class SurveyMemory:
    """Earlier stretches of a survey, on which the choice of its next stretch depends.

    Attributes
    ----------
    stretches : (m, 5) so far, as in `Route.stretches`.
    flow_um_s : (k, 2) most probable flow now, in some places.
    stated : relative error of the flow now.
    moved : by which the most probable flow has changed since the choice before, relative.
    progress_s : along the route now.
    """

    stretches: Floats
    flow_um_s: Floats
    stated: float
    moved: float
    progress_s: float

    @classmethod
    def of(cls, present: Route | None, mean_um_s: Floats, stated: float, progress_s: float) -> SurveyMemory:
        """The memory in the present route, and what is believed now: flow (n, 2) and error."""
        flow = mean_um_s[:: len(mean_um_s) // MOST_PLACES + 1]
        before = None if present is None else present.survey_flow_um_s
        if present is None or before is None or present.stretches is None or before.shape != flow.shape:
            return cls(np.zeros((0, 5)), flow, stated, 0.0, progress_s)
        square = float((flow**2).sum())
        moved = np.sqrt(float(((flow - before) ** 2).sum()) / max(square, 1e-300))
        return cls(present.stretches, flow, stated, float(moved), progress_s)

    def trust(self, count: int) -> float:
        """Ratio, 0 to 1, of actual to predicted gain of the latest `count` stretches: the better of two ratios.

        The error has fallen by the difference of the least errors that were stated before them and since, because each
        observation moves what is stated up or down. The map has moved since; what was expected of a stretch counts by
        the part of it that was travelled in that time, because the next one is chosen before its end.
        """
        rows = len(self.stretches)
        if not 0 < count <= rows:
            return 1.0
        stated, expected = np.append(self.stretches[:, _STATED], self.stated), self.stretches[:, _EXPECTED]
        first = rows + 1 - count
        fall = float(stated[:first].min() - stated[first:].min())
        expected_fall = float((stated[:-1] - expected)[-count:].sum())
        moves = np.append(self.stretches[:, _MOVED], self.moved)[-count:]
        travelled = self._travelled_fractions(self.progress_s) - self._travelled_fractions(
            float(self.stretches[-count, _PROGRESS])
        )
        expected_square = float(travelled @ (stated[:-1] ** 2 - expected**2))
        square = float((moves**2).sum())
        return min(max(fall / max(expected_fall, 1e-300), square / max(expected_square, 1e-300), 0.0), 1.0)

    def _travelled_fractions(self, progress_s: float) -> Floats:
        """(m,) part of each stretch that lies before a place of the route."""
        end_s = self.stretches[:, _END]
        begin_s = np.concatenate([[0.0], end_s[:-1]])
        return np.asarray(np.clip((progress_s - begin_s) / (end_s - begin_s), 0.0, 1.0))

    def with_stretch(self, route: Route, expected: float) -> Route:
        """The route with this memory and one more stretch, after which an error is expected."""
        row = [self.stated, expected, self.moved, self.progress_s, float(route.arrival_s[-1])]
        return replace(route, stretches=np.concatenate([self.stretches, [row]]), survey_flow_um_s=self.flow_um_s)
