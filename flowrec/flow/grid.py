"""The staggered (MAC) grid: which faces move, how they are numbered, and the way back to pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from flowrec.chip.chip import Chip, Kind, Side
from flowrec.errors import FlowError
from flowrec.flow.outline import outline

WALL, OPEN, OUTLET, INLET = range(4)  # kinds of a face
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Mouth:
    """An opening on the subcells: its faces on the border, in order along the side."""

    side: Side
    kind: Kind
    faces: Ints  # (m,) numbers of moving faces
    inward: float  # sign of the face velocity that points into the chip
    profile: Floats  # (m,) parabola whose flux is that of speed 1 over the opening's pixels
    vertices: tuple[Ints, Ints]  # rows and columns of the m + 1 ends of the faces


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """Cells of k x k a pixel. u lives on vertical faces (h, w + 1), v on horizontal ones (h + 1, w), p in cells.

    Only faces through which fluid can move are numbered, u first; -1 elsewhere.
    """

    k: int
    fluid: NDArray[np.bool_]  # (h, w) subcells connected to an opening
    kind_u: NDArray[np.int8]
    kind_v: NDArray[np.int8]
    number_u: Ints
    number_v: Ints
    number_p: Ints  # (h, w)
    faces: int
    cells: int
    mouths: tuple[Mouth, ...]
    distance: Floats | None  # as in Outline
    mask: NDArray[np.bool_]  # the chip's pixels

    def velocity(self, moving: Floats) -> Floats:
        """Pixel averages (..., h, w, 2) of face velocities (..., faces): zero in solid."""
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


def parabola(faces: int) -> Floats:
    """Face averages (faces,) of the parabola of mean 1 between walls at both ends."""
    edge = np.linspace(0.0, 1.0, faces + 1)
    return np.asarray(faces * np.diff(3.0 * edge**2 - 2.0 * edge**3), np.float64)


def build(chip: Chip, k: int) -> Grid:
    """Number the faces and cells of a chip.

    Raises
    ------
    FlowError
        If an opening has no fluid behind it.
    """
    drawn = outline(chip.mask, k, chip.walls)
    spans = [_span(chip, drawn.fluid, k, index) for index in range(len(chip.openings))]
    fluid = _fed(drawn.fluid, [span for span, _ in spans])
    h, w = fluid.shape
    kind_u, kind_v = np.zeros((h, w + 1), np.int8), np.zeros((h + 1, w), np.int8)
    kind_u[:, 1:-1] = np.where(fluid[:, 1:] & fluid[:, :-1], OPEN, WALL)
    kind_v[1:-1] = np.where(fluid[1:] & fluid[:-1], OPEN, WALL)
    for opening, (_, at) in zip(chip.openings, spans, strict=True):
        kinds = kind_u if opening.side in ("left", "right") else kind_v
        kinds[at] = INLET if opening.kind == "inlet" else OUTLET
    number_u, u_faces = _numbered(kind_u != WALL, 0)
    number_v, faces = _numbered(kind_v != WALL, u_faces)
    number_p, cells = _numbered(fluid, 0)
    mouths = []
    for opening, (_, (rows, columns)) in zip(chip.openings, spans, strict=True):
        upright = opening.side in ("left", "right")
        ends = [np.append(rows, rows[-1] + upright), np.append(columns, columns[-1] + (not upright))]
        mouths.append(
            Mouth(
                opening.side,
                opening.kind,
                (number_u if upright else number_v)[rows, columns],
                1.0 if opening.side in ("left", "top") else -1.0,
                # The flux is that of the named pixels, however wide a smooth outline makes the opening.
                parabola(len(rows)) * (opening.width_px * k / len(rows)),
                (ends[0], ends[1]),
            )
        )
    return Grid(
        k, fluid, kind_u, kind_v, number_u, number_v, number_p, faces, cells, tuple(mouths), drawn.distance, chip.mask
    )


def _numbered(where: NDArray[np.bool_], start: int) -> tuple[Ints, int]:
    """Consecutive numbers from `start` where true, -1 elsewhere, and the next free one."""
    count = int(np.count_nonzero(where))
    numbers = np.full(where.shape, -1, np.int64)
    numbers[where] = np.arange(start, start + count)
    return numbers, start + count


def _span(chip: Chip, fluid: NDArray[np.bool_], k: int, index: int) -> tuple[tuple[Ints, Ints], tuple[Ints, Ints]]:
    """Border cells of opening `index` and the indices of their border faces, as (rows, columns) each."""
    opening = chip.openings[index]
    h, w = fluid.shape
    drawn, line = (
        {"left": cells[:, 0], "right": cells[:, -1], "top": cells[0], "bottom": cells[-1]}[opening.side]
        for cells in (chip.mask, fluid)
    )
    # A smooth outline may lie up to half a pixel outside the pixels that the opening names.
    slack = k // 2 if chip.walls == "smooth" else 0
    low, high = max(opening.first * k - slack, 0), min((opening.last + 1) * k + slack, len(line))
    along = low + np.flatnonzero(line[low:high])
    named = drawn[max(opening.first, 0) : opening.last + 1]
    broken = len(along) == 0 or along[-1] - along[0] + 1 != len(along)
    if broken or len(named) != opening.width_px or not named.all():
        raise FlowError(
            f"opening {index} ({opening.side} {opening.first}..{opening.last}) of chip '{chip.name}' is not one run "
            f"of fluid (k={k}, walls={chip.walls}): correct its pixels, or try walls='pixel'"
        )
    still = np.zeros_like(along)
    if opening.side == "left":
        return (along, still), (along, still)
    if opening.side == "right":
        return (along, still + w - 1), (along, still + w)
    if opening.side == "top":
        return (still, along), (still, along)
    return (still + h - 1, along), (still + h, along)


def _fed(fluid: NDArray[np.bool_], spans: list[tuple[Ints, Ints]]) -> NDArray[np.bool_]:
    """The fluid that an opening reaches; ponds have no flow and no defined pressure."""
    labels, _ = label(fluid)
    return np.isin(labels, np.concatenate([labels[span] for span in spans]))
