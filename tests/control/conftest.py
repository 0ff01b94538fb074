"""Every method of the control stage."""

import pytest

from flowrec.control import Controller
from flowrec.control.controller import CONTROLLERS


@pytest.fixture(params=list(CONTROLLERS))
def any_controller(request):
    """A controller of each row of the table, with its default settings."""
    return Controller(method=request.param)
