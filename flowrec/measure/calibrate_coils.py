"""`flowrec calibrate coils`: the settings of the coils and their uncertainty, from a table of currents and fields."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

from flowrec.core import Coverage, Floats, __version__, say, table
from flowrec.measure.coil_calibration import CoilFit, advice, fit_coils, read_excitations
from flowrec.measure.proposal import as_sets, as_toml, check_outputs, write_outputs
from flowrec.rigs import sha256_of
from flowrec.stages import Coils

_EXACT_DIGITS = 9  # decimals from which on a value counts as exact


class CoilProposal(NamedTuple):
    """The fit, and the file that its settings were written to."""

    fit: CoilFit
    out: Path | None

    def as_json(self) -> dict[str, Any]:
        """The fit as plain numbers; None where the rows do not determine one."""
        fit, lines = self.fit, self.fit.excitations.lines
        direction, strength = fit.weakest
        return {
            "rows": len(lines),
            "degrees_of_freedom": fit.freedom,
            "mt_per_a": fit.mt_per_a.tolist(),
            "mt_per_a_standard_error": fit.mt_per_a_std.tolist(),
            "bias_mt": fit.bias_mt.tolist(),
            "bias_standard_error_mt": fit.bias_std_mt.tolist(),
            "residual_rms_mt": fit.noise_mt.tolist(),
            "worst_line": [lines[row] for row in fit.worst],
            "worst_residual_mt": [float(fit.residual_mt[row, axis]) for axis, row in enumerate(fit.worst)],
            "left_out_mt": [[None if math.isnan(v) else v for v in row] for row in fit.left_out_mt.tolist()],
            "suspicious_lines": [lines[row] for row in fit.suspects],
            "unchecked_lines": [lines[row] for row in fit.unchecked],
            "condition": fit.condition,
            "weakest_direction": direction,
            "weakest_mt_per_a": strength,
            "standard_error_of_4_mt": fit.uncertainty_mt,
            "advice": advice(fit),
            "set": as_sets(settings_of(fit)),
            "covered": Coverage(len(lines), len(lines), "rows").as_json(),
        }

    def show(self) -> None:
        fit, lines = self.fit, self.fit.excitations.lines
        rows = []
        for axis, (name, worst) in enumerate(zip("xyz", fit.worst, strict=True)):
            rows.append(
                (
                    f"b_{name}",
                    *(_with_doubt(*each) for each in zip(fit.mt_per_a[axis], fit.mt_per_a_std[axis], strict=True)),
                    _with_doubt(fit.bias_mt[axis], fit.bias_std_mt[axis]),
                    f"{fit.noise_mt[axis]:.2g}",
                    f"{fit.residual_mt[worst, axis]:+.2g} (line {lines[worst]})",
                )
            )
        table(
            f"{fit.excitations.name}: {len(lines)} excitations; mT per A of each coil, bias and residuals in mT",
            ("", *(f"coil {name}" for name in fit.excitations.coils), "bias", "residual", "worst"),
            rows,
        )
        direction, strength = fit.weakest
        say(
            f"A field of 4 mT is known to {fit.uncertainty_mt:.2g} mT (one standard error, {fit.freedom} degrees of "
            f"freedom). Weakest direction: {direction}, {strength:.3g} mT/A; the strongest direction has "
            f"{fit.condition:.2g} times as much."
        )
        for sentence in advice(fit):
            say(f"- {sentence}")
        if self.out is not None:
            say(f"{self.out} written: flowrec record {self.out}")
        say("With any configuration: " + " ".join(f"--set '{text}'" for text in as_sets(settings_of(fit))))


def calibrate_coils(path: Path, out: Path | None = None, overwrite: bool = False) -> CoilProposal:
    """Fit the settings of the coils to a table, and write them to `out` if it is given.

    Raises UsageError: the table can not be read or has too few rows, or no run could use such coils; OutputError: `out`
    may not be written, see `Output.check`.
    """
    outputs = check_outputs(out, (path,), overwrite)
    fit = fit_coils(read_excitations(path))
    settings = settings_of(fit)
    Coils(mt_per_a=settings["coils.mt_per_a"], bias_mt=settings["coils.bias_mt"]).check(path.name)
    if outputs:
        digest = sha256_of(path)[:12]
        noise = ", ".join(f"{value:.2g}" for value in fit.noise_mt)
        suspects = f"; {len(fit.suspects)} of them suspicious" if fit.suspects else ""
        comments = (
            f"By flowrec {__version__} calibrate coils from {path.name} (sha256 {digest}...): "
            f"{len(fit.residual_mt)} excitations{suspects}.",
            f"Residual rms {noise} mT in x, y, z; a field of 4 mT is known to {fit.uncertainty_mt:.2g} mT.",
        )
        write_outputs(outputs, (as_toml(comments, settings).encode(),))
    return CoilProposal(fit, out)


def settings_of(fit: CoilFit) -> dict[str, Any]:
    """The settings by key, to some hundredths of their standard errors."""
    matrix = tuple(_round_to_error(row, std) for row, std in zip(fit.mt_per_a, fit.mt_per_a_std, strict=True))
    return {"coils.mt_per_a": matrix, "coils.bias_mt": _round_to_error(fit.bias_mt, fit.bias_std_mt)}


def _round_to_error(values: Floats, stds: Floats) -> tuple[float, ...]:
    return tuple(round(float(v), _digits(s) + 2) + 0.0 for v, s in zip(values, stds, strict=True))


def _with_doubt(value: float, std: float) -> str:
    """A value with its standard error, to the first digit of that."""
    digits = _digits(std)
    return f"{value:.{digits}f} ± {std:.{digits}f}" if digits < _EXACT_DIGITS else f"{value:.4g}"


def _digits(std: float) -> int:
    """Number of decimals that show the first digit of a standard error."""
    return min(max(-math.floor(math.log10(std)), 0), _EXACT_DIGITS) if std > 0.0 else _EXACT_DIGITS
