"""Coils from measured fields: the numbers, how far they are to be trusted, and what is wrong with a table."""

import json

import numpy as np
import pytest

from flowrec.core import OutputError, UsageError
from flowrec.measure import windings_matrix
from flowrec.measure.calibrate_coils import _with_doubt, calibrate_coils, settings_of
from flowrec.measure.coil_calibration import Excitations, advice, fit_coils, read_excitations
from flowrec.measure.coil_windings import winding_of
from flowrec.measure.proposal import as_sets, check_outputs, write_outputs
from flowrec.stages import load_config
from tests.conftest import invoke

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
    from scipy.stats import t as student

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


@pytest.mark.parametrize("bias", [BIAS, np.array([0.3, -0.5, 3.0])])
def test_the_error_that_is_said_of_4_mt_is_the_largest_of_any_direction_with_the_currents_against_the_bias(bias):
    table = measured(2)
    fit = fit_coils(table._replace(field_mt=table.field_mt + bias - BIAS))
    directions = np.random.default_rng(0).standard_normal((20_000, 3))
    fields = 4.0 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    design, currents = (np.column_stack([each, np.ones(len(each))]) for each in (CURRENTS, np.zeros((len(fields), 3))))
    currents[:, :3] = np.linalg.solve(fit.mt_per_a, (fields - fit.bias_mt).T).T
    leverage = ((currents @ np.linalg.pinv(design)) ** 2).sum(axis=1)
    largest = np.sqrt(leverage.max() * (fit.noise_mt**2).sum())
    assert 0.97 * largest < fit.uncertainty_mt < 1.001 * largest


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_coil_that_was_driven_one_way_only_is_named_whichever_way_that_is(sign):
    currents = CURRENTS.copy()
    currents[:, 1] = sign * np.abs(currents[:, 1])
    told = [sentence for sentence in advice(fit_coils(measured(1, currents))) if "one way only" in sentence]
    assert len(told) == 1 and told[0].startswith("coil y was driven")
    currents[:, 1] += 0.1 * sign  # and never switched off
    assert any("coil y was driven" in sentence for sentence in advice(fit_coils(measured(1, currents))))


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
    assert any(sentence.startswith("line 7: ") for sentence in said)
    assert any("coil z" in sentence for sentence in said)
    assert any("6 rows" in sentence and " 2 " in sentence for sentence in said)


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
    with pytest.raises(UsageError, match="along z"):
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
    told = invoke("calibrate", "coils", path)
    assert told.exit_code == 0
    assert "12 excitations" in told.stdout and "Weakest direction: z" in told.output
    assert "--set 'coils.mt_per_a=[[2." in told.output
    figures = json.loads(invoke("calibrate", "coils", path, "--json").stdout)
    np.testing.assert_allclose(figures["mt_per_a"], A, atol=0.05)
    assert figures["degrees_of_freedom"] == 8 and len(figures["left_out_mt"]) == 12


def of_six():
    rng = np.random.default_rng(4)
    matrix = rng.normal(size=(3, 6))
    currents = np.concatenate([2 * np.eye(6), -2 * np.eye(6), rng.uniform(-2, 2, (12, 6))])
    field = currents @ matrix.T + BIAS
    rows = [",".join([*(f"i_{n}_a" for n in range(1, 7)), "b_x_mt", "b_y_mt", "b_z_mt"])]
    rows += [",".join(f"{v:.9f}" for v in row) for row in np.column_stack([currents, field])]
    return matrix, rows


def test_a_table_of_six_coils_gives_a_matrix_of_six_columns_that_a_run_uses(tmp_path):
    matrix, rows = of_six()
    table, out = tmp_path / "six.csv", tmp_path / "six.toml"
    table.write_text("\n".join(rows))
    answer = invoke("calibrate", "coils", table, "-o", out, "--json")
    told = json.loads(answer.stdout)
    np.testing.assert_allclose(told["mt_per_a"], matrix, atol=1e-7)
    assert told["degrees_of_freedom"] == 24 - 7 and told["advice"] == []
    coils = load_config(out).coils
    assert coils.count == 6
    np.testing.assert_allclose(coils.mt_per_a, matrix, atol=1e-6)
    np.testing.assert_allclose(coils.bias_mt, BIAS, atol=1e-6)
    shown = invoke("calibrate", "coils", table).stdout
    assert "coil 1" in shown and "coil 6" in shown


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda rows: rows[:7], "6 rows; 6 coils and a bias take 7, and 8 to see any residual; 24 are recommended"),
        (lambda rows: [rows[0].replace("i_5_a", "i_9_a"), *rows[1:]], "no column i_5_a; the header is i_1_a,i_2_a"),
        (lambda rows: [rows[0].replace("i_6_a", "i_999999999_a"), *rows[1:]], "no column i_6_a"),
        (lambda rows: [rows[0], *(f"0{row[row.index(',') :]}" for row in rows[1:])], "coil 1 was hardly driven"),
    ],
)
def test_a_table_of_six_coils_that_lacks_something_is_refused_in_one_line(tmp_path, change, says):
    table = tmp_path / "six.csv"
    table.write_text("\n".join(change(of_six()[1])))
    with pytest.raises(UsageError, match=says) as refused:
        fit_coils(read_excitations(table))
    assert "\n" not in str(refused.value)


def loops_mt(radius_mm, turns, places_mm, senses, at_mm):
    """Biot and Savart along loops about z, one ampere, summed over their parts."""
    angle = np.linspace(0.0, 2.0 * np.pi, 4001)[:-1]
    step = radius_mm * (angle[1] - angle[0])
    field = 0.0
    for place_mm, sense in zip(places_mm, senses, strict=True):
        part = np.column_stack([radius_mm * np.cos(angle), radius_mm * np.sin(angle), np.full(4000, place_mm)])
        along = sense * step * np.column_stack([-np.sin(angle), np.cos(angle), np.zeros(4000)])
        away = np.array([0.0, 0.0, at_mm]) - part
        field += np.sum(np.cross(along, away) / np.linalg.norm(away, axis=1)[:, None] ** 3, axis=0)[2]
    return 4e-7 * np.pi / (4.0 * np.pi) * turns * field * 1e6  # 1/mm to 1/m, T to mT


def test_the_field_of_windings_is_that_of_the_law_of_biot_and_savart():
    for text, places_mm, senses in (
        ("z:helmholtz:50:120", (25.0, -25.0), (1, 1)),
        ("z:pair:60:150:65", (32.5, -32.5), (1, 1)),
        ("z:coil:40:100:30", (-30.0,), (1,)),
        ("-z:coil:40:100:30", (-30.0,), (-1,)),
    ):
        one = winding_of(text)
        assert one.mt_per_a == pytest.approx(loops_mt(one.radius_mm, one.turns, places_mm, senses, 0.0), rel=1e-5), text
    maxwell = winding_of("z:maxwell:50:80")
    half_mm = 0.5 * np.sqrt(3.0) * 50.0
    two = [loops_mt(50.0, 80.0, (half_mm, -half_mm), (1, -1), at_mm) for at_mm in (-0.1, 0.1)]
    assert maxwell.mt_per_a == 0.0 and sum(two) == pytest.approx(0.0, abs=1e-9)
    assert maxwell.mt_per_mm_per_a == pytest.approx((two[1] - two[0]) / 0.2, rel=1e-4)


def test_windings_make_the_configuration_of_a_run_a_column_for_each(tmp_path):
    out = tmp_path / "coils.toml"
    given = ["x:helmholtz:50:120", "y:pair:60:150:65", "z:coil:40:100:30", "-z:coil:40:100:30", "x:maxwell:50:80"]
    words = [word for text in given for word in ("--winding", text)]
    answer = invoke("calibrate", "coils", *words, "-o", out, "--json")
    assert answer.exit_code == 0, answer.stderr
    coils = load_config(out).coils
    np.testing.assert_allclose(coils.mt_per_a, json.loads(answer.stdout)["mt_per_a"], rtol=1e-5)
    z, beside = coils.currents_a(np.array([[0.0, 0.0, 4.0]]), np.array([4.0]))[0][[2, 4]]
    assert z == pytest.approx(0.5 * 4.0 / coils.mt_per_a[2][2]) and beside == 0.0, "two share, a Maxwell pair rests"


@pytest.mark.parametrize(
    ("texts", "says"),
    [
        (["q:coil:1:1:1"], r"--winding q:coil:1:1:1: give AXIS:KIND"),
        (["x:ring:1:1"], "one of helmholtz, maxwell, pair, coil"),
        (["x:helmholtz:50"], "1 numbers, where helmholtz takes radius and turns"),
        (["x:pair:50:10"], "2 numbers, where pair takes radius, turns and distance"),
        (["x:coil:50:10:far"], "could not convert"),
        (["x:coil:50:-10:3"], "radius and turns are above 0"),
        (["x:coil:inf:10:3"], "radius and turns are above 0"),
        (["x:coil:50:10:3"], "1 given; a rotating field needs three coils or more"),
        (["x:coil:50:10:3", "y:coil:50:10:3"], "2 given; a rotating field needs three coils or more"),
        (["x:coil:50:10:3", "x:coil:50:10:3", "z:coil:50:10:3"], "no currents make a field along y"),
    ],
)
def test_windings_that_are_none_are_refused_in_one_line(texts, says):
    with pytest.raises(UsageError, match=says) as refused:
        windings_matrix(texts)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("words", [[], ["coils.csv", "--winding", "x:coil:1:1:1"]])
def test_calibrate_coils_takes_a_table_or_windings_and_not_both(words):
    told = invoke("calibrate", "coils", *words).exception
    assert isinstance(told, UsageError) and "--winding" in str(told)


def test_where_one_of_the_files_of_a_calibration_can_not_be_made_none_is_there(tmp_path):
    def contents():
        yield b"settings"
        raise ValueError("no picture")

    with pytest.raises(ValueError, match="no picture"):
        write_outputs(check_outputs(tmp_path / "out.toml", (), False, (".png",)), contents())
    assert not list(tmp_path.iterdir())
    write_outputs(check_outputs(tmp_path / "out.toml", (), False, (".png",)), (b"settings", b"picture"))
    assert {each.name: each.read_bytes() for each in tmp_path.iterdir()} == {
        "out.toml": b"settings",
        "out.png": b"picture",
    }


@pytest.mark.parametrize(
    ("value", "std", "said"),
    [(2.0, 0.0, "2"), (2.1234, 0.02, "2.12 ± 0.02"), (-0.5, 3.0, "-0 ± 3"), (1.5, 1e-12, "1.5")],
)
def test_a_value_is_shown_to_the_first_digit_of_its_error_and_an_exact_one_as_it_is(value, std, said):
    assert _with_doubt(value, std) == said
