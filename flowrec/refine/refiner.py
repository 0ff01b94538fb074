"""The refinement stage: an assumed flow and what the robot felt of the real one to a better flow."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from flowrec.chip.chip import Chip
from flowrec.errors import FlowError
from flowrec.flow import FlowSolver
from flowrec.messages import FlowField, Observations
from flowrec.refine.assimilate import Assimilate
from flowrec.refine.ni import Ni
from flowrec.refine.observation_operator import sight
from flowrec.refine.pi_unet import PiUnet
from flowrec.refine.pinn import Pinn
from flowrec.refine.unet import Unet


@dataclass(frozen=True, slots=True)
class Refiner:
    """Which method refines, and the settings of each."""

    # fvm: no refinement. ni, pinn, unet: the paper's baselines; the first two do not use the assumed field.
    method: Literal["assimilate", "pi_unet", "fvm", "ni", "pinn", "unet"] = "assimilate"
    assimilate: Assimilate = field(default_factory=Assimilate)
    pi_unet: PiUnet = field(default_factory=PiUnet)
    ni: Ni = field(default_factory=Ni)
    pinn: Pinn = field(default_factory=Pinn)
    unet: Unet = field(default_factory=Unet)

    @property
    def weights_sha256(self) -> str:
        """Hash of the trained weights that the method uses, '' where it uses none."""
        if self.method == "unet":
            return self.unet.weights_sha256
        return self.pi_unet.weights_sha256 if self.method == "pi_unet" else ""

    def refine(self, assumed: FlowField, observations: Observations, chip: Chip, solver: FlowSolver) -> FlowField:
        """Better field on the same pixels; stamp and request are those of `assumed`.

        `chip` holds the assumed parameters. Without a usable observation `assumed` comes back with a note, and with the
        standard deviation that its parameters' prior means.

        Raises
        ------
        FlowError
            If field and chip differ in size, or the flow of the fitted parameters can not be computed.
        """
        if assumed.velocity_um_s.shape[:2] != chip.mask.shape:
            raise FlowError(
                f"the assumed field has {assumed.velocity_um_s.shape[:2]} pixels and the mask of chip '{chip.name}' "
                f"{chip.mask.shape}: solve the flow again for this chip"
            )
        if self.method == "fvm":
            return replace(assumed, note="not refined: method fvm")
        seen = sight(observations, chip.mask, chip.um_per_px)
        if seen.count == 0:
            why = f"none of the observations is of use ({seen.ignored})" if seen.ignored else "no observations"
            return self.assimilate.unobserved(replace(assumed, note=f"not refined: {why}"), chip, solver)
        if self.method == "assimilate":
            return self.assimilate.fit(assumed, seen, chip, solver)
        if self.method == "ni":
            return self.ni.fit(assumed, seen, chip)
        if self.method == "pinn":
            return self.pinn.fit(assumed, seen, chip)
        if self.method == "unet":
            return self.unet.fit(assumed, seen, chip)
        start = self.assimilate.fit(assumed, seen, chip, solver) if self.pi_unet.start == "assimilate" else assumed
        return self.pi_unet.fit(start, seen, chip)
