import itertools

import numpy as np
import pytest

from flowrec.bench.plan import FULL, measure, show
from flowrec.bench.reserves import drive
from flowrec.bench.trips import SPEED_UM_S, best_time, draw_trip, worlds
from flowrec.core.errors import UsageError
from tests.stages.planning.worlds import PX, chip_of, field_of, open_water, robot

START, GOAL = np.array([300.0, 300.0]), np.array([900.0, 500.0])


def drawn():
    for world in worlds(128, 3):
        trip = draw_trip(world, np.random.default_rng(0))
        if trip is not None:
            yield world, trip


@pytest.mark.slow("a whole bench: three planners on two trips")
def test_the_bench_measures_every_planner_against_the_least_time_and_nobody_is_faster(tmp_path, capsys):
    figure = tmp_path / "plan.png"
    methods = ("time_field", "astar_paper", "astar_length:8")
    figures = measure(trips=2, side_px=128, methods=",".join(methods), figure=figure, quick=True)
    show(figures)
    assert "time_field" in capsys.readouterr().out and figure.stat().st_size > 20000
    for line in figures["summary"]["time_field"].values():
        assert line["failed"] == 0
        assert line["worst_percent"] is None or 98.0 < line["worst_percent"] <= line["best_percent"] < 100.5
    for method in methods[1:]:
        assert all(ratio is None or ratio > 0.995 for ratio in figures["ratios"][method].values())
    with pytest.raises(UsageError, match="'dijkstra'"):
        measure(methods="dijkstra")


@pytest.mark.slow("a bench on a fine grid")
def test_the_least_time_on_a_finer_grid_is_what_a_finer_grid_still_finds():
    for world, trip in itertools.islice(drawn(), 2):
        ends = trip.ends("up")
        two, four = (best_time(world, world.field(0.9), *ends, SPEED_UM_S, finer)[0] for finer in (2, 4))
        assert four == pytest.approx(two, rel=0.02)


@pytest.mark.slow("a bench of planners")
@pytest.mark.parametrize("flow", [(0.0, 0.0), (40.0, 30.0), (-60.0, 0.0)])
def test_driving_down_the_time_to_go_takes_the_time_that_it_says(flow):
    field = field_of(open_water(), *flow)
    route = FULL.plan(field, START, GOAL, chip_of(open_water()), robot())
    took, path = drive(route, field, START, GOAL, 100.0, 0.5 * PX, 60.0)
    assert took == pytest.approx(route.arrival_s[-1], rel=0.02)
    assert np.hypot(*(path[-1] - GOAL)) < 3.0 * PX


def test_a_robot_that_is_swept_away_never_arrives():
    field = field_of(open_water(), 50.0)
    route = FULL.plan(field, GOAL, START, chip_of(open_water()), robot())
    assert drive(route, field_of(open_water(), 150.0), GOAL, START, 100.0, 5.0, 60.0)[0] == np.inf
