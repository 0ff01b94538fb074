"""Flow field and observations to a better flow field: assimilation, the paper's PI-UNet and its baselines.

refiner: the table of methods. method, observation_operator: what all methods are given. gain: the null model.
assimilate: assimilation over several hypotheses, of which hypothesis is one; flow_model, prior, channel_cells,
discretisation_error: what may be wrong with a flow; causes: with the observations; evidence, mixture_regression: what
the observations say of it; wall_bias, obstacles: other walls; findings, report, uncertainty: what came out. case,
local_viscosity, residuals, gauss_newton: a case without dimensions, its equations and their direct solution. network,
network_inputs, network_fit, weights: what pi_unet, ni and unet share. pinn: the network of coordinates and its
case. torch is imported when a method that needs it runs.
"""

from flowrec.stages.refine.assimilate import Assimilate
from flowrec.stages.refine.ni import Ni
from flowrec.stages.refine.pi_unet import PiUnet
from flowrec.stages.refine.pinn import Pinn
from flowrec.stages.refine.refiner import REFINERS, Refiner
from flowrec.stages.refine.unet import Unet

__all__ = ["REFINERS", "Assimilate", "Ni", "PiUnet", "Pinn", "Refiner", "Unet"]
