"""The chip: fluid pixels, their size, the openings and the assumed fluid; and the settings that choose one."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flowrec.core import Bools, Floats, Floats32, Range, Seed
from flowrec.physics.chip.fluid import ViscosityLaw, ViscositySettings

Side = Literal["left", "right", "top", "bottom"]
Kind = Literal["inlet", "outlet"]
Walls = Literal["smooth", "pixel", "grey"]
GREYS_PER_PX = 50.0  # of a mask whose walls lie between its pixel centres: 128 is on the wall
WATER_MPA_S, WATER_KG_M3 = 1.0, 1000.0  # at 20 degrees C, to 0.2 %


@dataclass(frozen=True, slots=True)
class ChipSettings:
    """The chip and its fluid: a built-in chip by name, or a file; None keeps the value of that chip."""

    name: str = "bifurcation"  # bifurcation, straight, vessels
    # file of the chip instead of a name: *.png (*.toml beside it), *.toml (*.png beside it) or *.npz vessel case
    path: str = ""
    seed: Seed = 0  # number of the drawn network that the name `vessels` stands for
    # size of a pixel of the mask; needed for a PNG that has no TOML
    um_per_px: Annotated[float, Range(1e-3, 1e3)] | None = None
    # where the walls lie: smooth, on a contour through the pixels of the mask; pixel, on their edges. None: as the
    # chip's file states
    walls: Literal["smooth", "pixel"] | None = None
    # channel depth, for the depth-averaged friction; 0: two-dimensional
    depth_um: Annotated[float, Range(0.0, 1e5)] | None = None
    # viscosity of the fluid; of one that is not Newtonian, the unit of its law. None: as the chip's file states
    viscosity_mpa_s: Annotated[float, Range(1e-3, 1e5)] | None = None
    # density of the fluid. None: as the chip's file states
    density_kg_m3: Annotated[float, Range(1.0, 3e4)] | None = None
    # mean speed of the fastest inlet; the others keep their ratio to it
    inlet_speed_um_s: Annotated[float, Range(0.0, 1e7)] | None = None
    # Openings that are inlets, all others outlets at 0 Pa: "left:0" is the first on the left from the top,
    # "top:1" the second on the top from the left, "left" every one on the left.
    inlets: tuple[str, ...] = ()
    viscosity: ViscositySettings = field(default_factory=ViscositySettings)  # how it depends on the shear rate


@dataclass(frozen=True, slots=True)
class Opening:
    """A run of fluid pixels on the border of the mask, first to last inclusive along the side."""

    side: Side
    first: int
    last: int
    kind: Kind
    value: float  # inlet: mean inward speed, um/s; outlet: pressure, Pa

    @property
    def width_px(self) -> int:
        """Number of fluid pixels on the border."""
        return self.last - self.first + 1


@dataclass(frozen=True, slots=True, eq=False)
class Chip:
    """Mask and assumed boundary values, from which flow, planning and simulation start."""

    name: str
    mask: Bools  # (h, w) True in fluid
    um_per_px: float
    openings: tuple[Opening, ...]
    viscosity_mpa_s: float
    density_kg_m3: float
    depth_um: float | None = None  # None: two-dimensional; else depth-averaged friction -12 mu v / depth^2
    walls: Walls = "smooth"
    # (h, w) friction of each pixel beside that of the depth, as 12 / depth^2: the force is -mu times this times v
    friction_per_um2: Floats | None = None
    law: ViscosityLaw | None = None  # viscosity over viscosity_mpa_s as a function of shear rate; None: Newtonian
    # (h, w) the mask whose walls, moved outwards by the offset, are those of the chip; None: its own mask's
    drawn: Bools | None = None
    wall_offset_px: float = 0.0
    # (h, w) signed distance in px of the pixel centres of `drawn` to the walls, of walls `grey`
    level_px: Floats32 | None = None

    @property
    def size_um(self) -> tuple[float, float]:
        """Width and height of the mask in um."""
        return self.mask.shape[1] * self.um_per_px, self.mask.shape[0] * self.um_per_px

    @property
    def greys(self) -> NDArray[np.uint8]:
        """(h, w) grey levels of the mask in its file."""
        if self.walls == "grey" and self.level_px is not None:
            return greys_of(self.level_px)
        return np.where(self.mask, 255, 0).astype(np.uint8)

    @property
    def is_open_field(self) -> bool:
        """True where there is no channel: all is fluid but the border of the mask."""
        return bool(self.mask[1:-1, 1:-1].all())

    @property
    def is_driven(self) -> bool:
        """True where an opening drives the fluid."""
        return any(opening.value for opening in self.openings)

    @property
    def is_still(self) -> bool:
        """True where nobody asks for a flow: an open field whose openings drive nothing."""
        return not self.is_driven and self.is_open_field

    @property
    def boundary_values(self) -> Floats:
        """(openings,) inlets: mean inward speed, um/s; outlets: pressure, Pa."""
        return np.array([opening.value for opening in self.openings], np.float64)

    def with_boundary(
        self, values: ArrayLike, viscosity_mpa_s: float | None = None, density_kg_m3: float | None = None
    ) -> Chip:
        """A copy with other boundary values (openings,) and fluid."""
        openings = tuple(
            replace(opening, value=float(value))
            for opening, value in zip(self.openings, np.asarray(values, np.float64), strict=True)
        )
        return replace(
            self,
            openings=openings,
            viscosity_mpa_s=self.viscosity_mpa_s if viscosity_mpa_s is None else viscosity_mpa_s,
            density_kg_m3=self.density_kg_m3 if density_kg_m3 is None else density_kg_m3,
        )


def greys_of(level_px: Floats32) -> NDArray[np.uint8]:
    """(h, w) grey levels of a mask from the signed distances of its pixel centres to the walls, in px."""
    return np.clip(np.rint(128.0 + GREYS_PER_PX * level_px), 0.0, 255.0).astype(np.uint8)


def levels(greys: NDArray[np.uint8]) -> Floats32:
    """(h, w) signed distances to the walls, in px, of grey levels."""
    return np.asarray((greys.astype(np.float64) - 128.0) / GREYS_PER_PX, np.float32)
