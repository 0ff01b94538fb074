"""Fixtures that iterate the table of planners: a method is tested the moment it has a row, also by a package."""

import pytest

from flowrec.stages import PLANNERS, Planner, with_row
from flowrec.stages.planning.planner import RrtSettings
from tests.extras import why


@pytest.fixture(params=PLANNERS.usable())
def any_planner(request):
    """A planner of every row, with few iterations for the random trees; skips where the row's extra is missing."""
    extra = PLANNERS[request.param].extra
    if extra:
        pytest.importorskip(extra, reason=why(extra))
    return with_row(Planner(rrt=RrtSettings(iterations=1000)), PLANNERS, request.param)
