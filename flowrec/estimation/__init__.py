"""Track and applied field to Estimate; estimates to observations of the flow."""

from flowrec.estimation.consistency_monitor import HealthMonitor
from flowrec.estimation.kalman import Kalman
from flowrec.estimation.luenberger import Luenberger
from flowrec.estimation.observer import Observer
from flowrec.estimation.sampler import Sampler, Trimmed
from flowrec.estimation.smoother import Smoothed, observe, smooth

__all__ = ["HealthMonitor", "Kalman", "Luenberger", "Observer", "Sampler", "Smoothed", "Trimmed", "observe", "smooth"]
