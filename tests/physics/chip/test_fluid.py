"""Laws of viscosity: their derivatives, how a chip states one, and what is refused."""

import sys
from dataclasses import replace

import numpy as np
import pytest

from flowrec.core import ChipError
from flowrec.physics import (
    CarreauYasuda,
    ChipSettings,
    PowerLaw,
    ViscositySettings,
    blood,
    chip_files,
    chip_from_files,
    load_chip,
)
from flowrec.physics.chip.fluid import BLOOD_MPA_S, LAWS, TabulatedLaw, law_of, slit_factor

RATES = np.array([0.0, 0.03, 1.0, 40.0, 900.0])
SOME = [PowerLaw(0.6, 2.0), CarreauYasuda(0.3, 0.5, 0.05, 1.25), TabulatedLaw((0.1, 1.0, 30.0), (5.0, 3.0, 0.7))]


@pytest.mark.parametrize("law", SOME, ids=["power law", "carreau yasuda", "table"])
def test_the_derivatives_of_a_law_are_those_of_its_values(law):
    rate2, step = RATES[1:] ** 2, 1e-6
    ends = [law.relative(rate2 * (1.0 + sign * step))[0] for sign in (1.0, -1.0)]
    np.testing.assert_allclose(law.relative(rate2)[1], (ends[0] - ends[1]) / (2.0 * step * rate2), rtol=1e-5)
    for number, found in enumerate(law.by_unknowns(rate2)):
        offset = step * np.eye(len(law.unknowns))[number]
        ends = [law.with_offset(sign * offset).relative(rate2)[0] for sign in (1.0, -1.0)]
        np.testing.assert_allclose(found, (ends[0] - ends[1]) / (2.0 * step), rtol=1e-5, atol=1e-9)
    value, slope = law.relative(np.zeros(1))
    assert np.isfinite(value[0]) and value[0] > 0.0 and np.isfinite(slope[0])


def test_blood_has_the_published_viscosities_at_rest_and_at_high_shear_rate():
    found = BLOOD_MPA_S * blood().relative(np.array([1e-8, 1e12]))[0]
    np.testing.assert_allclose(found, [56.0, 3.45], rtol=2e-3)
    chip = load_chip(ChipSettings("straight", viscosity=ViscositySettings("blood")))
    assert (chip.viscosity_mpa_s, chip.density_kg_m3) == (56.0, 1060.0)
    thicker = load_chip(ChipSettings("straight", viscosity_mpa_s=70.0, viscosity=ViscositySettings("blood")))
    assert thicker.viscosity_mpa_s == 70.0


def test_the_slit_factor_is_continuous_at_the_newtonian_fluid():
    np.testing.assert_allclose(slit_factor(1.0 + 1e-5), slit_factor(1.0), rtol=1e-4)
    np.testing.assert_allclose(slit_factor(0.5), 0.75)


@pytest.mark.parametrize("law", SOME, ids=["power law", "carreau yasuda", "table"])
def test_the_files_of_a_chip_hold_its_law_exactly(law):
    chip = replace(load_chip(ChipSettings("straight")), law=law)
    assert chip_from_files(*chip_files(chip)).law == law
    assert "viscosity]" not in chip_files(replace(chip, law=None))[1]


def test_settings_change_the_law_of_a_chip_or_replace_it(tmp_path):
    png, toml = chip_files(replace(load_chip(ChipSettings("straight")), law=PowerLaw(0.6, 2.0)))
    (tmp_path / "chip.png").write_bytes(png)
    (tmp_path / "chip.toml").write_text(toml)

    def law(**settings):
        return load_chip(ChipSettings(path=str(tmp_path / "chip.png"), viscosity=ViscositySettings(**settings))).law

    assert law() == PowerLaw(0.6, 2.0)
    assert law(exponent=0.8) == PowerLaw(0.8, 2.0)
    assert law(law="carreau_yasuda", exponent=0.8) == CarreauYasuda(0.8)
    assert law(law="newtonian") is None


def test_a_function_becomes_a_table_that_needs_it_no_more(tmp_path, monkeypatch):
    (tmp_path / "my_gel.py").write_text(
        "import numpy as np\n"
        "def thinning(rate):\n    return 2.0 / (1.0 + rate) ** 0.4 + 0.1\n"
        "def negative(rate):\n    return 1.0 - rate\n"
        "def endless(rate):\n    return np.inf * rate\n"
        "def fails(rate):\n    raise KeyError('gel')\n"
        "def one(rate):\n    return 3.0\n"
        "def falling(rate):\n    return 1e-3 + 1.0 / (1.0 + rate**2)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    law = law_of(ViscositySettings("function", function="my_gel:thinning"), "chip")
    np.testing.assert_allclose(law.relative(RATES**2)[0], 2.0 / (1.0 + RATES) ** 0.4 + 0.1, rtol=1e-4)
    chip = chip_from_files(*chip_files(replace(load_chip(ChipSettings("straight")), law=law)))
    del sys.modules["my_gel"]
    assert chip.law == law
    for name, words in {
        "negative": "it has to be finite and more than zero",
        "endless": "it has to be finite",
        "fails": "my_gel:fails' fails \\(KeyError",
        "one": "returns shape \\(\\) for",
        "falling": "the stress does not grow",
        "missing": 'give "module:name"',
    }.items():
        with pytest.raises(ChipError, match=words) as caught:
            law_of(ViscositySettings("function", function=f"my_gel:{name}"), "chip")
        assert "\n" not in str(caught.value)
    for text in ("", "my_gel", "no_such_module:f", ":f", "my_gel:"):
        with pytest.raises(ChipError):
            law_of(ViscositySettings("function", function=text), "chip")


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (
            ViscositySettings("power_law", exponent=0.0),
            "viscosity.exponent = 0: must be from 0.1 to 3; the nearest is 0.1",
        ),
        (ViscositySettings("power_law", exponent=-1.0), "nearest is 0.1"),
        (ViscositySettings("power_law", time_s=1.0), "viscosity.time_s is not for the law power_law, it has exp"),
        (
            ViscositySettings(exponent=0.5),
            "for the law newtonian, it has none; set chip.viscosity.law = power_law or carreau",
        ),
        (ViscositySettings("carreau_yasuda", time_s=np.inf), "viscosity.time_s = inf"),
        (ViscositySettings("carreau_yasuda", infinite_share=np.nan), "viscosity.infinite_share = nan"),
        (ViscositySettings("table"), "the law table needs chip.viscosity.rates_1_s"),
        (ViscositySettings("table", rates_1_s=(1.0, 1.0), ratios=(1.0, 1.0)), "rates ascending"),
        (ViscositySettings("table", rates_1_s=(1.0, 1e3), ratios=(1e-8, 1.0)), "can be computed"),
        (ViscositySettings("function"), "needs chip.viscosity.function"),
    ],
)
def test_a_law_without_a_flow_is_refused_in_one_line(settings, words):
    with pytest.raises(ChipError) as caught:
        law_of(settings, "chip")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ('viscosity = "thick"', "write [viscosity] above"),
        ('[viscosity]\nlaw = "power-law"', "it must be one of newtonian, power_law"),
        ("[viscosity]\nexponnt = 1", "did you mean exponent"),
        ('[viscosity]\nlaw = "power_law"\nexponent = "0.5"', "viscosity.exponent = '0.5' is no number"),
        ('[viscosity]\nlaw = "table"\nrates_1_s = [1, "2"]\nratios = [1, 1]', "is no number"),
        ("[viscosity]\nlaw = 3", "is no text"),
        ('[viscosity]\nlaw = "power_law"\nexponent = [0.5]', "is no number"),
    ],
)
def test_a_wrong_table_of_the_viscosity_is_one_line(lines, words):
    png, toml = chip_files(load_chip(ChipSettings("straight")))
    head, openings = toml.split("[[opening]]", 1)
    with pytest.raises(ChipError) as caught:
        chip_from_files(png, f"{head}\n{lines}\n[[opening]]{openings}")
    assert words in str(caught.value)


def test_every_law_has_a_row_that_loads():
    assert [row.name for row in LAWS.values()] == list(LAWS)
    assert all(callable(row.load()) for row in LAWS.values())
