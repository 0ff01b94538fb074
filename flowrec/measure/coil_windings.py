"""Field per ampere of coils from their windings: circular loops about the axes of the chip, centred on the robot.

On the axis of a loop of radius R with n turns, at a distance z from it, B = mu0 n I R^2 / (2 (R^2 + z^2)^(3/2)). A pair
of loops, each at half of its distance d from the robot and in series, makes twice that; at d = R, a Helmholtz pair,
B = (4/5)^(3/2) mu0 n I / R. A Maxwell pair, d = sqrt(3) R with opposite currents, makes no field at the robot, but the
gradient dB/dz = 3 mu0 n I R^2 z / (R^2 + z^2)^(5/2), z = d / 2 (J. D. Jackson, Classical Electrodynamics, 5.5).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from flowrec.core import Floats, UsageError, __version__, coil_names, say, table
from flowrec.measure.proposal import as_sets, as_toml, check_outputs, write_outputs
from flowrec.stages import Coils

_MU0_MT_MM_PER_A = 4e-1 * math.pi  # mu0 in mT mm/A
_KINDS = {"helmholtz": 1.0, "maxwell": math.sqrt(3.0), "pair": None, "coil": None}  # distance over radius, if it is set
_FORM = "AXIS:KIND:RADIUS_MM:TURNS[:DISTANCE_MM]"
_DIGITS = 6  # of the numbers that are printed; a winding is known to three


class Winding(NamedTuple):
    """One output: a coil, or a pair in series, about an axis of the chip.

    Attributes
    ----------
    axis : 0, 1, 2 of x, y, z; sign : -1 where a positive current makes a field along the negative axis.
    kind : helmholtz, maxwell, pair or coil.
    turns : of each coil.
    distance_mm : of the two coils of a pair; of a single coil from the robot.
    """

    axis: int
    sign: float
    kind: str
    radius_mm: float
    turns: float
    distance_mm: float

    @property
    def mt_per_a(self) -> float:
        """Field at the robot along the axis, mT/A."""
        if self.kind == "maxwell":
            return 0.0
        away_mm, coils = (self.distance_mm, 1.0) if self.kind == "coil" else (0.5 * self.distance_mm, 2.0)
        square = self.radius_mm**2 + away_mm**2
        return self.sign * coils * 0.5 * _MU0_MT_MM_PER_A * self.turns * self.radius_mm**2 / square**1.5

    @property
    def mt_per_mm_per_a(self) -> float:
        """Gradient at the robot of a Maxwell pair along the axis, mT/(mm A)."""
        away_mm = 0.5 * self.distance_mm
        square = self.radius_mm**2 + away_mm**2
        return self.sign * 3.0 * _MU0_MT_MM_PER_A * self.turns * self.radius_mm**2 * away_mm / square**2.5


def winding_of(text: str) -> Winding:
    """The winding of a text, as in x:helmholtz:50:120, -y:pair:60:150:55, z:coil:30:200:25 or x:maxwell:50:80.

    Raises UsageError: one line: a text of another form, or a number that is no length.
    """
    where = f"--winding {text}"
    axis, *rest = (part.strip().lower() for part in text.split(":"))
    if axis.lstrip("+-") not in ("x", "y", "z") or len(axis) > 2 or not rest or rest[0] not in _KINDS:
        raise UsageError(f"{where}: give {_FORM}, with x, y or z, and one of {', '.join(_KINDS)}")
    kind, *numbers = rest
    known = _KINDS[kind]
    if len(numbers) != (2 if known is not None else 3):
        more = "radius and turns" if known is not None else "radius, turns and distance"
        raise UsageError(f"{where}: {len(numbers)} numbers, where {kind} takes {more}; give {_FORM}")
    try:
        values = [float(number) for number in numbers]
    except ValueError as error:
        raise UsageError(f"{where}: {error}; give {_FORM}") from error
    least = [value for value in values[:2] if not 0.0 < value < math.inf]
    if least or not all(0.0 <= value < math.inf for value in values):
        raise UsageError(f"{where}: radius and turns are above 0, a distance is not negative; lengths in mm")
    distance_mm = values[2] if known is None else known * values[0]
    return Winding("xyz".index(axis[-1]), -1.0 if axis[0] == "-" else 1.0, kind, values[0], values[1], distance_mm)


class WindingProposal(NamedTuple):
    """The matrix of the windings, and the file that it was written to."""

    windings: tuple[Winding, ...]
    out: Path | None

    @property
    def mt_per_a(self) -> Floats:
        """(3, coils) field along x, y and z per ampere."""
        matrix = np.zeros((3, len(self.windings)))
        for column, winding in enumerate(self.windings):
            matrix[winding.axis, column] = winding.mt_per_a
        return matrix

    @property
    def settings(self) -> dict[str, Any]:
        """The setting by its key, to six digits."""
        rows = tuple(tuple(float(f"{value:.{_DIGITS}g}") for value in row) for row in self.mt_per_a.tolist())
        return {"coils.mt_per_a": rows}

    def as_json(self) -> dict[str, Any]:
        """Matrix, windings and setting as plain numbers."""
        windings = [each._asdict() | {"axis": "xyz"[each.axis]} for each in self.windings]
        return {"mt_per_a": self.mt_per_a.tolist(), "windings": windings, "set": as_sets(self.settings)}

    def show(self) -> None:
        """Print a row for each coil."""
        rows = []
        for name, each in zip(coil_names(len(self.windings)), self.windings, strict=True):
            gradient = f"{each.mt_per_mm_per_a:.4g}" if each.kind == "maxwell" else "-"
            size = f"{each.radius_mm:g} mm", f"{each.turns:g}", f"{each.distance_mm:.4g} mm"
            rows.append((name, "xyz"[each.axis], each.kind, *size, f"{each.mt_per_a:.4g}", gradient))
        head = ("coil", "axis", "kind", "radius", "turns", "distance", "mT/A", "mT/mm/A")
        table("field of thin windings in air, at their common centre", head, rows)
        say("Windings have a thickness and are never quite centred: measure the field before you rely on it.")
        if self.out is not None:
            say(f"{self.out} written: flowrec record {self.out}")
        say("With any configuration: " + " ".join(f"--set '{text}'" for text in as_sets(self.settings)))


def windings_matrix(texts: Sequence[str], out: Path | None = None, overwrite: bool = False) -> WindingProposal:
    """The matrix coils.mt_per_a of windings, a column each in their order; written to `out` if it is given.

    Raises UsageError: a text that is no winding, or windings that can not make every field, in one line; OutputError:
    `out` may not be written, see `Output.check`.
    """
    outputs = check_outputs(out, (), overwrite)
    proposal = WindingProposal(tuple(map(winding_of, texts)), out)
    if len(texts) < 3:
        raise UsageError(
            f"--winding: {len(texts)} given; a rotating field needs three coils or more, one for each output"
        )
    Coils(mt_per_a=proposal.settings["coils.mt_per_a"]).check("--winding")
    if outputs:
        comments = (f"By flowrec {__version__} calibrate coils from windings: {', '.join(texts)}.",)
        write_outputs(outputs, (as_toml(comments, proposal.settings).encode(),))
    return proposal
