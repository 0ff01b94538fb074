"""What stretches of a survey were worth, and that a survey without worth ends."""

from dataclasses import replace

import numpy as np
import pytest

from flowrec.stages.planning.survey_information import SurveyMemory
from tests.stages.planning.test_survey_information import UPPER, junction, ordered, planner, unknown

FLOW = np.full((10, 2), 40.0)


def memory(stated, expected, moved, late_s=0.0):
    """After stretches of 10 s with these stated and expected errors; the last of `stated` and `moved` is now.

    Each next stretch is chosen so long before the end of the present one.
    """
    end_s = 10.0 * np.arange(1, len(expected) + 1)
    progress_s = np.append(0.0, end_s - late_s)
    rows = np.column_stack([stated[:-1], expected, moved[:-1], progress_s[:-1], end_s])
    return SurveyMemory(rows, FLOW, stated[-1], moved[-1], progress_s[-1])


def test_stretches_that_lower_the_error_as_expected_or_move_the_map_as_far_are_trusted():
    falls = memory([0.4, 0.3, 0.2, 0.1], [0.3, 0.2, 0.1], [0.0, 0.0, 0.0, 0.0])
    assert falls.trust(2) == pytest.approx(1.0)
    # By the law of total variance: sqrt(0.5^2 - 0.4^2) for each stretch.
    moves = memory([0.5, 0.5, 0.5, 0.5], [0.4, 0.4, 0.4], [0.0, 0.0, 0.3, 0.3])
    assert moves.trust(2) == pytest.approx(1.0)
    assert memory([0.5, 0.5, 0.5, 0.5], [0.4, 0.4, 0.4], [0.0, 0.0, 0.0, 0.15]).trust(2) == pytest.approx(0.125)


def test_a_stretch_counts_by_the_part_of_it_that_was_travelled():
    # Of the last stretch 4 of 10 s, of the one before 6: together one of expected square 0.25 - 0.16 and none of 0.
    late = memory([0.5, 0.5, 0.5], [0.5, 0.4], [0.0, 0.0, 0.3], late_s=6.0)
    assert late.trust(1) == pytest.approx(1.0)
    assert replace(late, moved=0.09).trust(1) == pytest.approx(0.09**2 / (0.4 * 0.09))


def test_stretches_that_do_neither_are_trusted_no_more_and_too_few_are_believed():
    stays = memory([0.4, 0.4, 0.4, 0.4], [0.3, 0.3, 0.3], [0.3, 0.3, 0.0, 0.0])
    assert stays.trust(2) == 0.0
    assert stays.trust(4) == 1.0 and stays.trust(0) == 1.0
    # A stated error that rises and falls again has not fallen.
    assert memory([0.2, 0.4, 0.3, 0.2], [0.1, 0.3, 0.2], [0.0, 0.0, 0.0, 0.0]).trust(2) == 0.0


def test_the_move_is_that_of_the_flow_since_the_route_was_chosen():
    chip, field = junction()
    doubt = unknown(chip, field, (0.3, 0.3))
    first = planner().plan(ordered(chip, field, doubt))
    assert first.stretches.shape == (1, 5) and first.stretches[0, -1] == first.arrival_s[-1]
    after = SurveyMemory.of(first, 1.25 * doubt.mean_um_s, 0.1, 1.0)
    assert after.moved == pytest.approx(0.2) and SurveyMemory.of(first, doubt.mean_um_s, 0.1, 1.0).moved == 0.0


def test_a_survey_that_learns_nothing_ends_although_more_is_expected_of_the_next_stretch():
    def stretches(count):
        chip, field = junction()
        doubt, route, start = unknown(chip, field, (0.3, 0.3)), None, np.array([300.0, 445.0])
        for _ in range(6):
            # What was seen is forgotten: the flow is as little known as before.
            ends = {} if route is None else {"present": route, "progress_s": float(route.arrival_s[-1])}
            route = planner(memory_stretches=count).plan(ordered(chip, field, doubt, start=start, goal=UPPER, **ends))
            start = route.waypoints_um[-1]
        return route

    ended = stretches(2)
    assert not ended.more and ended.reason.startswith("enough") and len(ended.stretches) == 2
    endless = stretches(0)
    assert endless.more and endless.stretches is None
