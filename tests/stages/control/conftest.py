"""Every method of the control stage."""

import pytest

from flowrec.stages.control import Controller
from flowrec.stages.control.controller import CONTROLLERS
from flowrec.stages.outside_settings import with_row


@pytest.fixture(params=CONTROLLERS.usable())
def any_controller(request):
    """A controller of each row of the table, with its default settings."""
    return with_row(Controller(), CONTROLLERS, request.param)
