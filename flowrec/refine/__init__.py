"""Flow field and observations to a better flow field: assimilation, the paper's PI-UNet and its baselines.

refiner: the table of methods. method, observation_operator: what all methods are given. gain: the null model.
assimilate: assimilation over several hypotheses, of which hypothesis is one; flow_model, prior, channel_cells,
discretisation_error: what may be wrong with a flow; causes: with the observations; evidence, mixture_regression: what
the observations say of it; mask_variants, obstacles: other walls; findings, report, uncertainty: what came out. case,
local_viscosity, residuals, gauss_newton: a case without dimensions, its equations and their direct solution. network,
network_inputs, network_fit, weights: what pi_unet, ni and unet share. pinn, collocation: the network of coordinates and
its case. training: makes the shipped weights. torch is imported when a method that needs it runs.

The package is also the function `flowrec.refine(chip, observations)` (user_flow.py): calling it refines measurements.
"""

import sys
from types import ModuleType
from typing import Any

from flowrec.refine.assimilate import Assimilate
from flowrec.refine.ni import Ni
from flowrec.refine.pi_unet import PiUnet
from flowrec.refine.pinn import Pinn
from flowrec.refine.refiner import REFINERS, Refiner
from flowrec.refine.unet import Unet

__all__ = ["REFINERS", "Assimilate", "Ni", "PiUnet", "Pinn", "Refiner", "Unet"]


class _CallablePackage(ModuleType):
    """A package that is a function, too: `flowrec.refine` is the name of both."""

    def __call__(self, *args: Any, **options: Any) -> Any:
        from flowrec.refine.user_flow import refine

        return refine(*args, **options)


sys.modules[__name__].__class__ = _CallablePackage
