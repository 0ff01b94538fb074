"""The refinement stage: an assumed flow and local measurements of the real one to a better flow; its table of methods.

A new method is a file with a class that has the verb of `method.Refinement`, and a row below. Settings of its own are
one field of `Refiner` more, named in the row's options.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated

from flowrec.chip.chip import Chip
from flowrec.errors import FlowError
from flowrec.flow import FlowSolver
from flowrec.flow.uncertainty import FlowUncertainty
from flowrec.messages import FlowField, Observations
from flowrec.methods import Method, Methods
from flowrec.refine.assimilate import Assimilate
from flowrec.refine.method import Problem, Refinement
from flowrec.refine.ni import Ni
from flowrec.refine.observation_operator import ObservationOperator, observation_operator
from flowrec.refine.pi_unet import PiUnet
from flowrec.refine.pinn import Pinn
from flowrec.refine.uncertainty import flow_uncertainty
from flowrec.refine.unet import Unet
from flowrec.system.blas_threads import one_blas_thread

REFINERS = Methods(
    "refine.method",
    Method(
        "assimilate",
        "flowrec.refine.assimilate:Assimilate",
        "the boundary values that explain the observations best, with error bars",
        ("assimilate",),
    ),
    Method(
        "pi_unet",
        "flowrec.refine.pi_unet:PiUnet",
        "a U-Net corrects an initial field by physics and observations (the paper's method)",
        ("pi_unet", "assimilate"),
    ),
    Method("gain", "flowrec.refine.gain:Gain", "null model: the assumed flow times the factor that fits best"),
    Method("fvm", "flowrec.refine.refiner:AssumedFlow", "null model: the assumed flow of the solver, not refined"),
    Method(
        "ni", "flowrec.refine.ni:Ni", "the paper's baseline: a U-Net without initial prediction, for one case", ("ni",)
    ),
    Method(
        "pinn",
        "flowrec.refine.pinn:Pinn",
        "the paper's baseline: a network of the coordinates, for one case",
        ("pinn",),
    ),
    Method(
        "unet",
        "flowrec.refine.unet:Unet",
        "the paper's baseline: a U-Net trained on other vessels, no physics",
        ("unet",),
    ),
)


@dataclass(frozen=True, slots=True)
class AssumedFlow:
    """The method `fvm`: no refinement."""

    def fit(self, problem: Problem) -> FlowField:
        """The assumed field."""
        return replace(problem.assumed, note="not refined: method fvm")


@dataclass(frozen=True, slots=True)
class Refiner:
    """Chooses the method. `ni` and `pinn` do not use the assumed field."""

    method: Annotated[str, REFINERS] = "assimilate"
    # Mission and controller place the robot on the chip by the registration that the refinement found.
    place_robot: bool = True
    assimilate: Assimilate = field(default_factory=Assimilate)
    pi_unet: PiUnet = field(default_factory=PiUnet)
    ni: Ni = field(default_factory=Ni)
    pinn: Pinn = field(default_factory=Pinn)
    unet: Unet = field(default_factory=Unet)

    @property
    def weights_sha256(self) -> str:
        """Hash of the trained weights that the method uses, '' where it uses none."""
        return str(getattr(self._selected(), "weights_sha256", ""))

    @one_blas_thread()
    def refine(self, assumed: FlowField, observations: Observations, chip: Chip, solver: FlowSolver) -> FlowField:
        """Better field on the same pixels; stamp and request are those of `assumed`.

        `chip` holds the assumed parameters. Without a usable observation `assumed` is returned with a note, and with
        the standard deviation that follows from the prior of its parameters.

        Raises
        ------
        FlowError
            If field and chip differ in size, or the flow of the fitted parameters can not be computed.
        UsageError
            If there is no such method, or a package that it needs is not installed.
        """
        method = self._selected()
        if assumed.velocity_um_s.shape[:2] != chip.mask.shape:
            raise FlowError(
                f"the assumed field has {assumed.velocity_um_s.shape[:2]} pixels and the mask of chip '{chip.name}' "
                f"{chip.mask.shape}: solve the flow again for this chip"
            )
        operator = observation_operator(observations, chip.mask, chip.um_per_px, assumed.wall_px)

        def assimilated(obstacles: bool) -> tuple[FlowField, ObservationOperator]:
            return self.assimilate.fit_with_observations(problem, obstacles)

        problem = Problem(assumed, operator, chip, solver, assimilated)
        if operator.count == 0 and not isinstance(method, AssumedFlow):
            ignored = operator.ignored
            why = f"none of the observations is of use ({ignored})" if ignored else "no observations"
            return self.assimilate.unobserved(replace(assumed, note=f"not refined: {why}"), chip, solver)
        refined = method.fit(problem)
        return refined if self.place_robot else replace(refined, registration=None)

    @one_blas_thread()
    def prior_error_share(self, chip: Chip, solver: FlowSolver) -> float | None:
        """Expected relative RMSE of the chip's assumed flow; None where nothing says how wrong it may be."""
        return self.assimilate.prior_error_share(chip, solver)

    @one_blas_thread()
    def uncertainty(
        self, assumed: FlowField, observations: Observations, chip: Chip, solver: FlowSolver
    ) -> FlowUncertainty | None:
        """What is not known of the flow after some observations, by the assimilation, whatever the method.

        None where nothing says how wrong the assumed flow may be.
        """
        operator = observation_operator(observations, chip.mask, chip.um_per_px, assumed.wall_px)
        return flow_uncertainty(self.assimilate, operator, chip, solver)

    def _selected(self) -> Refinement:
        """The method with its settings: the first of the row's options, or its class where it has no settings."""
        row = REFINERS[self.method]
        method: Refinement = getattr(self, row.options[0]) if row.options else row.load()()
        return method
