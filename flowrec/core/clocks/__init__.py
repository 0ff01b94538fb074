"""The session clock, and the other clocks of a run relative to it."""

from flowrec.core.clocks.clock_monitor import ClockMonitor, read_clocks
from flowrec.core.clocks.device_clock import DeviceClock, Fit

__all__ = ["ClockMonitor", "DeviceClock", "Fit", "read_clocks"]
