"""`flowrec.solve` and `flowrec.refine`: a mask and measurements of anybody's, without a session."""

from __future__ import annotations

import re
from dataclasses import replace
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


def test_windows_of_half_a_channel_are_means_and_without_their_side_the_walls_seem_off(
    mask: Any, truth: FlowField
) -> None:
    rng = np.random.default_rng(3)
    side_um, (rows, columns) = 120.0, np.nonzero(mask[:, 8:52])
    chosen = rng.choice(len(rows), 40, replace=False)
    places = 10.0 * np.column_stack([columns[chosen] + 8.0, rows[chosen]])
    grid = side_um * (np.stack(np.meshgrid(np.arange(48.0), np.arange(48.0)), -1).reshape(-1, 2) / 47.0 - 0.5)
    at_um = places[:, None] + grid
    inside = np.abs(at_um[..., 1] - 155.0) < 120.0  # of the channel's middle
    flow = (sample(truth, at_um) * inside[..., None]).sum(axis=1) / inside.sum(axis=1)[:, None]
    table = np.column_stack([places, flow + rng.normal(0.0, 3.0, flow.shape), np.full(40, 3.0)])
    options: Any = {"um_per_px": 10.0, "inlet_speed_um_s": 100.0}
    found, as_points = (flowrec.refine(mask, table, window_um=side, **options) for side in (side_um, None))
    assert error_of(found, truth) < 0.02 and "walls" not in found.note
    assert error_of(as_points, truth) > 0.08, "what the side is for"


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
    "nothing moves": (np.array([[300, 160, 0, 0], [310, 160, 0, 0]]), r"all speeds are 0, and no std_um_s"),
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


@pytest.mark.parametrize("factor", [1000.0, -1000.0])
def test_speeds_far_above_all_that_the_method_can_follow_are_refused_with_the_unit_and_the_speed_to_give(
    mask: Any, measured: Any, factor: float
) -> None:
    measured = measured.assign(u_um_s=factor * measured.u_um_s, v_um_s=factor * measured.v_um_s)
    with pytest.raises(UsageError, match=rf"is {factor * 1.5:g} times the assumed one: is it in um/s\?") as caught:
        flowrec.refine(mask, measured, um_per_px=10.0, inlet_speed_um_s=100.0)
    speed = float(str(caught.value).rpartition(" ")[2])
    assert speed == pytest.approx(150.0 * abs(factor), rel=0.05)
    refined = flowrec.refine(mask, measured, um_per_px=10.0, inlet_speed_um_s=speed)
    assert refined.velocity_um_s[16, 30, 0] == pytest.approx(1.5 * 150.0 * factor, rel=0.05)


def test_speeds_at_which_the_flow_can_not_be_computed_are_refused_with_the_speed_to_give() -> None:
    mask = np.zeros((40, 60), np.bool_)
    mask[18:24] = mask[5:35, 20:40] = True
    mask[11:29, 26:34] = False
    options: Any = {"um_per_px": 1000.0, "inlet_speed_um_s": 5000.0, "inlets": ("left",)}
    places = 1000.0 * np.column_stack([np.linspace(3.0, 18.0, 30), np.tile([20.0, 21.0, 22.0], 10)])
    measured = 50.0 * sample(flowrec.solve(mask, **options), places)
    with pytest.raises(UsageError, match="give inlet_speed_um_s near 250000"):
        flowrec.refine(mask, np.hstack([places, measured]), **options)


@pytest.mark.parametrize(("seed", "factor"), [(0, 8.0), (0, -12.0), (2, 13.0), (1, -45.0), (3, 96.0)])
def test_a_flow_many_times_as_fast_as_assumed_either_way_is_found_and_told_in_the_note(
    seed: int, factor: float
) -> None:
    mask = np.zeros((40, 160), np.bool_)
    mask[10:30] = True
    options: Any = {"um_per_px": 5.0, "inlet_speed_um_s": 100.0}
    assumed, rng = flowrec.solve(mask, **options), np.random.default_rng(seed)
    places = np.column_stack([rng.uniform(20.0, 780.0, 30), rng.uniform(60.0, 135.0, 30)])
    flow = factor * (sample(assumed, places) + rng.normal(0.0, 3.0, places.shape))
    refined = flowrec.refine(mask, np.hstack([places, flow]), **options)
    assert refined.error_share is not None
    truth = replace(assumed, velocity_um_s=np.float32(factor) * assumed.velocity_um_s)
    assert error_of(refined, truth) < 2.0 * refined.error_share < 0.1
    told = re.search(r"the flow is ([0-9.]+) times the assumed one(.*?):", refined.note)
    assert told is not None and float(told[1]) == pytest.approx(abs(factor), rel=0.05)
    assert told[2] == ("" if factor > 0.0 else " in the other direction")


def test_speeds_of_another_unit_sign_or_direction_that_the_method_follows_are_told_in_the_note(
    mask: Any, measured: Any
) -> None:
    def note(u: Any, v: Any) -> str:
        table = measured.assign(u_um_s=u, v_um_s=v)
        return flowrec.refine(mask, table, um_per_px=10.0, inlet_speed_um_s=100.0).note

    u, v = measured.u_um_s, measured.v_um_s
    assert "is 0.0015 times the assumed one: is it in um/s?" in note(1e-3 * u, 1e-3 * v)
    assert "runs against the assumed one" in note(-u, -v)
    assert "runs across the assumed one: are u and v exchanged?" in note(v, u)
    assert "assumed one" not in note(u, v)


def test_places_that_fit_the_chip_with_y_the_other_way_up_are_refused_also_on_a_grid_that_holds_the_solid() -> None:
    mask = np.zeros((80, 100), np.bool_)
    mask[10:30] = True
    truth = flowrec.solve(mask, um_per_px=2.0)
    x, y = (each.ravel() for each in np.meshgrid(np.arange(4.0, 200.0, 12.0), np.arange(2.0, 160.0, 6.0)))
    grid = np.column_stack([x, y])
    flow = sample(truth, grid) * mask[np.rint(y / 2.0).astype(int), np.rint(x / 2.0).astype(int), None]
    assert flowrec.refine(mask, np.hstack([grid, flow]), um_per_px=2.0).note.startswith("assimilated")
    upwards = np.column_stack([x, 158.0 - y, flow[:, 0], -flow[:, 1]])
    with pytest.raises(UsageError, match=r"100 % with y counted from its lower edge: count y downwards"):
        flowrec.refine(mask, upwards, um_per_px=2.0)


def test_a_wild_row_does_not_widen_the_standard_deviation_of_the_others(measured: Any) -> None:
    alone = observations_of(measured).std_um_s[0]
    wild = measured.copy()
    wild.loc[7, "u_um_s"] = 1e7
    assert observations_of(wild).std_um_s[0] == pytest.approx(alone, rel=0.1)
    still = np.zeros((300, 4))  # of a grid that holds the solid
    grid = np.vstack([measured.to_numpy(), still])
    assert observations_of(grid).std_um_s[0] == pytest.approx(alone * np.sqrt(30.0 / 330.0))


@pytest.mark.parametrize("size", [-5.0, 0.0, float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["radius_um", "window_um"])
def test_a_size_that_is_none_is_refused(mask: Any, measured: Any, name: str, size: float) -> None:
    with pytest.raises(UsageError, match=rf"{name} = .* must be more than zero; leave it out where"):
        flowrec.refine(mask, measured, um_per_px=10.0, **{name: size})  # type: ignore[misc]


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({"um_per_px": 5e-6}, "chip.um_per_px = 5e-06: must be from 0.001 to 1000"),
        ({"um_per_px": 5.0, "inlet_speed_um_s": -50.0}, "chip.inlet_speed_um_s = -50: must be from 0"),
        ({"um_per_px": np.float32(5e-6)}, "chip.um_per_px"),
        ({"um_per_px": "wide"}, "um_per_px = 'wide': must be a number"),
    ],
)
def test_options_outside_of_the_ranges_of_the_settings_are_refused(mask: Any, options: Any, why: str) -> None:
    with pytest.raises(UsageError) as caught:
        flowrec.solve(mask, **options)
    assert why in str(caught.value)


def test_the_note_of_a_solved_flow_names_inlets_outlets_closed_openings_and_fluid_that_stands_still() -> None:
    mask = np.zeros((60, 80), np.bool_)
    mask[10:20] = mask[40:50] = True
    mask[20:30, 40:42] = mask[:10, 40:42] = True
    note = flowrec.solve(mask, um_per_px=5.0).note
    assert "inlets left:0; outlets left:1, right:0, right:1; closed where fluid meets the border at top 40-41" in note
    assert note.endswith("800 px of fluid are reached by no inlet and stand still")
    both = flowrec.solve(mask, um_per_px=5.0, inlets="left").note  # type: ignore[arg-type]
    assert "inlets left:0, left:1; outlets right:0, right:1" in both and "still" not in both


def test_headings_with_their_units_in_brackets_are_known(mask: Any, measured: Any, tmp_path: Path) -> None:
    file = tmp_path / "measured.csv"
    measured.to_csv(file, index=False, header=["x [um]", "Y (µm)", "u [um/s]", "V (µm/s)"])
    assert np.array_equal(observations_of(file).flow_um_s, observations_of(measured).flow_um_s)
