"""Lessons for a network: vessels drawn at random with an assumed and a true flow, made once and kept in a folder.

Everything comes from our own solver (`flowrec.bench.vessels`), so training needs no data from elsewhere. A share of
the assumed flows is solved on walls that are one pixel off, as a person may draw them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flowrec.bench.flow import with_wrong_mask
from flowrec.bench.vessels import draw_mask, make_case
from flowrec.chip.chip import Chip
from flowrec.chip.vessel_case import read_vessel_case
from flowrec.errors import FlowrecError, UsageError
from flowrec.flow import FlowSolver
from flowrec.messages import FlowField, Observations
from flowrec.units import M_PER_UM

WRONG_MASKS = ("grown", "shrunk", "shifted")
WRONG_MASK_SHARE = 0.15
NOISES = (0.0, 0.02, 0.05, 0.1)  # of the root mean square speed on the way
SHARES = (0.05, 0.1, 0.2)  # of the skeleton
OUTLIER_SHARE = 0.25  # of the draws have outliers, up to a seventh of the observations
SOLVER = FlowSolver(2)


@dataclass(frozen=True, slots=True, eq=False)
class Lesson:
    """An assumed flow, the true one on the same pixels, and a way on which a robot could feel it."""

    chip: Chip  # as assumed
    assumed: FlowField
    velocity_um_s: NDArray[np.float32]  # (h, w, 2) the truth
    pressure_pa: NDArray[np.float32]  # (h, w) the truth, for the assumed viscosity: what drives this flow against it
    way_px: NDArray[np.int16]  # (n, 2) row and column
    skeleton_px: int  # pixels of the skeleton

    def observe(self, rng: np.random.Generator) -> Observations:
        """What a robot would have felt, with a random noise, share of the way, and now and then outliers."""
        wanted = max(round(float(rng.choice(SHARES)) * self.skeleton_px), 1)
        at = np.unique(np.linspace(0, len(self.way_px) - 1, min(wanted, len(self.way_px))).round().astype(np.intp))
        rows, columns = self.way_px[at].T.astype(np.intp)
        felt = self.velocity_um_s[rows, columns].astype(np.float64)
        way = self.velocity_um_s[self.way_px[:, 0].astype(np.intp), self.way_px[:, 1].astype(np.intp)]
        size = float(np.sqrt((way.astype(np.float64) ** 2).sum(axis=1).mean()))
        std = float(rng.choice(NOISES)) * size
        felt = felt + std * rng.standard_normal(felt.shape)
        if rng.random() < OUTLIER_SHARE:
            wrong = rng.random(len(felt)) < rng.uniform(0.0, 0.15)
            felt[wrong] = 3.0 * size * rng.standard_normal((int(wrong.sum()), 2))
        points = np.column_stack([columns, rows]) * self.chip.um_per_px
        return Observations(0, points.astype(np.float64), felt, np.full(len(felt), std))


def prepare(folder: Path, count: int, seed: int = 0) -> Iterator[Path]:
    """Make the lessons that the folder does not have yet; yields the path of each of the `count`."""
    folder.mkdir(parents=True, exist_ok=True)
    for index in range(count):
        path = folder / f"lesson_{index:05d}.npz"
        if not path.exists():
            _make(path, np.random.default_rng([seed, 0x1E55, index]))
        yield path


def _make(path: Path, rng: np.random.Generator) -> None:
    """Write one vessel case with its assumed flow beside the true one."""
    part = path.with_suffix(".part")
    while True:
        case = make_case(draw_mask(rng), rng, truth_k=2)
        if case is None:
            continue
        wrong = str(rng.choice(WRONG_MASKS)) if rng.random() < WRONG_MASK_SHARE else "right"
        with part.open("wb") as file:
            np.savez(file, allow_pickle=False, **case)
        try:
            chip = with_wrong_mask(read_vessel_case(part), wrong)
            assumed = SOLVER.solve(chip)
        except FlowrecError:  # a wall one pixel off may close an opening
            continue
        with part.open("wb") as file:
            np.savez_compressed(
                file,
                allow_pickle=False,
                **case,
                wrong=np.array(wrong),
                assumed_v=assumed.velocity_um_s,
                assumed_p=assumed.pressure_pa,
            )
        part.replace(path)
        return


def read_lessons(paths: Sequence[Path]) -> list[Lesson]:
    """The lessons of some files.

    Raises
    ------
    UsageError
        If a file is not a lesson.
    """
    lessons = []
    for path in paths:
        chip = read_vessel_case(path)
        with np.load(path, allow_pickle=False) as data:
            if "assumed_v" not in data.files:
                raise UsageError(f"{path}: a vessel case but not a lesson; give an empty folder to make lessons in")
            chip = with_wrong_mask(chip, str(data["wrong"]))
            assumed = FlowField(
                0,
                0,
                "fvm",
                chip.um_per_px,
                data["assumed_v"],
                data["assumed_p"],
                None,
                chip.boundary_values,
                chip.viscosity_mpa_s,
                chip.density_kg_m3,
                "",
            )
            true = np.stack([data["vx"], data["vy"]], axis=-1) / M_PER_UM
            lessons.append(
                Lesson(
                    replace(chip, name=path.stem),
                    assumed,
                    true.astype(np.float32),
                    (data["p"] * float(data["mu_assumed"] / data["mu"])).astype(np.float32),
                    data["route_ij"],
                    int(data["skeleton"].sum()),
                )
            )
    return lessons
