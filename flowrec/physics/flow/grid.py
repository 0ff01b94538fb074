"""Staggered (MAC) grid: which faces carry flow, their numbering, and the pressure on pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flowrec.core import Bools, Floats, Floats32, FlowError, Ints
from flowrec.physics.chip.chip import Chip, Kind, Opening, Side
from flowrec.physics.chip.openings import SIDES, border
from flowrec.physics.flow.assembly import components
from flowrec.physics.flow.level_set import LevelSet, from_mask, subcells

WALL, OPEN, OUTLET, INLET = range(4)  # kinds of a face

# A face with a smaller open fraction counts as closed: its flux would be this fraction squared of an open face's.
CLOSED = 0.02

UPRIGHT = ("left", "right")  # sides whose openings consist of upright faces


@dataclass(frozen=True, slots=True, eq=False)
class Faces:
    """The faces of one velocity component: upright ones (h, w + 1) for u, level ones (h + 1, w) for v."""

    kind: NDArray[np.int8]
    number: Ints  # of the faces through which fluid can move; -1 elsewhere
    low: Floats  # where the fluid part of a face begins, 0 to 1
    high: Floats  # where it ends

    @property
    def T(self) -> Faces:  # noqa: N802 - as numpy's
        """The faces with rows and columns exchanged."""
        return Faces(self.kind.T, self.number.T, self.low.T, self.high.T)


@dataclass(frozen=True, slots=True)
class GridOpening:
    """An opening on the subcells: its faces on the border, in order along the side."""

    side: Side
    kind: Kind
    faces: Ints  # (m,) numbers
    inward: float  # sign of the face velocity that points into the chip
    profile: Floats  # (m,) fluxes of a parabola whose sum is that of mean speed 1 over the opening's pixels
    vertices: tuple[Ints, Ints]  # rows and columns of the m + 1 ends of the faces

    @property
    def streamfunction_sign(self) -> float:
        """Sign of the inflow as a change of the stream function along the side."""
        return self.inward if self.side in UPRIGHT else -self.inward


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """Cells of 1 / k of a pixel. u lives on upright faces (h, w + 1), v on level faces (h + 1, w), p in cells (h, w).

    Walls cut faces: fluid moves through a fraction of them. The unknown is the flux of each face over the side of a
    cell, that is its velocity times its open fraction, so the fluxes through the four sides of any cell sum to zero.
    Only faces through which fluid can move are numbered, first those of u, then those of v.
    """

    k: int
    fluid: Bools  # (h, w) cells, whole or cut, that are connected to an opening
    u: Faces
    v: Faces
    number_p: Ints  # (h, w) numbers of the cells, -1 elsewhere
    faces: int
    cells: int
    openings: tuple[GridOpening, ...]
    walls: LevelSet
    mask: Bools  # the chip's pixels

    @property
    def open_fraction(self) -> Floats:
        """(faces,) the part of each face that is fluid."""
        return self.on_faces(self.u.high - self.u.low, self.v.high - self.v.low)

    def on_faces(self, upright: Floats, level: Floats) -> Floats:
        """(faces,) of values of all upright (h, w + 1) and level (h + 1, w) faces, in the order of their numbers."""
        return np.concatenate([upright[self.u.number >= 0], level[self.v.number >= 0]])

    @property
    def wall_px(self) -> Floats32:
        """Signed distance (h, w) of the pixel centres to the wall, as in FlowField."""
        return self.walls.at_centres(self.k)

    def pressure(self, cells: Floats) -> Floats:
        """Averages (h, w) over the fluid cells of each pixel of cell values (cells,): zero in solid."""
        total, count = (self._pixel_sums(values) for values in (np.append(cells, 0.0)[self.number_p], self.fluid))
        return total / np.maximum(count, 1) * self.mask

    def face_means(self, pixels: Floats) -> Floats:
        """(faces,) means of the cells on both sides of each face, of values (h, w) of the pixels."""
        cells = np.pad(subcells(pixels, self.k), 1, mode="edge")
        across, down = cells[1:-1], cells[:, 1:-1]
        return self.on_faces(0.5 * (across[:, :-1] + across[:, 1:]), 0.5 * (down[:-1] + down[1:]))

    def _pixel_sums(self, cells: Floats | Bools) -> Floats:
        """Sums over the cells (h k, w k) of each pixel (h, w)."""
        h, w = self.mask.shape
        return cells.reshape(h, self.k, w, self.k).astype(np.float64).sum(axis=(1, 3))


def _parabola(low: Floats, high: Floats) -> Floats:
    """Fluxes (m,) through faces from low to high along an opening, of the parabola of mean 1 between its walls."""
    first, last = low[0], high[-1]
    a, b = (low - first) / (last - first), (high - first) / (last - first)
    return np.asarray((last - first) * ((3.0 * b**2 - 2.0 * b**3) - (3.0 * a**2 - 2.0 * a**3)), np.float64)


def build(chip: Chip, k: int, walls: LevelSet | None = None) -> Grid:
    """Number the faces and cells of a chip. `walls` replaces those of the mask.

    Raises FlowError if the pixels of an opening are not one run of fluid.
    """
    if walls is None:
        drawn = chip.mask if chip.drawn is None else chip.drawn
        walls = from_mask(drawn, k, chip.walls, chip.wall_offset_px, chip.level_px)
    level = walls.level
    split = _split_cells(level)
    # Upright faces; the level ones are those with rows and columns exchanged.
    (low_u, high_u, open_u), (low_v, high_v, open_v) = _fluid_part(level, split), _fluid_part(level.T, split.T)
    low_v, high_v, open_v = low_v.T, high_v.T, open_v.T
    places = [
        _opening_faces(chip, level, open_u if opening.side in UPRIGHT else open_v, k, index)
        for index, opening in enumerate(chip.openings)
    ]
    kind_u, kind_v = np.zeros(open_u.shape, np.int8), np.zeros(open_v.shape, np.int8)
    kind_u[:, 1:-1] = np.where(open_u[:, 1:-1], OPEN, WALL)
    kind_v[1:-1] = np.where(open_v[1:-1], OPEN, WALL)
    for opening, place in zip(chip.openings, places, strict=True):
        (kind_u if opening.side in UPRIGHT else kind_v)[place] = INLET if opening.kind == "inlet" else OUTLET
    fluid = _connected_cells(kind_u, kind_v)
    kind_u[:, 1:][~fluid], kind_u[:, :-1][~fluid] = WALL, WALL
    kind_v[1:][~fluid], kind_v[:-1][~fluid] = WALL, WALL
    number_u, u_faces = number_where(kind_u != WALL, 0)
    number_v, faces = number_where(kind_v != WALL, u_faces)
    number_p, cells = number_where(fluid, 0)
    u, v = Faces(kind_u, number_u, low_u, high_u), Faces(kind_v, number_v, low_v, high_v)
    openings = tuple(
        _grid_opening(opening, u if opening.side in UPRIGHT else v, place, k)
        for opening, place in zip(chip.openings, places, strict=True)
    )
    return Grid(k, fluid, u, v, number_p, faces, cells, openings, walls, chip.mask)


def _grid_opening(opening: Opening, faces: Faces, place: tuple[Ints, Ints], k: int) -> GridOpening:
    """An opening whose faces have these rows and columns."""
    rows, columns = place
    upright = opening.side in UPRIGHT
    start = np.arange(len(rows))
    profile = _parabola(start + faces.low[place], start + faces.high[place])
    return GridOpening(
        opening.side,
        opening.kind,
        faces.number[place],
        1.0 if opening.side in ("left", "top") else -1.0,
        # The flux is that of the opening's pixels, however wide a smooth contour makes it.
        profile * (opening.width_px * k / profile.sum()),
        (np.append(rows, rows[-1] + upright), np.append(columns, columns[-1] + (not upright))),
    )


def _fluid_part(level: Floats, split_cells: Bools) -> tuple[Floats, Floats, Bools]:
    """Begin and end (h, w + 1) of the fluid part of upright faces, 0 to 1, and which are open.

    Where there is no fluid, end <= begin. No face of a cell in `split_cells` (h, w) is open. The level is linear
    between the ends of a face and its midpoint.
    """
    first, middle, last = level[:-1:2, ::2], level[1::2, ::2], level[2::2, ::2]

    def crossing(solid: Floats, fluid: Floats) -> Floats:
        return -solid / np.maximum(fluid - solid, 1e-12)

    fluid_first, fluid, fluid_last = first > 0.0, middle > 0.0, last > 0.0
    low = np.where(fluid, 0.5 * crossing(first, middle), 0.5 + 0.5 * crossing(middle, last))
    high = np.where(fluid, 1.0 - 0.5 * crossing(last, middle), 0.5 - 0.5 * crossing(middle, first))
    low = np.where(fluid_first, 0.0, np.where(fluid | fluid_last, low, 1.0))
    high = np.where(fluid_last, 1.0, np.where(fluid | fluid_first, high, 0.0))
    split = fluid_first & fluid_last & ~fluid
    low, high = np.where(split, 0.5, low), np.where(split, 0.5, high)
    open_ = high - low >= CLOSED
    open_[:, 1:] &= ~split_cells
    open_[:, :-1] &= ~split_cells
    return low, high, open_


def _split_cells(level: Floats) -> Bools:
    """Cells (h, w) with solid in the centre and separate fluid at their sides: nothing may pass through."""
    corner, upright, flat = level[::2, ::2] > 0.0, level[1::2, ::2] > 0.0, level[::2, 1::2] > 0.0
    ring = [corner[:-1, :-1], flat[:-1], corner[:-1, 1:], upright[:, 1:], corner[1:, 1:], flat[1:], corner[1:, :-1]]
    ring.append(upright[:, :-1])
    changes = sum((one != two).astype(np.int64) for one, two in zip(ring, ring[1:] + ring[:1], strict=True))
    return (level[1::2, 1::2] <= 0.0) & (changes > 2)


def number_where(where: Bools, start: int) -> tuple[Ints, int]:
    """Consecutive numbers from `start` where true, -1 elsewhere, and the next free number."""
    count = int(np.count_nonzero(where))
    numbers = np.full(where.shape, -1, np.int64)
    numbers[where] = np.arange(start, start + count)
    return numbers, start + count


def _opening_faces(chip: Chip, level: Floats, open_: Bools, k: int, index: int) -> tuple[Ints, Ints]:
    """Rows and columns of the border faces of opening `index`: the run of open faces with most of its pixels."""
    opening = chip.openings[index]
    line, corner = border(open_, opening.side), border(level[::2, ::2], opening.side)
    pixels = border(chip.mask, opening.side)[max(opening.first, 0) : opening.last + 1]
    begin, end = max(opening.first, 0) * k, (opening.last + 1) * k
    # Faces that are connected along the border have the same run number.
    run = np.cumsum(~(line & np.append(False, line[:-1] & (corner[1:-1] > 0.0))))
    core = run[begin:end][line[begin:end]]
    if len(core) == 0 or len(pixels) != opening.width_px or not pixels.all():
        raise FlowError(
            f"opening {index} ({opening.side} {opening.first}..{opening.last}) of chip '{chip.name}' is not one run "
            f"of fluid (k={k}, walls={chip.walls}): correct its pixels, or try walls='pixel'"
        )
    along = np.flatnonzero(line & (run == np.bincount(core).argmax()))
    # A smooth contour can widen an opening by a pixel; fluid farther beyond its pixels stays closed.
    slack = k if chip.walls == "smooth" else 0
    along = along[(along >= opening.first * k - slack) & (along < end + slack)]
    images = np.meshgrid(*map(np.arange, open_.shape), indexing="ij")
    rows, columns = (border(image, opening.side)[along] for image in images)
    return rows, columns


def _connected_cells(kind_u: NDArray[np.int8], kind_v: NDArray[np.int8]) -> Bools:
    """Cells (h, w) connected to an opening: ponds have no flow and no defined pressure. In a closed box all cells."""
    h, w = kind_v.shape[0] - 1, kind_u.shape[1] - 1
    cell = np.arange(h * w).reshape(h, w)
    right, down = kind_u[:, 1:-1] != WALL, kind_v[1:-1] != WALL
    one = np.concatenate([cell[:, :-1][right], cell[:-1][down]])
    two = np.concatenate([cell[:, 1:][right], cell[1:][down]])
    labels = components(one, two, cell.size).reshape(h, w)
    at_openings = np.concatenate(
        [border(labels, side)[border(kind_u if side in UPRIGHT else kind_v, side) != WALL] for side in SIDES]
    )
    if len(at_openings) == 0:
        at_openings = labels.ravel()[np.concatenate([one, two])]
    return np.isin(labels, at_openings)
