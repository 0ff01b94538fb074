"""A few results kept in memory, by everything that enters them: so that keeping them can not change one."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any

from flowrec.chip.chip import Chip

# Factors take about 5 kB a cell: two gigabytes, or one large chip with what is asked of it.
LARGEST_CELLS, FEWEST = 400_000, 4

_kept: OrderedDict[Hashable, tuple[Any, int]] = OrderedDict()
_lock = threading.Lock()


def kept(key: Hashable, cells: int, make: Callable[[], Any]) -> Any:
    """What `make` returned for this key; made anew where that was too long ago. `cells` says how large it is."""
    with _lock:
        if key in _kept:
            _kept.move_to_end(key)
            return _kept[key][0]
    made = make()
    with _lock:
        _kept[key] = (made, cells)
        total = sum(size for _, size in _kept.values())
        while total > LARGEST_CELLS and len(_kept) > FEWEST:
            total -= _kept.popitem(last=False)[1][1]
    return made


def forget() -> None:
    """Drop all of it, as in a process that has just started."""
    with _lock:
        _kept.clear()


def chip_key(chip: Chip) -> Hashable:
    """All of a chip but its name, for a key."""
    return (
        chip.mask.shape,
        chip.mask.tobytes(),
        chip.um_per_px,
        chip.openings,
        chip.viscosity_mpa_s,
        chip.density_kg_m3,
        chip.depth_um,
        chip.walls,
    )


def cells_of(chip: Chip, k: int) -> int:
    """Number of fluid cells on k x k subcells a pixel."""
    return int(chip.mask.sum()) * k * k
