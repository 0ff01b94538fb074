"""The cache of factors and solutions holds no more memory than it may, and says truly how much that is."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp

from flowrec.physics import clear_cache, compute_cached
from flowrec.physics.flow import linear_solver
from flowrec.physics.flow.linear_solver import factorise, held_bytes


@dataclass(frozen=True, slots=True)
class Slotted:
    values: Any
    more: Any = None


@dataclass(frozen=True)
class Growing:
    values: Any

    @cached_property
    def later(self) -> np.ndarray:
        return np.zeros(100_000)


@pytest.fixture(autouse=True)
def empty(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(linear_solver, "LARGEST_BYTES", 1_000_000)
    monkeypatch.setattr(linear_solver, "FEWEST_ENTRIES", 2)
    clear_cache()


def kept() -> str:
    """The keys whose results are in the cache, the latest last."""
    return "".join(key if isinstance(key, str) else "-" for key in linear_solver._entries)


def test_the_results_that_were_not_used_for_longest_are_dropped_when_all_have_more_bytes_than_allowed() -> None:
    for key in "abc":
        compute_cached(key, lambda: np.zeros(45_000))
        compute_cached("a", lambda: pytest.fail("it is there"))
    assert kept() == "ca"


def test_a_result_larger_than_the_limit_stays_with_the_one_before_it_and_bytes_of_keys_count() -> None:
    compute_cached("x", lambda: None)
    compute_cached("y", lambda: None)
    compute_cached("z", lambda: np.zeros(1_000_000))
    assert kept() == "yz"
    compute_cached("x", lambda: None)
    for number in range(4):
        compute_cached((number, bytes(300_000)), lambda: None)
    assert kept() == "---"


def test_a_result_that_grows_when_it_is_used_counts_with_what_it_has_become() -> None:
    first = compute_cached("a", lambda: Growing(np.zeros(50_000)))
    compute_cached("b", lambda: None)
    compute_cached("c", lambda: None)
    assert first.later.size
    compute_cached("d", lambda: None)
    assert kept() == "bcd"


def test_arrays_are_counted_wherever_they_are_and_once() -> None:
    array, matrix = np.zeros(1000), sp.csr_array(np.eye(50))
    of_matrix = 50 * 8 + 50 * 4 + 51 * 4
    whole = Slotted(
        {"a": array, "b": [array[3:], (array.reshape(10, 100),)]}, SimpleNamespace(matrix=matrix, kind=dict)
    )
    held, _ = held_bytes([whole])
    assert sum(held.values()) == 8000 + of_matrix
    assert held_bytes([array, matrix])[0].items() <= held.items()
    assert held_bytes([array[:1]])[0] == {id(array): 8000}  # a view keeps all of it


@pytest.mark.skipif(sys.platform != "linux", reason="memory of a process as Linux tells it")
def test_factors_take_the_memory_that_is_counted_for_them_also_where_memory_was_used_before() -> None:
    one, side = sp.eye_array(90), sp.diags_array([-1.0, 4.0, -1.0], offsets=[-1, 0, 1], shape=(90, 90))
    matrix = sp.kron(one, side) - sp.kron(sp.diags_array([1.0, 1.0], offsets=[-1, 1], shape=(90, 90)), one)
    used = [np.ones(500_000) for _ in range(40)]  # 160 MB in blocks that a heap has

    def memory() -> int:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    del used
    before = memory()
    factors = [factorise(matrix) for _ in range(20)]
    assert memory() - before < 1.5 * sum(held_bytes(factors)[0].values()) + 10_000_000
    np.testing.assert_allclose(matrix @ factors[-1].solve(np.ones(8100)), 1.0)
