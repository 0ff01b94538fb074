"""Training examples (lessons): random vessel networks with an assumed and a true flow, stored in a folder.

flowrec's own solver makes all of them, so training needs no other data. Some of the assumed flows are solved in a mask
whose walls are one pixel off, as drawn by hand.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from flowrec.bench.vessel_truth import NOISES, SHARES, read_true_velocity
from flowrec.bench.vessels import draw_mask, make_case, with_mask_error
from flowrec.core import Floats32, FlowField, FlowrecError, Ints, Observations, UsageError, replacing
from flowrec.physics import Chip, FlowSolver, read_vessel_case
from flowrec.stages import ObservationOperator, observation_operator

_MASK_ERRORS = ("grown", "shrunk", "shifted")  # of those that are drawn
_MASK_ERROR_PROBABILITY = 0.15  # of a mask with one of these errors; the others are right
_OUTLIER_PROBABILITY = 0.25  # of one set of observations; up to a seventh of them are outliers then
_SOLVER = FlowSolver(2)


@dataclass(frozen=True, slots=True, eq=False)
class Lesson:
    """An assumed flow, the true flow on the same pixels, and the route along which it can be observed."""

    chip: Chip  # as assumed
    assumed: FlowField
    velocity_um_s: Floats32  # (h, w, 2) true
    # (h, w) true, scaled to the assumed viscosity: the pressure that drives the true flow against it
    pressure_pa: Floats32
    route_px: Ints  # (n, 2) row and column
    skeleton_px: int  # pixels of the skeleton

    def observe(self, rng: np.random.Generator) -> Observations:
        """Observations along the route with a random noise level and count, and in some sets with outliers."""
        wanted = max(round(float(rng.choice(list(SHARES.values()))) * self.skeleton_px), 1)
        at = np.unique(np.linspace(0, len(self.route_px) - 1, min(wanted, len(self.route_px))).round().astype(np.intp))
        on_route = self.velocity_um_s[*self.route_px.T].astype(np.float64)
        rms = float(np.sqrt((on_route**2).sum(axis=1).mean()))
        std = float(rng.choice(list(NOISES.values()))) * rms
        flow = on_route[at] + std * rng.standard_normal((len(at), 2))
        if rng.random() < _OUTLIER_PROBABILITY:
            wrong = rng.random(len(at)) < rng.uniform(0.0, 0.15)
            flow[wrong] = 3.0 * rms * rng.standard_normal((int(wrong.sum()), 2))
        points = self.route_px[at][:, ::-1].astype(np.float64) * self.chip.um_per_px
        return Observations(0, points, flow, np.full(len(at), std))

    def operator(self, rng: np.random.Generator) -> ObservationOperator:
        """The operator of such observations."""
        return observation_operator(self.observe(rng), self.chip.mask, self.chip.um_per_px, self.assumed.wall_px)


def prepare(folder: Path, count: int, seed: int = 0) -> Iterator[Path]:
    """Yield the paths of `count` lessons in the folder; a missing one is made first."""
    folder.mkdir(parents=True, exist_ok=True)
    for index in range(count):
        path = folder / f"lesson_{index:05d}.npz"
        if not path.exists():
            _make(path, np.random.default_rng([seed, 0x1E55, index]))
        yield path


def _make(path: Path, rng: np.random.Generator) -> None:
    """Write one vessel case and its assumed flow."""
    with replacing(path) as part:
        while True:
            case = make_case(draw_mask(rng), rng, truth_k=2)
            if case is None:
                continue
            error = str(rng.choice(_MASK_ERRORS)) if rng.random() < _MASK_ERROR_PROBABILITY else "right"
            with part.open("wb") as file:
                np.savez(file, allow_pickle=False, **case)
            try:
                assumed = _SOLVER.solve(with_mask_error(read_vessel_case(part), error))
            except FlowrecError:  # a wall that is one pixel off may close an opening
                continue
            case |= {"wrong": error, "assumed_v": assumed.velocity_um_s, "assumed_p": assumed.pressure_pa}
            case["assumed_walls"] = assumed.wall_px
            with part.open("wb") as file:
                np.savez_compressed(file, allow_pickle=False, **case)
            return


def read_lesson(path: Path) -> Lesson:
    """Read one lesson. Raises UsageError if the file is not a lesson."""
    chip = read_vessel_case(path)
    with np.load(path, allow_pickle=False) as data:
        if "assumed_walls" not in data.files:
            raise UsageError(f"{path}: a vessel case but not a lesson; give an empty folder to make lessons in")
        chip = replace(with_mask_error(chip, str(data["wrong"])), name=path.stem)
        parameters = chip.boundary_values, chip.viscosity_mpa_s, chip.density_kg_m3
        assumed = FlowField(
            *(0, 0, "fvm", chip.um_per_px, data["assumed_v"], data["assumed_p"], None, *parameters, ""),
            wall_px=data["assumed_walls"],
        )
        return Lesson(
            chip,
            assumed,
            read_true_velocity(path).astype(np.float32),
            (data["p"] * float(data["mu_assumed"] / data["mu"])).astype(np.float32),
            data["route_ij"].astype(np.intp),
            int(data["skeleton"].sum()),
        )
