"""`python -m tests.perf.alignment DIR`: the fit of a log to a movie beside two simple rivals, on the same missions.

Each simulated mission is a track and a table of commands on a clock of its own, half of them with another rate. A track
is given its own log, its own log after it was spoilt (see `spoilt`), and logs of other missions. All methods search the
same offsets and rates. The thresholds of the rivals are those that make the fewest mistakes on the other half of the
missions.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer
from numpy.typing import NDArray

import flowrec
from flowrec.bench.harness import Results, run
from flowrec.core.errors import UsageError
from flowrec.core.messages import FlowField
from flowrec.core.terminal import progress, table
from flowrec.core.units import NS_PER_S, nanoseconds
from flowrec.measure.calibrate_motion import ANYWHERE, fit_log
from flowrec.stages.config import load_config
from flowrec.stages.control.field_log import FieldLog
from flowrec.verbs.record import record

Floats = NDArray[np.float64]
SESSIONS = Path(__file__).parents[2] / "sessions"
# Name, configuration, and settings: what a laboratory may have.
FAMILIES = {
    "upstream": ("upstream.toml", ()),
    "downstream": ("downstream.toml", ()),
    "vessels": ("vessels.toml", ()),
    "10 Hz": ("upstream.toml", ("camera.rate_hz=10",)),
    "unsteady": (
        "upstream.toml",
        (
            "simulated.heading_noise_rad=0.15",
            "simulated.speed_noise=0.15",
            "simulated.position_noise_um=4",
            "simulated.pulsation_share=0.3",
        ),
    ),
    "slow": ("downstream.toml", ("robot.max_speed_um_s=250",)),
}
_LEAST_OVERLAP = 0.5
_RATE_STEP = 0.6  # frames by which the ends of the movie move between two rates
_WRONG_S = 0.02  # an accepted offset with a larger error is a mistake


@dataclass(frozen=True, slots=True, eq=False)
class Mission:
    """What a laboratory has of a run."""

    family: str
    seed: int
    stamps_ns: NDArray[np.int64]
    positions_um: Floats
    log: FieldLog
    flow: FlowField | None
    delay_s: float


class Found(NamedTuple):
    """Time of the log = offset_s + rate * time of the movie."""

    offset_s: float
    rate: float
    score: float
    accepted: bool | None  # None: by a threshold of the score
    why: str = ""  # it is refused


def mission(folder: Path, family: str, seed: int) -> Mission:
    """Fly a mission, or read it again."""
    out = folder / f"{family.replace(' ', '')}_{seed}.mcap"
    if not out.exists():
        toml, sets = FAMILIES[family]
        seeds = [f"simulated.seed={seed}", *([f"chip.seed={seed}"] if family == "vessels" else [])]
        small = ["recording.region=robot", "recording.full_every_s=1000000", "recording.frames=jpeg"]
        record(load_config(SESSIONS / toml, [*seeds, *sets, *small, "duration_s=60"]), out)
    with flowrec.open(out) as session:
        tracks = [track for track in session.messages("track") if track.seen]
        currents = list(session.messages("currents"))
        changed = [
            now
            for before, now in zip([None, *currents[:-1]], currents, strict=True)
            if before is None or _command(before) != _command(now)
        ]
        log = FieldLog([each.stamp_ns for each in changed], *np.array([_command(each) for each in changed]).T)
        return Mission(
            family,
            seed,
            np.array([track.stamp_ns for track in tracks], np.int64),
            np.array([track.position_um for track in tracks]),
            log,
            session.fields.get("assumed"),
            session.config.robot.delay_s,
        )


def _command(currents: Any) -> tuple[float, float, float]:
    return currents.frequency_hz, currents.heading_rad, currents.amplitude_mt


def spoilt(given: Mission, rng: np.random.Generator) -> Mission:
    """Another particle is followed for 2 s, 5 positions are wrong, a fifth of the images and a second of them lack."""
    stamps, positions = given.stamps_ns, given.positions_um.copy()
    count, step_s = len(stamps), float(np.median(np.diff(stamps))) / NS_PER_S
    angle = rng.uniform(-math.pi, math.pi, 5)
    positions[rng.choice(count, 5, replace=False)] += 400.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    other = min(int(2.0 / step_s), count // 5)
    first = int(rng.integers(5, count - other - 5))
    drift = rng.normal(0.0, 150.0, 2) * step_s * np.arange(other)[:, None]
    positions[first : first + other] = given.positions_um[first] + [400.0, 150.0] + drift
    kept = rng.random(count) > 0.2
    gap = min(int(1.0 / step_s), count // 10)
    begin = int(rng.integers(5, count - gap))
    kept[begin : begin + gap] = False
    return replace(given, stamps_ns=stamps[kept], positions_um=positions[kept])


def ours(given: Mission, log: FieldLog) -> Found:
    """The fit of `flowrec import --align`."""
    try:
        fit = fit_log(given.stamps_ns, given.positions_um, log, ANYWHERE, given.flow)
    except UsageError as error:
        return Found(0.0, 1.0, 0.0, accepted=False, why=str(error))
    return Found(fit.offset_s, fit.rate, fit.explained, not fit.refusal, fit.refusal)


def _correlated(pick: Callable[[Floats, Floats], tuple[Floats, Floats]], given: Mission, log: FieldLog) -> Found:
    """The largest correlation of two series (n, d) of velocities, um/s and revolutions per second.

    Parameters
    ----------
    pick : makes the series of velocity (n, 2) and rotation (m, 2).
    """
    times_s = given.stamps_ns / NS_PER_S
    step_s = float(np.median(np.diff(times_s)))
    grid = np.arange(times_s[0], times_s[-1], step_s)
    way = np.column_stack([np.interp(grid, times_s, given.positions_um[:, axis]) for axis in (0, 1)])
    velocity = np.diff(way, axis=0) / step_s
    begin_s, end_s = log.times_ns[0] / NS_PER_S, log.times_ns[-1] / NS_PER_S
    n, best = len(velocity), Found(0.0, 1.0, -1.0, accepted=None)
    span = math.log(ANYWHERE.largest_rate)
    step = _RATE_STEP / (n / 2)
    for k in range(-int(span / step), int(span / step) + 1):
        rate = math.exp(k * step)
        least = max(int(_LEAST_OVERLAP * min(n, (end_s - begin_s) / (step_s * rate))), 3)
        first_s = begin_s - (n - least) * step_s * rate
        lags = max(int((end_s - begin_s) / (step_s * rate)) + n - 2 * least, 3)
        at_ns = (first_s + step_s * rate * np.arange(lags + n)) * NS_PER_S
        rotation = np.diff(log.turns_until(np.minimum(at_ns, log.times_ns[-1])), axis=0) / (step_s * rate)
        moved, turned = pick(velocity, rotation)
        score = _normalised(moved, turned, lags)
        lag = int(np.argmax(score))
        if score[lag] > best.score:
            near = score[lag - 1 : lag + 2] if 0 < lag < lags - 1 else np.array([0.0, 1.0, 0.0])
            bend = near[0] - 2.0 * near[1] + near[2]
            part = 0.5 * float((near[0] - near[2]) / bend) if bend < 0.0 else 0.0
            offset_s = first_s + (lag + part) * step_s * rate - rate * float(grid[0])
            best = Found(offset_s, rate, float(score[lag]), accepted=None)
    return best


def _normalised(moved: Floats, turned: Floats, lags: int) -> Floats:
    """(lags,) correlation coefficients of (n, d) with each stretch of (lags + n - 1, d), means taken off."""
    n = len(moved)
    moved = moved - moved.mean(0)
    size = 1 << (len(turned) + n).bit_length()
    ones, total = np.zeros((size, 1)), np.zeros(lags)
    ones[:n] = 1.0

    def slide(left: Floats, right: Floats) -> Floats:
        product = np.conj(np.fft.rfft(left, size, axis=0)) * np.fft.rfft(right, size, axis=0)
        return np.asarray(np.fft.irfft(product, size, axis=0)[:lags], np.float64)

    total = slide(moved, turned).sum(1)
    energy = (slide(ones, turned**2) - slide(ones, turned) ** 2 / n).sum(1)
    floor = 1e-6 * max(float(energy.max()), 1e-300)
    return np.where(energy > floor, total / np.sqrt(np.maximum(energy, floor) * max((moved**2).sum(), 1e-300)), 0.0)


def by_speed(given: Mission, log: FieldLog) -> Found:
    """The null model: speed of the track against the commanded frequency."""
    return _correlated(lambda v, f: (np.hypot(*v.T)[:, None], np.hypot(*f.T)[:, None]), given, log)


def by_velocity(given: Mission, log: FieldLog) -> Found:
    """Both components of the velocity against those of the commanded rotation; the axes of the log must be right."""
    return _correlated(lambda v, f: (v, f), given, log)


METHODS: dict[str, Callable[[Mission, FieldLog], Found]] = {
    "flowrec": ours,
    "velocity": by_velocity,
    "speed": by_speed,
}


def measured(missions: list[Mission], foreign: int, names: tuple[str, ...]) -> list[dict[str, Any]]:
    """One row for each case and method."""
    rows: list[dict[str, Any]] = []
    with progress("cases", len(missions)) as done:
        for number, one in enumerate(missions):
            rng = np.random.default_rng([one.seed, number])
            rate, shift_s = (25.0 / 30.0 if number % 2 else 1.0), float(rng.uniform(-2e3, 2e4))
            # The movie's clock is faster by 1 / rate; times of the log are those of the run, later by the shift.
            movie = replace(one, stamps_ns=np.rint(one.stamps_ns / rate).astype(np.int64))
            same = [each for each in missions if each.family == one.family and each is not one]
            other = [each for each in missions if each.family != one.family]
            cases = [("own", movie, one), ("own, spoilt", spoilt(movie, rng), one)]
            foreigners = (
                ("same kind", movie, same),
                ("other kind", movie, other),
                ("same kind, spoilt", cases[1][1], same),
            )
            cases += [
                (f"of another run, {kind}", given, pool[int(rng.integers(len(pool)))])
                for kind, given, pool in foreigners
                for _ in range(foreign)
                if pool
            ]
            for kind, given, source in cases:
                log = source.log.shift_clock(nanoseconds(shift_s))
                middle_s = float(given.stamps_ns.mean()) / NS_PER_S
                true_s = rate * middle_s + shift_s - one.delay_s
                for name in names:
                    found = METHODS[name](given, log)
                    error_s = found.offset_s + found.rate * middle_s - true_s
                    rows.append(
                        {
                            "fold": number // 2 % 2, "mission": f"{one.family} {one.seed}", "log": source.seed,
                            "case": kind, "own": kind.startswith("own"), "method": name, "score": found.score,
                            "accepted": found.accepted, "error_s": error_s, "rate_error": found.rate / rate - 1.0,
                            "why": found.why,
                        }
                    )  # fmt: skip
            done(number + 1)
    for name in names:
        mine = [row for row in rows if row["method"] == name]
        if mine and mine[0]["accepted"] is None:
            for fold in (0, 1):
                least = _threshold([row for row in mine if row["fold"] != fold])
                for row in mine:
                    if row["fold"] == fold:
                        row["accepted"] = row["score"] >= least
    return rows


def _threshold(rows: list[dict[str, Any]]) -> float:
    """The score from which on a fit is accepted with the fewest mistakes."""
    right = {id(row): row["own"] and abs(row["error_s"]) < _WRONG_S for row in rows}
    scores = sorted({row["score"] for row in rows}) or [0.0]

    def mistakes(least: float) -> int:
        return sum((row["score"] >= least) != right[id(row)] for row in rows)

    return min([*scores, scores[-1] + 1e-9], key=mistakes)


def measure(
    folder: Annotated[Path, typer.Argument(help="Folder for the missions, about 5 MB each; those there are used.")],
    count: Annotated[int, typer.Option(min=2, help="Missions of each family.")] = 10,
    first: Annotated[int, typer.Option(min=0, help="First seed.")] = 1000,
    foreign: Annotated[int, typer.Option(min=1, help="Logs of other runs of each kind, for each mission.")] = 1,
    methods: Annotated[str, typer.Option(help="Comma-separated names of methods.")] = ",".join(METHODS),
) -> Results:
    """Errors, false refusals and false acceptances of each method."""
    folder.mkdir(parents=True, exist_ok=True)
    missions = []
    with progress("missions", count * len(FAMILIES)) as done:
        for number in range(count):
            for family in FAMILIES:
                missions.append(mission(folder, family, first + number))
                done(len(missions))
    return {"rows": measured(missions, foreign, tuple(methods.split(",")))}


def show(results: Results) -> None:
    """One line for each case and method."""
    rows = results["rows"]
    cells = []
    for case in dict.fromkeys(row["case"] for row in rows):
        for method in dict.fromkeys(row["method"] for row in rows):
            mine = [row for row in rows if (row["case"], row["method"]) == (case, method)]
            accepted = [row for row in mine if row["accepted"]]
            errors_ms = 1e3 * np.abs([row["error_s"] for row in mine])
            own = mine[0]["own"]
            wrong = sum(abs(row["error_s"]) >= _WRONG_S for row in accepted) if own else len(accepted)
            cells.append(
                (
                    case, method, str(len(mine)), f"{len(accepted)}", f"{wrong}",
                    f"{np.median(errors_ms):.2f}, {np.quantile(errors_ms, 0.95):.3g}" if own else "",
                    f"{(errors_ms <= 3.0).mean():.0%}" if own else "",
                )
            )  # fmt: skip
    table(
        "Log against movie",
        ("log", "method", "cases", "accepted", "of these wrong", "offset error ms: median, 95 %", "within 3 ms"),
        cells,
    )


if __name__ == "__main__":
    run(measure, show)
