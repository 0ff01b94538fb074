"""Every method of the observer stage."""

import pytest

from flowrec.estimation import Observer
from flowrec.estimation.observer import OBSERVERS


@pytest.fixture(params=list(OBSERVERS))
def any_observer(request):
    """An observer of each row of the table, with its default settings."""
    return Observer(request.param)
