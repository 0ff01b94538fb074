"""One session for all tests of what leaves flowrec."""

from __future__ import annotations

import pytest

import flowrec
from flowrec.store import Session
from tests.outlets import primes


@pytest.fixture(scope="session")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    path = tmp_path_factory.mktemp("primes") / "primes.mcap"
    primes.write(path)
    return flowrec.open(path)
