"""Calibration of the coils from measured fields: field = A current + bias by least squares, with its uncertainty."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit  # quantile of Student's t; scipy.stats takes 0.3 s to load

from flowrec.core import Floats, UsageError, coil_names, refuse_irregular
from flowrec.stages import WORST_CONDITION, current_columns, direction_name

_FIELDS = ("b_x_mt", "b_y_mt", "b_z_mt")
_HEADER = ",".join((*current_columns(3), *_FIELDS))
_NUMBERED = re.compile(r"i_(\d+)_a")
_UNIT_NAMES = {"a": "ampere", "mt": "millitesla"}
_SIGNIFICANCE = 0.05  # probability that a calibration without a wrong row is reported to have one
_WEAK_EXCITATION = 0.05  # fraction of the strongest direction of the currents
_NOMINAL_MT = 4.0  # of the field whose standard error is stated
_DIRECTIONS = 400  # in which the uncertainty is evaluated


class Excitations(NamedTuple):
    """Rows of the file. Axes are those of the chip: x and y as in the image, z up from the floor."""

    currents_a: Floats  # (n, coils)
    field_mt: Floats  # (n, 3)
    lines: tuple[int, ...]  # (n,) line of each row in the file
    name: str

    @property
    def coils(self) -> tuple[str, ...]:
        """Names of the coils, as in the columns."""
        return coil_names(self.currents_a.shape[1])

    @property
    def unknowns(self) -> int:
        """Unknowns of each axis: the coils and the bias."""
        return len(self.coils) + 1

    @property
    def good_rows(self) -> int:
        """Number of rows that is recommended."""
        return 4 * len(self.coils)

    @property
    def good_set(self) -> str:
        """The rows that are recommended, in words."""
        every = "all three" if len(self.coils) == 3 else f"all {len(self.coils)}"
        return f"{self.good_rows} are recommended: each coil alone with both signs, then some of {every} at once"


def read_excitations(path: Path) -> Excitations:
    """Read a CSV file of currents that were set and fields that a probe at the robot's position showed.

    Its columns are i_x_a, i_y_a, i_z_a, or of more than three coils i_1_a, i_2_a, ..., and b_x_mt, b_y_mt, b_z_mt, in
    any order; lines that begin with # are comments. Raises UsageError: a file that can not be read, with the line.
    """
    refuse_irregular(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise UsageError(f"{path}: no such file; expected rows of {_HEADER}") from error
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"{path}: can not be read as a CSV file ({error})") from error
    rows = [
        (number, f"{path}:{number}", _cells(line, f"{path}:{number}"))
        for number, line in enumerate(text.splitlines(), 1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not rows:
        raise UsageError(f"{path}: is empty; the first line is {_HEADER}, then one row for each excitation")
    (_, where_header, header), *rows = rows
    names = (*current_columns(_coils_of(header)), *_FIELDS)
    places = [_place(name, header, where_header, names) for name in names]
    values = []
    for _, where, cells in rows:
        if len(cells) != len(header):
            raise UsageError(
                f"{where}: {len(cells)} values where the header has {len(header)} columns; correct that line"
            )
        values.append([_number(name, cells[place], where) for name, place in zip(names, places, strict=True)])
    table = np.array(values, np.float64).reshape(-1, len(names))
    return Excitations(table[:, :-3], table[:, -3:], tuple(number for number, _, _ in rows), path.name)


def _cells(line: str, where: str) -> list[str]:
    try:
        return [cell.strip() for cell in next(csv.reader([line]))]
    except csv.Error as error:
        raise UsageError(f"{where}: {error}; is it no table?") from error


def _coils_of(header: list[str]) -> int:
    """Number of coils that a header has columns for: three, unless it numbers them."""
    numbers = [int(found[1]) for cell in header if (found := _NUMBERED.fullmatch(cell.lower()))]
    return min(max(numbers), len(header)) if numbers else 3


def _place(name: str, header: list[str], where: str, names: Sequence[str]) -> int:
    given = [each.lower() for each in header]
    if given.count(name) == 1:
        return given.index(name)
    if len(given) == 1 and ";" in given[0]:
        raise UsageError(f"{where}: columns are separated by ';'; save it with commas, and points in the numbers")
    if name in given:
        raise UsageError(f"{where}: two columns are named {name}; leave one")
    stem, _, unit = name.rpartition("_")
    other = next((word for word in given if stem in (word.rpartition("_")[0], word)), None)
    if other is None:
        raise UsageError(f"{where}: no column {name}; the header is {','.join(names)}")
    raise UsageError(
        f"{where}: column {other!r} where {name!r} belongs: give it in {_UNIT_NAMES[unit]}, and say so in its name"
    )


def _number(name: str, cell: str, where: str) -> float:
    try:
        value = float(cell)
    except ValueError as error:
        raise UsageError(f"{where}: {name} = {cell!r} is no number; correct that line") from error
    if not math.isfinite(value):
        raise UsageError(f"{where}: {name} = {cell}: give a finite number or leave the row out")
    return value


class CoilFit(NamedTuple):
    """B = A i + b with uncertainties; arrays by axis of the field (rows) and coil (columns)."""

    excitations: Excitations
    mt_per_a: Floats  # (3, coils) A
    mt_per_a_std: Floats  # (3, coils) standard errors
    bias_mt: Floats  # (3,)
    bias_std_mt: Floats  # (3,)
    residual_mt: Floats  # (n, 3) measured minus fitted
    noise_mt: Floats  # (3,) of one reading: sqrt(sum of squares / degrees of freedom)
    freedom: int  # degrees of freedom: rows minus unknowns
    left_out_mt: Floats  # (n, 3) measured minus predicted by the other rows; NaN where they can not
    score: Floats  # (n, 3) `left_out_mt` in standard deviations (externally studentised); NaN likewise
    critical_score: float  # critical score for all rows and axes together; inf without degrees of freedom
    uncertainty_mt: float  # standard error of a nominal field in the worst direction, from the fit alone

    @property
    def worst(self) -> list[int]:
        """Row of the largest residual of each axis."""
        return np.abs(self.residual_mt).argmax(axis=0).tolist()

    @property
    def suspects(self) -> list[int]:
        """Rows whose residual is significant, worst first."""
        worst = np.nan_to_num(np.abs(self.score), posinf=np.inf).max(axis=1)
        return [int(row) for row in np.argsort(-worst) if worst[row] > self.critical_score]

    @property
    def unchecked(self) -> list[int]:
        """Rows that no other row confirms: without them the fit is singular, so an error in them is not visible."""
        return [int(row) for row in np.flatnonzero(np.isnan(self.left_out_mt).any(axis=1))]

    @property
    def condition(self) -> float:
        """Condition number of A: the largest ratio of the currents that two fields of one amplitude need."""
        return float(np.linalg.cond(self.mt_per_a))

    @property
    def weakest(self) -> tuple[str, float]:
        """The direction of the field that needs most current, and the field per ampere there, mT/A."""
        directions, gain, _ = np.linalg.svd(self.mt_per_a)
        return direction_name(directions[:, -1]), float(gain[-1])


def fit_coils(excitations: Excitations) -> CoilFit:
    """Fit A and b by least squares.

    Leave-one-out residuals follow from the leverages h of the one fit: e / (1 - h). Raises UsageError: too few or
    dependent rows, and which to add; coils whose fields are linearly dependent.
    """
    currents, field, where = excitations.currents_a, excitations.field_mt, excitations.name
    _refuse_too_little(excitations)
    count = len(currents)
    X = np.column_stack([currents, np.ones(count)])
    Q, R = np.linalg.qr(X)
    solution = np.linalg.solve(R, Q.T @ field)  # (coils + 1, 3)
    residual = field - X @ solution
    freedom = count - excitations.unknowns
    variance = (residual**2).sum(0) / freedom
    unscaled = np.linalg.inv(R.T @ R)
    std = np.sqrt(np.outer(variance, np.diag(unscaled)))  # (3, coils + 1)
    leverage = (Q**2).sum(1)
    free = np.where(leverage < 1.0 - 1e-9, 1.0 - leverage, np.nan)[:, None]
    left_out = residual / free
    score, critical_score = np.full_like(residual, np.nan), np.inf
    if freedom > 1:
        # All axes share one probe and so one noise, estimated from all axes of the other rows: one axis alone has too
        # few of them. The floor keeps rounding errors of an exact fit from being significant.
        others = np.maximum((residual**2).sum() - (residual**2 / free).sum(1), 0.0) / (3 * (freedom - 1))
        floor = (1e-12 * max(float(np.abs(field).max()), 1e-12)) ** 2
        score = residual / np.sqrt((others[:, None] + floor) * free)
        critical_score = float(stdtrit(3 * (freedom - 1), 1.0 - 0.5 * _SIGNIFICANCE / residual.size))
    A = solution[:-1].T
    directions, gain, _ = np.linalg.svd(A)
    if gain[-1] * WORST_CONDITION <= gain[0]:
        raise UsageError(
            f"{where}: these coils make no field along {direction_name(directions[:, -1])} ({gain[-1]:.3g} mT/A, "
            f"{gain[0]:.3g} in the best direction); is a coil not connected, or a probe axis dead?"
        )
    return CoilFit(
        excitations=excitations,
        mt_per_a=A,
        mt_per_a_std=std[:, :-1],
        bias_mt=solution[-1],
        bias_std_mt=std[:, -1],
        residual_mt=residual,
        noise_mt=np.sqrt(variance),
        freedom=freedom,
        left_out_mt=left_out,
        score=score,
        critical_score=critical_score,
        uncertainty_mt=_uncertainty_mt(A, solution[-1], variance, unscaled),
    )


def advice(fit: CoilFit) -> list[str]:
    """Instructions to improve the calibration, in sentences; empty if nothing would improve it much."""
    sentences, lines, names = [], fit.excitations.lines, fit.excitations.coils
    for row in fit.suspects:
        axis = int(np.nanargmax(np.abs(fit.score[row])))
        sentences.append(
            f"line {lines[row]}: b_{'xyz'[axis]}_mt is {fit.left_out_mt[row, axis]:+.3g} mT off what the other rows "
            f"predict ({abs(fit.score[row, axis]):.0f} standard deviations); measure it again or leave it out"
        )
    if fit.unchecked:
        sentences.append(
            f"line {', '.join(str(lines[row]) for row in fit.unchecked)}: no other row excites what this one does, so "
            "an error in it would not be seen; add its opposite"
        )
    if len(lines) < fit.excitations.good_rows:
        good = fit.excitations.good_set
        sentences.append(f"{len(lines)} rows leave {fit.freedom} degrees of freedom for the residuals; {good}")
    low, high = fit.excitations.currents_a.min(axis=0), fit.excitations.currents_a.max(axis=0)
    one_sided = [name for c, name in enumerate(names) if low[c] > -0.2 * high[c] or high[c] <= 0.0]
    if one_sided:
        sentences.append(
            f"coil {', '.join(one_sided)} was driven one way only: add rows with the opposite sign, to tell the bias "
            "from the coil"
        )
    return sentences


def _refuse_too_little(excitations: Excitations) -> None:
    """Raise UsageError if the rows do not determine the unknowns, and say what to add."""
    currents, where, unknowns = excitations.currents_a, excitations.name, excitations.unknowns
    if len(currents) <= unknowns:
        count = "three" if unknowns == 4 else str(unknowns - 1)
        raise UsageError(
            f"{where}: {len(currents)} rows; {count} coils and a bias take {unknowns}, and {unknowns + 1} to see any "
            f"residual; {excitations.good_set}"
        )
    spread = currents - currents.mean(0)
    _, size, directions = np.linalg.svd(spread, full_matrices=False)
    if size[0] == 0.0:
        raise UsageError(f"{where}: all rows have the same currents; drive each coil alone, with both signs")
    if size[-1] >= _WEAK_EXCITATION * size[0]:
        return
    missing = [direction for s, direction in zip(size, directions, strict=True) if s < _WEAK_EXCITATION * size[0]]
    coils = [c for c in range(unknowns - 1) if any(abs(direction[c]) > 0.3 for direction in missing)]
    names = " and ".join(excitations.coils[c] for c in coils)
    level = float(np.abs(currents).max()) or 1.0
    if len(missing) == 1 and len(coils) > 1:
        why = f"the currents of coils {names} always change together, so their fields can not be told apart"
    else:
        why = f"coil{'s' if len(coils) > 1 else ''} {names} {'were' if len(coils) > 1 else 'was'} hardly driven"
    rows = [
        ",".join(f"{sign * level:g}" if k == c else "0" for k in range(unknowns - 1))
        for c in (coils if len(missing) == len(coils) else coils[:1])
        for sign in (1.0, -1.0)
    ]
    raise UsageError(f"{where}: {why}; add rows with the currents {' and '.join(rows)} A")


def _uncertainty_mt(A: Floats, bias: Floats, variance: Floats, unscaled: Floats) -> float:
    """Standard error of a nominal field, from the fit alone: the largest over directions on a spiral on the sphere."""
    k = np.arange(_DIRECTIONS) + 0.5
    z, azimuth = 1.0 - k / (0.5 * _DIRECTIONS), np.pi * (1.0 + 5.0**0.5) * k
    ring = np.sqrt(1.0 - z**2)
    field = _NOMINAL_MT * np.column_stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z])
    x = np.column_stack([np.linalg.lstsq(A, (field - bias).T)[0].T, np.ones(len(k))])
    spread = np.einsum("ni,ij,nj->n", x, unscaled, x)
    return float(np.sqrt(spread.max() * variance.sum()))
