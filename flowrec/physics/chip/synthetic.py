"""Synthetic chips: a straight channel, the paper's kind of bifurcation, and another vessel network for every seed.

A channel is a centreline with a width; a pixel is fluid if its centre lies within.

Vessels are a jittered lattice of junctions. Edges are removed at random as long as all junctions stay connected and
none becomes a dead end, so that what is left has loops. One inlet is on the left, two outlets are on the right, and one
is on top or below. The inlet speed is such that a robot of 600 um/s can hold its place in every branch.
"""

from __future__ import annotations

import functools
import itertools
import math

import numpy as np
import scipy  # its ndimage and sparse load at first use, not at start-up
from numpy.typing import ArrayLike

from flowrec.core import Bools, ChipError, Floats
from flowrec.physics.chip.chip import WATER_KG_M3, WATER_MPA_S, Chip
from flowrec.physics.chip.openings import find_openings, guess_inlets, set_inlet_speed

_UM_PER_PX = 20.0
_HEIGHT, _WIDTH = 256, 320  # of the vessels
_ROWS, _COLUMNS = 3, 4  # of their junctions
_PEAK_UM_S = 400.0  # in the fastest branch, by the resistance network; bends and junctions add to it
_KEPT = 8  # networks, whose drawing takes a tenth of a second
_Edge = tuple[int, int]


def smooth_curve(points: ArrayLike, steps: int = 24) -> Floats:
    """A Catmull-Rom curve (n, 2) through points (m, 2), with `steps` points from one to the next."""
    given = np.asarray(points, np.float64)
    p = np.concatenate((2 * given[:1] - given[1:2], given, 2 * given[-1:] - given[-2:-1]))
    t = np.linspace(0.0, 1.0, steps, endpoint=False)[:, None]
    pieces = [
        0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)
        for a, b, c, d in zip(p[:-3], p[1:-2], p[2:-1], p[3:], strict=True)
    ]
    return np.concatenate((*pieces, given[-1:]))


def draw_channel(gap: Floats, curve: Floats, width: float) -> None:
    """Lower `gap` (h, w), the distance of pixel centres to the nearest channel (negative inside), to this channel's.

    Curve (n, 2) and width in pixels. Only pixels within the channel and a little around it are touched.
    """
    height, breadth = gap.shape
    reach = 0.5 * width + 3.0
    for (ax, ay), (bx, by) in zip(curve[:-1].tolist(), curve[1:].tolist(), strict=True):
        left, right = max(math.floor(min(ax, bx) - reach), 0), min(math.ceil(max(ax, bx) + reach) + 1, breadth)
        top, bottom = max(math.floor(min(ay, by) - reach), 0), min(math.ceil(max(ay, by) + reach) + 1, height)
        if left >= right or top >= bottom:
            continue
        x, y = np.meshgrid(np.arange(left, right) - ax, np.arange(top, bottom) - ay)
        dx, dy = bx - ax, by - ay
        along = np.clip((x * dx + y * dy) / max(dx * dx + dy * dy, 1e-12), 0.0, 1.0)
        window = gap[top:bottom, left:right]
        np.minimum(window, np.hypot(x - along * dx, y - along * dy) - 0.5 * width, out=window)


def straight() -> Chip:
    """5.12 mm of a channel 0.4 mm wide: Poiseuille flow, mean 200 um/s, so 300 um/s in the middle."""
    mask = np.zeros((64, 256), np.bool_)
    mask[22:42] = True
    return _chip("straight", mask, 200.0)


@functools.cache
def bifurcation() -> Chip:
    """6.4 x 5.12 mm: the inlet on the left splits into a short fast and a long slow branch that meet again.

    In a plane channel the mean speed goes as width^2 / length at a given pressure drop. So the short lower branch
    (4.5 mm, 0.29 mm wide) is about two and a half times faster than the long upper one (5.6 mm, 0.20 mm wide, the
    narrowest). For a robot of radius 50 um and v_max = 600 um/s the middle of the short branch runs at three
    quarters of v_max: downstream the short branch saves 2.7 s of 9, upstream the long one saves 3 s of 19, and the
    robot can hold its place everywhere, also where the true inflow is a fifth faster.
    """
    middle = 2.7  # mm from the top: height of inlet and outlet
    left, right, bottom, top = 1.1, 5.3, 3.4, 1.2
    short = [(left, middle), (1.85, 3.085), (2.5, 3.365), (3.2, bottom), (3.9, 3.365), (4.55, 3.085), (right, middle)]
    long = [(left, middle), (1.4, 2.15), (2.1, 1.4), (3.2, top), (4.3, 1.4), (5.0, 2.15), (right, middle)]
    ends = [(-1.0, middle), (left, middle)], [(right, middle), (7.4, middle)]
    gap = np.full((256, 320), np.inf)
    for points, width_mm in ((ends[0], 0.5), (ends[1], 0.5), (short, 0.29), (long, 0.2)):
        draw_channel(gap, smooth_curve(np.asarray(points) * 1e3 / _UM_PER_PX), width_mm * 1e3 / _UM_PER_PX)
    return _chip("bifurcation", gap <= 0, 220.0)


@functools.lru_cache(_KEPT)
def vessels(seed: int) -> Chip:
    """The chip of a seed, (256, 320) pixels of 20 um, channels 0.16 to 0.4 mm wide."""
    rng = np.random.default_rng([seed, 0x7E55E1] if seed >= 0 else [-seed, 1, 0x7E55E1])
    for _ in range(200):
        chip = _attempt(rng, f"vessels-{seed}")
        if chip is not None:
            return chip
    raise ChipError(f"vessels: no valid network from seed {seed}; choose another seed")


def _attempt(rng: np.random.Generator, name: str) -> Chip | None:
    """One drawing; None if channels have merged or a branch has no flow."""
    nodes = _junctions(rng)
    edges = _thin_out(rng, len(nodes))
    count = len(nodes)
    # Openings as further nodes beyond the border, each tied to one junction.
    right = rng.choice(_ROWS, 2, replace=False)
    top = bool(rng.random() < 0.5)
    across = 1 + int(rng.integers(_COLUMNS - 2))
    ends = [(-12.0, nodes[(_ROWS // 2) * _COLUMNS, 1] + rng.uniform(-20, 20))]
    edges.append(((_ROWS // 2) * _COLUMNS, count))
    for row in sorted(right.tolist()):
        junction = row * _COLUMNS + _COLUMNS - 1
        edges.append((junction, count + len(ends)))
        ends.append((_WIDTH + 12.0, nodes[junction, 1] + rng.uniform(-12, 12)))
    junction = across if top else (_ROWS - 1) * _COLUMNS + across
    edges.append((junction, count + len(ends)))
    ends.append((nodes[junction, 0] + rng.uniform(-12, 12), -12.0 if top else _HEIGHT + 12.0))
    points = np.concatenate((nodes, ends))

    chains = _chains(edges, len(points))
    curves = [_wander(rng, points[chain]) for chain in chains]
    widths = [float(rng.uniform(8.0, 14.0)) for _ in chains]
    for k, chain in enumerate(chains):
        if count in chain:
            widths[k] = 20.0
        elif max(chain) > count:
            widths[k] = max(widths[k], 11.0)

    gap = np.full((_HEIGHT, _WIDTH), np.inf)
    for curve, width in zip(curves, widths, strict=True):
        draw_channel(gap, curve, width)
    mask = gap <= 0
    loops = len(edges) - len(points) + 1  # of a connected graph
    inlet_speed = _inlet_speed([(chain[0], chain[-1]) for chain in chains], curves, widths, count)
    if inlet_speed is None or not _as_drawn(mask, loops, "top" if top else "bottom"):
        return None
    return _chip(name, mask, inlet_speed)


def _junctions(rng: np.random.Generator) -> Floats:
    """(rows * columns, 2) points in pixels."""
    x = np.linspace(0.2, 0.8, _COLUMNS) * _WIDTH
    y = np.linspace(0.2, 0.8, _ROWS) * _HEIGHT
    lattice = np.stack(np.meshgrid(x, y), -1)
    lattice[:, ::2, 1] += 9.0  # shifted columns: fewer right angles
    lattice[:, 1::2, 1] -= 9.0
    return lattice.reshape(-1, 2) + rng.uniform(-13, 13, (_ROWS * _COLUMNS, 2))


def _thin_out(rng: np.random.Generator, count: int) -> list[_Edge]:
    """Lattice edges left after random removal; all junctions stay connected and none is a dead end."""
    lattice = [(k, k + 1) for k in range(count) if (k + 1) % _COLUMNS]
    lattice += [(k, k + _COLUMNS) for k in range(count - _COLUMNS)]
    edges = lattice
    wanted = int(rng.integers(2, 5))  # independent loops
    for k in rng.permutation(len(lattice)).tolist():
        if len(edges) - count + 1 <= wanted:
            break
        fewer = [edge for edge in edges if edge != lattice[k]]
        degree = np.bincount(np.ravel(fewer), minlength=count)
        graph = scipy.sparse.coo_array((np.ones(len(fewer)), np.transpose(fewer)), shape=(count, count))
        if degree.min() >= 2 and scipy.sparse.csgraph.connected_components(graph, directed=False)[0] == 1:
            edges = fewer
    return edges


def _chains(edges: list[_Edge], count: int) -> list[list[int]]:
    """Nodes of each branch from one fork or opening to the next; nodes of two edges lie within a branch."""
    around: list[list[int]] = [[] for _ in range(count)]
    for a, b in edges:
        around[a].append(b)
        around[b].append(a)
    chains = []
    for fork in (k for k in range(count) if len(around[k]) != 2):
        for second in around[fork]:
            chain = [fork, second]
            while len(around[chain[-1]]) == 2:
                one, other = around[chain[-1]]
                chain.append(other if one == chain[-2] else one)
            # Each branch is found from both of its ends; one around the fork itself from either direction.
            if (chain[0], chain[1]) <= (chain[-1], chain[-2]):
                chains.append(chain)
    return chains


def _wander(rng: np.random.Generator, corners: Floats) -> Floats:
    """A smooth curve through points (n, 2) that bends to either side between them, as real vessels do."""
    points = [corners[0]]
    for a, b in itertools.pairwise(corners):
        step = b - a
        bend = float(rng.uniform(-0.14, 0.14))
        normal = np.array([-step[1], step[0]])
        points += [a + step / 2 + bend * normal, b]
    return smooth_curve(points, 16)


def _as_drawn(mask: Bools, loops: int, fourth_side: str) -> bool:
    """True if the mask has one piece, the openings and the islands that were drawn: no channels have merged."""
    if [opening.side for opening in find_openings(mask)] != ["left", "right", "right", fourth_side]:
        return False
    _, pieces = scipy.ndimage.label(mask)
    # Fluid connects through sides, so solid does through corners. Islands are what solid does not reach the border.
    solid, _ = scipy.ndimage.label(~mask, np.ones((3, 3)))
    edge = np.concatenate((solid[0], solid[-1], solid[:, 0], solid[:, -1]))
    islands = np.setdiff1d(np.unique(solid[~mask]), edge)
    sizes = np.bincount(solid.ravel())[islands]
    return bool(pieces == 1 and len(islands) == loops and (sizes > 150).all())


def _inlet_speed(ends: list[_Edge], curves: list[Floats], widths: list[float], inlet: int) -> float | None:
    """Mean inlet speed in um/s at which the fastest branch peaks at the wanted speed; None if a branch has no flow.

    Plane Poiseuille flow in each branch, q = w^3 dp / (12 mu L), as a network: G p = q, with p = 0 at the outlets,
    which are the nodes after the inlet.
    """
    length = np.array([np.hypot(*np.diff(curve, axis=0).T).sum() for curve in curves])
    width = np.asarray(widths)
    conductance = width**3 / length
    first, second = np.transpose(ends)[:, :, None]
    nodes = np.unique(ends)
    nodes = nodes[nodes <= inlet]
    incidence = (first == nodes).astype(np.float64) - (second == nodes)
    pressure = np.linalg.solve(incidence.T @ (conductance[:, None] * incidence), (nodes == inlet).astype(np.float64))
    peak = 1.5 * np.abs(incidence @ pressure) * conductance / width
    if peak.min() < 0.03 * peak.max():
        return None
    of_inlet = width[(np.asarray(ends) == inlet).any(axis=1)][0]
    return round(_PEAK_UM_S / float(of_inlet * peak.max()), 1)


def _chip(name: str, mask: Bools, inlet_speed_um_s: float) -> Chip:
    """A chip of water with the default openings; the mask becomes read-only."""
    mask.flags.writeable = False
    openings = set_inlet_speed(guess_inlets(find_openings(mask)), inlet_speed_um_s)
    return Chip(name, mask, _UM_PER_PX, openings, WATER_MPA_S, WATER_KG_M3)
