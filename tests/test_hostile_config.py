"""Made-up configurations: no code, no crash of the parser."""

import pytest

from flowrec.config import config_from_toml
from flowrec.errors import UsageError


@pytest.mark.parametrize(
    "toml",
    [
        'rig = "os.system"', '[control]\nlaw = "subprocess:run"', '[plan]\nmethod = "__import__(\'os\')"',
        '[refine]\nmethod = "pickle.loads"', '__class__ = "os"', "a = " + "[" * 5000, "a = " + "9" * 5000,
    ],
)  # fmt: skip
def test_a_configuration_names_no_code_and_breaks_no_parser(toml):
    with pytest.raises(UsageError) as error:
        config_from_toml(toml, "config.toml inside")
    assert len(str(error.value).splitlines()) == 1
