"""Which images are left out when the disk is slower than the camera: every second, fourth, ... is kept, not bursts."""

from __future__ import annotations

from flowrec.units import NS_PER_S

# The fuller the queue, the fewer are kept: shares of its room from which one in 2, 4, 8 and 16 is.
_STEPS = (0.5, 0.625, 0.75, 0.875)
_LOW = 0.125  # from here down one tries to keep more again
_PATIENCE_S = 1.0
_LONGEST_PATIENCE_S = 32.0


class Thinning:
    """Decides frame by frame. A disk that takes all of them is never met with anything but `every` = 1.

    One in `every` frames is kept, counted from the first, so that the kept ones lie evenly also across a change.
    When the queue has run low, `every` is halved; where that soon turns out to have been too much, the next try
    waits twice as long.

    Attributes
    ----------
    every : 1, 2, 4, 8 or 16.
    """

    def __init__(self) -> None:
        self.every = 1
        self._number = -1
        self._patience_s = _PATIENCE_S
        self._changed_ns: int | None = None  # when `every` was last halved or doubled

    def keeps(self, fill: float, stamp_ns: int) -> bool:
        """Whether to keep the next frame, the queue being that full (0 to 1)."""
        self._number += 1
        wanted: int = 2 ** sum(fill >= step for step in _STEPS)
        since_s = float("inf") if self._changed_ns is None else (stamp_ns - self._changed_ns) / NS_PER_S
        if wanted > self.every:
            if since_s < self._patience_s:
                self._patience_s = min(2.0 * self._patience_s, _LONGEST_PATIENCE_S)
            self.every, self._changed_ns = wanted, stamp_ns
        elif self.every > 1 and fill < _LOW and since_s >= self._patience_s:
            self.every, self._changed_ns = self.every // 2, stamp_ns
        return self._number % self.every == 0
