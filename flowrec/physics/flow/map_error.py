"""Relative error of a map of the flow: one number that the field states, within the bounds of each use of it.

The number is `FlowField.error_share`, the expected relative RMSE of the velocity. It holds under the assumptions of the
refinement and is a mean over the chip. Therefore no use goes below a least error, which was chosen with maps that were
20 % wrong and stated 2 %. The largest error is also that of a field that states none: it is the constant that every map
was given before fields stated their error, and with which `flowrec bench missions` has flown without wall contact.
"""

from __future__ import annotations

from dataclasses import dataclass

from flowrec.core import FlowField


@dataclass(frozen=True, slots=True)
class MapError:
    """The error of a map for one use: some standard deviations, between a least and a largest error."""

    deviations: float
    least: float
    most: float

    def of(self, field: FlowField | None, stated: float | None) -> float:
        """The relative error of a map: the one that a setting states, else from the field."""
        if stated is not None:
            return stated
        if field is None or field.error_share is None:
            return self.most
        return min(max(self.deviations * field.error_share, self.least), self.most)


COURSE = MapError(2.0, 0.06, 0.2)  # margin of plans and surveys where the flow is fast
RESERVE = MapError(1.0, 0.02, 0.05)  # speed that a plan keeps back in a flow without standard deviations
CONTROL = MapError(1.0, 0.1, 0.3)  # weight of the map against the observer
OBSERVER = MapError(1.0, 0.1, 0.25)  # process noise of the filter that corrects the map
STEP_OUT = MapError(2.0, 0.1, 0.2)  # motion that may be missing because of the map
