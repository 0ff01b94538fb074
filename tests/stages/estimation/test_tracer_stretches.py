"""Stretches of the ways of tracers as observations of the flow."""

from __future__ import annotations

import numpy as np
import pytest

from flowrec.core import NS_PER_S, Tracers
from flowrec.stages.estimation.tracer_stretches import CAPACITY, collect_stretches


def tracers(
    time_s: float, from_um: list, from_s: list, position_um: list, age: float = 20.0, missed_s: list | None = None
) -> Tracers:
    """Two bodies, the numbers 4 and 7."""
    one, place = np.ones(2), np.array(position_um, float)
    return Tracers(
        round(time_s * NS_PER_S), np.array([4.0, 7.0]), place, np.zeros((2, 2)), one, one, one, age * one, 0 * one,
        np.array([0.0, 1.0]), np.array(from_um, float), np.array(from_s, float), 8,
        None if missed_s is None else np.array(missed_s),
    )  # fmt: skip


START = [[0.0, 0.0], [10.0, 0.0]]


def test_a_stretch_gives_its_mean_velocity_in_its_middle_and_its_body() -> None:
    before = tracers(1.9, START, [1.0, 1.0], [[90.0, 0.0], [11.0, 0.0]])
    after = tracers(2.0, [[100.0, 40.0], [10.0, 0.0]], [2.0, 1.0], [[100.0, 40.0], [11.0, 0.0]])
    found = collect_stretches(None, before, after)
    assert found.flow_um_s.tolist() == [[100.0, 40.0]] and found.position_um.tolist() == [[50.0, 20.0]]
    assert found.tracer.tolist() == [4.0] and found.entered.tolist() == [0.0] and found.time_s.tolist() == [1.5]
    np.testing.assert_allclose(found.std_um_s, [np.hypot(np.sqrt(2.0), 2.0)])
    assert collect_stretches(found, after, after) is found
    twice = collect_stretches(found, before, after)
    assert len(twice.std_um_s) == 2


def test_what_sticks_or_is_new_tells_no_flow() -> None:
    before = tracers(1.9, START, [1.0, 1.0], START)
    stuck = tracers(2.0, [[3.0, 0.0], [10.0, 3.0]], [2.0, 2.0], [[3.0, 0.0], [10.0, 3.0]])
    assert collect_stretches(None, before, stuck) is None
    new = tracers(1.9, START, [1.0, 1.0], START, age=2.0)
    moved = tracers(2.0, [[100.0, 0.0], [10.0, 0.0]], [2.0, 1.0], START)
    assert collect_stretches(None, new, moved) is None
    assert collect_stretches(None, before, moved) is not None


@pytest.mark.parametrize(("missed_s", "counts"), [(None, True), (0.0, True), (0.19, True), (0.21, False)])
def test_a_stretch_that_images_do_not_show_for_over_a_tenth_of_its_time_tells_no_flow(missed_s, counts) -> None:
    missed = None if missed_s is None else [missed_s, 0.0]
    before = tracers(2.9, START, [1.0, 1.0], [[90.0, 0.0], [11.0, 0.0]], missed_s=missed)
    after = tracers(3.0, [[100.0, 0.0], [10.0, 0.0]], [3.0, 1.0], [[100.0, 0.0], [11.0, 0.0]], missed_s=[0.0, 0.0])
    assert (collect_stretches(None, before, after) is not None) is counts


def test_of_more_stretches_than_are_kept_all_of_some_tracers_stay_from_every_part_of_the_run() -> None:
    kept = None
    for ten in range(80):  # ten bodies after the other ten, each over ten stretches
        bodies, ones = 10.0 * ten + np.arange(10.0), np.ones(10)
        for step in range(10):
            began_s = 10.0 * ten + step

            def at(time_s: float, from_um: float, from_s: float, bodies=bodies, ones=ones) -> Tracers:
                begin = np.stack((from_um * ones, 0.0 * ones), axis=1)
                return Tracers(
                    round(time_s * NS_PER_S), bodies, begin, 0.0 * begin, ones, ones, ones, 20.0 * ones, 0.0 * ones,
                    ones, begin, from_s * ones, 800,
                )  # fmt: skip

            before = at(began_s + 0.9, 100.0 * step, began_s)
            kept = collect_stretches(kept, before, at(began_s + 1.0, 100.0 * (step + 1), began_s + 1.0))
    assert kept is not None and len(kept.time_s) == CAPACITY
    assert (np.diff(kept.time_s) >= 0.0).all(), "in the order of their times"
    assert np.histogram(kept.time_s, 8, (0.0, 800.0))[0] == pytest.approx(CAPACITY / 8, rel=0.1)
    each = np.unique(kept.tracer, return_counts=True)[1]
    assert np.count_nonzero(each == 10) >= len(each) - 1
