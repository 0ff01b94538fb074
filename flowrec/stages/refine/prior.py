"""Prior of the assimilation: Gaussians around the assumed boundary values and fluid."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from flowrec.core import Floats, FlowError, Range
from flowrec.physics import Chip


@dataclass(frozen=True, slots=True)
class PriorSettings:
    """Widths of the prior, each one standard deviation."""

    # standard deviation of an inlet's speed, as a fraction of the assumed one
    inlet_std_share: Annotated[float, Range(1e-4, 10.0)] = 0.25
    # standard deviation of a factor that is common to all inlets
    pump_std_share: Annotated[float, Range(0.0, 10.0)] = 0.0
    # standard deviation of an outlet's pressure, as a fraction of the largest assumed |pressure|
    outlet_std_share: Annotated[float, Range(1e-4, 10.0)] = 0.10
    # standard deviation of the viscosity, as a fraction of the assumed one
    viscosity_std_share: Annotated[float, Range(1e-4, 10.0)] = 0.30
    # standard deviation of the density, as a fraction of the assumed one
    density_std_share: Annotated[float, Range(1e-4, 10.0)] = 0.10
    # standard deviation of the chip's depth, where it has one, as a fraction of it
    depth_std_share: Annotated[float, Range(0.0, 10.0)] = 0.0
    # standard deviation of skew and flatness of the inlets' profiles, as a fraction of the inlet speed
    inlet_shape_std: Annotated[float, Range(0.0, 10.0)] = 0.0
    # standard deviation of the exponent of the chip's law of viscosity, where it has one; three times that of ln of its
    # other unknowns
    law_std: Annotated[float, Range(0.0, 3.0)] = 0.15


def at_rest(chip: Chip) -> FlowError:
    """The error for a chip whose assumed flow is at rest."""
    return FlowError(
        f"chip '{chip.name}' is assumed to stand still, so nothing says how wrong that may be: give an inlet speed or "
        "an outlet pressure of the right size"
    )


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """z ~ N(0, 1), the unknowns in prior standard deviations, and their effect on the P parameters of Sensitivities.

    z holds one unknown per opening, then ln mu and ln rho, then the optional ones: ln of the depth friction, the shapes
    of the inlets, a factor common to all inlets, and those of the chip's law of viscosity.
    """

    effect: Floats  # (unknowns, P): offset = z effect
    viscosity_std: float  # of ln mu
    density_std: float  # of ln rho
    depth_index: int | None = None  # of the unknown that is the depth; None: it is none
    depth_std: float = 0.0  # of ln depth
    law_stds: tuple[float, ...] = ()  # of the unknowns of the law of viscosity, the last ones of z

    @classmethod
    def of(cls, settings: PriorSettings, chip: Chip, drop_pa: float) -> Prior:
        """Prior of a chip in whose assumed flow the pressure varies by `drop_pa`.

        Raises
        ------
        FlowError
            If the assumed flow is at rest.
        """
        inlet = np.array([opening.kind == "inlet" for opening in chip.openings])
        values, count = chip.boundary_values, len(inlet)
        # A closed inlet is no more certain than an open one.
        speed = np.where(values != 0.0, np.abs(values), np.abs(values[inlet]).max(initial=0.0))
        std = np.where(inlet, settings.inlet_std_share * speed, settings.outlet_std_share * drop_pa)
        if min(std) <= 0.0:
            raise at_rest(chip)
        with_depth = settings.depth_std_share > 0.0 and chip.depth_um is not None
        shapes = 2 * int(inlet.sum()) if settings.inlet_shape_std > 0.0 else 0
        law_stds = law_widths(settings, chip)
        laws = len(law_stds)
        parameters = count + 1 + with_depth + shapes + laws
        rows = [*np.eye(count, parameters) * std[:, None]]
        viscosity, density, depth, pump = np.zeros((4, parameters))
        viscosity[count], density[count] = settings.viscosity_std_share, -settings.density_std_share
        # The flow depends on p / mu: a pressure is as uncertain as the viscosity.
        viscosity[:count] = np.where(inlet, 0.0, -values * settings.viscosity_std_share)
        rows += [viscosity, density]
        depth_index = len(rows) if with_depth else None
        if with_depth:
            depth[count + 1] = -2.0 * settings.depth_std_share  # friction is proportional to 1 / depth^2
            rows.append(depth)
        if shapes:
            widths = np.repeat(settings.inlet_shape_std * speed[inlet], 2)
            rows += [*np.eye(shapes, parameters, parameters - laws - shapes) * widths[:, None]]
        if settings.pump_std_share > 0.0:
            pump[:count] = np.where(inlet, values, 0.0) * settings.pump_std_share
            rows.append(pump)
        rows += [*np.eye(laws, parameters, parameters - laws) * np.array(law_stds)[:, None]]
        stds = (settings.viscosity_std_share, settings.density_std_share)
        return cls(np.stack(rows), *stds, depth_index, settings.depth_std_share, law_stds)

    @property
    def law_index(self) -> int:
        """Place in z of the first unknown of the law of viscosity."""
        return len(self.effect) - len(self.law_stds)

    def offset(self, z: Floats) -> Floats:
        """(P,) change of the parameters of Sensitivities."""
        return np.asarray(z[: len(self.effect)] @ self.effect)

    def chip(self, chip: Chip, z: Floats) -> Chip:
        """The chip with the boundary values, viscosity, its law and density of z."""
        count = len(chip.openings)
        thicker = float(np.exp(self.viscosity_std * z[count]))
        values = chip.boundary_values + self.offset(z)[:count]
        outlet = np.array([opening.kind == "outlet" for opening in chip.openings])
        if chip.law is not None and self.law_stds:
            last = self.law_index
            chip = replace(chip, law=chip.law.with_offset(z[last : last + len(self.law_stds)] * self.law_stds))
        return chip.with_boundary(
            np.where(outlet, values * thicker, values),
            chip.viscosity_mpa_s * thicker,
            chip.density_kg_m3 * float(np.exp(self.density_std * z[count + 1])),
        )


def law_widths(settings: PriorSettings, chip: Chip) -> tuple[float, ...]:
    """Standard deviations of the unknowns of a chip's law of viscosity; () where it is Newtonian or taken as known."""
    if chip.law is None or settings.law_std == 0.0:
        return ()
    return tuple(settings.law_std * (3.0 if name.startswith("ln ") else 1.0) for name in chip.law.unknowns)
