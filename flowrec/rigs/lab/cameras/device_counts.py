"""Counts of a camera: the ids of its blocks, unwrapped to the index of its frames, and the ticks of its clock.

What is missing between two ids is a gap; a frame is stamped by the ticks, fitted to the host's clock. Devices count
differently. GigE Vision counts with 16 bits from 1 to 65535, then 1 again (0 is left out), or with 64 bits ("extended
ids"); USB3 Vision with 64 bits from 0. A new connection begins anew. Blocks may come out of order, because an
incomplete one is given up late.
"""

from __future__ import annotations

from flowrec.core import NS_PER_S, DeviceClock, Fit, nanoseconds, seconds
from flowrec.rigs.lab.cameras.camera import CameraInfo

_BEHIND = 256  # blocks; an id that lies further back means that the device has begun to count anew
_HASTE = 4.0  # a gap of more than so many times the blocks that fit into the time passed means the same
_SLACK = 64  # blocks, for rates that are not what they are said to be
_FROZEN = 2  # frames in a row with the same device time: the clock stands still, and is not used


class BlockIds:
    """Unwraps the ids of one camera.

    Attributes
    ----------
    index : of the newest block; the first one has index 0.
    restarts : how often the device began to count anew without a new connection.
    """

    def __init__(self) -> None:
        self.index = -1
        self.restarts = 0
        self.reset(0)

    def reset(self, bits: int, rate_hz: float = 0.0) -> None:
        """Begin with a new connection: whatever id comes next, it is the next index.

        Parameters
        ----------
        bits : of the ids; 0: the device has none, and each block is taken for the next one.
        rate_hz : of the blocks; 0: not known, then every gap is believed.
        """
        self._bits = bits
        self._rate_hz = rate_hz
        self._skips_zero = bits == 16
        self._newest: int | None = None
        self._newest_ns = 0
        self._first = (0, 0)  # index and arrival of the first block of this connection

    def step(self, block_id: int | None, arrival_ns: int) -> int:
        """Distance of a block from the newest one: 1 for the next one, 0 for the same, negative for older ones.

        A positive step makes it the newest one, and is added to `index`.
        """
        step = 1
        if block_id is not None and self._bits:
            if self._newest is None:
                self._first = (self.index + 1, arrival_ns)
            else:
                step = self._distance(block_id, self._newest)
                if step < -_BEHIND or (self._rate_hz and step > self._possible(arrival_ns)):
                    self.restarts += 1
                    self._first = (self.index + 1, arrival_ns)
                    step = 1
        if step > 0:
            self.index += step
            self._newest, self._newest_ns = block_id, arrival_ns
        return step

    def _distance(self, block_id: int, newest: int) -> int:
        """From the newest block to this one, the shorter way round."""
        if block_id == 0:
            self._skips_zero = False
        count = (1 << self._bits) - self._skips_zero
        forward = (block_id - newest) % count
        return forward if forward <= count // 2 else forward - count

    def _possible(self, arrival_ns: int) -> float:
        """The longest gap that is possible. Blocks that a busy host takes late arrive close together."""
        index, arrived_ns = self._first
        due = self._rate_hz * seconds(arrival_ns - arrived_ns) - (self.index - index)
        return _SLACK + _HASTE * (max(due, 0.0) + self._rate_hz * seconds(arrival_ns - self._newest_ns))


class Stamper:
    """Stamps by the device's clock, or by the arrival where it has none."""

    def __init__(self) -> None:
        self.frozen = False  # the clock stands still
        self._fit: Fit | None = None
        self._stood = 0
        self._last_ns: int | None = None
        self._clock = DeviceClock()
        self._before_ns = 0  # from the middle of an exposure to the arrival

    def reset(self, info: CameraInfo, exposure_s: float, delay_s: float) -> None:
        """Begin with a connection."""
        if info.ticks_per_s:
            self._clock = DeviceClock(unit=NS_PER_S / info.ticks_per_s)
        self._before_ns = nanoseconds(0.5 * (info.exposure_s or exposure_s) + delay_s)
        self._stood = 0
        self.frozen = False

    def take(self, ticks: int | None, arrival_ns: int) -> tuple[int, Fit | None, int | None]:
        """The stamp of a frame, the fit that made it, and the stamp before."""
        before_ns, fit = self._last_ns, None
        stamp_ns = arrival_ns - self._before_ns
        if ticks is not None and not self.frozen:
            self._fit = self._clock.take(self._fit, ticks, arrival_ns)
            self._stood = self._stood + 1 if self._fit.flag == "duplicate" else 0
            self.frozen = self._stood == _FROZEN
            if self._fit.good:
                fit = self._fit
                stamp_ns = fit.stamp_ns - self._before_ns
        if before_ns is not None:
            stamp_ns = max(stamp_ns, before_ns + 1)
        self._last_ns = stamp_ns
        return stamp_ns, fit, before_ns
