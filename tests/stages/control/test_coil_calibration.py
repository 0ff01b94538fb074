"""Coils from measured fields: the numbers, how far they are to be trusted, and what is wrong with a table."""

import json

import numpy as np
import pytest
from scipy.stats import t as student
from typer.testing import CliRunner

from flowrec.core.errors import UsageError
from flowrec.core.system.outputs import OutputError
from flowrec.measure.calibrate_coils import calibrate_coils, settings_of
from flowrec.measure.coil_calibration import Excitations, advice, fit_coils, read_excitations
from flowrec.measure.proposal import as_sets
from flowrec.stages.config import load_config
from flowrec.verbs.cli import app

A = np.array([[2.1, 0.1, -0.05], [0.08, 1.9, 0.1], [0.02, -0.1, 1.5]])
BIAS = np.array([0.02, -0.01, -0.045])
NOISE_MT = 0.02
CURRENTS = np.concatenate([2 * np.eye(3), -2 * np.eye(3), np.random.default_rng(0).uniform(-2, 2, (6, 3))])
HEADER = "i_x_a,i_y_a,i_z_a,b_x_mt,b_y_mt,b_z_mt\n"


def measured(seed=None, currents=CURRENTS, noise_mt=NOISE_MT):
    noise = noise_mt * np.random.default_rng(seed).standard_normal((len(currents), 3)) if seed is not None else 0.0
    return Excitations(currents, currents @ A.T + BIAS + noise, tuple(range(2, len(currents) + 2)), "made up")


def file_of(tmp_path, excitations, name="coils.csv"):
    rows = np.column_stack([excitations.currents_a, excitations.field_mt])
    path = tmp_path / name
    path.write_text(HEADER + "".join(",".join(f"{v:.6f}" for v in row) + "\n" for row in rows))
    return path


def test_without_noise_matrix_and_bias_come_out_exactly_and_nothing_stands_out():
    fit = fit_coils(measured())
    np.testing.assert_allclose(fit.mt_per_a, A, atol=1e-12)
    np.testing.assert_allclose(fit.bias_mt, BIAS, atol=1e-12)
    assert not fit.suspects and not fit.unchecked and not advice(fit)
    assert fit.weakest[0] == "z" and fit.condition == pytest.approx(np.linalg.cond(A))


def test_standard_errors_are_those_of_many_calibrations():
    fits = [fit_coils(measured(seed)) for seed in range(1, 401)]
    off = np.array([np.column_stack([f.mt_per_a - A, f.bias_mt - BIAS]) for f in fits])
    said = np.array([np.column_stack([f.mt_per_a_std, f.bias_std_mt]) for f in fits])
    inside = np.mean(np.abs(off) < student.ppf(0.975, 8) * said)
    assert inside == pytest.approx(0.95, abs=0.015)
    np.testing.assert_allclose(np.sqrt(np.mean(said**2, 0)), off.std(0), rtol=0.15)
    assert np.sqrt(np.mean([f.noise_mt**2 for f in fits])) == pytest.approx(NOISE_MT, rel=0.03)
    # The field that is set for 4 mT by a fit, beside the one that is then there.
    wanted = np.array([0.0, 0.0, 4.0])
    missed = [A @ np.linalg.solve(f.mt_per_a, wanted - f.bias_mt) + BIAS - wanted for f in fits]
    known = np.sqrt(np.mean([f.uncertainty_mt**2 for f in fits]))
    assert 0.7 * known < np.sqrt(np.mean(np.sum(np.square(missed), 1))) <= 1.05 * known, "said is the worst direction"
    assert np.mean([bool(f.suspects) for f in fits]) < 0.08, "false alarms"


def test_leave_one_out_is_what_leaving_one_out_gives():
    table = measured(3)
    fit = fit_coils(table)
    for row in range(12):
        keep = np.arange(12) != row
        rest = fit_coils(Excitations(table.currents_a[keep], table.field_mt[keep], tuple(range(11)), "rest"))
        foretold = rest.mt_per_a @ table.currents_a[row] + rest.bias_mt
        np.testing.assert_allclose(fit.left_out_mt[row], table.field_mt[row] - foretold, atol=1e-12)
        noise = np.sqrt(np.sum(rest.residual_mt**2) / (3 * rest.freedom))
        x = np.append(table.currents_a[row], 1.0)
        X = np.column_stack([table.currents_a, np.ones(12)])
        free = 1.0 - x @ np.linalg.solve(X.T @ X, x)
        np.testing.assert_allclose(fit.score[row], fit.left_out_mt[row] * np.sqrt(free) / noise, rtol=1e-6)


def test_a_bad_row_is_found_by_its_line_even_where_it_pulls_the_fit_towards_itself():
    found = 0
    for seed in range(40):
        table = measured(seed)
        row, axis = seed % 12, seed % 3
        field = table.field_mt.copy()
        field[row, axis] += 0.2
        fit = fit_coils(Excitations(table.currents_a, field, table.lines, "bad"))
        found += fit.suspects[:1] == [row]
        if fit.suspects[:1] == [row]:
            assert advice(fit)[0].startswith(f"line {row + 2}: b_{'xyz'[axis]}_mt is +0.")
    assert found >= 36


def test_a_row_that_nothing_confirms_is_named():
    currents = np.array([[2.0, 0, 0], [-2, 0, 0], [0, 2, 0], [0, -2, 0], [1, 1, 0], [0, 0, 2.0]])
    fit = fit_coils(measured(1, currents))
    assert fit.unchecked == [5] and np.isnan(fit.left_out_mt[5]).all()
    said = advice(fit)
    assert any("line 7: no other row excites" in sentence for sentence in said)
    assert any("coil z was driven one way only" in sentence for sentence in said)
    assert any("6 rows leave 2" in sentence for sentence in said)


@pytest.mark.parametrize(
    ("currents", "says"),
    [
        (CURRENTS[:4], "4 rows; three coils and a bias take 4, and 5 to see any residual; 12 are recommended"),
        (CURRENTS * [1, 1, 0], "coil z was hardly driven; add rows with the currents 0,0,2 and 0,0,-2 A"),
        (
            CURRENTS * [0, 0, 1],
            "coils x and y were hardly driven; add rows with the currents 2,0,0 and -2,0,0 and 0,2,0",
        ),
        (
            CURRENTS[:, [0, 0, 2]],
            "the currents of coils x and y always change together.*add rows with the currents 2,0,0",
        ),
        (np.ones((7, 3)), "all rows have the same currents"),
    ],
)
def test_excitations_that_do_not_suffice_are_refused_with_those_to_add(currents, says):
    with pytest.raises(UsageError, match=f"made up: {says}"):
        fit_coils(measured(1, np.asarray(currents, float)))


def test_a_probe_with_a_dead_axis_makes_no_coils():
    table = measured(1)
    with pytest.raises(UsageError, match=r"no field along z .*probe axis dead"):
        fit_coils(Excitations(table.currents_a, table.field_mt * [1.0, 1.0, 0.0], table.lines, "made up"))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", r": is empty; the first line is i_x_a,i_y_a,i_z_a,b_x_mt"),
        ("i_x_a;i_y_a;i_z_a\n1;2;3\n", r":1: columns are separated by ';'"),
        (HEADER.replace("b_z_mt", "b_z_ut"), r":1: column 'b_z_ut' where 'b_z_mt' belongs: give it in millitesla"),
        (HEADER.replace("i_y_a", "i_y"), r":1: column 'i_y' where 'i_y_a' belongs: give it in ampere"),
        (HEADER.replace("i_y_a", "i_x_a"), r":1: two columns are named i_x_a"),
        ("1,2,3,4,5,6\n", r":1: no column i_x_a; the header is i_x_a"),
        ("# remark\n\n" + HEADER + "1,2,3,4,5,6\n1,2,3,4,5\n", r":5: 5 values where the header has 6"),
        (HEADER + "1,2,3,4,5,6\n1,2,x,4,5,6\n", r":3: i_z_a = 'x' is no number"),
        (HEADER + "1,2,3,4,5,nan\n", r":2: b_z_mt = nan: give a finite number"),
        (HEADER + "1,2,3,4,,6\n", r":2: b_y_mt = '' is no number"),
    ],
)
def test_a_bad_table_is_refused_in_one_line_with_the_line_of_the_file(tmp_path, text, says):
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(UsageError, match=rf"bad\.csv{says}") as caught:
        read_excitations(path)
    assert "\n" not in str(caught.value)


def test_columns_may_stand_in_any_order_beside_others_and_behind_a_byte_order_mark(tmp_path):
    path = tmp_path / "mixed.csv"
    path.write_bytes(b'\xef\xbb\xbfB_X_mT, note ,i_z_a,i_y_a,i_x_a,b_y_mt,b_z_mt\r\n4,"a, b",3,2,1,5,6\r\n')
    table = read_excitations(path)
    assert table.currents_a.tolist() == [[1.0, 2.0, 3.0]] and table.field_mt.tolist() == [[4.0, 5.0, 6.0]]


def test_a_run_takes_the_written_settings_and_the_printed_ones_alike(tmp_path):
    path, out = file_of(tmp_path, measured(5)), tmp_path / "out.toml"
    fit = calibrate_coils(path, out).fit
    written = load_config(out).coils
    assert written == load_config(None, as_sets(settings_of(fit))).coils
    np.testing.assert_allclose(written.mt_per_a, fit.mt_per_a, atol=0.01 * fit.mt_per_a_std.max())
    assert "12 excitations" in out.read_text() and "sha256" in out.read_text()
    with pytest.raises(OutputError, match="--overwrite"):
        calibrate_coils(path, out)


def test_the_command_says_it_for_people_and_for_programs(tmp_path):
    path = file_of(tmp_path, measured(5))
    told = CliRunner().invoke(app, ["calibrate", "coils", str(path)])
    assert told.exit_code == 0
    assert "12 excitations" in told.stdout and "Weakest direction: z" in told.output
    assert "--set 'coils.mt_per_a=[[2." in told.output
    figures = json.loads(CliRunner().invoke(app, ["calibrate", "coils", str(path), "--json"]).stdout)
    np.testing.assert_allclose(figures["mt_per_a"], A, atol=0.05)
    assert figures["degrees_of_freedom"] == 8 and len(figures["left_out_mt"]) == 12
