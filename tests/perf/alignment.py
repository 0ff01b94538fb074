"""`python -m tests.perf.alignment DIR`: the fit of a log to a movie, on simulated missions.

Each simulated mission is a track and a table of commands on a clock of its own, half of them with another rate. A track
is given its own log, its own log after it was spoilt (see `spoilt`), and logs of other missions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer
from numpy.typing import NDArray

import flowrec
from flowrec.bench.harness import Results, run
from flowrec.core import NS_PER_S, FlowField, UsageError, nanoseconds, progress, table
from flowrec.measure import ANYWHERE, fit_log
from flowrec.stages import FieldLog, load_config
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
    why: str  # it is refused; "": it is accepted


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


def fitted(given: Mission, log: FieldLog) -> Found:
    """The fit of `flowrec import --align`."""
    try:
        fit = fit_log(given.stamps_ns, given.positions_um, log, ANYWHERE, given.flow)
    except UsageError as error:
        return Found(0.0, 1.0, 0.0, str(error))
    return Found(fit.offset_s, fit.rate, fit.explained, fit.refusal)


def measured(missions: list[Mission], foreign: int) -> list[dict[str, Any]]:
    """One row for each case."""
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
                found = fitted(given, log)
                error_s = found.offset_s + found.rate * middle_s - true_s
                rows.append(
                    {
                        "mission": f"{one.family} {one.seed}", "log": source.seed, "case": kind,
                        "own": kind.startswith("own"), "score": found.score, "accepted": not found.why,
                        "error_s": error_s, "rate_error": found.rate / rate - 1.0, "why": found.why,
                    }
                )  # fmt: skip
            done(number + 1)
    return rows


def measure(
    folder: Annotated[Path, typer.Argument(help="Folder for the missions, about 5 MB each; those there are used.")],
    count: Annotated[int, typer.Option(min=2, help="Missions of each family.")] = 10,
    first: Annotated[int, typer.Option(min=0, help="First seed.")] = 1000,
    foreign: Annotated[int, typer.Option(min=1, help="Logs of other runs of each kind, for each mission.")] = 1,
) -> Results:
    """Errors, false refusals and false acceptances."""
    folder.mkdir(parents=True, exist_ok=True)
    missions = []
    with progress("missions", count * len(FAMILIES)) as done:
        for number in range(count):
            for family in FAMILIES:
                missions.append(mission(folder, family, first + number))
                done(len(missions))
    return {"rows": measured(missions, foreign)}


def show(results: Results) -> None:
    """One line for each case."""
    rows = results["rows"]
    cells = []
    for case in dict.fromkeys(row["case"] for row in rows):
        mine = [row for row in rows if row["case"] == case]
        accepted = [row for row in mine if row["accepted"]]
        errors_ms = 1e3 * np.abs([row["error_s"] for row in mine])
        own = mine[0]["own"]
        wrong = sum(abs(row["error_s"]) >= _WRONG_S for row in accepted) if own else len(accepted)
        offset = (f"{np.median(errors_ms):.2f}, {np.quantile(errors_ms, 0.95):.3g}", f"{(errors_ms <= 3.0).mean():.0%}")
        cells.append((case, str(len(mine)), str(len(accepted)), str(wrong), *(offset if own else ("", ""))))
    columns = ("log", "cases", "accepted", "of these wrong", "offset error ms: median, 95 %", "within 3 ms")
    table("Log against movie", columns, cells)


if __name__ == "__main__":
    run(measure, show)
