"""Fixtures that iterate the table of planners: a method is tested the moment it has a row."""

import importlib.util

import pytest

from flowrec.planning import PLANNERS, Planner
from flowrec.planning.planner import RrtSettings


@pytest.fixture(params=list(PLANNERS))
def any_planner(request):
    """A planner of every row, with few iterations for the random trees; skips where the row's extra is missing."""
    extra = PLANNERS[request.param].extra
    if extra and importlib.util.find_spec(extra) is None:
        pytest.skip(f"{extra} is not installed")
    return Planner(method=request.param, rrt=RrtSettings(iterations=1500))
