"""Flow field and observations to a better flow field: assimilation, the paper's PI-UNet and its baselines.

Secrets: which pixels an observation sees (sight), the prior and its posterior (assimilate), the correction and when
to believe it (pi_unet, judge), how it is found (descend; balance and stencil directly), its units (case), what
networks see and how their output becomes a field (scene), what an observation says along a channel (spread), the
network (network), its weights on disk (weights), the discrete equations (physics). Of the baselines: a field from
observations alone (ni), what other vessels teach (unet), a flow as a network of coordinates (pinn), where that is
asked (collocation), that network and its derivatives (coordinate_net). For all: what part of an image a network sees
(crop), the same bytes every time (torch_run). torch is imported when a method that needs it runs.
"""

from flowrec.refine.assimilate import Assimilate
from flowrec.refine.ni import Ni
from flowrec.refine.pi_unet import PiUnet
from flowrec.refine.pinn import Pinn
from flowrec.refine.refiner import Refiner
from flowrec.refine.unet import Unet

__all__ = ["Assimilate", "Ni", "PiUnet", "Pinn", "Refiner", "Unet"]
