"""The chips of `python -m tests.perf.planning`, and its short form."""

import numpy as np
import pytest

from flowrec.bench.plan import FULL
from flowrec.bench.trips import draw_trip, worlds
from tests.perf.planning import magnified, measure, show


@pytest.mark.slow("solves and plans on a grid twice as fine")
def test_a_magnified_world_has_the_same_flow_and_the_same_times():
    world, trip = next(
        (world, trip) for world in worlds(128, 3) if (trip := draw_trip(world, np.random.default_rng(0)))
    )
    twice = magnified(world)
    times = [FULL.plan(w.field(0.5), *trip.ends("down"), w.chip, w.robot).arrival_s[-1] for w in (world, twice)]
    assert twice.chip.mask.shape == (256, 256)
    assert times[1] == pytest.approx(times[0], rel=0.08)


@pytest.mark.slow("plans on two chips, beside a search of scipy")
def test_a_plan_is_timed_beside_dijkstra_on_chips_of_both_resolutions(capsys):
    results = measure(per_size=1, repeats=1, side_px=128)
    show(results)
    assert [row["pixels"] for row in results["rows"]] == [[256, 256]] * 2
    assert all(row["plan_ms"] > 0.0 and row["dijkstra_ms"] > 0.0 for row in results["rows"])
