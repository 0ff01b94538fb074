"""What is believed before anything was observed: Gaussians around the assumed boundary values and fluid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowrec.chip.chip import Chip
from flowrec.errors import FlowError
from flowrec.refine.observation_operator import Floats


@dataclass(frozen=True, slots=True)
class Widths:
    """One standard deviation of each belief."""

    inlet_share: float  # of the assumed inlet speed, each inlet for itself
    pump_share: float  # the same, one factor for all inlets
    outlet_share: float  # of the assumed difference of pressure
    viscosity_share: float  # of the assumed viscosity
    density_share: float  # of the assumed density
    depth_share: float  # of the assumed depth
    shape_share: float  # skew and flatness of an inlet's profile, of its speed


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """z ~ N(0, 1), the beliefs in standard deviations, and what they mean for the P parameters of a FlowResponse.

    z holds first one belief per opening, then ln mu and ln rho, then the optional ones.
    """

    spread: Floats  # (beliefs, P): offset = z spread
    viscosity_std: float  # of ln mu
    density_std: float  # of ln rho

    @classmethod
    def of(cls, widths: Widths, chip: Chip, drop_pa: float) -> Prior:
        """Of a chip in whose assumed flow the pressure differs by `drop_pa`.

        Raises
        ------
        FlowError
            If nothing moves in the assumed flow.
        """
        inlet = np.array([opening.kind == "inlet" for opening in chip.openings])
        values, count = chip.boundary_values, len(inlet)
        speeds = np.abs(values[inlet])
        # A closed inlet is no more certain than an open one.
        speed = np.where(values != 0.0, np.abs(values), speeds.max(initial=0.0))
        with_depth = widths.depth_share > 0.0 and chip.depth_um is not None
        own = np.where(inlet, widths.inlet_share * speed, widths.outlet_share * drop_pa)
        if min(own) <= 0.0:
            raise FlowError(
                f"chip '{chip.name}' is assumed to stand still, so nothing says how wrong that may be: "
                "give an inlet speed or an outlet pressure of the right size"
            )
        inlets = np.flatnonzero(inlet)
        shapes = 2 * len(inlets) if widths.shape_share > 0.0 else 0
        parameters = count + 1 + with_depth + shapes
        rows = [*np.eye(count, parameters) * own[:, None]]
        viscosity, density = np.zeros((2, parameters))
        viscosity[count], density[count] = widths.viscosity_share, -widths.density_share
        # Flow goes with p / mu: what is assumed of a pressure is as uncertain as the viscosity.
        viscosity[:count] = np.where(inlet, 0.0, -values * widths.viscosity_share)
        rows += [viscosity, density]
        if with_depth:
            depth = np.zeros(parameters)
            depth[count + 1] = 2.0 * widths.depth_share  # friction goes as 1 / depth^2
            rows.append(depth)
        if shapes:
            rows += [
                *np.eye(shapes, parameters, parameters - shapes)
                * np.repeat(widths.shape_share * speed[inlet], 2)[:, None]
            ]
        if widths.pump_share > 0.0:
            rows.append(
                np.where(np.arange(parameters) < count, 1.0, 0.0)
                * np.pad(np.where(inlet, values, 0.0), (0, parameters - count))
                * widths.pump_share
            )
        return cls(np.stack(rows), widths.viscosity_share, widths.density_share)

    def offset(self, z: Floats) -> Floats:
        """(P,) parameters of the FlowResponse, from its own."""
        return np.asarray(z[: len(self.spread)] @ self.spread)

    def chip(self, chip: Chip, z: Floats) -> Chip:
        """The chip with boundary values, viscosity and density as believed in z."""
        count = len(chip.openings)
        thicker = float(np.exp(self.viscosity_std * z[count]))
        values = chip.boundary_values + self.offset(z)[:count]
        outlet = np.array([opening.kind == "outlet" for opening in chip.openings])
        return chip.with_boundary(
            np.where(outlet, values * thicker, values),
            chip.viscosity_mpa_s * thicker,
            chip.density_kg_m3 * float(np.exp(self.density_std * z[count + 1])),
        )
