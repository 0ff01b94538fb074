"""Control: a route and an estimate to a demand, and that to coil currents."""

from flowrec.stages.control.coils import Coils
from flowrec.stages.control.controller import Controller

__all__ = ["Coils", "Controller"]
