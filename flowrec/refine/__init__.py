"""Flow field and observations to a better flow field: assimilation, and the paper's PI-UNet.

Secrets: which pixels an observation sees (sight), the prior and its posterior (assimilate), the correction and when
to believe it (pi_unet, judge), its units (case), what networks see and how their output becomes a field (scene,
spread), the network (network), its weights on disk (weights), its descent (descend), the discrete equations (physics,
stencil) and their direct solution with observations (balance), torch made repeatable (still). The room imports torch
only when a network runs.
"""

from flowrec.refine.assimilate import Assimilate
from flowrec.refine.pi_unet import PiUnet
from flowrec.refine.refiner import Refiner

__all__ = ["Assimilate", "PiUnet", "Refiner"]
