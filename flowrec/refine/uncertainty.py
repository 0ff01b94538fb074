"""The uncertainty of a flow after some observations, for those who plan where to look next."""

from __future__ import annotations

import math

import numpy as np

from flowrec.chip.chip import Chip
from flowrec.errors import FlowError
from flowrec.flow import FlowSolver
from flowrec.flow.uncertainty import FlowUncertainty
from flowrec.refine.assimilate import Assimilate
from flowrec.refine.observation_operator import ObservationOperator


def flow_uncertainty(
    settings: Assimilate, operator: ObservationOperator, chip: Chip, solver: FlowSolver
) -> FlowUncertainty | None:
    """The posterior of the assimilation, on the chip's own walls; the prior without an observation.

    None where there is no prior: the chip is assumed to stand still, or its flow can not be computed.
    """
    try:
        if operator.count == 0:
            model = settings._linear_model(chip, solver)  # noqa: SLF001
            covariance, mean, factor = np.eye(len(model.columns)), model.base, 1.0
        else:
            found = settings._posterior(operator, chip, solver)  # noqa: SLF001
            model, covariance = found.model, found.found.covariance
            factor = found.found.noise_factor * math.sqrt(found.found.correlation_length)
            mean = model.base + np.tensordot(found.found.mean, model.columns, axes=1) + found.nonlinear
    except FlowError:
        return None
    error = np.sqrt((model.error_std**2).mean(axis=1))
    return FlowUncertainty(mean, model.columns, np.zeros((0, len(mean))), covariance, error, factor)
