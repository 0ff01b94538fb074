"""The bench of Table I: it scores as numpy does, looks at no truth before that, and its figures keep their names."""

import importlib.util

import numpy as np
import pytest

from flowrec.bench import figure_flow, flow
from flowrec.bench.figure_flow import FlowPanels, draw, median_case
from flowrec.bench.flow import make_up
from flowrec.bench.harness import need_matplotlib
from flowrec.bench.vessel_truth import read_observations
from flowrec.core.errors import ChipError, UsageError
from flowrec.physics.chip.io import read_vessel_case
from flowrec.physics.flow.solver import FlowSolver
from flowrec.stages.refine import Pinn, Refiner

TRUTHS = ("vx", "vy", "p", "mu", "nu", "rho", "op_u_true", "op_p_true")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("cases")
    make_up(made, 1)
    return made


def without_truth(path, out):
    with np.load(path) as case:
        np.savez(out, **{key: case[key] for key in case.files if key not in TRUTHS})
    return out


@pytest.mark.slow("a whole bench: solves, refines and draws")
def test_rows_and_summary_have_the_promised_names_and_numbers(folder, tmp_path):
    figures = flow.measure(folder, "assimilate", k=1, fields=tmp_path / "fields", figure=tmp_path / "one.png")
    (row,) = figures["rows"]
    assert {"case", "method", "rmse_vx", "rmse_vy", "rmse_v", "seconds", "cpu_seconds", "peak_mb", "note"} <= set(row)
    line = figures["summary"]["assimilate"]
    assert line["mean"] == row["rmse_v"] and line["std"] == 0.0 and line["median_seconds"] == row["seconds"]
    with np.load(tmp_path / "fields" / "made_up_00.assimilate.npz") as kept, np.load(folder / "made_up_00.npz") as case:
        mask = case["mask"]
        miss = [(kept["velocity_um_s"][..., i] - 1e6 * case[key])[mask] for i, key in enumerate(("vx", "vy"))]
        true = [1e6 * case[key][mask] for key in ("vx", "vy")]
    for i, name in enumerate(("rmse_vx", "rmse_vy")):
        assert row[name] == pytest.approx(np.linalg.norm(miss[i]) / np.linalg.norm(true[i]), rel=1e-5)
    assert row["rmse_v"] == pytest.approx(np.linalg.norm(miss) / np.linalg.norm(true), rel=1e-5)
    assert (tmp_path / "one.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow("a bench with every method")
def test_no_truth_is_read_before_there_is_a_result_to_score(folder, tmp_path, monkeypatch):
    order = []
    solve, refine, read = FlowSolver.solve, Refiner.refine, flow.read_true_velocity
    monkeypatch.setattr(FlowSolver, "solve", lambda *a: order.append("solve") or solve(*a))
    monkeypatch.setattr(Refiner, "refine", lambda *a: order.append("refine") or refine(*a))
    monkeypatch.setattr(flow, "read_true_velocity", lambda path: order.append("truth") or read(path))
    row = flow.refine_case(folder / "made_up_00.npz", "fvm", flow.Scenario(k=1))
    assert order == ["solve", "refine", "refine", "truth"] and 0.0 < row["rmse_v"] < 1.0
    order.clear()
    bare = without_truth(folder / "made_up_00.npz", tmp_path / "bare.npz")
    with pytest.raises(ChipError, match="no vx, vy"):
        flow.refine_case(bare, "assimilate", flow.Scenario(k=1))
    assert order[-1] == "truth" and order.count("truth") == 1, "all but the score is there"


@pytest.mark.slow("a bench with every method")
def test_a_case_without_its_truth_is_refined_to_the_same_bytes(folder, tmp_path):
    fields = []
    for path in (folder / "made_up_00.npz", without_truth(folder / "made_up_00.npz", tmp_path / "made_up_00.npz")):
        chip, solver = read_vessel_case(path), FlowSolver(1)
        settings = Pinn(iterations=5, points=64, width=16, depth=2, features=8)
        refiner = Refiner("pinn", pinn=settings)
        fields.append(refiner.refine(solver.solve(chip), read_observations(path, "05", "10"), chip, solver))
    assert fields[0].same_as(fields[1])


def test_every_method_of_the_papers_table_has_a_row_under_its_name():
    assert {"fvm", "ni", "pinn", "unet", "pi_unet", "assimilate"} <= set(flow.METHODS)
    assert all(refiner.method == name.split(":")[0] for name, refiner in flow.METHODS.items())


def row(case, method, error):
    times = {"seconds": 123.4, "cpu_seconds": 100.0, "seconds_update": 0.1}
    others = {"within_2_std": 0.9, "stated_over_true": 1.1, "crps": 0.02, "peak_mb": 200.0, "note": ""}
    return {"case": case, "method": method, **dict.fromkeys(("rmse_vx", "rmse_vy", "rmse_v"), error), **times, **others}


def test_the_printed_table_wraps_no_cell(capsys, monkeypatch):
    rows = [row("a", name, 0.5) for name in flow.METHODS]
    summary = {name: flow.summary([made for made in rows if made["method"] == name]) for name in flow.METHODS}
    flow.show({"rows": rows, "left_out": {}, "summary": summary, "noise": "05", "share": "10"})
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 100
    assert sum("0.500±0.000" in line for line in lines) == len(flow.METHODS)
    assert any("pi_unet:assimilate" in line for line in lines)


def test_the_case_of_the_figure_is_that_of_median_error_before_refinement():
    errors = {"a": 0.3, "b": 0.1, "c": 0.2, "d": 0.4}
    rows = [row(name, "fvm", error) for name, error in errors.items()]
    rows += [row(name, "ni", 1.0 - error) for name, error in errors.items()]
    assert median_case(rows) == "c"
    assert median_case([made for made in rows if made["method"] == "ni"]) == "a"


def test_an_arrow_of_the_top_speed_is_as_long_as_a_block():
    ax = figure_flow.new_figure(2.0, 2.0).subplots()
    velocity_um_s = np.broadcast_to([2400.0, 3200.0], (40, 40, 2))
    figure_flow._arrows(ax, velocity_um_s, np.array([[20, 20]]), top=4.0)
    (arrows,) = ax.collections
    assert np.hypot(arrows.U, arrows.V) / arrows.scale == pytest.approx(figure_flow.BLOCK_PX)


def test_a_figure_is_drawn_even_where_a_method_is_far_off_or_perfect(tmp_path):
    rng = np.random.default_rng(0)
    mask = np.zeros((32, 32), bool)
    mask[10:20] = True
    truth = np.where(mask[..., None], [3000.0, 0.0], 0.0)
    fields = {"fvm": truth, "ni": -5.0 * truth}
    points = rng.uniform([0, 110], [310, 190], (7, 2))
    picture = FlowPanels("a", mask, 10.0, truth, fields, points, np.full((7, 2), 2000.0))
    rows = [row(name, method, error) for name in "ab" for method, error in (("fvm", 0.0), ("ni", 6.0))]
    draw(tmp_path / "a.png", picture, rows)
    assert (tmp_path / "a.png").stat().st_size > 20_000


def test_wrong_requests_are_said_in_one_line_before_anything_is_computed(folder, tmp_path, monkeypatch):
    for words, named in (
        ({"cases": folder, "methods": "magic"}, "magic"),
        ({"cases": folder, "methods": "fvm", "case": "made_up_77"}, "made_up_77.*made_up_00"),
        ({"cases": tmp_path, "methods": "fvm"}, str(tmp_path)),
    ):
        with pytest.raises(UsageError, match=named):
            flow.measure(**words)
    monkeypatch.setattr(importlib.util, "find_spec", lambda _name: None)
    with pytest.raises(UsageError, match=r"pip install 'flowrec\[notebook\]'"):
        need_matplotlib()
