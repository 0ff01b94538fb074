"""`flowrec bench track`: the tracking study of the paper, how closely each law follows a lemniscate in a vortex.

Besides, the tracker on movies of robots of many looks.

The Observer and Controller stages run on a plant that is integrated exactly (lemniscate.py).
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from scipy.spatial import KDTree

from flowrec.bench.figures import draw_track
from flowrec.bench.harness import FigureFile, Results, print_rows
from flowrec.bench.lemniscate import CENTRE_UM, PERIOD_S, LemniscateRun, RunDisturbances, fly, lemniscate
from flowrec.bench.robot_tracking import show_rows, tracking_rows
from flowrec.core import Floats, progress, table
from flowrec.stages import CONTROLLERS, OBSERVERS, Controller, Kalman, Observer, with_row

V_MAX_UM_S = 1000.0
NO_LIMIT_UM_S = 1e6
CONVERGED_UM = 50.0
_LAST_FRAMES = 30  # the last second of a run
IDEAL = RunDisturbances()
ALL = RunDisturbances(delay_s=0.04, noise_um=10.0, map_error=0.1)
WORLDS = {"ideal": IDEAL, "all": ALL}
STEP_OUTS_UM_S = (600.0, 500.0)


@dataclass(frozen=True, slots=True)
class ControlLoop:
    """A controller with its observer."""

    method: str
    observer: str
    v_max_um_s: float = V_MAX_UM_S


# As in the paper, luenberger does not filter the measured position. The null model is the law without compensation.
LAWS = {
    "paper, with compensation": ControlLoop("ff_fb", "luenberger"),
    "paper, without": ControlLoop("ff_fb_no_flow", "luenberger"),
    "paper, with observer": ControlLoop("ff_fb_observer", "luenberger"),
    "paper as printed": ControlLoop("ff_fb_literal", "luenberger"),
    "paper as printed, no limit": ControlLoop("ff_fb_literal", "luenberger", NO_LIMIT_UM_S),
    "paper's law, kalman_map": ControlLoop("ff_fb", "kalman_map"),
    **{f"vector, {name}": ControlLoop("vector", name) for name in OBSERVERS.usable()},
}
# Other methods that follow a reference; the rest needs a time to go, which a lemniscate does not have.
LAWS |= {
    f"{name}, kalman_map": ControlLoop(name, "kalman_map")
    for name in CONTROLLERS.usable()
    if not CONTROLLERS[name].needs and name not in {law.method for law in LAWS.values()}
}
FIRST = ("paper, with compensation", "paper, without", "paper, with observer")
OURS = ("paper, with compensation", "vector, kalman", "vector, kalman_map")

# The paper's reference moves on wherever the robot is. That of flowrec is no faster than the robot, and by default it
# waits for a robot that is behind.
FIXED_PACE = Controller(lag_free_radii=1e9, lag_full_radii=2e9, pace_share=1e9)
PACES = {
    "as planned": FIXED_PACE,
    "limited speed": replace(FIXED_PACE, pace_share=Controller().pace_share),
    "limited speed, waits": Controller(),
}


def measure(
    seeds: Annotated[int, typer.Option(min=1, help="Runs with noise per law.")] = 5,
    figure: FigureFile = None,
    movies: Annotated[Path | None, typer.Option(metavar="DIR", help="Recorded movies: NAME/*.png, NAME.csv.")] = None,
) -> Results:
    """Every law in both worlds; two laws with a step-out speed below what the reference needs, at each pace.

    Besides, the tracker on robots of many looks, and on the recorded movies of a folder.
    """
    flown: dict[tuple[str, str], list[LemniscateRun]] = {}
    step_out: list[dict[str, Any]] = []
    bounded = ("paper, with compensation", "vector, kalman_map")
    total = len(LAWS) * len(WORLDS) + len(bounded) * len(STEP_OUTS_UM_S) * len(PACES) + 1
    with progress("tracking", total, "runs") as done:
        for world_name, world in WORLDS.items():
            for name, law in LAWS.items():
                flown[name, world_name] = flights(law, FIXED_PACE, world, seeds)
                done(len(flown))
        for top_um_s in STEP_OUTS_UM_S:
            world = replace(ALL, step_out_um_s=top_um_s)
            for name in bounded:
                for pace, controller in PACES.items():
                    made = flights(LAWS[name], controller, world, seeds)
                    step_out.append(score(f"{name}; {pace}", f"step-out at {top_um_s:g} um/s", made))
                    done(len(flown) + len(step_out))
        looks = list(tracking_rows(movies))
        done(total)
    if figure is not None:
        panels = {
            "laws of the paper, ideal": {name: flown[name, "ideal"][0] for name in FIRST},
            "40 ms latency, 10 µm noise, map 10 % too strong": {name: flown[name, "all"][0] for name in OURS},
        }
        draw_track(figure, lemniscate(1).waypoints_um - CENTRE_UM, panels, PERIOD_S)
    return {
        "seeds": seeds,
        "v_max_um_s": V_MAX_UM_S,
        "worlds": {name: asdict(world) for name, world in WORLDS.items()},
        "rows": [score(name, world, made) for (name, world), made in flown.items()],
        "step_out": step_out,
        "looks": looks,
    }


def flights(law: ControlLoop, pace: Controller, world: RunDisturbances, seeds: int) -> list[LemniscateRun]:
    """One run per seed; one run if there is no noise."""
    return [flight(law, pace, world, seed) for seed in range(seeds if world.noise_um > 0.0 else 1)]


def flight(law: ControlLoop, pace: Controller, world: RunDisturbances, seed: int) -> LemniscateRun:
    """One run with the noise of a seed."""
    # The noise that a robot at rest would show.
    kalman = Kalman(position_noise_um=world.noise_um if world.noise_um > 0.0 else None)
    observer = with_row(Observer(kalman=kalman), OBSERVERS, law.observer)
    return fly(with_row(pace, CONTROLLERS, law.method), observer, world.robot(law.v_max_um_s), world, seed)


def score(name: str, world: str, flown: list[LemniscateRun]) -> dict[str, Any]:
    """Means over flights. Errors are distances to the reference in um.

    `steady_um` is the RMSE of the second lap and `off_curve_um` that of the distance to the curve; `converged_s` is the
    time from which on the error stays below 50 um, None if one flight does not converge; `observer_um_s` is the RMS
    error of the estimated flow in the second lap; `progress` the part of the two laps that the reference covered.
    """
    steady = flown[0].time_s >= PERIOD_S
    curve = KDTree(lemniscate(1).waypoints_um - CENTRE_UM)  # a point every 3 um
    converged = [_converged_s(one) for one in flown]
    return {
        "law": name,
        "world": world,
        "rmse_um": _mean([_rms(one.error_um) for one in flown]),
        "steady_um": _mean([_rms(one.error_um[steady]) for one in flown]),
        "off_curve_um": _mean([_rms(curve.query(one.position_um[steady])[0]) for one in flown]),
        "converged_s": None if None in converged else _mean([value for value in converged if value is not None]),
        "observer_um_s": _mean([_rms(one.flow_miss_um_s[steady]) for one in flown]),
        "progress": _mean([one.progress_s[-1] / one.time_s[-1] for one in flown]),
        "demand_um_s": max(float(np.hypot(*one.demand_um_s.T).max()) for one in flown),
    }


def _converged_s(flight: LemniscateRun) -> float | None:
    """From when on the error stays below 50 um; None if it does not for the last second."""
    out = np.flatnonzero(flight.error_um > CONVERGED_UM)
    if not len(out):
        return 0.0
    return float(flight.time_s[out[-1] + 1]) if out[-1] + 1 < len(flight.time_s) - _LAST_FRAMES else None


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _mean(values: list[float]) -> float:
    return float(np.mean(values))


def show(results: Results) -> None:
    """Print the tables."""
    rows = {(row["law"], row["world"]): row for row in results["rows"]}

    def cells(row: dict[str, Any]) -> tuple[str, ...]:
        converged = "never" if row["converged_s"] is None else f"{row['converged_s']:.1f}"
        return f"{row['rmse_um']:.0f}", f"{row['steady_um']:.1f}", converged

    table(
        "Lemniscate, distance to the reference in um; all: 40 ms latency, 10 um noise, flow map 10 % too strong",
        ("law", "ideal RMSE", "steady", "< 50 um, s", "all RMSE", "steady", "< 50 um, s"),
        [(name, *(cell for world in WORLDS for cell in cells(rows[name, world]))) for name in LAWS],
    )
    print_rows(
        "Step-out speed below that of the reference (all)",
        results["step_out"],
        {
            **{"law; pace of the reference": "{law}", "world": "{world}", "RMSE": "{rmse_um:.0f}"},
            **{"steady": "{steady_um:.1f}", "off the curve": "{off_curve_um:.1f}", "progress": "{progress:.1%}"},
        },
    )
    show_rows(results["looks"])
