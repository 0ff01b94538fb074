"""`flowrec.solve` and `flowrec.refine`: a mask and measurements of anybody's, without a session."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import flowrec
from flowrec.core.errors import ChipError, FlowrecError, UsageError
from flowrec.core.messages import FlowField
from flowrec.physics.chip.chip import Chip, ChipSettings
from flowrec.physics.chip.io import load_chip
from flowrec.physics.flow.sampling import sample
from flowrec.store.table_columns import OBSERVED, observations_of

GOLDEN = Path(__file__).parents[3] / "sessions" / "golden.mcap"


@pytest.fixture(scope="module")
def mask() -> np.ndarray[Any, np.dtype[np.bool_]]:
    """A straight channel, 24 px wide and 60 px long."""
    mask = np.zeros((32, 60), np.bool_)
    mask[4:28] = True
    return mask


@pytest.fixture(scope="module")
def truth(mask: np.ndarray[Any, np.dtype[np.bool_]]) -> FlowField:
    return flowrec.solve(mask, um_per_px=10.0, inlet_speed_um_s=150.0)


@pytest.fixture(scope="module")
def measured(truth: FlowField) -> Any:
    """Exact measurements of the true flow, 150 um/s where 100 um/s are assumed."""
    places = np.column_stack([np.linspace(50.0, 550.0, 30), 160.0 + 60.0 * np.sin(np.arange(30))])
    flow = sample(truth, places)
    import pandas

    return pandas.DataFrame({"x_um": places[:, 0], "y_um": places[:, 1], "u_um_s": flow[:, 0], "v_um_s": flow[:, 1]})


def error_of(field: FlowField, truth: FlowField) -> float:
    difference = field.velocity_um_s - truth.velocity_um_s
    return float(np.sqrt((difference**2).sum() / (truth.velocity_um_s**2).sum()))


def test_measurements_in_any_kind_of_table_give_the_same_flow_near_the_true_one(
    mask: Any, truth: FlowField, measured: Any, tmp_path: Path
) -> None:
    options: Any = {"um_per_px": 10.0, "inlet_speed_um_s": 100.0}
    assert error_of(flowrec.solve(mask, **options), truth) > 0.3
    file = tmp_path / "measured.csv"
    measured.to_csv(file, index=False)
    kinds = (measured, file, str(file), measured.to_numpy(), {name: measured[name].tolist() for name in measured})
    refined = [flowrec.refine(mask, kind, **options) for kind in kinds]
    assert error_of(refined[0], truth) < 0.02 and refined[0].std_um_s is not None
    assert all(field.same_as(refined[0]) for field in refined[1:])
    assert flowrec.refine(mask, measured, method="gain", **options).method == "gain"


def test_the_observed_flow_of_an_exported_session_is_read_as_it_was_recorded(tmp_path: Path) -> None:
    session = flowrec.open(GOLDEN)
    recorded = session.last.observations
    assert recorded is not None
    import pandas

    for file_format, read in (("csv", str), ("parquet", pandas.read_parquet)):
        folder = flowrec.export(session, tmp_path / file_format, file_format=file_format)
        again = observations_of(read(folder / f"observed_flow.{file_format}"))
        assert np.array_equal(again.position_um, recorded.position_um)
        assert np.array_equal(again.flow_um_s, recorded.flow_um_s)
        assert np.array_equal(again.std_um_s, recorded.std_um_s)
        assert (again.rolled_um_s is None) == (recorded.rolled_um_s is None)


def test_the_tracks_of_beads_by_number_tell_the_mean_over_the_depth_at_which_each_goes_faster_or_slower(
    mask: Any,
) -> None:
    options: Any = {"um_per_px": 10.0, "inlet_speed_um_s": 100.0, "depth_um": 60.0}
    assumed = flowrec.solve(mask, **options)
    rng = np.random.default_rng(2)
    share = 1.5 * (1.0 - rng.uniform(-1.0, 1.0, 60) ** 2)  # of the flow's mean over the depth, between plates
    bead = rng.permutation(np.repeat(np.arange(60), np.rint(8.0 * share).astype(int)))  # stretches of equal length
    places = np.column_stack([rng.uniform(50.0, 550.0, len(bead)), rng.uniform(110.0, 210.0, len(bead))])
    flow = 1.4 * share[bead, None] * sample(assumed, places)
    table = {"x_um": places[:, 0], "y_um": places[:, 1], "u_um_s": flow[:, 0], "v_um_s": flow[:, 1], "tracer": bead}
    found = flowrec.refine(mask, table, **options)
    unnumbered = flowrec.refine(mask, {name: table[name] for name in list(table)[:4]}, **options)
    middle = np.s_[16, 30, 0]
    stated = found.std_um_s[middle] / found.velocity_um_s[middle]
    ratio, without = (each.velocity_um_s[middle] / assumed.velocity_um_s[middle] for each in (found, unnumbered))
    assert ratio == pytest.approx(1.4, rel=0.08) and 0.02 < stated < 0.1
    assert without > 1.55, "as if all beads went with the mean"


WRONG: dict[str, tuple[Any, str]] = {
    "no column": (
        {"x_um": [1.0], "y_um": [1.0], "u_um_s": [1.0]},
        r"no column v_um_s; the columns are x_um, y_um, u_um_s",
    ),
    "three columns": (np.zeros((5, 3)), r"has the shape \(5, 3\) where \(n, 4 to 9\) belongs; the columns are x_um"),
    "a vector": (np.zeros(4), r"has the shape \(4,\)"),
    "text": ([["a", "b", "c", "d"]], r"are no table of numbers"),
    "an object": (object(), r"are no table of numbers"),
    "no row": (np.zeros((0, 4)), r"has no row; give at least one observation"),
    "NaN": (np.array([[300, 160, 1, np.nan], [300, 160, np.nan, 1]]), r"row 1: u_um_s is nan; leave these rows out"),
    "infinity": (np.array([[300, 160, 1, np.inf]]), r"row 0: v_um_s is inf"),
    "std": (np.array([[300, 160, 1, 1, 0.0]]), r"row 0: std_um_s is 0; it must be more than zero"),
    "half of its own motion": (np.array([[300, 160, 1, 1, 1, 1.0]]), r"own_u_um_s and own_v_um_s belong together"),
    "ragged": ({"x_um": [1.0, 2.0], "y_um": [1.0], "u_um_s": [1.0], "v_um_s": [1.0]}, r"y_um has the shape \(1,\)"),
    "outside": (
        np.array([[300, 160, 1, 1], [300, 9000, 1, 1]]),
        r"1 of 2 places are outside of chip .* row 1, \(300, 9000\)",
    ),
    "in solid": (np.array([[300, 5, 1, 1]]), r"all 1 places are in solid"),
}


@pytest.mark.parametrize("name", WRONG)
def test_measurements_that_are_no_such_table_are_refused_in_one_line_that_says_what_is_wanted(
    name: str, mask: Any
) -> None:
    given, why = WRONG[name]
    with pytest.raises(UsageError, match=why) as caught:
        flowrec.refine(mask, given, um_per_px=10.0)
    assert "\n" not in str(caught.value)


def test_nan_and_infinity_in_each_column_are_refused(mask: Any) -> None:
    row = [300.0, 160.0, *np.ones(len(OBSERVED) - 2)]
    for column, name in enumerate(OBSERVED):
        for bad in (np.nan, np.inf, -np.inf):
            table = np.array([row, row])
            table[1, column] = bad
            with pytest.raises(UsageError, match=rf"row 1: {name} is {bad:g}"):
                observations_of(table)


def test_masks_and_chips_that_carry_no_flow_are_refused_in_one_line(mask: Any) -> None:
    chip = load_chip(ChipSettings(name="straight"))
    assert isinstance(chip, Chip) and flowrec.solve(chip).same_as(flowrec.solve("straight"))
    for given, options, error in (
        (mask.astype(float), {"um_per_px": 1.0}, UsageError),
        (mask[0], {"um_per_px": 1.0}, UsageError),
        (mask, {}, ChipError),
        (~mask & False, {"um_per_px": 1.0}, ChipError),
        (mask[:0], {"um_per_px": 1.0}, ChipError),
        ("nosuch", {}, ChipError),
        (Path("nosuch.png"), {}, ChipError),
        (chip, {"um_per_px": 1.0}, UsageError),
    ):
        with pytest.raises(error) as caught:
            flowrec.solve(given, **options)  # type: ignore[arg-type]
        assert "\n" not in str(caught.value) and isinstance(caught.value, FlowrecError)
