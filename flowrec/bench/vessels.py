"""Random vessel networks with a true and an assumed flow, in the format of a vessel case (`chip/io.py`).

The true flow is computed by flowrec's own solver, on a finer grid. The cases therefore measure a refinement, not the
solver.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.ndimage import binary_dilation, binary_erosion, gaussian_filter, label
from scipy.sparse.csgraph import dijkstra

from flowrec.bench.vessel_truth import NOISES, SHARES
from flowrec.core import Bools, Floats, FlowrecError, Ints
from flowrec.physics import (
    Chip,
    FlowSolver,
    Opening,
    Walls,
    border,
    draw_channel,
    find_openings,
    run_around,
    smooth_curve,
)

SIDE_PX = 128
Mask = Bools


def photograph(mask: Mask, blur_px: float = 1.0, finer: int = 1) -> NDArray[np.uint8]:
    """A picture (h, w) of dark channels: out of focus, lit from one side, with 1 % noise; one mask has one picture.

    The mask has `finer` pixels per pixel side of the picture.
    """
    rng = np.random.default_rng(zlib.crc32(mask.tobytes()))
    each = 4 if finer == 1 else 1  # subpixels that a pixel of the mask is cut into
    fine, beyond = each * finer, 8  # subpixels, and pixels beyond the border over which channels go on
    drawn = np.pad(mask, beyond * finer, mode="edge").repeat(each, axis=0).repeat(each, axis=1).astype(np.float64)
    drawn = gaussian_filter(drawn, fine * blur_px)
    h, w = (size // fine for size in drawn.shape)
    seen = drawn.reshape(h, fine, w, fine).mean(axis=(1, 3))[beyond:-beyond, beyond:-beyond]
    y, x = np.mgrid[: seen.shape[0], : seen.shape[1]] / max(seen.shape)
    angle = rng.uniform(0.0, 2.0 * np.pi)
    light = (0.65 - 0.3 * seen) * (1.0 + 0.15 * (np.cos(angle) * x + np.sin(angle) * y))
    return np.asarray(np.clip(255.0 * (light + rng.normal(0.0, 0.01, seen.shape)), 0, 255), np.uint8)


def threshold_by_otsu(picture: NDArray[np.uint8]) -> Mask:
    """The mask that one threshold for the whole picture gives."""
    smooth = cv2.GaussianBlur(picture, (0, 0), 0.7)
    return _largest(cv2.threshold(smooth, 0, 1, cv2.THRESH_BINARY_INV + cv2.THRESH_OTSU)[1].astype(bool))


def threshold_by_neighbours(picture: NDArray[np.uint8]) -> Mask:
    """The mask of the pixels that are darker than the 31 x 31 pixels around them."""
    smooth = cv2.GaussianBlur(picture, (0, 0), 0.7)
    kind = cv2.ADAPTIVE_THRESH_MEAN_C
    return _largest(cv2.adaptiveThreshold(smooth, 1, kind, cv2.THRESH_BINARY_INV, 31, 3).astype(bool))


# A mask whose walls are drawn one pixel off, or that of a picture, by name.
MASK_ERRORS: dict[str, Callable[[Mask], Mask]] = {
    "right": lambda mask: mask,
    "grown": binary_dilation,
    "shrunk": lambda mask: binary_erosion(mask, border_value=1),
    "shifted": lambda mask: np.concatenate([mask[:, :1], mask[:, :-1]], axis=1),
    "otsu": lambda mask: threshold_by_otsu(photograph(mask)),
    "adaptive": lambda mask: threshold_by_neighbours(photograph(mask)),
}
_LONGEST_ROUTE_PX = 160
_LETTER = {"left": "W", "right": "E", "top": "S", "bottom": "N"}


def draw_mask(rng: np.random.Generator, side_px: int = SIDE_PX) -> Mask:
    """Draw a vessel tree with some loops: a trunk from border to border, then branches that start on a vessel."""
    gap = np.full((side_px, side_px), np.inf)

    def border_point() -> Floats:
        place = rng.uniform(0.1, 0.9) * side_px
        beyond = 10.0
        return np.array(
            [(-beyond, place), (side_px + beyond, place), (place, -beyond), (place, side_px + beyond)][rng.integers(4)]
        )

    def draw(a: Floats, b: Floats, width: float) -> Floats:
        t = np.linspace(0.0, 1.0, 5)[:, None]
        along = b - a
        across = np.array([-along[1], along[0]])
        sway = rng.normal(0.0, 0.07, 5)
        sway[[0, -1]] = 0.0
        curve = smooth_curve(a + t * along + sway[:, None] * across, 10)
        draw_channel(gap, curve, width)
        return curve

    trunk = draw(border_point(), border_point(), float(rng.uniform(7.0, 15.0)))
    curves = [trunk]
    for _ in range(int(rng.integers(2, 6))):
        parent = curves[rng.integers(len(curves))]
        inside = parent[(parent > 8).all(axis=1) & (parent < side_px - 8).all(axis=1)]
        if len(inside) == 0:
            continue
        start = inside[rng.integers(len(inside))]
        if rng.random() < 0.2:  # a loop connects two vessels
            other = curves[rng.integers(len(curves))]
            end = other[rng.integers(len(other))]
        else:
            end = border_point()
        if np.hypot(*(end - start)) > 25.0:
            curves.append(draw(start, end, float(rng.uniform(3.0, 9.0))))
    return gap <= 0.0


def make_case(mask: Mask, rng: np.random.Generator, truth_k: int = 4) -> dict[str, Any] | None:
    """The arrays of a vessel case by key, in SI units; None if the mask does not suit.

    The assumed inlet speeds differ from the true ones by up to 30 %, the viscosity by up to 70 %, the density by up to
    a factor of two. Outlets are assumed at 0 Pa; their true pressures are up to a tenth of the pressure drop.
    """
    mask = _largest(mask)
    openings = list(find_openings(mask))
    if not 1000 <= mask.sum() <= 2800 or not 3 <= len(openings) <= 7:
        return None
    mask = _without_grazed(mask, openings)
    skeleton = thin(mask)
    route = _route(skeleton, openings, rng)
    if route is None:
        return None
    inlets = rng.permutation(len(openings))[: int(rng.integers(1, min(len(openings), 4)))]
    px = float(rng.choice([1e-5, 1e-4, 2e-4]))
    mu, rho = float(rng.uniform(8e-4, 4e-3)), float(rng.uniform(950.0, 1100.0))
    reynolds = float(np.exp(rng.uniform(np.log(0.01), np.log(15.0))))
    width = max(openings[i].width_px for i in inlets)
    speed = reynolds * mu / (rho * width * px)
    true_u = np.full(len(openings), np.nan)
    true_u[inlets] = speed * rng.uniform(0.8, 1.2, len(inlets))

    def chip(u: Floats, p: Floats) -> Chip:
        made = tuple(
            replace(o, kind="inlet", value=float(u[i] * 1e6)) if i in inlets else replace(o, value=float(p[i]))
            for i, o in enumerate(openings)
        )
        return Chip("made-up", mask, px * 1e6, made, mu * 1e3, rho, walls="pixel")

    outlet = np.isnan(true_u)
    try:
        drop = float(np.abs(FlowSolver(1).solve(chip(true_u, np.zeros(len(openings)))).pressure_pa).max())
        true_p = np.where(outlet, rng.uniform(0.0, 0.1, len(openings)) * drop, np.nan)
        field = FlowSolver(truth_k).solve(chip(true_u, true_p))
    except FlowrecError:
        return None
    velocity = field.velocity_um_s.astype(np.float64) * 1e-6
    case: dict[str, Any] = {
        "mask": mask,
        "vx": velocity[..., 0],
        "vy": velocity[..., 1],
        "p": field.pressure_pa.astype(np.float64),
        "px": px,
        "rho": rho,
        "mu": mu,
        "nu": mu / rho,
        "rho_assumed": rho / float(rng.uniform(0.5, 2.0)),
        "mu_assumed": mu / float(rng.uniform(0.6, 1.7)),
        "op_side": np.array([_LETTER[o.side] for o in openings]),
        "op_a": np.array([o.first for o in openings]),
        "op_b": np.array([o.last for o in openings]),
        "op_type": np.where(outlet, "outlet", "inlet"),
        "op_u_true": true_u,
        "op_u_assumed": true_u * rng.uniform(0.7, 1.3, len(openings)),
        "op_p_true": true_p,
        "op_p_assumed": np.where(outlet, 0.0, np.nan),
        "skeleton": skeleton,
    }
    return case | _route_observations(velocity, route, int(skeleton.sum()), rng)


def _route_observations(velocity: Floats, route: Ints, skeleton_px: int, rng: np.random.Generator) -> dict[str, Any]:
    """Noisy velocities on the pixels of a route (n, 2), and the indices that are observed, by key of a vessel case."""
    on_way = velocity[route[:, 0], route[:, 1]]
    rms = float(np.sqrt((on_way**2).sum(axis=1).mean()))
    case: dict[str, Any] = {
        "route_ij": route.astype(np.int16),
        "route_v_sigma": np.array([noise * rms for noise in NOISES.values()]),
    }
    for name, noise in NOISES.items():
        case[f"route_v_n{name}"] = on_way + noise * rms * rng.standard_normal(on_way.shape)
    for name, share in SHARES.items():
        observed = min(max(round(share * skeleton_px), 1), len(route))
        case[f"obs_idx_{name}"] = np.unique(np.linspace(0, len(route) - 1, observed).round().astype(np.int64))
    return case


def with_mask_error(chip: Chip, error: str) -> Chip:
    """The chip as drawn with one of MASK_ERRORS; its openings move to where the border of the new mask is open.

    Walls of a picture are smooth, as those of any mask that a user brings.
    """
    mask = MASK_ERRORS[error](chip.mask)
    openings = []
    for opening in chip.openings:
        middle = (opening.first + opening.last + (error == "shifted" and opening.side in ("top", "bottom"))) // 2
        # A closed opening stays one solid pixel wide; the solver refuses it by name.
        first, last = run_around(border(mask, opening.side), middle) or (middle, middle)
        openings.append(replace(opening, first=first, last=last))
    walls: Walls = "smooth" if error in ("otsu", "adaptive") else chip.walls
    return replace(chip, mask=mask, openings=tuple(openings), walls=walls)


def thin(mask: Mask) -> Mask:
    """The skeleton of a mask, one pixel wide. Source: Zhang and Suen (1984)."""
    image = np.pad(mask, 1)
    while True:
        before = int(image.sum())
        for first in (True, False):
            n = [
                image[1 + dy : image.shape[0] - 1 + dy, 1 + dx : image.shape[1] - 1 + dx].astype(np.int8)
                for dy, dx in ((-1, 0), (-1, 1), (0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1))
            ]
            count = sum(n)
            turns = sum((n[i] == 0) & (n[(i + 1) % 8] == 1) for i in range(8))
            a, b = (n[0] * n[2] * n[4], n[2] * n[4] * n[6]) if first else (n[0] * n[2] * n[6], n[0] * n[4] * n[6])
            image[1:-1, 1:-1] &= ~((count >= 2) & (count <= 6) & (turns == 1) & (a == 0) & (b == 0))
        if int(image.sum()) == before:
            return image[1:-1, 1:-1]


def _largest(mask: Mask) -> Mask:
    labels, count = label(mask)
    return mask if count < 2 else np.asarray(labels == 1 + int(np.argmax(np.bincount(labels.ravel())[1:])))


def _without_grazed(mask: Mask, openings: list[Opening]) -> Mask:
    """The mask with a wall along the border except at openings, for channels that only graze the border."""
    kept = np.zeros_like(mask)
    for o in openings:
        border(kept, o.side)[o.first : o.last + 1] = True  # a view
    closed = mask.copy()
    edge = np.ones_like(mask)
    edge[1:-1, 1:-1] = False
    closed &= kept | ~edge
    return _largest(closed)


def _route(skeleton: Mask, openings: list[Opening], rng: np.random.Generator) -> Ints | None:
    """(n, 2) rows and columns of the shortest path along the skeleton between two random openings; None if short."""
    rows, columns = np.nonzero(skeleton)
    if len(rows) < 60:
        return None
    number = np.full(skeleton.shape, -1)
    number[rows, columns] = np.arange(len(rows))
    padded = np.pad(number, 1, constant_values=-1)
    parts = []
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        other = padded[rows + 1 + dy, columns + 1 + dx]
        here = np.flatnonzero(other >= 0)
        parts.append((here, other[here], np.full(len(here), np.hypot(dy, dx))))
    a, b, cost = (np.concatenate(part) for part in zip(*parts, strict=True))
    graph = sparse.coo_array((cost, (a, b)), shape=(len(rows), len(rows))).tocsr()
    start, end = (int(i) for i in rng.choice(len(openings), 2, replace=False))

    def nearest(opening: Opening) -> int:
        middle = 0.5 * (opening.first + opening.last)
        far = {"left": 0, "top": 0, "right": skeleton.shape[1] - 1, "bottom": skeleton.shape[0] - 1}[opening.side]
        at = (middle, far) if opening.side in ("left", "right") else (far, middle)
        return int(np.argmin(np.hypot(rows - at[0], columns - at[1])))

    source, goal = nearest(openings[start]), nearest(openings[end])
    distance, before = dijkstra(graph, directed=False, indices=source, return_predecessors=True)
    if not np.isfinite(distance[goal]):
        return None
    way = [goal]
    while way[-1] != source:
        way.append(int(before[way[-1]]))
    way = way[::-1][:_LONGEST_ROUTE_PX]
    return np.column_stack([rows[way], columns[way]]) if len(way) >= 60 else None
