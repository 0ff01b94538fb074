"""Control: a route and an estimate to a demand, and that to coil currents."""

from flowrec.control.coils import Coils
from flowrec.control.controller import Controller

__all__ = ["Coils", "Controller"]
