"""Every method of the observer stage."""

import pytest

from flowrec.stages import OBSERVERS, Observer, with_row


@pytest.fixture(params=OBSERVERS.usable())
def any_observer(request):
    """An observer of each row of the table, with its default settings."""
    return with_row(Observer(), OBSERVERS, request.param)
