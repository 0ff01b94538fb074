"""The staggered (MAC) grid: which faces move, how they are numbered, and the way back to pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from flowrec.chip.chip import Chip, Kind, Side
from flowrec.errors import FlowError
from flowrec.flow.level_set import Outline, outline

WALL, OPEN, OUTLET, INLET = range(4)  # kinds of a face

# A face of which less is open counts as shut: what passes there is this share squared of a whole face's flux.
SHUT = 0.02

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Mouth:
    """An opening on the subcells: its faces on the border, in order along the side."""

    side: Side
    kind: Kind
    faces: Ints  # (m,) numbers of moving faces
    inward: float  # sign of the face velocity that points into the chip
    profile: Floats  # (m,) fluxes of the parabola whose sum is that of speed 1 over the opening's pixels
    vertices: tuple[Ints, Ints]  # rows and columns of the m + 1 ends of the faces


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """Cells of k x k a pixel. u lives on vertical faces (h, w + 1), v on horizontal ones (h + 1, w), p in cells.

    Walls cut faces: fluid moves through a share of them. What is solved for is the flux of each face over the side
    of a cell, its velocity times its share, so that the fluxes of the four sides of any cell add up to nothing.
    Only faces through which fluid can move are numbered, u first; -1 elsewhere.
    """

    k: int
    fluid: NDArray[np.bool_]  # (h, w) subcells, whole or cut, that fluid from an opening can enter
    kind_u: NDArray[np.int8]
    kind_v: NDArray[np.int8]
    number_u: Ints
    number_v: Ints
    number_p: Ints  # (h, w)
    faces: int
    cells: int
    mouths: tuple[Mouth, ...]
    ends_u: tuple[Floats, Floats]  # (h, w + 1) each: where the fluid part of a face begins and ends, 0 to 1
    ends_v: tuple[Floats, Floats]  # (h + 1, w)
    level: Floats  # as in Outline
    stepped: bool
    mask: NDArray[np.bool_]  # the chip's pixels

    @property
    def share(self) -> Floats:
        """(faces,) the part of each face that is fluid."""
        share = np.empty(self.faces)
        for number, (low, high) in ((self.number_u, self.ends_u), (self.number_v, self.ends_v)):
            open_ = number >= 0
            share[number[open_]] = (high - low)[open_]
        return share

    def velocity(self, moving: Floats) -> Floats:
        """Pixel averages (..., h, w, 2) of velocity from fluxes (..., faces): zero in solid."""
        lead = moving.shape[:-1]
        padded = np.concatenate([moving, np.zeros((*lead, 1))], axis=-1)
        u, v = padded[..., self.number_u], padded[..., self.number_v]
        cells = np.stack(
            [0.5 * (u[..., :, 1:] + u[..., :, :-1]), 0.5 * (v[..., 1:, :] + v[..., :-1, :])],
            axis=-1,
        )
        return np.asarray(self._blocks(cells).mean(axis=(-4, -2)) * self.mask[..., None])

    def pressure(self, cells: Floats) -> Floats:
        """Averages (..., h, w) over the fluid subcells of each pixel of cell values (..., cells): zero in solid."""
        padded = np.concatenate([cells, np.zeros((*cells.shape[:-1], 1))], axis=-1)
        total = self._blocks(padded[..., self.number_p][..., None]).sum(axis=(-4, -2))[..., 0]
        count = self._blocks(self.fluid[..., None]).sum(axis=(-4, -2))[..., 0]
        return np.asarray(total / np.maximum(count, 1) * self.mask)

    def _blocks(self, cells: NDArray[np.generic]) -> NDArray[np.float64]:
        """(..., h k, w k, c) as (..., h, k, w, k, c)."""
        *lead, h, w, channels = cells.shape
        return cells.reshape(*lead, h // self.k, self.k, w // self.k, self.k, channels).astype(np.float64)


def parabola(low: Floats, high: Floats) -> Floats:
    """Fluxes (m,) through faces from low to high along an opening, of the parabola of mean 1 between its walls."""
    first, last = low[0], high[-1]
    a, b = (low - first) / (last - first), (high - first) / (last - first)
    return np.asarray((last - first) * ((3.0 * b**2 - 2.0 * b**3) - (3.0 * a**2 - 2.0 * a**3)), np.float64)


def build(chip: Chip, k: int, drawn: Outline | None = None) -> Grid:
    """Number the faces and cells of a chip; its walls are those of an outline, where one is given.

    Raises
    ------
    FlowError
        If an opening has no fluid behind it.
    """
    drawn = outline(chip.mask, k, chip.walls) if drawn is None else drawn
    h, w = drawn.shape
    level = drawn.level
    ends_u, ends_v = _ends(level), _ends(level.T)
    ends_v = (ends_v[0].T, ends_v[1].T)
    open_u, open_v = (high - low >= SHUT for low, high in (ends_u, ends_v))
    apart = _parted(level)
    open_u[:, 1:] &= ~apart
    open_u[:, :-1] &= ~apart
    open_v[1:] &= ~apart
    open_v[:-1] &= ~apart
    spans = [_span(chip, level, open_u, open_v, k, index) for index in range(len(chip.openings))]
    kind_u, kind_v = np.zeros((h, w + 1), np.int8), np.zeros((h + 1, w), np.int8)
    kind_u[:, 1:-1] = np.where(open_u[:, 1:-1], OPEN, WALL)
    kind_v[1:-1] = np.where(open_v[1:-1], OPEN, WALL)
    for opening, at in zip(chip.openings, spans, strict=True):
        kinds = kind_u if opening.side in ("left", "right") else kind_v
        kinds[at] = INLET if opening.kind == "inlet" else OUTLET
    fluid = _fed(kind_u, kind_v)
    kind_u[:, 1:][~fluid], kind_u[:, :-1][~fluid] = WALL, WALL
    kind_v[1:][~fluid], kind_v[:-1][~fluid] = WALL, WALL
    number_u, u_faces = _numbered(kind_u != WALL, 0)
    number_v, faces = _numbered(kind_v != WALL, u_faces)
    number_p, cells = _numbered(fluid, 0)
    mouths = []
    for opening, (rows, columns) in zip(chip.openings, spans, strict=True):
        upright = opening.side in ("left", "right")
        ends = [np.append(rows, rows[-1] + upright), np.append(columns, columns[-1] + (not upright))]
        low, high = (np.arange(len(rows)) + end[rows, columns] for end in (ends_u if upright else ends_v))
        profile = parabola(low, high)
        mouths.append(
            Mouth(
                opening.side,
                opening.kind,
                (number_u if upright else number_v)[rows, columns],
                1.0 if opening.side in ("left", "top") else -1.0,
                # The flux is that of the named pixels, however wide a smooth outline makes the opening.
                profile * (opening.width_px * k / profile.sum()),
                (ends[0], ends[1]),
            )
        )
    return Grid(
        k,
        fluid,
        kind_u,
        kind_v,
        number_u,
        number_v,
        number_p,
        faces,
        cells,
        tuple(mouths),
        ends_u,
        ends_v,
        level,
        drawn.stepped,
        chip.mask,
    )


def _ends(level: Floats) -> tuple[Floats, Floats]:
    """Begin and end (h, w + 1) of the fluid part of upright faces, 0 to 1; end <= begin where there is none.

    The level runs straight between the ends of a face and its middle.
    """
    first, middle, last = level[:-1:2, ::2], level[1::2, ::2], level[2::2, ::2]

    def crossing(solid: Floats, fluid: Floats) -> Floats:
        return np.asarray(-solid / np.maximum(fluid - solid, 1e-12))

    wet_first, wet, wet_last = first > 0.0, middle > 0.0, last > 0.0
    low = np.where(wet, 0.5 * crossing(first, middle), 0.5 + 0.5 * crossing(middle, last))
    high = np.where(wet, 1.0 - 0.5 * crossing(last, middle), 0.5 - 0.5 * crossing(middle, first))
    low = np.where(wet_first, 0.0, np.where(wet | wet_last, low, 1.0))
    high = np.where(wet_last, 1.0, np.where(wet | wet_first, high, 0.0))
    split = wet_first & wet_last & ~wet
    return np.where(split, 0.5, low), np.where(split, 0.5, high)


def _parted(level: Floats) -> NDArray[np.bool_]:
    """Cells (h, w) with solid in the middle and separate fluid beside it: nothing may pass through."""
    corner, upright, flat = level[::2, ::2] > 0.0, level[1::2, ::2] > 0.0, level[::2, 1::2] > 0.0
    ring = [corner[:-1, :-1], flat[:-1], corner[:-1, 1:], upright[:, 1:], corner[1:, 1:], flat[1:], corner[1:, :-1]]
    ring.append(upright[:, :-1])
    changes = sum((one != two).astype(np.int64) for one, two in zip(ring, ring[1:] + ring[:1], strict=True))
    return np.asarray((level[1::2, 1::2] <= 0.0) & (changes > 2))


def _numbered(where: NDArray[np.bool_], start: int) -> tuple[Ints, int]:
    """Consecutive numbers from `start` where true, -1 elsewhere, and the next free one."""
    count = int(np.count_nonzero(where))
    numbers = np.full(where.shape, -1, np.int64)
    numbers[where] = np.arange(start, start + count)
    return numbers, start + count


def _span(
    chip: Chip, level: Floats, open_u: NDArray[np.bool_], open_v: NDArray[np.bool_], k: int, index: int
) -> tuple[Ints, Ints]:
    """Rows and columns of the border faces of opening `index`: the run of open ones with most of its pixels."""
    opening = chip.openings[index]
    drawn, line, corner = {
        "left": (chip.mask[:, 0], open_u[:, 0], level[::2, 0]),
        "right": (chip.mask[:, -1], open_u[:, -1], level[::2, -1]),
        "top": (chip.mask[0], open_v[0], level[0, ::2]),
        "bottom": (chip.mask[-1], open_v[-1], level[-1, ::2]),
    }[opening.side]
    named = drawn[max(opening.first, 0) : opening.last + 1]
    # Faces that hang together, numbered by the run they are in.
    run = np.cumsum(~(line & np.append(False, line[:-1] & (corner[1:-1] > 0.0))))
    core = run[max(opening.first, 0) * k : (opening.last + 1) * k]
    core = core[line[max(opening.first, 0) * k : (opening.last + 1) * k]]
    if len(core) == 0 or len(named) != opening.width_px or not named.all():
        raise FlowError(
            f"opening {index} ({opening.side} {opening.first}..{opening.last}) of chip '{chip.name}' is not one run "
            f"of fluid (k={k}, walls={chip.walls}): correct its pixels, or try walls='pixel'"
        )
    along = np.flatnonzero(line & (run == np.bincount(core).argmax()))
    # Fluid that lies beyond the named pixels by more than an outline can stays shut.
    slack = k if chip.walls == "smooth" else 0
    along = along[(along >= opening.first * k - slack) & (along < (opening.last + 1) * k + slack)]
    still = np.zeros_like(along)
    return {
        "left": (along, still),
        "right": (along, still + open_u.shape[1] - 1),
        "top": (still, along),
        "bottom": (still + open_v.shape[0] - 1, along),
    }[opening.side]


def _fed(kind_u: NDArray[np.int8], kind_v: NDArray[np.int8]) -> NDArray[np.bool_]:
    """The cells that an opening reaches; ponds have no flow and no defined pressure. All of them in a closed box."""
    h, w = kind_v.shape[0] - 1, kind_u.shape[1] - 1
    cell = np.arange(h * w).reshape(h, w)
    right, down = kind_u[:, 1:-1] != WALL, kind_v[1:-1] != WALL
    one = np.concatenate([cell[:, :-1][right], cell[:-1][down]])
    two = np.concatenate([cell[:, 1:][right], cell[1:][down]])
    _, labels = connected_components(
        sp.coo_array((np.ones(len(one), bool), (one, two)), shape=(h * w, h * w)), directed=False
    )
    labels = labels.reshape(h, w)
    sides = [
        (kind_u[:, 0], labels[:, 0]),
        (kind_u[:, -1], labels[:, -1]),
        (kind_v[0], labels[0]),
        (kind_v[-1], labels[-1]),
    ]
    fed = np.concatenate([line[kinds != WALL] for kinds, line in sides])
    if len(fed) == 0:
        fed = labels.ravel()[np.concatenate([one, two])]
    return np.isin(labels, fed)
