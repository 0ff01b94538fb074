"""Results of the slow stages, which the worker delivers: flow fields and routes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated

import numpy as np
from numpy.typing import ArrayLike

from flowrec.core.declarations import Matrix, Message, Raster, Shape, Vector

if TYPE_CHECKING:
    import pandas
    import xarray
    from matplotlib.axes import Axes

    from flowrec.core.field_views import Shown


@dataclass(frozen=True, slots=True, eq=False)
class FlowField(Message):
    """A steady flow on the pixels of the chip's mask. `request` is the number of the work order that it answers.

    Velocities are values at the centres of the pixels, never means over them. The speed between centres is what
    `flow.sample` gives: it follows the profile of the channel and is zero at its walls, for which it needs `wall_px`.
    Sums over pixels are sums over points: the flow rate through a section is not theirs, but that of the boundary
    values, which are means over an opening. In a field without `wall_px`, from numerics 1, velocities are means.
    """

    stamp_ns: int
    request: int
    method: Annotated[str, "fvm, assimilate, pi_unet, ..."]
    um_per_px: float
    velocity_um_s: Annotated[Raster, Shape("h", "w", 2), "x then y, at pixel centres; 0 in solid"]
    pressure_pa: Annotated[Raster, Shape("h", "w"), "0 in solid"]
    std_um_s: Annotated[
        Raster | None,
        Shape("h", "w", 2),
        "One standard deviation of each component; None if the method does not estimate it.",
    ]
    boundary_values: Annotated[Vector, Shape("n"), "of inlets: mean inward speed, um/s; of outlets: pressure, Pa"]
    viscosity_mpa_s: float
    density_kg_m3: float
    note: Annotated[str, "human-readable remark of the method on its result"]
    wall_px: Annotated[
        Raster | None,
        Shape("h", "w"),
        "Signed distance from the pixel centres to the wall in pixels, negative in solid; exact near the wall only, "
        "and the wall lies where it is 0 between two centres. None: not stated.",
    ] = None
    error_share: Annotated[
        float | None,
        "Expected relative RMSE of the velocity over the fluid pixels: from the posterior, or from the prior where no "
        "observation was used. None: not known.",
    ] = None
    parameter_names: Annotated[
        str,
        'What the refinement found besides the boundary values and the fluid: "; " between the names, one value and '
        "one standard deviation per name. The names are listed in stages/refine/causes.py.",
    ] = ""
    parameters: Annotated[Vector, Shape("m")] = field(default_factory=lambda: np.zeros(0))
    parameter_std: Annotated[Vector, Shape("m")] = field(default_factory=lambda: np.zeros(0))
    viscosity_law: Annotated[
        str,
        "How the viscosity over viscosity_mpa_s depends on the shear rate, for people; the chip holds the law. '': it "
        "does not, or not stated.",
    ] = ""
    registration: Annotated[
        Matrix | None,
        Shape(2, 3),
        "The registration that the refinement found: a measured place x (2,) lies on the chip at R (x, 1). None: as "
        "stated.",
    ] = None
    refused: Annotated[
        str,
        "Why this is the flow that was in use before, with the number of the order that it answers, and not the flow "
        "that was ordered. '': it is that one.",
    ] = ""
    log_score: Annotated[
        float | None,
        "Mean ln probability density, per observation and in 1/(um/s)^2, of observations that were held back: under "
        "the flow that was ordered, under the flow in use before it, and one standard error of their difference. None: "
        "not tested. See stages/refine/held_back.py.",
    ] = None
    log_score_before: float | None = None
    log_score_error: float | None = None

    def to_xarray(self) -> xarray.Dataset:
        """The field as an xarray Dataset with the dimensions y_um, x_um and component; see field_views.py."""
        from flowrec.core.field_views import to_xarray

        return to_xarray(self)

    def to_pandas(self) -> pandas.DataFrame:
        """The field as a DataFrame with a row for each pixel of fluid; see field_views.py."""
        from flowrec.core.field_views import to_pandas

        return to_pandas(self)

    def plot(self, ax: Axes | None = None, show: Shown = "speed", path_um: ArrayLike | None = None) -> Axes:
        """Draw speed and arrows, or with `show="error"` the stated error, with Matplotlib; see field_views.py."""
        from flowrec.core.field_views import plot

        return plot(self, ax, show, path_um)


@dataclass(frozen=True, slots=True, eq=False)
class Route(Message):
    """A path with the time at which each point should be passed, or the reason why no path exists."""

    stamp_ns: int
    request: int
    method: str
    reachable: bool
    reason: Annotated[str, "why not, when it is not"]
    waypoints_um: Annotated[Matrix, Shape("n", 2), "n = 0 when unreachable"]
    arrival_s: Annotated[Vector, Shape("n"), "since the start of the route, strictly increasing"]
    time_to_go_s: Annotated[
        Raster | None,
        Shape("h", "w", finite=False),
        "Seconds to the goal by the fastest way; the first point is the centre of the chip's first pixel. inf: there "
        "is no way. None: the planner knows the time along its path only. -grad T is the best heading at every point "
        "(a policy). Narrow channels have several points per pixel.",
    ] = None
    time_to_go_um_per_px: Annotated[float, "distance between points; 0: that of the chip's pixels"] = 0.0
    more: Annotated[
        bool,
        "Of a survey: the next stretch is to be ordered on the way. A route that is ordered on the way begins as the "
        "one before, with the same times.",
    ] = False
    stretches: Annotated[
        Matrix | None,
        Shape("m", 5),
        "Of a survey that remembers, for each stretch: the relative error of the flow when it was chosen, the one "
        "expected after it, the relative change of the most probable flow since the choice before, and in s along the "
        "route the progress at the choice and the end of the stretch.",
    ] = None
    survey_flow_um_s: Annotated[
        Matrix | None,
        Shape("o", 2),
        "most probable flow when the latest stretch was chosen, at evenly spread fluid pixels",
    ] = None
    goal_um: Annotated[
        Vector,
        Shape("q"),
        "(2,) the goal that was asked for, which its last point may be near only; (0,): none, or not stated",
    ] = field(default_factory=lambda: np.zeros(0))
    refused: Annotated[
        str,
        "Why this is the route that was in use before, or none, and not the result of the order. '': it is that "
        "result.",
    ] = ""
