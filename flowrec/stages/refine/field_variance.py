"""The variance of the flow of a hypothesis, before and after observations."""

from __future__ import annotations

import numpy as np

from flowrec.core import Floats
from flowrec.stages.refine.causes import LOCAL, RESISTANCE, WALLS, WALLS_LONG
from flowrec.stages.refine.channel_cells import steepness
from flowrec.stages.refine.flow_model import FlowModel
from flowrec.stages.refine.hypothesis import HypothesisFit


def field_columns(found: HypothesisFit) -> Floats:
    """(p, n, 2) um/s per unit of each of the first p unknowns, which are those of the flow."""
    columns, bias = _columns(found.observed.model, found.in_use), found.observed.wall_mode
    return columns if bias is None else np.concatenate([columns, bias[None]])


def field_variance(found: HypothesisFit) -> Floats:
    """(n, 2) posterior variance of each component of the flow of a hypothesis."""
    columns = field_columns(found)
    values, vectors = np.linalg.eigh(found.posterior.covariance[: len(columns), : len(columns)])
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    spread = np.tensordot(root.T, columns, axes=1)
    return np.asarray((spread**2).sum(axis=0) + left_variance(found))


def left_variance(found: HypothesisFit) -> Floats:
    """(n, 2) the part of it that no unknown explains: the error of the grid, and of the profile beside walls."""
    names, model = [effect.name for effect in found.effects], found.observed.model
    local, walls = (float(found.posterior.square_sizes[names.index(name)]) for name in ("local", "walls"))
    return _remaining_variance(model, found.in_use, local, walls)


def _columns(model: FlowModel, flow: Floats) -> Floats:
    """(p, n, 2) of the unknowns of the flow: boundary values and fluid, resistances, walls."""
    sections = model.cells.toarray()[:, :, None] * flow
    walls = -WALLS_LONG * model.widening[:, None, None] * (3.0 * model.resistance + sections)
    return np.concatenate([model.known, model.resistance, walls])


def prior_of(model: FlowModel) -> tuple[Floats, Floats]:
    """Columns (p, n, 2) of the unknowns of the flow, and their covariance (p, p) before any observation."""
    cells = len(model.resistance)
    sizes = np.repeat([1.0, RESISTANCE[0], WALLS[0]], [len(model.known), cells, cells])
    return _columns(model, model.base), np.diag(sizes**2)


def prior_variance(model: FlowModel) -> Floats:
    """(n, 2) variance of each component of the flow before any observation."""
    columns, covariance = prior_of(model)
    variance = (np.diag(covariance)[:, None, None] * columns**2).sum(axis=0)
    return np.asarray(variance + prior_left_variance(model))


def prior_left_variance(model: FlowModel) -> Floats:
    """(n, 2) `left_variance` before any observation."""
    return _remaining_variance(model, model.base, LOCAL[0] ** 2, WALLS[0] ** 2)


def _remaining_variance(model: FlowModel, flow: Floats, local: float, walls: float) -> Floats:
    """(n, 2) the same for squared sizes of the grid's error and of walls that are off, as no cell explains them."""
    wider = (model.widening @ model.cells)[:, None] * flow
    beside = steepness(model.chip.mask, flow) ** 2 + (1.0 - WALLS_LONG**2) * wider**2
    return np.asarray(local * model.error_std[:, None] ** 2 + walls * beside)


def expected_error(flow: Floats, variance: Floats) -> float:
    """Expected relative RMSE of a mean flow (n, 2) whose components have a variance (n, 2)."""
    total = float(variance.sum())
    return float(np.sqrt(total / max(float((flow**2).sum()) + total, 1e-300)))
