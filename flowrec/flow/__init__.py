"""Chip and boundary values to a flow field: grid, equations, solver, sampling.

Secrets: what a mask tells of its walls (contour), where they lie on the grid (outline), numbering of faces (grid), the
flow between walls along one grid line (lines), the balance of a face (momentum), conservation of mass (stream),
factorisation and Newton's method (system), units and messages (solver), interpolation (sampling).
"""

from flowrec.flow.modes import FlowModes
from flowrec.flow.sampling import sample
from flowrec.flow.solver import FlowSolver

__all__ = ["FlowModes", "FlowSolver", "sample"]
