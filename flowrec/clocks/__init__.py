"""One session clock, and what other clocks say beside it."""

from flowrec.clocks.device import DeviceClock, Fit
from flowrec.clocks.watch import ClockWatch, read_clocks

__all__ = ["ClockWatch", "DeviceClock", "Fit", "read_clocks"]
