"""Flow field and observations to a better flow field: assimilation, and the paper's PI-UNet.

Secrets: which pixels an observation sees (sight), the prior and its posterior (assimilate), the correction and when
to believe it (pi_unet), the network (network), the discrete equations (physics). Only the last two import torch.
"""

from flowrec.refine.assimilate import Assimilate
from flowrec.refine.pi_unet import PiUnet
from flowrec.refine.refiner import Refiner

__all__ = ["Assimilate", "PiUnet", "Refiner"]
