"""Made-up configurations: no code, no crash of the parser."""

import pytest

from flowrec.core import UsageError
from flowrec.stages import config_from_toml, load_config


@pytest.mark.parametrize(
    "toml",
    [
        'rig = "os.system"', '[control]\nlaw = "subprocess:run"', '[plan]\nmethod = "__import__(\'os\')"',
        '[refine]\nmethod = "pickle.loads"', '__class__ = "os"', "a = " + "[" * 5000, "a = " + "9" * 5000,
        "duration_s = 1" + "0" * 400, "[simulated]\nseed = 0x" + "f" * 5000,
    ],
)  # fmt: skip
def test_a_configuration_names_no_code_and_breaks_no_parser(toml):
    with pytest.raises(UsageError) as error:
        config_from_toml(toml, "config.toml inside")
    assert len(str(error.value).splitlines()) == 1


@pytest.mark.parametrize("digits", [400, 5000])
def test_a_number_beyond_all_measure_is_refused_on_the_command_line_too(digits):
    with pytest.raises(UsageError) as error:
        load_config(None, ["simulated.seed=1" + "0" * digits])
    assert len(str(error.value)) < 300
