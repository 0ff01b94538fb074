"""A configuration is refused in one line, or it is exactly what was asked for."""

from __future__ import annotations

from pathlib import Path

import pytest

from flowrec.chip import load_chip
from flowrec.config import Config, config_from_toml, load_config, resolve, to_toml, with_sets
from flowrec.errors import UsageError


def test_a_configuration_survives_its_own_toml() -> None:
    config = resolve(load_config(None, ["simulated.seed=7", "control.method=ff_fb"]), load_chip(Config().chip))
    assert config_from_toml(to_toml(config), "test") == config


def test_an_unknown_key_is_refused_with_the_nearest_known_one() -> None:
    with pytest.raises(UsageError, match=r"unknown key observer\.metod; did you mean observer\.method\?"):
        load_config(None, ["observer.metod=kalman"])


def test_a_wrong_value_is_refused_with_its_key() -> None:
    with pytest.raises(UsageError, match=r"control\.method = 'telepathy'"):
        load_config(None, ["control.method=telepathy"])
    with pytest.raises(UsageError, match=r"robot\.max_speed_um_s = -1: must be from 0.01 to .*; the nearest is 0.01"):
        load_config(None, ["robot.max_speed_um_s=-1"])
    with pytest.raises(UsageError, match=r"dance': must be one of survey"):
        load_config(None, ["mission.phases=survey,dance"])


def test_phases_may_be_given_as_words_with_commas() -> None:
    assert load_config(None, ["mission.phases=survey,refine"]).mission.phases == ("survey", "refine")


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"nowhere\.toml: no such configuration"):
        load_config(tmp_path / "nowhere.toml")


def test_every_example_configuration_resolves() -> None:
    examples = sorted((Path(__file__).parents[1] / "sessions").glob("*.toml"))
    assert examples
    for path in examples:
        config = load_config(path)
        resolved = resolve(config, load_chip(config.chip))
        assert resolved.robot.radius > 0
        assert isinstance(resolved.mission.goal, tuple)


def test_a_goal_in_a_wall_or_outside_is_refused() -> None:
    config = load_config(None, [])
    chip = load_chip(config.chip)
    with pytest.raises(UsageError, match="goal"):
        resolve(with_sets(config, ["mission.goal=[0.0, 0.0]"]), chip)
    with pytest.raises(UsageError, match="goal"):
        resolve(with_sets(config, ["mission.goal=[1e6, 0.0]"]), chip)


def test_a_place_that_the_chip_does_not_have_is_refused_with_those_it_has() -> None:
    config = load_config(None, ["mission.goal=outlet:9"])
    with pytest.raises(UsageError, match=r"outlet:9.*it has"):
        resolve(config, load_chip(config.chip))
