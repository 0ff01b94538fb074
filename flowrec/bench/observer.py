"""`flowrec bench observer`: error of the flow that each observer tells, on the paper's lemniscate in its swirling flow.

The robot is driven along the lemniscate exactly; what differs is the noise of its measured positions, whether the flow
pulsates, and whether it rolls as far per revolution as is thought. RMSE is of the vector, over the second lap.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from flowrec.bench.figure_observer import draw
from flowrec.bench.harness import FigureFile, Results, Seed
from flowrec.bench.lemniscate import CENTRE_UM, PERIOD_S, RATE_HZ, SPIN_PER_S, place_um, vortex_map
from flowrec.estimation import HealthMonitor, Kalman, Luenberger, Observer, smooth
from flowrec.estimation.tuning import tune
from flowrec.flow import sample
from flowrec.messages import Applied, Estimate, FlowField, Health, Track
from flowrec.robot import Robot
from flowrec.session import Session
from flowrec.terminal import progress, say, table
from flowrec.units import seconds

ROBOT = Robot(radius_um=50.0, max_speed_um_s=600.0, step_out_hz=30.0, um_per_rev=25.0)
LAPS = 2
GAINS_PER_S = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0)
MAP_SHARE = 1.1  # the map is that much too strong

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Case:
    """What the observers have to cope with."""

    name: str
    noise_um: float = 10.0
    pulsation: float = 0.0  # share of the flow
    pulsation_hz: float = 1.0
    gain: float = 1.0  # true um per revolution over the nominal
    map_share: float = MAP_SHARE


CASES = (
    Case("5 um", 5.0),
    Case("10 um", 10.0),
    Case("15 um", 15.0),
    Case("10 um, pulsating", pulsation=0.5),
    Case("10 um, gain +10 %", gain=1.1),
    Case("10 um, gain +10 %, true map", gain=1.1, map_share=1.0),
)


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """A driven lap: what is known and what is true. Rows are frames."""

    tracks: list[Track]
    applied: list[Applied]
    time_s: Floats
    flow_um_s: Floats


def drive(case: Case, seed: int = 0, laps: int = LAPS) -> Run:
    """The robot on its lemniscate: its own displacement is what the flow (Simpson's rule) leaves of the way."""
    rng = np.random.default_rng(seed)
    count = round(laps * PERIOD_S * RATE_HZ)
    time = np.arange(count) / RATE_HZ

    def flow(at: Floats) -> Floats:
        away = place_um(at) - CENTRE_UM
        pulse = 1.0 + case.pulsation * np.sin(2 * np.pi * case.pulsation_hz * at)
        return np.asarray(SPIN_PER_S * pulse[:, None] * np.stack([-away[:, 1], away[:, 0]], -1))

    place, true = place_um(time), flow(time)
    carried = (true[:-1] + 4.0 * flow(time[:-1] + 0.5 / RATE_HZ) + true[1:]) / (6.0 * RATE_HZ)
    moved = np.concatenate([np.zeros((1, 2)), np.diff(place, axis=0) - carried])
    measured = place + case.noise_um * rng.standard_normal(place.shape)
    turns = moved / (case.gain * ROBOT.um_per_rev)
    stamps = [round(at * 1e9) for at in time]
    tracks = [Track(stamp, True, at, 0.9, 0, 5.0, np.zeros(4)) for stamp, at in zip(stamps, measured, strict=True)]
    applied = [Applied(stamp, 0.0, 0.0, 0.0, np.zeros(3), turn) for stamp, turn in zip(stamps, turns, strict=True)]
    return Run(tracks, applied, time, true)


def observe(observer: Observer, run: Run, field: FlowField | None = None) -> list[Estimate]:
    """The estimate after every frame."""
    estimates: list[Estimate] = []
    for track, done in zip(run.tracks, run.applied, strict=True):
        estimates.append(observer.estimate(estimates[-1] if estimates else None, track, done, ROBOT, field))
    return estimates


def rmse(run: Run, flow_um_s: Floats) -> float:
    """Of the vector over the second half, um/s."""
    half = len(run.time_s) // 2
    return float(np.sqrt(np.square(flow_um_s - run.flow_um_s)[half:].sum(axis=1).mean()))


def _flows(estimates: list[Estimate]) -> Floats:
    return np.array([estimate.flow_um_s for estimate in estimates])


def _alarm(estimates: list[Estimate]) -> tuple[str, float | None]:
    """The alarms of a run and when the first began, s."""
    monitor = HealthMonitor()
    health: Health | None = None
    before: Estimate | None = None
    names: set[str] = set()
    first: float | None = None
    for estimate in estimates:
        health = monitor.watch(health, before, estimate, None, ROBOT)
        before = estimate
        if health.alarm:
            names |= set(health.alarm.split("; "))
            first = seconds(estimate.stamp_ns) if first is None else first
    return ", ".join(sorted(names)), first


def measure(
    session: Annotated[
        Path | None, typer.Option(metavar="FILE.mcap", help="Also recommend settings for this recording.")
    ] = None,
    figure: FigureFile = None,
    seed: Seed = 0,
) -> Results:
    """Error per case and observer. With a recorded session also what settings it recommends.

    Raises
    ------
    UsageError
        If a figure is wanted and matplotlib is not installed, or the session is too short.
    """
    rows: list[dict[str, Any]] = []
    curves: dict[str, Floats] = {}
    truth: Floats | None = None
    time: Floats | None = None
    with progress("observing", len(CASES)) as done:
        for number, case in enumerate(CASES):
            run = drive(case, seed)
            field = vortex_map(case.map_share - 1.0)
            kalman = Kalman(position_noise_um=case.noise_um)
            tried = {
                gain: _flows(observe(Observer("luenberger", luenberger=Luenberger(gain)), run)) for gain in GAINS_PER_S
            }
            best = min(tried, key=lambda gain: rmse(run, tried[gain]))

            def by(observer: Observer, known: FlowField | None = None, run: Run = run) -> tuple[Floats, list[Estimate]]:
                estimates = observe(observer, run, known)
                return _flows(estimates), estimates

            found: dict[str, tuple[Floats, list[Estimate]]] = {
                "luenberger": (tried[1.0], []),
                "luenberger, best gain": (tried[best], []),
                "kalman": by(Observer(kalman=kalman)),
                "kalman_map": by(Observer("kalman_map", kalman=kalman), field),
                "map alone": (sample(field, place_um(run.time_s)), []),
                "smoother": (smooth(run.tracks, run.applied, kalman, ROBOT).flow_um_s, []),
            }
            if case.gain != 1.0:
                felt = replace(kalman, estimate_gain=True)
                found["kalman, gain felt"] = by(Observer(kalman=felt))
                found["kalman_map, gain felt"] = by(Observer("kalman_map", kalman=felt), field)
            for name, (flow, estimates) in found.items():
                half = len(estimates) // 2
                alarm, after_s = _alarm(estimates) if estimates else ("", None)
                gain = estimates[-1].um_per_rev if estimates else None
                rows.append(
                    {
                        "case": case.name,
                        "observer": name,
                        "rmse_um_s": rmse(run, flow),
                        "nis": float(np.nanmean([one.nis for one in estimates[half:]])) if estimates else None,
                        "alarm": alarm,
                        "alarm_after_s": after_s,
                        "um_per_rev": gain,
                        "gain_per_s": {"luenberger": 1.0, "luenberger, best gain": best}.get(name),
                    }
                )
            if case.name == "10 um":
                curves = {name: flow for name, (flow, _) in found.items()}
                truth, time = run.flow_um_s, run.time_s
            done(number + 1)
    if figure is not None:
        assert time is not None and truth is not None
        draw(figure, time, truth, curves, rows)
    figures: dict[str, Any] = {"seed": seed, "map_share": MAP_SHARE, "rows": rows}
    if session is not None:
        figures["session"] = recommend(session)
    return figures


def recommend(path: Path) -> dict[str, Any]:
    """Settings of the Kalman filter that suit a recording, and the alarms that its observer would have raised."""
    session = Session(path)
    config = session.config
    ticks = [tick for tick in session.ticks(with_frames=False) if tick.track is not None and tick.applied is not None]
    tracks, applied = [tick.track for tick in ticks], [tick.applied for tick in ticks]
    fields = [tick.field for tick in ticks] if config.observer.method == "kalman_map" else None
    tuned = tune(tracks, applied, config.robot, config.observer.kalman, fields)  # type: ignore[arg-type]
    return {
        "path": str(path),
        "sets": tuned.sets,
        "position_noise_um": tuned.position_noise_um,
        "position_noise_from": tuned.source,
        "rest_s": tuned.rest_s,
        "agility": tuned.agility,
        "nis": tuned.nis,
        "nis_before": tuned.nis_before,
    }


def show(figures: dict[str, Any]) -> None:
    """Print the table, and what a session recommends."""
    names = list(dict.fromkeys(row["observer"] for row in figures["rows"]))
    cases = list(dict.fromkeys(row["case"] for row in figures["rows"]))
    lines = []
    for name in names:
        cells = []
        for case in cases:
            row = next((one for one in figures["rows"] if (one["case"], one["observer"]) == (case, name)), None)
            said = "" if row is None else f"{row['rmse_um_s']:.1f}"
            if row is not None and row["nis"] is not None and math.isfinite(row["nis"]):
                said += f" ({row['nis']:.2f})"
            cells.append(said)
        lines.append((name, *cells))
    table("RMSE of the flow in um/s (and mean NIS)", ("observer", *cases), lines)
    for row in figures["rows"]:
        if row["alarm"]:
            say(f"alarm in {row['case']} by {row['observer']}: {row['alarm']} after {row['alarm_after_s']:.1f} s")
        if row["um_per_rev"] is not None:
            say(f"{row['case']}: {row['observer']} finds {row['um_per_rev']:.2f} um per revolution")
    if "session" in figures:
        found = figures["session"]
        say(
            f"{found['path']}: position noise {found['position_noise_um']:.2f} um from a {found['position_noise_from']}"
            f" robot; NIS {found['nis_before']:.2f} as recorded, {found['nis']:.2f} with"
        )
        for text in found["sets"]:
            say(f"  --set {text}")
