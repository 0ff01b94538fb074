"""The golden sessions: recorded once by a release, replayed by every version since.

The numerics of the first are version 1, in which the velocities of a flow field were means over pixels. All that its
loop and its planner made of the recorded inputs, fields included, is still computed to the last digit; of the two
fields themselves, the flow behind them is still the same. The second, of the moderate world, has a survey by
information, stretch by stretch, and numerics version 3. The third has the settled format, its digest chained over
the chunks, and numerics version 5; the fourth has the walls of its first image, and numerics version 9: as long as
those hold, every message of it is computed again to the last digit.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import flowrec
from flowrec.core import NUMERICS_VERSION, UM_PER_M
from flowrec.physics import Scales, System, system
from flowrec.store import SessionReader
from flowrec.verbs import Change
from flowrec.verbs.comparison import Comparison
from flowrec.verbs.replay_result import Replay
from flowrec.verbs.session_replay import replay_session

GOLDEN = Path(__file__).parents[2] / "sessions" / "golden.mcap"
MODERATE = GOLDEN.with_name("golden_moderate.mcap")
SETTLED = GOLDEN.with_name("golden_numerics5.mcap")
TRACED = GOLDEN.with_name("golden_numerics10.mcap")
BY_OTHER_NUMERICS = {"/flow/assumed", "/flow/refined"}


@pytest.mark.parametrize("path", [GOLDEN, MODERATE, SETTLED, TRACED])
def test_a_golden_session_is_small_and_says_nothing_of_the_machine_it_was_made_on(path: Path) -> None:
    assert path.stat().st_size < 3_000_000
    facts = SessionReader(path).header.provenance
    assert not {"host", "user", "platform", "git_diff"} & set(facts)


def verified(path: Path, from_s: float | None = None) -> tuple[Replay, Comparison, list[str]]:
    """A replay whose ticks are those of the recording; the comparison of the worker's results, and what is printed."""
    done = replay_session(path, Change(), from_s=from_s, verify=True)
    lines = done.lines()
    assert done.comparison.same and done.digest[0], lines
    assert done.recorded.mission is not None and done.recorded.mission.outcome == "reached"
    assert done.worker is not None
    return done, done.worker.comparison, lines


@pytest.mark.parametrize("from_s", [None, 3.0])
def test_the_golden_session_replays_the_same_but_for_the_meaning_of_its_fields(from_s: float | None) -> None:
    done, comparison, lines = verified(GOLDEN, from_s)
    not_recorded = done.as_json()["not_recorded"]  # is not compared
    assert not_recorded["/run/mission held_ns"] == "not recorded in golden.mcap"
    different = {path for path, count in comparison.topics.items() if count.different}
    assert different == (BY_OTHER_NUMERICS if from_s is None else set()), lines
    routes = comparison.topics["/plan/route"]
    assert routes.identical + routes.within_tolerance == (2 if from_s is None else 1)
    if different:
        assert not done.same
        assert "the same within tolerance; results of the worker made by other numerics" in lines[-1]


def test_the_golden_session_of_the_moderate_world_replays_the_same_but_for_what_newer_numerics_find() -> None:
    _, comparison, lines = verified(MODERATE)
    different = {path for path, count in comparison.topics.items() if count.different}
    assert different <= {"/plan/route", "/flow/refined"}, lines  # by the survey and by the refinement
    versions = f"(recorded: version 3, replayed: version {NUMERICS_VERSION})"
    assert f"results of the worker made by other numerics {versions}" in lines[-1]
    routes = comparison.topics["/plan/route"]
    assert routes.identical + routes.within_tolerance > 0  # the way to the goal in the recorded map


@pytest.mark.parametrize(("path", "walls"), [(SETTLED, "smooth"), (TRACED, "grey")])
def test_a_golden_session_of_the_settled_format_is_intact_and_replays_the_same(path: Path, walls: str) -> None:
    done, _, lines = verified(path)
    assert done.session.chip.walls == walls
    assert "consistent with their digest" in " ".join(lines)
    recorded = done.session.header.provenance["numerics_version"]
    assert done.same or recorded != str(NUMERICS_VERSION), lines  # the slow results, too


@pytest.mark.parametrize("path", [GOLDEN, MODERATE])
def test_what_a_refinement_finds_of_the_robot_corrects_nothing_in_a_session_from_before(path: Path) -> None:
    refiner = flowrec.open(path).config.refine
    assert not refiner.correct_robot and not refiner.correct_heading


@pytest.mark.parametrize("path", [GOLDEN, MODERATE, SETTLED])
def test_a_session_from_before_keeps_the_step_out_and_the_spots_of_its_time(path: Path) -> None:
    config = flowrec.open(path).config
    assert config.health.step_out.least_gain == -0.5
    assert config.tracker.tracer.most_elongated == 0.0


def means_over_pixels(equations: System, flux: NDArray[np.float64]) -> NDArray[np.float64]:
    """The velocity (h, w, 2) in m/s as version 1 of the numerics gave it."""
    grid, padded = equations.grid, np.append(flux, 0.0)
    u, v = padded[grid.u.number], padded[grid.v.number]
    cells = np.stack([0.5 * (u[:, 1:] + u[:, :-1]), 0.5 * (v[1:] + v[:-1])], axis=-1)
    h, w = grid.mask.shape
    return cells.reshape(h, grid.k, w, grid.k, 2).mean(axis=(1, 3)) * grid.mask[..., None]


def test_the_flow_of_the_golden_session_is_the_recorded_one_where_it_is_averaged_over_pixels() -> None:
    session = flowrec.open(GOLDEN)
    (assumed,) = session.messages("assumed")
    solver, chip = session.config.flow, session.chip
    equations, scales = system(chip, solver.k), Scales.of(chip, solver.k, solver.convection)
    flux = equations.steady(scales.drive, scales.inertia, solver.max_iterations, solver.tolerance)
    means = means_over_pixels(equations, flux) * UM_PER_M
    assert np.abs(means - assumed.velocity_um_s).max() < 1e-4  # its tolerance in a comparison, um/s
