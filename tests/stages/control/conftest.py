"""Every method of the control stage."""

import pytest

from flowrec.stages import CONTROLLERS, Controller, with_row


@pytest.fixture(params=CONTROLLERS.usable())
def any_controller(request):
    """A controller of each row of the table, with its default settings."""
    return with_row(Controller(), CONTROLLERS, request.param)
