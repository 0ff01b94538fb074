"""The refinement stage: an assumed flow and local measurements of the real one to a better flow; its table of methods.

A new method is a file with a class that has the verb of `method.Refinement`, and a row below. Settings of its own are
one field of `Refiner` more, named in the row's options.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal

import numpy as np

from flowrec.core import FlowError, FlowField, Method, Methods, Observations, one_blas_thread
from flowrec.physics import Chip, FlowSolver, FlowUncertainty
from flowrec.stages.refine.assimilate import Assimilate
from flowrec.stages.refine.held_back import FEWEST, made_after, worse
from flowrec.stages.refine.method import Refinement, RefinementProblem
from flowrec.stages.refine.ni import Ni
from flowrec.stages.refine.observation_operator import ObservationOperator, observation_operator
from flowrec.stages.refine.pi_unet import PiUnet
from flowrec.stages.refine.pinn import Pinn
from flowrec.stages.refine.tracer_heights import at_mean_height
from flowrec.stages.refine.uncertainty import flow_uncertainty
from flowrec.stages.refine.unet import Unet

REFINERS = Methods(
    "refine.method",
    Method(
        "assimilate",
        "flowrec.stages.refine.assimilate:Assimilate",
        "the boundary values that explain the observations best, with error bars",
        ("assimilate",),
    ),
    Method(
        "pi_unet",
        "flowrec.stages.refine.pi_unet:PiUnet",
        "a U-Net corrects an initial field by physics and observations (the paper's method)",
        ("pi_unet", "assimilate"),
    ),
    Method("gain", "flowrec.stages.refine.gain:Gain", "null model: the assumed flow times the factor that fits best"),
    Method(
        "fvm", "flowrec.stages.refine.refiner:AssumedFlow", "null model: the assumed flow of the solver, not refined"
    ),
    Method(
        "ni",
        "flowrec.stages.refine.ni:Ni",
        "the paper's baseline: a U-Net without initial prediction, for one case",
        ("ni",),
    ),
    Method(
        "pinn",
        "flowrec.stages.refine.pinn:Pinn",
        "the paper's baseline: a network of the coordinates, for one case",
        ("pinn",),
    ),
    Method(
        "unet",
        "flowrec.stages.refine.unet:Unet",
        "the paper's baseline: a U-Net trained on other vessels, no physics",
        ("unet",),
    ),
    group="flowrec.refiners",
    verb="fit",
)


NO_FLOW = (
    "there is no log of the coils, and the motion of a driven robot is not that of the flow; import with --coils LOG, "
    "or with --set movie.drifts=true if nothing drove it"
)


def _untested_reason(operator: ObservationOperator, before: FlowField | None) -> str:
    """Reason why a flow could not be tested on observations that were held back."""
    count = operator.count if before is None else int(np.count_nonzero(made_after(operator, before)))
    why = f"{count} are too few" if count < FEWEST else "the method would have to fit again without them"
    return f"not tested on observations that were held back: {why}"


def keep_flow(in_use: FlowField, why: str, refused: FlowField | None = None) -> FlowField:
    """The flow in use with the reason why another is refused, and with the scores of that one where it has any."""
    scores: dict[str, Any] = {
        name: getattr(refused, name, None) for name in ("log_score", "log_score_before", "log_score_error")
    }
    return replace(in_use, refused=why, **scores)


@dataclass(frozen=True, slots=True)
class AssumedFlow:
    """The method `fvm`: no refinement."""

    def fit(self, problem: RefinementProblem) -> FlowField:
        """The assumed field."""
        return replace(problem.assumed, note="not refined: method fvm")


@dataclass(frozen=True, slots=True)
class Refiner:
    """Refines the flow with observations; `method` selects how. `ni` and `pinn` do not use the assumed field."""

    method: Annotated[str, REFINERS] = "assimilate"
    # predicts: the flow in use stays where the refined one predicts observations that were held back worse, by more
    # than two standard errors; always: the refined one is adopted without a test
    adopt: Literal["predicts", "always"] = "predicts"
    # the motion of the body tells the flow; False: nobody knows what part of it is the robot's own, and nothing is
    # refined
    observes_flow: bool = True
    # Mission and controller place the robot on the chip by the registration that the refinement found.
    place_robot: bool = True
    # Observer, health and controller take the um per revolution that the refinement found, and read the map where its
    # registration puts the robot.
    correct_robot: bool = True
    # Observer, health and coils take the angle that it found between the robot's heading and its course.
    correct_heading: bool = True
    # Observer, health and coils take how much more slowly than the fluid it found the flow to carry the robot.
    correct_lag: bool = True
    assimilate: Assimilate = field(default_factory=Assimilate)
    pi_unet: PiUnet = field(default_factory=PiUnet)
    ni: Ni = field(default_factory=Ni)
    pinn: Pinn = field(default_factory=Pinn)
    unet: Unet = field(default_factory=Unet)

    @property
    def weights_sha256(self) -> str:
        """Hash of the trained weights that the method uses, '' where it uses none."""
        return str(getattr(self._selected_method(), "weights_sha256", ""))

    @one_blas_thread()
    def refine(
        self,
        assumed: FlowField,
        observations: Observations,
        chip: Chip,
        solver: FlowSolver,
        before: FlowField | None = None,
    ) -> FlowField:
        """Better field on the same pixels; stamp and request are those of `assumed`.

        `chip` holds the assumed parameters. Without a usable observation `assumed` is returned with a note, and with
        the standard deviation that follows from the prior of its parameters. Where its method can, it states how it
        predicts observations that were held back, and how the flow in use does: `before`, a refined one, or `assumed`.

        Raises
        ------
        NotFiniteError
            If the fit diverges.
        FlowError
            If field and chip differ in size, or the flow of the fitted parameters can not be computed.
        UsageError
            If there is no such method, or a package that it needs is not installed.
        """
        method = self._selected_method()
        if not self.observes_flow:
            return keep_flow(assumed if before is None else before, NO_FLOW)
        if assumed.velocity_um_s.shape[:2] != chip.mask.shape:
            raise FlowError(
                f"the assumed field has {assumed.velocity_um_s.shape[:2]} pixels and the mask of chip '{chip.name}' "
                f"{chip.mask.shape}: solve the flow again for this chip"
            )
        observations = at_mean_height(observations, assumed, chip)
        operator = observation_operator(observations, chip.mask, chip.um_per_px, assumed.wall_px)

        def fit_assimilation(obstacles: bool) -> tuple[FlowField, ObservationOperator]:
            return self.assimilate.fit_with_observations(problem, obstacles)

        hold_back = self.adopt == "predicts"
        if before is not None and before.refused and np.array_equal(before.velocity_um_s, assumed.velocity_um_s):
            before = None
        problem = RefinementProblem(assumed, operator, chip, solver, fit_assimilation, hold_back, before)
        if operator.count == 0 and not isinstance(method, AssumedFlow):
            ignored = operator.ignored
            why = f"none of the observations is of use ({ignored})" if ignored else "no observations"
            return self.assimilate.prior_field(replace(assumed, note=f"not refined: {why}"), chip, solver)
        refined = method.fit(problem)
        if hold_back and refined.log_score is None and not isinstance(method, AssumedFlow):
            refined = replace(refined, note=f"{refined.note}; {_untested_reason(operator, before)}")
        return refined if self.place_robot else replace(refined, registration=None)

    def choose(self, refined: FlowField, in_use: FlowField) -> FlowField:
        """The refined flow, or with a reason the flow in use where that predicts held-back observations better."""
        if self.adopt == "always" or not worse(refined):
            return refined
        return keep_flow(in_use, f"by {refined.method} it predicts observations that were held back worse", refined)

    @one_blas_thread()
    def prior_error_share(self, chip: Chip, solver: FlowSolver) -> float | None:
        """Expected relative RMSE of the chip's assumed flow; None where nothing says how wrong it may be."""
        return self.assimilate.prior_error_share(chip, solver)

    def preparations(self, chip: Chip, solver: FlowSolver) -> Iterator[Callable[[], object]]:
        """Parts of the refinements and survey orders to come, to be called while nobody waits; they fill caches only.

        A part raises FlowrecError where it can not be done. The order that needs it then says so.
        """
        yield self._selected_method
        for part in self.assimilate.preparations(chip, solver):
            yield one_blas_thread()(part)

    @one_blas_thread()
    def uncertainty(
        self, assumed: FlowField, observations: Observations, chip: Chip, solver: FlowSolver
    ) -> FlowUncertainty | None:
        """Posterior uncertainty of the flow after some observations, by the assimilation, whatever the method.

        None where nothing says how wrong the assumed flow may be.
        """
        observations = at_mean_height(observations, assumed, chip)
        operator = observation_operator(observations, chip.mask, chip.um_per_px, assumed.wall_px)
        return flow_uncertainty(self.assimilate, operator, chip, solver)

    def _selected_method(self) -> Refinement:
        """The method with its settings: the first of the row's options, or its class where it has no settings."""
        row = REFINERS[self.method]
        method: Refinement = row.section(self) if row.options else row.load()()
        return method
