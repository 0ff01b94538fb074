"""Interface of the methods of refinement: their input, and their function."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from flowrec.core import FlowField
from flowrec.physics import Chip, FlowSolver
from flowrec.stages.refine.observation_operator import ObservationOperator


@dataclass(frozen=True, slots=True, eq=False)
class RefinementProblem:
    """One refinement: the true flow is not part of it."""

    assumed: FlowField  # flow of the chip's assumed parameters
    operator: ObservationOperator  # with at least one observation
    chip: Chip  # with the assumed parameters
    solver: FlowSolver
    # Computes the result of the assimilation, for methods that start from it, and the observations less what it finds
    # that robot, registration and pump do to them. True: with channels partly blocked.
    assimilated: Callable[[bool], tuple[FlowField, ObservationOperator]]
    # Whether to state how the result predicts observations that were held back, see held_back.py.
    hold_back: bool = False
    before: FlowField | None = None  # the refined flow in use; None: it is the assumed one


class Refinement(Protocol):
    """A method: a frozen dataclass of its settings."""

    def fit(self, problem: RefinementProblem) -> FlowField:
        """Better field (h, w) with the stamp and request of `problem.assumed`: zero in solid, with a note.

        Its `std_um_s` is the standard deviation of each component, or None where the method gives none; its scores are
        those of held_back.py, or None where the method would have to fit again to hold observations back.

        Raises
        ------
        FlowError
            If the method can not give a field.
        """
        ...
