"""A flow field for other libraries: as an xarray Dataset, and drawn by Matplotlib. Neither needs the true flow."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flowrec.core.declarations import message_fields
from flowrec.core.errors import UsageError
from flowrec.core.units import unit_of

if TYPE_CHECKING:
    import pandas
    import xarray
    from matplotlib.axes import Axes

Shown = Literal["speed", "error"]
_ARROWS = 24  # along the longer side
_LENGTH = 1.6  # of the fastest arrow, in spaces between arrows
_SOLID, _PATH = "0.85", "tab:red"
_PLACE = ("y_um", "x_um")
_DIMS = {"velocity_um_s": (*_PLACE, "component"), "std_um_s": (*_PLACE, "component"), "pressure_pa": _PLACE}
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


class Field(Protocol):
    """Flow field to be drawn: messages.FlowField, which imports this file."""

    @property
    def stamp_ns(self) -> int: ...
    @property
    def method(self) -> str: ...
    @property
    def note(self) -> str: ...
    @property
    def um_per_px(self) -> float: ...
    @property
    def velocity_um_s(self) -> NDArray[np.float32]: ...
    @property
    def std_um_s(self) -> NDArray[np.float32] | None: ...
    @property
    def wall_px(self) -> NDArray[np.float32] | None: ...
    @property
    def pressure_pa(self) -> NDArray[np.float32]: ...
    @property
    def boundary_values(self) -> NDArray[np.float64]: ...


def to_xarray(field: Field) -> xarray.Dataset:
    """A field as a Dataset with the dimensions y_um, x_um (pixel centres, chip frame, y down) and component.

    `velocity_um_s` and `pressure_pa`, and `std_um_s` if the method states it; each says its unit and meaning. Method,
    note, fluid and boundary values are attributes.

    Raises
    ------
    UsageError : xarray is not installed.
    """
    try:
        import xarray as xr
    except ModuleNotFoundError as error:
        raise UsageError(
            f"to_xarray needs {error.name}, which is not installed: pip install 'flowrec[export]'"
        ) from error
    meanings = {each.name: each.meaning for each in message_fields(type(field))}
    variables = {
        name: (dims, values, {"units": unit_of(name), "description": meanings[name]})
        for name, dims in _DIMS.items()
        if (values := getattr(field, name)) is not None
    }
    h, w = field.velocity_um_s.shape[:2]
    places = {"x_um": np.arange(w) * field.um_per_px, "y_um": np.arange(h) * field.um_per_px}
    coordinates: dict[str, Any] = {
        name: (name, values, {"units": "um", "description": f"centre of the pixel, {name[0]} in the chip frame"})
        for name, values in places.items()
    }
    facts = {name: value for name in _NUMBERS if (value := getattr(field, name)) is not None}
    facts |= {"method": field.method, "note": field.note, "boundary_values": field.boundary_values.tolist()}
    return xr.Dataset(variables, coordinates | {"component": ["x", "y"]}, facts)


def values_of(field: Field, fluid: NDArray[np.bool_]) -> NDArray[np.float64]:
    """(n, 7) the columns VALUES, a row for each pixel of fluid (h, w); NaN where no standard deviation is stated."""
    rows, columns = np.nonzero(fluid)
    places = np.column_stack([columns, rows]) * field.um_per_px
    std = field.std_um_s[fluid] if field.std_um_s is not None else np.full((len(rows), 2), np.nan)
    return np.hstack([places, field.velocity_um_s[fluid], std, field.pressure_pa[fluid][:, None]])


def to_pandas(field: Field) -> pandas.DataFrame:
    """The columns VALUES with a row for each pixel of fluid; UsageError if pandas is not installed."""
    try:
        import pandas
    except ModuleNotFoundError as error:
        raise UsageError("to_pandas needs pandas, which is not installed: pip install 'flowrec[export]'") from error
    return pandas.DataFrame(values_of(field, fluid_of(field)), columns=list(VALUES))


def fluid_of(field: Field) -> NDArray[np.bool_]:
    """(h, w) where a field has fluid; of a field that does not state its walls, where it flows."""
    if field.wall_px is not None:
        return field.wall_px > 0
    moving: NDArray[np.bool_] = np.any(field.velocity_um_s != 0, axis=-1)
    return moving


def plot(field: Field, ax: Axes | None = None, show: Shown = "speed", path_um: ArrayLike | None = None) -> Axes:
    """Draw a field with its arrows; lengths in um, y down as in the image.

    Parameters
    ----------
    ax : Matplotlib axes to draw in; None: a new figure.
    show : the speed, or the stated error, one standard deviation of the velocity vector: the error map that needs no
        truth.
    path_um : (n, 2) places of a robot or a route, drawn over it.

    Raises
    ------
    UsageError : Matplotlib is not installed, the method states no error, or the path has another shape.
    """
    try:
        import matplotlib.pyplot as plt
    except ModuleNotFoundError as error:
        raise UsageError(f"plot needs {error.name}, which is not installed: pip install 'flowrec[report]'") from error
    if show not in ("speed", "error"):
        raise UsageError(f"show = {show!r}: must be 'speed' or 'error'")
    if show == "error" and field.std_um_s is None:
        raise UsageError(f"the method {field.method} states no error; a field of method assimilate has one")
    vectors = field.velocity_um_s if show == "speed" else field.std_um_s
    fluid = fluid_of(field)
    assert vectors is not None
    values = np.where(fluid, np.hypot(vectors[..., 0], vectors[..., 1]), np.nan)
    h, w = fluid.shape
    px = field.um_per_px
    axes: Axes = ax if ax is not None else plt.subplots(layout="constrained")[1]
    drawn = axes.imshow(
        values, extent=(-0.5 * px, (w - 0.5) * px, (h - 0.5) * px, -0.5 * px), vmin=0.0, interpolation="nearest"
    )
    label = {"speed": "speed (um/s)", "error": "one standard deviation (um/s)"}[show]
    axes.figure.colorbar(drawn, ax=axes, label=label, fraction=0.046 * h / w, pad=0.03)
    axes.set_facecolor(_SOLID)
    if show == "speed":
        _arrows(axes, field, fluid)
    if path_um is not None:
        path = np.asarray(path_um, np.float64)
        if path.ndim != 2 or path.shape[1] != 2:
            raise UsageError(f"path_um has the shape {path.shape}; it must be (n, 2): x and y in um")
        axes.plot(path[:, 0], path[:, 1], color="white", linewidth=3.0)
        axes.plot(path[:, 0], path[:, 1], color=_PATH, linewidth=1.5)
    axes.set(xlabel="x (um)", ylabel="y (um)", title=f"flow by {field.method}", aspect="equal")
    return axes


def _arrows(axes: Axes, field: Field, fluid: NDArray[np.bool_]) -> None:
    step = max(1, max(fluid.shape) // _ARROWS)
    rows, columns = np.mgrid[step // 2 : fluid.shape[0] : step, step // 2 : fluid.shape[1] : step]
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
