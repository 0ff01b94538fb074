"""The cases of `flowrec bench paper`: a function for each kind, from its cell and a seed to the results of a row.

Each calls the bench that measures the same by itself. What several cells of a seed have in common (a survey, a vessel,
a network with a trip through it) is kept until the next seed, so that they are compared on the same.
"""

from __future__ import annotations

import itertools
import tempfile
from dataclasses import replace
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from flowrec.bench.flow import METHODS, Scenario, refine_case
from flowrec.bench.harness import Results, flow_scores
from flowrec.bench.lemniscate import CENTRE_UM
from flowrec.bench.missions import TrueWorld, fly
from flowrec.bench.plan import FULL, TREES, plan_trip
from flowrec.bench.plan import METHODS as PLANS
from flowrec.bench.track import FIXED_PACE, LAWS, WORLDS, flight, score
from flowrec.bench.trips import SPEED_UM_S, Points, Trip, TripCase, best_time, draw_trip, worlds
from flowrec.bench.vessel_truth import read_true_velocity
from flowrec.bench.vessels import draw_mask, make_case
from flowrec.core import Bools, Floats, FlowError, FlowField, Observations, Tick, seconds
from flowrec.physics import sample
from flowrec.stages import PLANNERS, PiUnet, Refiner

FIRST_SEED = 1000  # worlds, vessels and networks from here on are for figures only
SIDE_PX, TREE_ITERATIONS = 256, 20_000  # of the chips of random worlds; nodes tried by RRT*
TRACE_POINTS, TRACED_SEED = 160, 0  # of the curves that the rows of the first seed carry, to be drawn

# The paper's robot takes its observations while it is carried through the whole chip, and they are trimmed.
_SURVEY = ("survey.method=downstream", "survey.share=1.0", "mission.goal=outlet", "mission.phases=survey,refine")
_PAPER = ("observer.method=luenberger", "control.method=ff_fb")
# Planner and law of a navigation. Law and observer of the first four are the paper's, so that planners are compared;
# those of the next two are its baselines, which leave the compensation out or take it from the observer.
NAVIGATIONS: dict[str, tuple[str, ...]] = {
    "astar_paper": ("plan.method=astar_paper", *_PAPER),
    "astar_length": ("plan.method=astar_length", *_PAPER),
    "time_field": ("plan.method=time_field", *_PAPER),
    "energy": ("plan.method=time_field", "plan.cost=energy", *_PAPER),
    "without": ("plan.method=astar_paper", *_PAPER, "control.method=ff_fb_no_flow"),
    "with observer": ("plan.method=astar_paper", *_PAPER, "control.method=ff_fb_observer"),
    "policy": (),  # flowrec's own, with its observer
}
_PRINTED = PiUnet(start="fvm", weights="none", finish="none")
# The loss of the paper's network and what it is made of, each left out or changed by itself.
ABLATION: dict[str, PiUnet] = {
    "all terms": _PRINTED,
    "no continuity": replace(_PRINTED, continuity_weight=0.0),
    "no momentum": replace(_PRINTED, momentum_weight=0.0),
    "no equations": replace(_PRINTED, continuity_weight=0.0, momentum_weight=0.0),
    "no observations": replace(_PRINTED, observation_weight=0.0),
    "observations hard": replace(_PRINTED, observations="hard"),
    "walls free": replace(_PRINTED, near_wall="free"),
    "walls hard": replace(_PRINTED, near_wall="hard"),
    "both hard, as printed": replace(_PRINTED, observations="hard", near_wall="hard"),
    "balanced after it": replace(_PRINTED, finish="balance"),
    "trained, not balanced": replace(_PRINTED, weights="vessels"),
    "trained and balanced": PiUnet(start="fvm"),
}


def survey(seed: int, data: Path | None, chip: str, world: str, sampler: str) -> Results:
    """Error of the flow before and after the refinement of a survey; of the first seed also Fig. 11."""
    del data
    flown = _flown_survey(seed, chip, world, sampler)
    last, truth, ticks = flown
    assert last.assumed is not None and last.refined is not None and last.observations is not None
    fluid = np.any(truth.velocity_um_s != 0.0, axis=-1)
    found: Results = {
        "assumed_error": flow_scores(last.assumed, truth.velocity_um_s, fluid)["error"],
        "refined_error": flow_scores(last.refined, truth.velocity_um_s, fluid)["error"],
        "observations": len(last.observations.std_um_s),
        "survey_s": seconds(last.stamp_ns - ticks[0].stamp_ns),
        "contacts": last.truth.contacts if last.truth is not None else 0,
    }
    if seed != TRACED_SEED:
        return found
    seen = _treat(last.observations, sampler)
    estimates = _every_few([one for one in ticks if one.estimate is not None])
    return found | {
        "trace_s": [seconds(one.stamp_ns - ticks[0].stamp_ns) for one in estimates],
        "trace_um_s": [float(np.hypot(*one.estimate.flow_um_s)) for one in estimates if one.estimate is not None],
        "seen_x_um": seen.position_um[:, 0].tolist(),
        "seen_y_um": seen.position_um[:, 1].tolist(),
        "seen_um_s": np.hypot(*seen.flow_um_s.T).tolist(),
        **_picture(last.refined.velocity_um_s, fluid, last.refined.um_per_px),
    }


def mission(seed: int, data: Path | None, chip: str, world: str, sampler: str, way: str, navigation: str) -> Results:
    """Navigation through the whole chip on the map of a survey in the same world, from inlet to outlet or back."""
    del data
    known, _, _ = _flown_survey(seed, chip, world, sampler)
    ticks: list[Tick] = []
    start, true = Tick(refined=known.refined), TrueWorld(world, "ample", NAVIGATIONS[navigation])

    def watch(tick: Tick) -> None:
        ticks.append(_bare(tick))

    row = fly(FIRST_SEED + seed, _chip(chip), way, "assumed", "policy", true, watch, start)
    on_way = [one for one in ticks if one.mission is not None and one.mission.phase == "navigate" and one.truth]
    places = np.array([one.truth.position_um for one in on_way if one.truth is not None]).reshape(-1, 2)
    found: Results = {
        **{name: getattr(row, name) for name in ("outcome", "note", "contacts", "replans", "optimum_s", "planned_s")},
        "reached": row.outcome == "reached",
        "time_s": row.seconds,
        "over_least": row.ratio,
        "rms_um": row.rms_um,
        "swum_um2_s": _swum(on_way),
        "length_um": float(np.hypot(*np.diff(places, axis=0).T).sum()) if len(places) > 1 else None,
        "branch": _branch(places, known.refined) if chip == "bifurcation" else None,
    }
    if seed == TRACED_SEED:
        thin = places[:: max(len(places) // TRACE_POINTS, 1)]
        found |= {"trace_x_um": thin[:, 0].tolist(), "trace_y_um": thin[:, 1].tolist()}
    return found


def trip(seed: int, data: Path | None, planner: str, ratio: float, way: str) -> Results:
    """Length, travel time and energy of a route through a network, at the robot's full speed in the true flow."""
    del data
    world, drawn = _network(seed)
    method = replace(FULL, cost="energy") if planner == "energy" else PLANS[planner]
    if method.method in TREES:
        method = replace(method, rrt=replace(method.rrt, iterations=TREE_ITERATIONS, seed=seed))
    field, ends = world.field(ratio), drawn.ends(way)
    row, route = plan_trip(method, world, field, ends)
    least_s = _least_time(seed, ratio, way)
    found: Results = {**row, "world": world.name, "optimum_s": least_s if np.isfinite(least_s) else None}
    found["lost"] = found["optimum_s"] is not None and found["time_s"] is None
    if route.reachable:
        # Each swims as it is meant to: at full speed, or at the speed that saves energy.
        times = route.arrival_s if planner == "energy" else _full_speed(field, route.waypoints_um)
        found["own_time_s"] = float(times[-1])
        found["energy_um2_s"] = swim_energy(field, route.waypoints_um, times)
    if seed == TRACED_SEED and route.reachable:
        thin = route.waypoints_um[:: max(len(route.waypoints_um) // TRACE_POINTS, 1)]
        found |= {"trace_x_um": thin[:, 0].tolist(), "trace_y_um": thin[:, 1].tolist()}
        found |= _picture(field.velocity_um_s, world.chip.mask, field.um_per_px)
    return found


def tracking(seed: int, data: Path | None, world: str, law: str) -> Results:
    """Tracking error of a law on the lemniscate; of the first seed also path and errors over time."""
    del data
    flown = flight(LAWS[law], FIXED_PACE, WORLDS[world], seed)
    found = {key: value for key, value in score(law, world, [flown]).items() if key not in ("law", "world")}
    if seed != TRACED_SEED:
        return found
    step = max(len(flown.time_s) // (3 * TRACE_POINTS), 1)
    x_um, y_um = flown.position_um[::step].T
    return found | {
        "trace_s": flown.time_s[::step].tolist(),
        "trace_x_um": x_um.tolist(),
        "trace_y_um": y_um.tolist(),
        "trace_error_um": flown.error_um[::step].tolist(),
        "trace_miss_um_s": flown.flow_miss_um_s[::step].tolist(),
        "centre_um": CENTRE_UM,
    }


def refinement(seed: int, data: Path | None, vessels: str, method: str, level: int = 2) -> Results:
    """Table I: a vessel of a kind (drawn, crops, openfoam) refined by a method, or by a network of ABLATION.

    `level` is the number of the solver's cells per pixel side.
    """
    if vessels == "openfoam":
        assert data is not None
        path = data / "vessels" / f"case_{seed:02d}.npz"
        return _refine(path, method, Scenario(k=level), seed == TRACED_SEED and level == Scenario().k)
    return _refine_arrays(_vessel(seed, vessels, data), method, seed == TRACED_SEED)


def sensitivity(seed: int, data: Path | None, varied: str, level: float, method: str) -> Results:
    """A drawn vessel whose observations or assumptions are changed in one way; 5 % noise and a tenth seen otherwise."""
    arrays, rng = dict(_vessel(seed, "drawn", data)), np.random.default_rng([seed, 0x5E25])
    route, sigma = arrays["route_ij"], arrays["route_v_sigma"].copy()
    if varied == "share":
        count = min(max(round(level * int(arrays["skeleton"].sum())), 1), len(route))
        arrays["obs_idx_10"] = np.unique(np.linspace(0, len(route) - 1, count).round().astype(np.int64))
    elif varied == "noise":
        sigma[2] = sigma[2] / 0.05 * level
        arrays["route_v_n05"] = arrays["route_v_n00"] + sigma[2] * rng.standard_normal(arrays["route_v_n00"].shape)
        arrays["route_v_sigma"] = sigma
    elif varied == "inlets":  # wrong by this share, each to either side
        signs = rng.choice([-1.0, 1.0], len(arrays["op_u_true"]))
        arrays["op_u_assumed"] = arrays["op_u_true"] * (1.0 + level * signs)
    else:  # viscosity, wrong by this factor
        arrays["mu_assumed"], arrays["rho_assumed"] = arrays["mu"] * level, arrays["rho"]
    return _refine_arrays(arrays, method, traced=False)


def swim_energy(field: FlowField, waypoints_um: Points, arrival_s: Floats) -> float:
    """Integral of |u|^2 + idle^2 over a route, um2/s, with the own speed u; the cost of plan.cost = "energy".

    At `idle`, half of the robot's speed, swimming takes as much power as everything else.
    """
    legs, dt = np.diff(waypoints_um, axis=0), np.diff(arrival_s)
    own = legs[dt > 0] / dt[dt > 0, None] - sample(field, 0.5 * (waypoints_um[1:] + waypoints_um[:-1]))[dt > 0]
    return float((((own**2).sum(axis=1) + (0.5 * SPEED_UM_S) ** 2) * dt[dt > 0]).sum())


def planners() -> list[str]:
    """The planners that can plan here: trees need OMPL. `energy` is time_field with energy as its cost."""
    names = ("time_field", "energy", "astar_paper", "astar_length", "astar_length:8", "rrt")
    extra = {name: PLANNERS[PLANS[name].method].extra for name in names if name in PLANS}
    return [name for name in names if not extra.get(name) or find_spec(extra[name]) is not None]


def _chip(name: str) -> tuple[str, ...]:
    return (f"chip.name={name}",)


@lru_cache(maxsize=8)
def _flown_survey(seed: int, chip: str, world: str, sampler: str) -> tuple[Tick, FlowField, list[Tick]]:
    """The last tick of a survey, the true flow, and all ticks without their images."""
    ticks: list[Tick] = []
    true = TrueWorld(world, "ample", (*_SURVEY, f"sampler.method={sampler}"))
    row = fly(
        FIRST_SEED + seed, _chip(chip), "down", "surveyed", "policy", true, lambda tick: ticks.append(_bare(tick))
    )
    truth = next((tick.true_field for tick in ticks if tick.true_field is not None), None)
    if not ticks or truth is None or ticks[-1].refined is None:
        raise FlowError(f"survey without a refined flow: {row.outcome}, {row.note}")
    return ticks[-1], truth, ticks


def _bare(tick: Tick) -> Tick:
    return replace(tick, frame=None)


def _treat(observations: Observations, sampler: str) -> Observations:
    from flowrec.stages import Trimmed

    return Trimmed().treat(observations) if sampler == "trimmed" else observations


def _every_few(ticks: list[Tick]) -> list[Tick]:
    return ticks[:: max(len(ticks) // TRACE_POINTS, 1)]


def _swum(ticks: list[Tick]) -> float:
    """Integral of the squared own speed that was demanded, um2/s."""
    steps = [seconds(b.stamp_ns - a.stamp_ns) for a, b in itertools.pairwise(ticks)]
    powers = [float((one.demand.velocity_um_s**2).sum()) if one.demand is not None else 0.0 for one in ticks]
    return float(np.dot(steps, powers[: len(steps)]))


def _branch(places: Points, known: FlowField | None) -> str | None:
    """The branch of the bifurcation that a path took: the long one lies in the upper half of the chip."""
    if known is None or not len(places):
        return None
    height_um, width_um = (known.um_per_px * size for size in known.velocity_um_s.shape[:2])
    middle = places[np.abs(places[:, 0] - 0.5 * width_um) < 0.1 * width_um]
    if not len(middle):
        return None
    return "long" if float(np.median(middle[:, 1])) < 0.45 * height_um else "short"


def _picture(
    velocity_um_s: NDArray[np.floating], fluid: Bools, um_per_px: float, top_um_s: float | None = None
) -> Results:
    """The speed as an image for a figure: rows of numbers from 0 to 1 of `top_um_s`; -1 in solid."""
    speed = np.linalg.norm(velocity_um_s.astype(np.float64), axis=-1)
    top = top_um_s or float(np.percentile(speed[fluid], 99.5))
    image = np.where(fluid, np.minimum(speed / max(top, 1e-9), 1.0), -1.0).round(2)
    return {"image": image.ravel().tolist(), "image_width": image.shape[1], "top_um_s": top, "um_per_px": um_per_px}


@lru_cache(maxsize=2)
def _network(seed: int) -> tuple[TripCase, Trip]:
    for number, world in enumerate(worlds(SIDE_PX, FIRST_SEED * (1 + seed))):
        drawn = draw_trip(world, np.random.default_rng([number, seed, 5]))
        if drawn is not None:
            return world, drawn
    raise AssertionError("worlds has no end")


@lru_cache(maxsize=8)
def _least_time(seed: int, ratio: float, way: str) -> float:
    world, drawn = _network(seed)
    return best_time(world, world.field(ratio), *drawn.ends(way), SPEED_UM_S)[0]


def _full_speed(field: FlowField, waypoints_um: Points) -> Floats:
    from flowrec.stages import travel_time

    return travel_time(field, waypoints_um, SPEED_UM_S)[0]


@lru_cache(maxsize=3)
def _vessel(seed: int, vessels: str, data: Path | None) -> dict[str, Any]:
    """The arrays of a vessel case: drawn, or a crop of a segmented fundus as in the paper."""
    for attempt in itertools.count():
        rng = np.random.default_rng([FIRST_SEED + seed, attempt, 0xCA5E])
        case = make_case(draw_mask(rng) if vessels == "drawn" else _crop(data, rng), rng)
        if case is not None:
            return case
    raise AssertionError("count has no end")


def _crop(data: Path | None, rng: np.random.Generator) -> Bools:
    """128 x 128 pixels of a mask in `data`/masks, at a scale at which vessels are a few to 15 pixels wide."""
    assert data is not None
    files = sorted((data / "masks").glob("*.png"))
    image = _mask(files[int(rng.integers(len(files)))])
    scale = float(rng.uniform(0.4, 0.9))
    size = round(128 / scale)
    top, left = (int(rng.integers(0, max(extent - size, 1))) for extent in image.shape)
    window = image[top : top + size, left : left + size].astype(np.float32)
    return cv2.resize(window, (128, 128), interpolation=cv2.INTER_AREA) > 0.5


@lru_cache(maxsize=20)
def _mask(path: Path) -> Bools:
    return np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)) > 0


def _refine_arrays(arrays: dict[str, Any], method: str, traced: bool) -> Results:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "case.npz"
        np.savez(path, allow_pickle=False, **arrays)
        return _refine(path, method, Scenario(), traced)


def _refine(path: Path, method: str, scenario: Scenario, traced: bool) -> Results:
    """Scores of a refinement; `error` is the relative RMSE of the velocity."""
    refiner = Refiner("pi_unet", pi_unet=ABLATION[method]) if method in ABLATION else METHODS[method]
    with tempfile.TemporaryDirectory() as folder:
        fields = Path(folder)
        row = refine_case(path, method, scenario, fields if traced else None, refiner)
        kept = ("rmse_vx", "rmse_vy", "rmse_speed", "rmse_p", "within_2_std", "crps", "note")
        found = {"error": row["rmse_v"], **{name: row[name] for name in kept}}
        found |= {"method_s": row["cpu_seconds"], "update_s": row["seconds_update"]}
        if traced:
            with np.load(next(fields.glob("*.npz"))) as field:
                true = _picture(read_true_velocity(path), field["mask"], 1.0)
                found |= _picture(field["velocity_um_s"], field["mask"], 1.0, true["top_um_s"]) | {
                    "truth": true["image"]
                }
    return found
