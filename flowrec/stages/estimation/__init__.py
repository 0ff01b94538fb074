"""Track and applied field to Estimate; estimates to observations of the flow."""

from flowrec.stages.estimation.consistency_monitor import HealthMonitor
from flowrec.stages.estimation.kalman import Kalman
from flowrec.stages.estimation.luenberger import Luenberger
from flowrec.stages.estimation.observer import Observer
from flowrec.stages.estimation.sampler import Sampler, Trimmed
from flowrec.stages.estimation.smoother import Smoothed, observe, smooth

__all__ = ["HealthMonitor", "Kalman", "Luenberger", "Observer", "Sampler", "Smoothed", "Trimmed", "observe", "smooth"]
