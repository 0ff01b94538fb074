"""The coils' calibration: field = A current + bias, by least squares, and how far it is to be trusted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from flowrec.control.coil_limits import WORST_CONDITION, named
from flowrec.control.excitations import Excitations
from flowrec.errors import UsageError

_UNKNOWNS = 4  # of each axis: three coils and the bias
_LEAST_ROWS = _UNKNOWNS + 1
_GOOD_ROWS = 12
_CHANCE = 0.05  # that a calibration without a bad row is said to have one
_WEAK_EXCITATION = 0.05  # share of the strongest direction of the currents
_NOMINAL_MT = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class CoilFit:
    """B = A i + b with its doubts; arrays by axis of the field (rows) and coil (columns), both x, y, z."""

    excitations: Excitations
    mt_per_a: NDArray[np.float64]  # (3, 3) A
    mt_per_a_std: NDArray[np.float64]  # (3, 3) standard errors
    bias_mt: NDArray[np.float64]  # (3,)
    bias_std_mt: NDArray[np.float64]  # (3,)
    residual_mt: NDArray[np.float64]  # (n, 3) measured less fitted
    noise_mt: NDArray[np.float64]  # (3,) of one reading: sqrt(sum of squares / degrees of freedom)
    freedom: int  # rows less unknowns
    left_out_mt: NDArray[np.float64]  # (n, 3) measured less what the other rows foretell; NaN where they can not
    score: NDArray[np.float64]  # (n, 3) that, in its own standard deviations (externally studentised); NaN likewise
    suspicion: float  # a score beyond this is hardly chance, for all rows and axes together; inf without freedom
    uncertainty_mt: float  # standard error of a nominal field in the worst direction, from the fit alone

    @property
    def suspects(self) -> list[int]:
        """Rows to look at again, worst first."""
        worst = np.nan_to_num(np.abs(self.score), posinf=np.inf).max(axis=1)
        return [int(row) for row in np.argsort(-worst) if worst[row] > self.suspicion]

    @property
    def unchecked(self) -> list[int]:
        """Rows that no other row confirms: without them the fit has no answer, so any error in them passes."""
        return [int(row) for row in np.flatnonzero(np.isnan(self.left_out_mt).any(axis=1))]

    @property
    def condition(self) -> float:
        """The strongest direction of the coils over the weakest: how many times the current one field can cost."""
        return float(np.linalg.cond(self.mt_per_a))

    @property
    def weakest(self) -> tuple[str, float]:
        """The direction of the field that costs most current, and what one ampere makes there, mT/A."""
        directions, strength, _ = np.linalg.svd(self.mt_per_a)
        return named(directions[:, -1]), float(strength[-1])


def fit_coils(excitations: Excitations) -> CoilFit:
    """The calibration that the rows say.

    Leave-one-out residuals come from the leverages h of the one fit: e / (1 - h).

    Raises
    ------
    UsageError : rows that do not suffice, and which to add; coils that do not span the room.
    """
    currents, field, where = excitations.currents_a, excitations.field_mt, excitations.name
    _refuse_too_little(excitations)
    count = len(currents)
    X = np.column_stack([currents, np.ones(count)])
    Q, R = np.linalg.qr(X)
    solution = np.linalg.solve(R, Q.T @ field)  # (4, 3)
    residual = field - X @ solution
    freedom = count - _UNKNOWNS
    variance = (residual**2).sum(0) / freedom
    unscaled = np.linalg.inv(R.T @ R)
    std = np.sqrt(np.outer(variance, np.diag(unscaled)))  # (3, 4)
    leverage = (Q**2).sum(1)
    free = np.where(leverage < 1.0 - 1e-9, 1.0 - leverage, np.nan)[:, None]
    left_out = residual / free
    score, suspicion = np.full_like(residual, np.nan), np.inf
    if freedom > 1:
        # One probe, one noise: that of all axes of the other rows, as one axis alone has too few to tell a bad row by.
        # A set that fits exactly has none, and nothing stands out of nothing.
        others = np.maximum((residual**2).sum() - (residual**2 / free).sum(1), 0.0) / (3 * (freedom - 1))
        floor = (1e-12 * max(float(np.abs(field).max()), 1e-12)) ** 2
        score = residual / np.sqrt((others[:, None] + floor) * free)
        suspicion = float(student.ppf(1.0 - 0.5 * _CHANCE / residual.size, 3 * (freedom - 1)))
    A = solution[:3].T
    strength = np.linalg.svd(A, compute_uv=False)
    if strength[-1] * WORST_CONDITION <= strength[0]:
        raise UsageError(
            f"{where}: these coils make no field along {named(np.linalg.svd(A)[0][:, -1])} ({strength[-1]:.3g} mT/A, "
            f"{strength[0]:.3g} in the best direction); is a coil not connected, or a probe axis dead?"
        )
    return CoilFit(
        excitations=excitations,
        mt_per_a=A,
        mt_per_a_std=std[:, :3],
        bias_mt=solution[3],
        bias_std_mt=std[:, 3],
        residual_mt=residual,
        noise_mt=np.sqrt(variance),
        freedom=freedom,
        left_out_mt=left_out,
        score=score,
        suspicion=suspicion,
        uncertainty_mt=_uncertainty_mt(A, solution[3], variance, unscaled),
    )


def advice(fit: CoilFit) -> list[str]:
    """What would make it better, in sentences; empty where nothing would much."""
    said, lines = [], fit.excitations.lines
    for row in fit.suspects:
        axis = int(np.nanargmax(np.abs(fit.score[row])))
        said.append(
            f"line {lines[row]}: b_{'xyz'[axis]}_mt is {fit.left_out_mt[row, axis]:+.3g} mT off what the other rows "
            f"foretell ({abs(fit.score[row, axis]):.0f} standard deviations); measure it again or leave it out"
        )
    if fit.unchecked:
        said.append(
            f"line {', '.join(str(lines[row]) for row in fit.unchecked)}: no other row excites what this one does, so "
            "an error in it would not be seen; add its opposite"
        )
    if len(lines) < _GOOD_ROWS:
        said.append(
            f"{len(lines)} rows leave {fit.freedom} to judge the residuals by; {_GOOD_ROWS} do well: each coil alone "
            "with both signs, then some of all three at once"
        )
    currents = fit.excitations.currents_a
    one_sided = [
        "xyz"[c] for c in range(3) if currents[:, c].min() > -0.2 * currents[:, c].max() or currents[:, c].max() <= 0.0
    ]
    if one_sided:
        said.append(
            f"coil {', '.join(one_sided)} was driven one way only: add rows with the opposite sign, to tell the bias "
            "from the coil"
        )
    return said


def _refuse_too_little(excitations: Excitations) -> None:
    """Raise UsageError where the rows can not tell the twelve unknowns apart, and say what to add."""
    currents, where = excitations.currents_a, excitations.name
    if len(currents) < _LEAST_ROWS:
        raise UsageError(
            f"{where}: {len(currents)} rows; three coils and a bias take {_UNKNOWNS}, and {_LEAST_ROWS} to see any "
            f"residual; {_GOOD_ROWS} do well: each coil alone with both signs, then some of all three at once"
        )
    spread = currents - currents.mean(0)
    _, size, directions = np.linalg.svd(spread, full_matrices=False)
    if size[0] == 0.0:
        raise UsageError(f"{where}: all rows have the same currents; drive each coil alone, with both signs")
    if size[-1] >= _WEAK_EXCITATION * size[0]:
        return
    missing = [direction for s, direction in zip(size, directions, strict=True) if s < _WEAK_EXCITATION * size[0]]
    coils = [c for c in range(3) if any(abs(direction[c]) > 0.3 for direction in missing)]
    names = " and ".join("xyz"[c] for c in coils)
    level = float(np.abs(currents).max()) or 1.0
    if len(missing) == 1 and len(coils) > 1:
        why = f"the currents of coils {names} always change together, so their fields can not be told apart"
    else:
        why = f"coil{'s' if len(coils) > 1 else ''} {names} {'were' if len(coils) > 1 else 'was'} hardly driven"
    rows = [
        ",".join(f"{sign * level:g}" if k == c else "0" for k in range(3))
        for c in (coils if len(missing) == len(coils) else coils[:1])
        for sign in (1.0, -1.0)
    ]
    raise UsageError(f"{where}: {why}; add rows with the currents {' and '.join(rows)} A")


def _uncertainty_mt(
    A: NDArray[np.float64], bias: NDArray[np.float64], variance: NDArray[np.float64], unscaled: NDArray[np.float64]
) -> float:
    """Standard error of the field, by the fit alone, where a nominal one is asked for; the worst of 400 directions."""
    k = np.arange(400) + 0.5
    up, around = 1.0 - k / 200.0, np.pi * (1.0 + 5.0**0.5) * k
    ring = np.sqrt(1.0 - up**2)
    wanted = _NOMINAL_MT * np.column_stack([ring * np.cos(around), ring * np.sin(around), up])
    x = np.column_stack([np.linalg.solve(A, (wanted - bias).T).T, np.ones(len(k))])
    spread = np.einsum("ni,ij,nj->n", x, unscaled, x)
    return float(np.sqrt(spread.max() * variance.sum()))
