"""`flowrec bench observer`: error of the flow that each observer estimates, on the paper's lemniscate in a vortex.

The robot moves along the lemniscate exactly. The cases differ in the noise of the measured positions, in pulsation of
the flow and in the error of the displacement per revolution. RMSE is that of the vector over the second lap.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from flowrec.bench.figures import draw_observer
from flowrec.bench.harness import FigureFile, Results, Seed
from flowrec.bench.lemniscate import CENTRE_UM, PERIOD_S, RATE_HZ, SPIN_PER_S, place_um, vortex_map
from flowrec.core import Applied, Estimate, Floats, FlowField, Health, Track, progress, say, seconds, table
from flowrec.measure import tune
from flowrec.physics import Robot, sample
from flowrec.stages import OBSERVERS, HealthMonitor, Kalman, Luenberger, Observer, smooth, with_row
from flowrec.store import Session

ROBOT = Robot(radius_um=50.0, max_speed_um_s=600.0, step_out_hz=30.0, um_per_rev=25.0)
LAPS = 2  # of the lemniscate
GAINS_PER_S = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0)  # tried of the Luenberger observer; that of the paper is 1
MAP_SCALE = 1.1  # of the map over the true flow: a tenth too fast
PULSATION_HZ = 1.0
DRAWN = "10 um"


@dataclass(frozen=True, slots=True)
class ObserverCase:
    """Conditions of one run."""

    name: str
    noise_um: float = 10.0
    pulsation: float = 0.0  # amplitude, relative to the flow
    gain: float = 1.0  # true um per revolution over the nominal value
    map_scale: float = MAP_SCALE  # of the map over the true flow


CASES = (
    ObserverCase("5 um", 5.0),
    ObserverCase("10 um", 10.0),
    ObserverCase("15 um", 15.0),
    ObserverCase("10 um, pulsating", pulsation=0.5),
    ObserverCase("10 um, gain +10 %", gain=1.1),
    ObserverCase("10 um, gain +10 %, true map", gain=1.1, map_scale=1.0),
)


@dataclass(frozen=True, slots=True, eq=False)
class ObserverRun:
    """Inputs of the observer and the truth, frame by frame."""

    tracks: list[Track]
    applied: list[Applied]
    time_s: Floats  # (n,)
    flow_um_s: Floats  # (n, 2) true


def drive(case: ObserverCase, seed: int = 0, laps: int = LAPS) -> ObserverRun:
    """The robot on the lemniscate. Its own displacement is the path less that by the flow (Simpson's rule)."""
    rng = np.random.default_rng(seed)
    count = round(laps * PERIOD_S * RATE_HZ)
    time = np.arange(count) / RATE_HZ

    def flow(at: Floats) -> Floats:
        away = place_um(at) - CENTRE_UM
        pulse = 1.0 + case.pulsation * np.sin(2 * np.pi * PULSATION_HZ * at)
        return SPIN_PER_S * pulse[:, None] * np.stack([-away[:, 1], away[:, 0]], -1)

    place, true = place_um(time), flow(time)
    carried = (true[:-1] + 4.0 * flow(time[:-1] + 0.5 / RATE_HZ) + true[1:]) / (6.0 * RATE_HZ)
    moved = np.concatenate([np.zeros((1, 2)), np.diff(place, axis=0) - carried])
    measured = place + case.noise_um * rng.standard_normal(place.shape)
    turns = moved / (case.gain * ROBOT.um_per_rev)
    stamps = [round(at * 1e9) for at in time]
    tracks = [Track(stamp, True, at, 0.9, 0, 5.0, np.zeros(4)) for stamp, at in zip(stamps, measured, strict=True)]
    applied = [Applied(stamp, 0.0, 0.0, 0.0, np.zeros(3), turn) for stamp, turn in zip(stamps, turns, strict=True)]
    return ObserverRun(tracks, applied, time, true)


def observe(observer: Observer, run: ObserverRun, field: FlowField | None = None) -> list[Estimate]:
    """The estimate after every frame."""
    estimates: list[Estimate] = []
    for track, done in zip(run.tracks, run.applied, strict=True):
        estimates.append(observer.estimate(estimates[-1] if estimates else None, track, done, ROBOT, field))
    return estimates


def rmse(run: ObserverRun, flow_um_s: Floats) -> float:
    """RMSE of the vector over the second half of the run, um/s."""
    half = len(run.time_s) // 2
    return float(np.sqrt(np.square(flow_um_s - run.flow_um_s)[half:].sum(axis=1).mean()))


def estimates_of(case: ObserverCase, run: ObserverRun) -> tuple[dict[str, tuple[Floats, list[Estimate]]], float]:
    """Estimated flow (n, 2) in um/s by observer, with the estimates if it makes one per frame; the best gain, 1/s.

    Beside the rows of OBSERVERS: the Luenberger observer with its best gain, the smoother, the map alone, the Kalman
    filters that also estimate the displacement per revolution (if that is wrong), and a flow of zero.
    """
    field, kalman = vortex_map(case.map_scale - 1.0), Kalman(position_noise_um=case.noise_um)
    observers = {name: with_row(Observer(kalman=kalman), OBSERVERS, name) for name in OBSERVERS.usable()}
    if case.gain != 1.0:
        adapting = replace(kalman, estimate_gain=True)
        observers |= {f"{name}, gain estimated": Observer(name, kalman=adapting) for name in ("kalman", "kalman_map")}
    gains = [Observer("luenberger", luenberger=Luenberger(gain)) for gain in GAINS_PER_S]
    best = min(gains, key=lambda observer: rmse(run, _flows(observe(observer, run))))
    found = {name: observe(observer, run, field) for name, observer in observers.items()}
    found["luenberger, best gain"] = observe(best, run)
    flows = {name: (_flows(estimates), estimates) for name, estimates in found.items()}
    flows |= {
        "smoother": (smooth(run.tracks, run.applied, kalman, ROBOT).flow_um_s, []),
        "map alone": (sample(field, place_um(run.time_s)), []),
        "no observer": (np.zeros_like(run.flow_um_s), []),
    }
    return flows, best.luenberger.gain_per_s


def _flows(estimates: list[Estimate]) -> Floats:
    return np.array([estimate.flow_um_s for estimate in estimates])


def _alarms(estimates: list[Estimate]) -> tuple[str, float | None]:
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
            names |= set(health.alarms)
            first = seconds(estimate.stamp_ns) if first is None else first
    return ", ".join(sorted(names)), first


def measure(
    session: Annotated[
        Path | None, typer.Option(metavar="FILE.mcap", help="Also recommend settings for this recording.")
    ] = None,
    figure: FigureFile = None,
    seed: Seed = 0,
) -> Results:
    """Error by case and observer; with a recorded session also the settings that it recommends.

    Raises UsageError if the session is too short.
    """
    rows: list[dict[str, Any]] = []
    drawn: tuple[Floats, Floats, dict[str, Floats]] | None = None
    recommended: Results | None = None
    with progress("observing", len(CASES) + int(session is not None), "cases") as done:
        for number, case in enumerate(CASES):
            run = drive(case, seed)
            found, best_gain = estimates_of(case, run)
            gains = {"luenberger": 1.0, "luenberger, best gain": best_gain}
            for name, (flow, estimates) in found.items():
                nis = np.array([one.nis for one in estimates[len(estimates) // 2 :]])
                has_nis = bool(np.isfinite(nis).any())
                alarm, after_s = _alarms(estimates) if has_nis else ("", None)
                rows.append(
                    {
                        "case": case.name,
                        "observer": name,
                        "rmse_um_s": rmse(run, flow),
                        "nis": float(np.nanmean(nis)) if has_nis else None,
                        "alarm": alarm,
                        "alarm_after_s": after_s,
                        "um_per_rev": estimates[-1].um_per_rev if estimates else None,
                        "gain_per_s": gains.get(name),
                    }
                )
            if case.name == DRAWN:
                drawn = run.time_s, run.flow_um_s, {name: flow for name, (flow, _) in found.items()}
            done(number + 1)
        if session is not None:
            recommended = recommend(session)
            done(len(CASES) + 1)
    if figure is not None:
        assert drawn is not None
        noises = {case.name: case.noise_um for case in CASES[:3]}
        of = {(row["case"], row["observer"]): row["rmse_um_s"] for row in rows}
        by_noise = {name: {um: of[case, name] for case, um in noises.items()} for name in drawn[2]}
        draw_observer(figure, *drawn, by_noise)
    results: Results = {"seed": seed, "map_share": MAP_SCALE, "rows": rows}
    return results if recommended is None else results | {"session": recommended}


def recommend(path: Path) -> dict[str, Any]:
    """Settings of the Kalman filter that suit a recording."""
    session = Session(path)
    config = session.config
    ticks = [tick for tick in session.ticks(with_frames=False) if tick.track is not None and tick.applied is not None]
    tracks, applied = [tick.track for tick in ticks], [tick.applied for tick in ticks]
    fields = [tick.field for tick in ticks] if "map" in OBSERVERS[config.observer.method].needs else None
    tuned = tune(tracks, applied, config.robot, config.observer.kalman, fields)  # type: ignore[arg-type]
    keys = ("sets", "position_noise_um", "rest_s", "agility", "nis", "nis_before")
    return {"path": str(path), "position_noise_from": tuned.source, **{key: getattr(tuned, key) for key in keys}}


def show(results: Results) -> None:
    """Print the table, the alarms, and what a session recommends."""
    rows = {(row["observer"], row["case"]): row for row in results["rows"]}
    cases = list(dict.fromkeys(case for _, case in rows))

    def cell(row: dict[str, Any] | None) -> str:
        if row is None:
            return ""
        return f"{row['rmse_um_s']:.1f}" + ("" if row["nis"] is None else f" ({row['nis']:.2f})")

    names = dict.fromkeys(name for name, _ in rows)
    lines = [(name, *(cell(rows.get((name, case))) for case in cases)) for name in names]
    table("RMSE of the flow in um/s (and mean NIS)", ("observer", *cases), lines)
    for (name, case), row in rows.items():
        if row["alarm"]:
            say(f"alarm in {case} by {name}: {row['alarm']} after {row['alarm_after_s']:.1f} s")
        if row["um_per_rev"] is not None:
            say(f"{case}: {name} estimates {row['um_per_rev']:.2f} um per revolution")
    if "session" in results:
        found = results["session"]
        say(
            f"{found['path']}: position noise {found['position_noise_um']:.2f} um from a {found['position_noise_from']}"
            f" robot; NIS {found['nis_before']:.2f} as recorded, {found['nis']:.2f} with"
        )
        for text in found["sets"]:
            say(f"  --set {text}")
