"""Results of the slow stages, which the worker delivers: flow fields and routes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from flowrec.core.declarations import NOT_STATED, Bools, Floats, Matrix, Message, Raster, Shape, Vector, message_fields
from flowrec.core.errors import UsageError, needs
from flowrec.core.units import seconds, unit_of

if TYPE_CHECKING:
    import pandas
    import xarray
    from matplotlib.axes import Axes

Shown = Literal["speed", "error"]
_ARROWS = 24  # along the longer side
_LOW = 4.0  # width over height of a low picture
_LENGTH = 1.6  # of the fastest arrow, in spaces between arrows
_SOLID, _PATH = "0.85", "tab:red"
_PLACE = ("y_um", "x_um")
_DIMS = {"velocity_um_s": (*_PLACE, "component"), "std_um_s": (*_PLACE, "component"), "pressure_pa": _PLACE}
_LONG_NAMES = {"velocity_um_s": "flow velocity", "std_um_s": "standard deviation", "pressure_pa": "pressure"}
_NUMBERS = ("um_per_px", "viscosity_mpa_s", "density_kg_m3", "error_share", "stamp_ns")

# Columns of a field with a row a pixel.
VALUES = {
    "x_um": "centre of the pixel, x in the chip frame",
    "y_um": "centre of the pixel, y in the chip frame",
    "u_um_s": "flow velocity along x",
    "v_um_s": "flow velocity along y",
    "std_u_um_s": "one standard deviation of u_um_s; empty if the method states none",
    "std_v_um_s": "one standard deviation of v_um_s; empty if the method states none",
    "pressure_pa": "pressure above that of an outlet at 0 Pa",
}


@dataclass(frozen=True, slots=True, eq=False)
class FlowField(Message):
    """A steady flow on the pixels of the chip's mask. `request` is the number of the work order that it answers.

    Velocities are values at the centres of the pixels, never means over them. The speed between centres is what
    `flow.sample` gives: it follows the profile of the channel and is zero at its walls, for which it needs `wall_px`.
    Sums over pixels are sums over points: the flow rate through a section is not theirs, but that of the boundary
    values, which are means over an opening. In a field without `wall_px`, from numerics 1, velocities are means.
    """

    def __repr__(self) -> str:
        height, width = self.pressure_pa.shape
        fastest = float(np.hypot(*np.moveaxis(self.velocity_um_s, -1, 0)).max(initial=0.0))
        stated = f", states an error of {100.0 * self.error_share:.1f} %" if self.error_share is not None else ""
        return (
            f"<flow by {self.method}: {width} x {height} pixels of {self.um_per_px:g} um, at most {fastest:.0f} um/s"
            f"{stated}>"
        )

    stamp_ns: int
    request: Annotated[int, "number of the work order that it answers"]
    method: Annotated[str, "method that made it: fvm, assimilate, pi_unet, ..."]
    um_per_px: Annotated[float, "size of a pixel of the chip"]
    velocity_um_s: Annotated[Raster, Shape("h", "w", 2), "velocity at the pixel centres, x then y; 0 in solid"]
    pressure_pa: Annotated[Raster, Shape("h", "w"), "pressure at the pixel centres; 0 in solid"]
    std_um_s: Annotated[
        Raster | None,
        Shape("h", "w", 2),
        "One standard deviation of each component; None if the method does not estimate it.",
    ]
    boundary_values: Annotated[
        Vector, Shape("n"), "boundary values of the openings; inlets: mean inward speed, um/s; outlets: pressure, Pa"
    ]
    viscosity_mpa_s: Annotated[float, "viscosity of the fluid"]
    density_kg_m3: Annotated[float, "density of the fluid"]
    note: Annotated[str, "remark of the method on its result, human-readable"]
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
    parameters: Annotated[Vector, Shape("m"), "values of parameter_names"] = NOT_STATED
    parameter_std: Annotated[Vector, Shape("m"), "one standard deviation of each"] = NOT_STATED
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
        "mean ln probability density, per observation and in 1/(um/s)^2, of observations that were held back, under "
        "the flow that was ordered; None: not tested. See stages/refine/held_back.py.",
    ] = None
    log_score_before: Annotated[float | None, "such a mean under the flow in use before it"] = None
    log_score_error: Annotated[float | None, "one standard error of the difference of the two"] = None

    def parameter(self, name: str) -> tuple[float, float] | None:
        """Value and standard deviation of something that the refinement found; None if it says nothing of it."""
        names = self.parameter_names.split("; ")
        if name not in names:
            return None
        index = names.index(name)
        return float(self.parameters[index]), float(self.parameter_std[index])

    def to_xarray(self) -> xarray.Dataset:
        """The field as an xarray Dataset: dimensions y_um, x_um (pixel centres, chip frame, y down) and component.

        `velocity_um_s` and `pressure_pa`, and `std_um_s` if the method states it; each says its unit and meaning. Other
        coordinates: `fluid`, False in solid, and `time_s`, when the field was adopted, so that
        `xarray.concat(..., "time_s")` joins several. Method, note and boundary values are attributes.

        Raises
        ------
        UsageError : xarray is not installed.
        """
        with needs("to_xarray", "export"):
            import xarray as xr
        meanings = {each.name: each.meaning for each in message_fields(type(self))}
        variables = {
            name: (
                dims,
                values,
                {"units": unit_of(name), "long_name": _LONG_NAMES[name], "description": meanings[name]},
            )
            for name, dims in _DIMS.items()
            if (values := getattr(self, name)) is not None
        }
        h, w = self.velocity_um_s.shape[:2]
        places = {"x_um": np.arange(w) * self.um_per_px, "y_um": np.arange(h) * self.um_per_px}
        coordinates: dict[str, Any] = {
            name: (name, values, {"units": "um", "long_name": name[0], "description": VALUES[name]})
            for name, values in places.items()
        }
        coordinates["fluid"] = _PLACE, fluid_of(self), {"long_name": "fluid", "description": "False in solid"}
        coordinates["time_s"] = (
            (),
            seconds(self.stamp_ns),
            {"units": "s", "long_name": "time", "description": "when the field was adopted, on the session clock"},
        )
        facts = {name: value for name in _NUMBERS if (value := getattr(self, name)) is not None}
        facts |= {"method": self.method, "note": self.note, "boundary_values": self.boundary_values.tolist()}
        return xr.Dataset(variables, coordinates | {"component": ["x", "y"]}, facts)

    def to_pandas(self) -> pandas.DataFrame:
        """The columns VALUES with a row for each pixel of fluid; UsageError if pandas is not installed."""
        with needs("to_pandas", "export"):
            import pandas
        return pandas.DataFrame(values_of(self, fluid_of(self)), columns=list(VALUES))

    def plot(self, ax: Axes | None = None, show: Shown = "speed", path_um: ArrayLike | None = None) -> Axes:
        """Draw the field with its arrows by Matplotlib; lengths in um, y down as in the image.

        Parameters
        ----------
        ax : Matplotlib axes to draw in; None: a new figure.
        show : the speed, or the stated error, one standard deviation of the velocity vector: the error map that needs
            no truth.
        path_um : (n, 2) places of a robot or a route, drawn over it.

        Raises
        ------
        UsageError : Matplotlib is not installed, the method states no error, or the path has another shape.
        """
        with needs("plot", "report"):
            import matplotlib.pyplot as plt
        if show not in ("speed", "error"):
            raise UsageError(f"show = {show!r}: must be 'speed' or 'error'")
        if show == "error" and self.std_um_s is None:
            raise UsageError(f"the method {self.method} states no error; a field of method assimilate has one")
        vectors = self.velocity_um_s if show == "speed" else self.std_um_s
        fluid = fluid_of(self)
        assert vectors is not None
        values = np.where(fluid, np.hypot(vectors[..., 0], vectors[..., 1]), np.nan)
        h, w = fluid.shape
        px = self.um_per_px
        axes: Axes = ax if ax is not None else plt.subplots(layout="constrained")[1]
        drawn = axes.imshow(
            values, extent=(-0.5 * px, (w - 0.5) * px, (h - 0.5) * px, -0.5 * px), vmin=0.0, interpolation="nearest"
        )
        label = {"speed": "speed (um/s)", "error": "one standard deviation (um/s)"}[show]
        beside: dict[str, Any] = {"fraction": 0.046 * h / w, "pad": 0.03}
        below = {"location": "bottom", "fraction": 0.08, "aspect": 40.0}  # the bar of a low picture would be too short
        axes.figure.colorbar(drawn, ax=axes, label=label, **(below if w > _LOW * h else beside))
        axes.set_facecolor(_SOLID)
        if show == "speed":
            _arrows(axes, self, fluid)
        if path_um is not None:
            path = np.asarray(path_um, np.float64)
            if path.ndim != 2 or path.shape[1] != 2:
                raise UsageError(f"path_um has the shape {path.shape}; it must be (n, 2): x and y in um")
            axes.plot(path[:, 0], path[:, 1], color="white", linewidth=3.0)
            axes.plot(path[:, 0], path[:, 1], color=_PATH, linewidth=1.5)
        axes.set(xlabel="x (um)", ylabel="y (um)", title=f"flow by {self.method}", aspect="equal")
        return axes


def values_of(field: FlowField, fluid: Bools) -> Floats:
    """(n, 7) the columns VALUES, a row for each pixel of fluid (h, w); NaN where no standard deviation is stated."""
    rows, columns = np.nonzero(fluid)
    places = np.column_stack([columns, rows]) * field.um_per_px
    std = field.std_um_s[fluid] if field.std_um_s is not None else np.full((len(rows), 2), np.nan)
    return np.hstack([places, field.velocity_um_s[fluid], std, field.pressure_pa[fluid][:, None]])


def fluid_of(field: FlowField) -> Bools:
    """(h, w) where a field has fluid; of a field that does not state its walls, where it flows."""
    if field.wall_px is not None:
        return field.wall_px > 0
    return np.any(field.velocity_um_s != 0, axis=-1)


def _arrows(axes: Axes, field: FlowField, fluid: Bools) -> None:
    step = max(1, max(fluid.shape) // _ARROWS)
    h, w = fluid.shape
    rows, columns = np.mgrid[min(step, h) // 2 : h : step, min(step, w) // 2 : w : step]
    inside = fluid[rows, columns]
    rows, columns = rows[inside], columns[inside]
    velocity = field.velocity_um_s[rows, columns]
    fastest = float(np.hypot(velocity[:, 0], velocity[:, 1]).max(initial=0.0))
    if fastest > 0.0:
        axes.quiver(
            *(columns * field.um_per_px, rows * field.um_per_px, velocity[:, 0], velocity[:, 1]),
            color="black",
            angles="xy",
            scale_units="xy",
            scale=fastest / (_LENGTH * step * field.um_per_px),  # the longest arrow is so many spaces long
            units="width",
            width=0.004,
            headwidth=4.0,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Route(Message):
    """A path with the time at which each point should be passed, or the reason why no path exists."""

    stamp_ns: int
    request: Annotated[int, "number of the work order that it answers"]
    method: Annotated[str, "method that planned it"]
    reachable: Annotated[bool, "a path exists"]
    reason: Annotated[str, "reason why no path exists"]
    waypoints_um: Annotated[Matrix, Shape("n", 2), "points of the path; none when the goal is unreachable"]
    arrival_s: Annotated[Vector, Shape("n"), "time of each point since the start of the route, strictly increasing"]
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
        "goal that was asked for (2,), which its last point may be near only; (0,): none, or not stated",
    ] = NOT_STATED
    refused: Annotated[
        str,
        "Why this is the route that was in use before, or none, and not the result of the order. '': it is that "
        "result.",
    ] = ""

    @property
    def lasts_s(self) -> float:
        """Time from its first point to its last one; IndexError of a route without points."""
        return float(self.arrival_s[-1])
