"""Procedural vessels: another network for every seed, always connected, with loops and several openings.

A jittered lattice of junctions; edges are taken away at random as long as all junctions stay connected and none
becomes a dead end, so that what is left has loops. One inlet on the left, two outlets on the right, and one on top
or below. The inlet speed is set so that no branch is faster than a robot of 600 um/s can hold against.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from flowrec.chip.chip import Chip, Opening
from flowrec.chip.draw import curve_length, draw_channel, smooth_curve
from flowrec.chip.io import WATER_KG_M3, WATER_MPA_S
from flowrec.chip.openings import find_openings, guess_inlets, set_inlet_speed
from flowrec.errors import ChipError

_HEIGHT, _WIDTH, _UM_PER_PX = 256, 320, 20.0
_ROWS, _COLUMNS = 3, 4
_PEAK_UM_S = 400.0  # in the fastest branch, by the resistance network; bends and junctions add to it
_Edge = tuple[int, int]


def vessels(seed: int) -> Chip:
    """The chip of a seed, (256, 320) pixels of 20 um, channels 0.16 to 0.4 mm wide."""
    rng = np.random.default_rng([seed, 0x7E55E1] if seed >= 0 else [-seed, 1, 0x7E55E1])
    for _ in range(200):
        chip = _attempt(rng, f"vessels-{seed}")
        if chip is not None:
            return chip
    raise ChipError(f"vessels: no valid network from seed {seed}; choose another seed")


def _attempt(rng: np.random.Generator, name: str) -> Chip | None:
    """One drawing, or None where channels grew together that should not."""
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
    openings = guess_inlets(find_openings(mask)) if mask.any() else ()
    loops = len(edges) - len(points) + 1  # of a connected graph
    inlet_speed = _inlet_speed([(chain[0], chain[-1]) for chain in chains], curves, widths, count)
    if inlet_speed is None or not _as_drawn(mask, openings, loops, (top, len(ends))):
        return None
    mask.flags.writeable = False
    return Chip(name, mask, _UM_PER_PX, set_inlet_speed(openings, inlet_speed), WATER_MPA_S, WATER_KG_M3)


def _junctions(rng: np.random.Generator) -> NDArray[np.float64]:
    """(rows * columns, 2) points in pixels."""
    x = np.linspace(0.2, 0.8, _COLUMNS) * _WIDTH
    y = np.linspace(0.2, 0.8, _ROWS) * _HEIGHT
    lattice = np.stack(np.meshgrid(x, y), -1)
    lattice[:, ::2, 1] += 9.0  # shifted columns: fewer right angles
    lattice[:, 1::2, 1] -= 9.0
    return lattice.reshape(-1, 2) + rng.uniform(-13, 13, (_ROWS * _COLUMNS, 2))


def _thin_out(rng: np.random.Generator, count: int) -> list[_Edge]:
    """The edges of the lattice less some, all junctions still connected and on a loop or between loops."""
    edges = [(k, k + 1) for k in range(count) if (k + 1) % _COLUMNS] + [
        (k, k + _COLUMNS) for k in range(count - _COLUMNS)
    ]
    everything = list(edges)
    wanted = int(rng.integers(2, 5))  # independent loops
    for k in rng.permutation(len(edges)).tolist():
        if len(edges) - count + 1 <= wanted:
            break
        edge = everything[k]
        fewer = [other for other in edges if other != edge]
        degree = np.bincount(np.ravel(fewer), minlength=count)
        if degree.min() >= 2 and _connected(fewer, count):
            edges = fewer
    return edges


def _chains(edges: list[_Edge], count: int) -> list[list[int]]:
    """Nodes of each branch from one fork or opening to the next: nodes of two edges are only passed through."""
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


def _wander(rng: np.random.Generator, corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """A smooth curve through points (n, 2) that swings to either side between them: real vessels are never straight."""
    points = [corners[0]]
    for a, b in itertools.pairwise(corners):
        step = b - a
        bend = float(rng.uniform(-0.14, 0.14))
        normal = np.array([-step[1], step[0]])
        points += [a + step / 2 + bend * normal, b]
    return smooth_curve(points, 16)


def _connected(edges: list[_Edge], count: int) -> bool:
    group = list(range(count))
    for a, b in edges:
        old, new = group[a], group[b]
        group = [new if g == old else g for g in group]
    return len(set(group)) == 1


def _as_drawn(mask: NDArray[np.bool_], openings: tuple[Opening, ...], loops: int, drawn: tuple[bool, int]) -> bool:
    """One piece, the openings and the islands that were meant: nothing has grown together."""
    top, ends = drawn
    sides = sorted(opening.side for opening in openings)
    if sides != sorted(["left", *["right"] * (ends - 2), "top" if top else "bottom"]):
        return False
    _, pieces = label(mask)
    # Fluid connects through sides, so solid does through corners. Islands are what solid does not reach the border.
    solid, _ = label(~mask, np.ones((3, 3)))
    edge = np.concatenate((solid[0], solid[-1], solid[:, 0], solid[:, -1]))
    islands = np.setdiff1d(np.unique(solid[~mask]), edge)
    sizes = np.bincount(solid.ravel())[islands]
    return bool(pieces == 1 and len(islands) == loops and (sizes > 150).all())


def _inlet_speed(ends: list[_Edge], curves: list[NDArray[np.float64]], widths: list[float], inlet: int) -> float | None:
    """Mean inlet speed in um/s at which the fastest branch peaks at the wanted speed; None where a branch stands still.

    Plane Poiseuille flow in each branch, q = w^3 dp / (12 mu L), as a network: G p = q, with p = 0 at the outlets,
    which are the nodes after the inlet.
    """
    conductance = np.array([w**3 / curve_length(c) for w, c in zip(widths, curves, strict=True)])
    nodes = sorted({node for pair in ends for node in pair if node <= inlet})
    row = {node: k for k, node in enumerate(nodes)}
    G = np.zeros((len(nodes), len(nodes)))
    for (a, b), g in zip(ends, conductance.tolist(), strict=True):
        for here, there in ((a, b), (b, a)):
            if here <= inlet and here != there:
                G[row[here], row[here]] += g
                if there <= inlet:
                    G[row[here], row[there]] -= g
    source = np.zeros(len(nodes))
    source[row[inlet]] = 1.0
    solved = np.linalg.solve(G, source)
    pressure = {node: float(solved[k]) for node, k in row.items()}
    flux = np.array([abs(pressure.get(a, 0.0) - pressure.get(b, 0.0)) for a, b in ends]) * conductance
    peak = 1.5 * flux / np.asarray(widths)
    if peak.min() < 0.03 * peak.max():
        return None
    of_inlet = widths[next(k for k, pair in enumerate(ends) if inlet in pair)]
    return round(_PEAK_UM_S / (of_inlet * float(peak.max())), 1)
