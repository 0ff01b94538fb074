"""One session clock, and what other clocks say beside it."""

from flowrec.clocks.clock_monitor import ClockWatch, read_clocks
from flowrec.clocks.device_clock import DeviceClock, Fit

__all__ = ["ClockWatch", "DeviceClock", "Fit", "read_clocks"]
