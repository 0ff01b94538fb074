"""A few results kept in memory, by everything that enters them: so that keeping them can not change one."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any

from flowrec.chip.chip import Chip

KEPT = 48  # of all kinds: one chip and one fluid, and the walls that it may have instead

_kept: OrderedDict[Hashable, Any] = OrderedDict()
_lock = threading.Lock()


def kept(key: Hashable, make: Callable[[], Any]) -> Any:
    """What `make` returned for this key; made anew where that was too long ago."""
    with _lock:
        if key in _kept:
            _kept.move_to_end(key)
            return _kept[key]
    made = make()
    with _lock:
        _kept[key] = made
        while len(_kept) > KEPT:
            _kept.popitem(last=False)
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
