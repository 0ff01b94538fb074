"""A made-up mission: a bifurcation with analytic flow, a robot that swims along it, every message there is."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator

import cv2
import numpy as np
import psutil
import pytest

from flowrec.core import Tick, Timing
from flowrec.core import messages as m
from flowrec.physics import Calibration, Chip, Robot
from flowrec.view import Scene

H, W, UM_PER_PX = 256, 320, 4.0
CAMERA_UM_PER_PX = 2.0
MIDDLE = np.array([[-20, 128], [90, 128]], float)
UPPER = np.array([[90, 128], [150, 60], [230, 60], [340, 60]], float)
LOWER = np.array([[90, 128], [150, 196], [230, 196], [340, 196]], float)


def _channel(points: np.ndarray, half_width: float, speed: float) -> tuple[np.ndarray, np.ndarray]:
    """Velocity (H, W, 2) and mask of a channel along a polyline in pixels with a parabolic profile."""
    y, x = np.mgrid[0:H, 0:W].astype(float)
    best = np.full((H, W), np.inf)
    velocity = np.zeros((H, W, 2))
    for a, b in itertools.pairwise(points):
        along = b - a
        t = np.clip(((x - a[0]) * along[0] + (y - a[1]) * along[1]) / (along @ along), 0, 1)
        distance = np.hypot(x - a[0] - t * along[0], y - a[1] - t * along[1])
        nearer = distance < best
        best = np.where(nearer, distance, best)
        profile = np.clip(1 - (distance / half_width) ** 2, 0, None) * speed
        velocity = np.where(nearer[..., None], profile[..., None] * along / np.hypot(*along), velocity)
    return velocity, best < half_width


def field(share: float, method: str, std: bool = False) -> m.FlowField:
    """The flow with a share of it through the upper branch, peak 300 um/s at the inlet."""
    parts = [_channel(MIDDLE, 22, 300.0), _channel(UPPER, 15, 600 * share), _channel(LOWER, 15, 600 * (1 - share))]
    velocity = np.zeros((H, W, 2))
    for part, mask in parts:
        velocity = np.where(
            mask[..., None] & (np.abs(part).sum(-1) > np.abs(velocity).sum(-1))[..., None], part, velocity
        )
    spread = np.repeat((0.02 + 0.15 * np.hypot(*np.moveaxis(velocity, -1, 0)))[..., None], 2, -1) if std else None
    return m.FlowField(
        0, 0, method, UM_PER_PX, velocity, np.zeros((H, W)), spread, np.array([200.0, 0.0, 0.0]), 1.0, 998.0, "made up"
    )


def mask() -> np.ndarray:
    """(H, W) fluid."""
    return _channel(MIDDLE, 22, 1)[1] | _channel(UPPER, 15, 1)[1] | _channel(LOWER, 15, 1)[1]


@pytest.fixture(autouse=True)
def no_process_stays() -> Iterator[None]:
    """End what a test has started and not ended, such as a viewer where it failed: it would stay for ever."""
    before = set(psutil.Process().children(recursive=True))
    yield
    left = set(psutil.Process().children(recursive=True)) - before
    _, alive = psutil.wait_procs(left, 5.0)
    for process in alive:
        process.kill()
    psutil.wait_procs(alive)
    assert not alive


@pytest.fixture(scope="session")
def scene() -> Scene:
    chip = Chip("made up", mask(), UM_PER_PX, (), 1.0, 998.0)
    robot = Robot(radius_um=20.0, max_speed_um_s=600.0, step_out_hz=30.0)
    return Scene(chip, Calibration(CAMERA_UM_PER_PX, (0.0, 0.0)), robot, "a made-up mission", {"operator": "nobody"})


def mission(ticks: int = 120, seed: int = 0, share: float = 0.65) -> Iterator[Tick]:
    """Ticks at 60 Hz: survey, refine at 30 %, navigate into the upper branch; lost for a few frames at 60 %."""
    noise = np.random.default_rng(seed)
    fluid = cv2.resize(mask().astype(np.uint8), (640, 512), interpolation=cv2.INTER_LINEAR)
    backdrop = cv2.GaussianBlur(np.where(fluid, 158, 96).astype(np.uint8), (0, 0), 2)
    grain = noise.normal(0, 4, backdrop.shape)
    backdrop = np.clip(backdrop + grain, 0, 255).astype(np.uint8)
    assumed, refined, truth = field(0.5, "fvm"), field(share, "assimilate", std=True), field(0.7, "truth")
    way = np.concatenate([np.array([[20, 128.0]]), UPPER[:-1], [[300.0, 60.0]]]) * UM_PER_PX
    steps = np.r_[0, np.cumsum(np.hypot(*np.diff(way, axis=0).T))]
    fine = np.linspace(0, steps[-1], 120)
    waypoints = np.stack([np.interp(fine, steps, way[:, c]) for c in (0, 1)], 1)
    tick = Tick()
    for i in range(ticks):
        now, done = round(i * 1e9 / 60), i / ticks
        at = np.array([np.interp(done * steps[-1] * 0.95, steps, way[:, c]) for c in (0, 1)])
        seen = not 0.6 <= done < 0.63
        centre = at / CAMERA_UM_PER_PX
        image = backdrop.copy()
        cv2.circle(image, (round(centre[0]), round(centre[1])), 10, 30, -1, cv2.LINE_AA)
        estimate = at + noise.normal(0, 2, 2)
        wanted = 6.0 * (np.array([np.interp((done + 0.01) * steps[-1], steps, way[:, c]) for c in (0, 1)]) - at)
        heading = float(np.arctan2(wanted[1], wanted[0]))
        flow = field_at(truth, at)
        phase = "survey" if done < 0.25 else "refine" if done < 0.3 else "navigate"
        new: dict[str, object] = {
            "stamp_ns": now,
            "frame": m.Frame(now, i, image),
            "track": m.Track(now, seen, at, 0.9 * seen, 0, 10.0, np.array([0.0, 0, 640, 512])),
            "estimate": m.Estimate(
                now, estimate, flow + noise.normal(0, 12, 2), np.eye(4), 2.0 if seen else np.nan, at, seen
            ),
            "demand": m.Demand(now, wanted, at + 8.0, i / 60, abs(14 + 6 * np.sin(i / 9)), False, wanted[None]),
            "currents": m.Currents(
                now, 9 + 3 * np.sin(i / 20), heading, 5.0, i * 0.9, 1.5 * np.cos([i * 0.9, i * 0.9 + 2, i]), False
            ),
            "timing": Timing(now, 2.1, 0.2, 0.4, 0.3, 3.4, 0.0, 0),
            "truth": m.Truth(now, at, flow, 20.0, 0),
        }
        if tick.mission is None or tick.mission.phase != phase:
            new["mission"] = m.Mission(now, phase, now, 1, "", now, way[0], way[-1], False, "", "")
            new["event"] = m.Event(now, "warning" if phase == "refine" else "info", f"{phase} begins")
        if i == 0:
            new |= {"assumed": assumed, "true_field": truth}
        if tick.refined is None and done >= 0.3:
            new["refined"] = refined
            new["route"] = m.Route(now, 2, "astar", True, "", waypoints, np.linspace(0, 20, 120))
        tick = Tick(**{name: new.get(name, getattr(tick, name)) for name in Tick.__dataclass_fields__})
        yield tick


def field_at(flow: m.FlowField, at_um: np.ndarray) -> np.ndarray:
    """The velocity at the nearest pixel."""
    column, row = np.clip(np.rint(at_um / UM_PER_PX).astype(int), 0, (W - 1, H - 1))
    return np.asarray(flow.velocity_um_s[row, column], np.float64)


@pytest.fixture(scope="session")
def ticks() -> list[Tick]:
    return list(mission())


@pytest.fixture(scope="session")
def made_up() -> Callable[..., Iterator[Tick]]:
    return mission
