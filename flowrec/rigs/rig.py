"""What the loop needs of a rig. The table of rigs is in rig_settings.py, because the configuration names one."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol, Self

from flowrec.messages import Currents
from flowrec.pipeline import Inputs


class Rig(Protocol):
    """Camera and coils. Leaving the context zeroes the coils.

    `zero` is for emergencies. The watchdog calls it in another thread than the one that calls the other methods, at any
    time from before the context is entered until the process ends, also while `inputs` or `apply` is at work or stuck
    in a driver.
    """

    def __enter__(self) -> Self: ...

    def __exit__(self, *error: object) -> None: ...

    def inputs(self) -> Iterator[Inputs]:
        """What arrives, frame by frame."""

    def apply(self, currents: Currents) -> None:
        """Send a command to the coils."""

    def zero(self) -> None:
        """Take the field away now; until the rig is entered again `apply` lets none back. A second call is harmless.

        Raises
        ------
        RigError : the hardware has refused; it is called again.
        """
