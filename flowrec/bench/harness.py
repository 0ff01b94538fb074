"""Shared parts of the benches: command-line options, output files, the choice of methods, and statistics.

A bench is a module with `measure`, which returns its results as a dictionary for JSON, and `show`, which prints them.
The parameters of `measure` that are annotated as options are the options of its command.
"""

from __future__ import annotations

import importlib.util
import inspect
import json
import math
import os
import platform
import sys
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, get_origin

import numpy as np
import scipy  # its special loads at first use, not at start-up
import typer
from numpy.typing import NDArray
from typer.core import TyperCommand

from flowrec.core import (
    FIGURE,
    JSON,
    Z95,
    Bools,
    Floats,
    FlowField,
    FlowrecError,
    Output,
    StoppedError,
    UsageError,
    looked_at,
    provenance,
    replace_content,
    say,
    table,
)
from flowrec.verbs import HELP_WIDTH, AsJson, CommandLineError, FiniteNumbers, Overwrite, Stoppable, usage_line

Results = dict[str, Any]

JsonFile = Annotated[Path | None, typer.Option("--out", metavar="FILE", help="Also write the results as JSON.")]
FigureFile = Annotated[Path | None, typer.Option(metavar="FILE", help="Draw the results (PNG, PDF or SVG).")]
Cases = Annotated[Path | None, typer.Option(metavar="DIR", help="Vessel cases (*.npz); random ones by default.")]
Names = Annotated[str | None, typer.Option(metavar="A,B", help="Only these methods; by default all.")]
Seed = Annotated[int, typer.Option(min=0, help="Seed of all random numbers.")]
Quick = Annotated[bool, typer.Option("--quick", help="Smaller cases only.")]

_BOOTSTRAP_DRAWS = 10_000  # of a bootstrap: the ends of an interval are exact to 3 % of the standard error


class _Bench(Stoppable, FiniteNumbers, TyperCommand):
    pass


def run(
    measure: Callable[..., Results],
    show: Callable[[Any], None],
    words: Sequence[str] | None = None,
    program: str | None = None,
    summary: str | None = None,
) -> None:
    """Run a bench as a command of its own; `words` are its arguments, by default those of the process.

    Ends with SystemExit: the exit status is 1 if the results count faults (`fault_count`).
    """
    app = typer.Typer(
        add_completion=False,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"], "max_content_width": HELP_WIDTH},
        rich_markup_mode=None,
    )
    app.command(cls=_Bench, help=summary or inspect.getdoc(sys.modules[measure.__module__]))(_command(measure, show))
    try:
        sys.exit(app(args=words, prog_name=program, standalone_mode=False) or 0)
    except CommandLineError as error:
        sys.stderr.write(usage_line(error))
        sys.exit(error.exit_code)
    except FlowrecError as error:
        if isinstance(error, StoppedError) and "--json" in (sys.argv if words is None else words):
            typer.echo(json.dumps(error.as_json()))
        sys.stderr.write(f"flowrec: {error}\n")
        sys.exit(error.exit_status)


def _command(measure: Callable[..., Results], show: Callable[[Any], None]) -> Callable[..., None]:
    """A function with the options of `measure` and those of every bench, for typer."""

    def command(as_json: bool, out: Path | None, overwrite: bool, **options: Any) -> None:
        inputs = tuple(value for name, value in options.items() if isinstance(value, Path) and name != "figure")
        with ExitStack() as stack:
            file = out and stack.enter_context(Output(out, JSON, inputs, overwrite).new_file())
            if figure := options.get("figure"):
                need_matplotlib()
                options["figure"] = stack.enter_context(Output(figure, FIGURE, inputs, overwrite).new_file())
            looked_at()
            measured = measure(**options)
            covered = looked_at()
            results = {"machine": machine(), **measured, "covered": [each.as_json() for each in covered]}
            if as_json:
                typer.echo(json.dumps(results))
            else:
                show(results)
                for each in covered:
                    say(each.text)
            if file is not None:
                file.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
        if results.get("fault_count"):
            raise typer.Exit(1)

    own = inspect.signature(measure, eval_str=True).parameters.values()
    common = inspect.signature(_common, eval_str=True).parameters.values()
    parameters = [one for one in (*own, *common) if get_origin(one.annotation) is Annotated]
    parameters = [one.replace(kind=inspect.Parameter.KEYWORD_ONLY) for one in parameters]
    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {one.name: one.annotation for one in parameters}
    return command


def _common(as_json: AsJson = False, out: JsonFile = None, overwrite: Overwrite = False) -> None:
    """Declares the options of every bench."""


def print_rows(title: str, rows: Iterable[Results], columns: dict[str, str], text: str = "") -> None:
    """Print a `table`: a format string of the row's keys by heading, as in {"RMSE": "{rmse_um:.1f}"}. None is "-"."""

    def cell(template: str, row: Results) -> str:
        try:
            return template.format(**row)
        except TypeError:  # None has no format
            return "-"

    table(
        title, tuple(columns), [tuple(cell(template, row) for template in columns.values()) for row in rows], text=text
    )


def need_matplotlib() -> None:
    """Raise UsageError if matplotlib is not installed."""
    if importlib.util.find_spec("matplotlib") is None:
        raise UsageError("--figure needs matplotlib, which is not installed: pip install 'flowrec[notebook]'")


def machine() -> dict[str, Any]:
    """The computer and the versions that a result depends on."""
    return {
        "cores": os.cpu_count(),
        "threads": os.environ.get("OMP_NUM_THREADS", "default"),
        "platform": platform.platform(),
        "python": platform.python_version(),
        **{package: version(package) for package in ("numpy", "scipy")},
    }


def code_version() -> str:
    """The version and the commit of this flowrec."""
    facts = provenance(anonymous=True)
    changed = " with local changes" if facts.get("git_changed") == "True" else ""
    return f"flowrec {facts['flowrec']} {facts.get('git_commit', '')[:10]}{changed}"


def kept_lines(path: Path) -> list[str]:
    """The lines of a file that a bench appends to; none of a file that is not there, nor one that was cut short."""
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True) if path.exists() else []
    return lines[:-1] if lines and not lines[-1].endswith("\n") else lines


def cut_torn_end(path: Path) -> None:
    """Cut off a last line that has no end."""
    if path.exists() and not (data := path.read_bytes()).endswith(b"\n"):
        replace_content(path, data[: data.rfind(b"\n") + 1])


def choose_names(what: str, names: str | None, known: Iterable[str]) -> tuple[str, ...]:
    """The names in "A,B", all known ones if there are none given.

    Raises UsageError if a name is not known; `what` is the kind of name, as in "bench flow: no method".
    """
    known = tuple(known)
    wanted = known if names is None else tuple(dict.fromkeys(names.split(",")))
    if unknown := [name for name in wanted if name not in known]:
        raise UsageError(f"{what} {', '.join(map(repr, unknown))}; there are {', '.join(known)}")
    return wanted


def vessel_cases(folder: Path) -> list[Path]:
    """The vessel cases in a folder; UsageError if there are none."""
    cases = sorted(folder.glob("*.npz"))
    if not cases:
        raise UsageError(f"{folder}: no vessel case (*.npz) in it")
    return cases


def flow_scores(found: FlowField, truth: NDArray[np.floating], mask: Bools) -> dict[str, float | None]:
    """Scores of a field over the components of the pixels of a mask (h, w); `truth` (h, w, 2) in um/s.

    error : relative RMSE of v. within_2_sigma : fraction of the components within two stated standard deviations of the
    truth. stated_over_true : root mean square of the stated standard deviations over that of the errors; both None if
    none are stated. crps : continuous ranked probability score of the Gaussian (Gneiting and Raftery 2007, eq. 21),
    mean over the components, over the rms speed; without a standard deviation that is the mean absolute error.
    """
    true = truth[mask].astype(np.float64)
    off = found.velocity_um_s[mask].astype(np.float64) - true
    rms, error = (math.sqrt(float((each**2).sum(axis=1).mean())) for each in (true, off))
    within, stated, crps = None, None, np.abs(off)
    if found.std_um_s is not None:
        std = np.maximum(found.std_um_s[mask].astype(np.float64), 1e-9)
        within = float((np.abs(off) <= 2.0 * std).mean())
        stated = math.sqrt(float((std**2).sum(axis=1).mean())) / max(error, 1e-12)
        z = off / std
        density = np.exp(-0.5 * z**2) / math.sqrt(2.0 * math.pi)
        crps = std * (z * (2.0 * scipy.special.ndtr(z) - 1.0) + 2.0 * density - 1.0 / math.sqrt(math.pi))
    return {
        "error": error / rms,
        "within_2_sigma": within,
        "stated_over_true": stated,
        "crps": float(crps.mean()) / rms,
    }


def stated_over_true(rows: Iterable[tuple[float, float | None]]) -> float | None:
    """Root mean square of stated errors over that of the errors, of fields (error, stated over true); None: of none."""
    true, stated = np.array([(error, error * ratio) for error, ratio in rows if ratio is not None]).reshape(-1, 2).T
    return math.hypot(*stated) / max(math.hypot(*true), 1e-300) if len(true) else None


def wilson(successes: int, count: int) -> tuple[float, float]:
    """The 95 % score interval of a proportion; (0, 1) without a trial. Source: Wilson (1927)."""
    if count == 0:
        return 0.0, 1.0
    ratio, zz = successes / count, Z95 * Z95
    middle = (ratio + zz / (2 * count)) / (1 + zz / count)
    half = Z95 * math.sqrt(ratio * (1 - ratio) / count + zz / (4 * count * count)) / (1 + zz / count)
    # The ends are exact if all or none succeeded: rounding must not take them out of [0, 1].
    return (0.0 if successes == 0 else middle - half), (1.0 if successes == count else middle + half)


def paired_ratio(ratios: Floats) -> Results:
    """Geometric mean of paired ratios (n,), its bootstrap 95 % interval, and tests of the hypothesis that it is 1.

    The sign test and Wilcoxon's signed-rank test are two-sided; ties (ratio 1) count for neither side.
    """
    from scipy.stats import binomtest, wilcoxon

    if len(ratios) == 0:
        return {"count": 0}
    logs = np.log(ratios)
    rng = np.random.default_rng(0)
    means = rng.choice(logs, (_BOOTSTRAP_DRAWS, len(logs))).mean(axis=1)
    less, more = int((logs < 0).sum()), int((logs > 0).sum())
    return {
        "count": len(ratios),
        "mean": float(np.exp(logs.mean())),
        "interval_95": tuple(float(np.exp(end)) for end in np.percentile(means, (2.5, 97.5))),
        "less": less,
        "more": more,
        "sign_p": float(binomtest(less, less + more).pvalue) if less + more else 1.0,
        "wilcoxon_p": float(wilcoxon(logs).pvalue) if less + more else 1.0,
    }


def mean_with_interval(values: Sequence[float]) -> Results:
    """Mean of values and its bootstrap 95 % interval (percentiles of resampled means); NaN without a value."""
    if len(values) == 0:
        return {"mean": math.nan, "interval_95": (math.nan, math.nan)}
    sample = np.asarray(values, np.float64)
    means = np.random.default_rng(0).choice(sample, (_BOOTSTRAP_DRAWS, len(sample))).mean(axis=1)
    low, high = np.percentile(means, (2.5, 97.5))
    return {"mean": float(sample.mean()), "interval_95": (float(low), float(high))}
