"""Every number of the configuration has a range, and what lies outside of it is refused in one line."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

import pytest

from flowrec.core import UsageError
from flowrec.physics import load_chip
from flowrec.stages import Config, load_config, with_sets
from flowrec.stages.resolve import resolve
from flowrec.store import Session
from flowrec.verbs import session_replay as replay
from tests.conftest import run

GOLDEN = Path(__file__).parents[2] / "sessions" / "golden.mcap"


def settings(section: type = Config, prefix: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Key, type and default of every setting."""
    hints, made = get_type_hints(section, include_extras=True), section()
    for field in fields(section):
        hint, default = hints[field.name], getattr(made, field.name)
        if is_dataclass(default):
            yield from settings(type(default), f"{prefix}{field.name}.")
        else:
            yield prefix + field.name, hint, default


def is_numeric(hint: Any) -> bool:
    if get_origin(hint) is not None:
        return any(is_numeric(part) for part in get_args(hint))
    return hint in (int, float)


def range_of(hint: Any) -> Any:
    parts = get_args(hint)
    own = [part for part in parts if hasattr(part, "low")]
    return own[0] if own else next((found for part in parts if (found := range_of(part)) is not None), None)


NUMERIC = {key: (hint, default) for key, hint, default in settings() if is_numeric(hint)}


def numbers(value: Any) -> list[float]:
    if isinstance(value, tuple):
        return [number for inner in value for number in numbers(inner)]
    return [value] if isinstance(value, (int, float)) else []


def written(value: float, default: Any) -> str:
    """The number as TOML, in the place of the first number of a tuple."""
    if isinstance(default, tuple):
        return f"[{', '.join([written(value, default[0]), *map(str, map(as_list, default[1:]))])}]"
    return repr(value)


def as_list(value: Any) -> Any:
    return [as_list(inner) for inner in value] if isinstance(value, tuple) else value


def refused(key: str, value: str) -> str:
    try:
        load_config(None, [f"{key}={value}"])
    except UsageError as error:
        return str(error)
    return ""


def judge(key: str, hint: Any, default: Any) -> None:
    """Whether a setting has a range that is kept."""
    valid = range_of(hint)
    assert valid is not None, f"{key}: declare Annotated[..., Range(low, high)]"
    assert all(valid.low <= number <= valid.high for number in numbers(default))
    if key in ("mission.start", "mission.goal", "camera.centre_um", "simulated.centre_um", "tracker.click_px"):
        default = (0.0, 0.0)
    if key == "tracker.box_px":
        default = (0.0, 0.0, 0.0, 0.0)
    if key in ("robot.speed_at_hz", "tracker.robots_px"):
        default = ((5.0, 100.0),)
    if key.endswith((".rates_1_s", ".ratios", ".nominals")):
        default = (1.0,)
    whole = isinstance(valid.low, int)
    told = [float(format(limit, "g")) for limit in (valid.low, valid.high) if not whole]
    assert all(limit in valid for limit in told), f"{key}: a limit as it is told would be refused: {valid}"
    below = valid.low - 1 if whole else math.nextafter(valid.low, -math.inf)
    above = valid.high + 1 if whole else math.nextafter(valid.high, math.inf)
    outside = {below: valid.low, -math.inf: valid.low, above: valid.high, math.inf: valid.high, math.nan: None}
    for value, nearest in outside.items():
        if value == valid.high:  # a range that ends at infinity
            continue
        said = refused(key, written(value, default))
        assert said.startswith(f"--set: {key} = "), f"{key}={value}: {said or 'accepted'}"
        assert "\n" not in said
        assert f"must be {valid}" in said
        if nearest is not None:
            assert said.endswith(f"the nearest is {nearest if whole else format(nearest, 'g')}"), said
    for value in {valid.low, valid.high} - {math.inf}:
        assert f"{key} = " not in refused(key, written(value, default))


def test_every_number_among_the_settings_has_a_range_that_is_kept() -> None:
    assert len(NUMERIC) > 250
    for key, (hint, default) in NUMERIC.items():
        judge(key, hint, default)


@pytest.mark.parametrize(
    "absurd",
    [
        "control.kp_per_s=-3", "plan.speed_share=5", "robot.um_per_rev=inf", "observer.kalman.position_noise_um=0",
        "health.window_s=0", "coils.bias_mt=[0.0, nan, 0.0]", "mission.goal=[nan, 100.0]", "simulated.k=3",
        "plan.reach_px=2.5", "camera.width_px=1e300",
    ],
)  # fmt: skip
def test_settings_that_no_run_can_be_made_with_are_refused(absurd: str) -> None:
    key, value = absurd.split("=")
    with pytest.raises(UsageError, match=rf"^--set: {key} = .*must be") as caught:
        load_config(None, [absurd])
    assert value.startswith("[") or "nearest is" in str(caught.value)


def test_a_configuration_made_in_python_is_checked_before_it_is_flown() -> None:
    config = Config()
    config = replace(config, control=replace(config.control, kp_per_s=-3.0))
    with pytest.raises(UsageError, match=r"control\.kp_per_s = -3: .* 0 to 1000; .* 0$"):
        resolve(config, load_chip(config.chip))


def test_a_recorded_setting_outside_of_its_range_may_stay_but_not_be_set() -> None:
    config = Config()
    recorded = replace(config, control=replace(config.control, kp_per_s=-3.0))
    assert with_sets(recorded, ["plan.method=astar_time"]).control.kp_per_s == -3.0
    with pytest.raises(UsageError, match=r"control\.kp_per_s = -4"):
        with_sets(recorded, ["control.kp_per_s=-4"])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["record", "--rig", "simulatd"], "--rig: rig = 'simulatd': must be one of simulated"),
        (["record", "--seed", "-1"], "--seed: simulated.seed = -1: must be from 0;"),
        (["record", "--duration", "-2"], "--duration: duration_s = -2: must be from 0.001"),
        (["record", "--duration", "nan"], "'--duration': nan is no number to work with"),
        (["record", "--goal", "nan,100"], "--goal: mission.goal = nan: must be from"),
        (["record", "--split", "1e99s"], "--split"),
        (["record", "--split", "99999999999s"], "--split: recording.split_s = 1e+11: must be from 0 to 1e+07"),
        (["record", "--set", "control.method=vektor"], "--set: control.method = 'vektor': must be one of vector"),
        (["record", "--set", "mission.phases=survey,dance"], "'dance': must be one of survey, refine, plan, navigate"),
        (["replay", GOLDEN, "--plan", "astr"], "--plan: plan.method = 'astr': must be one of time_field"),
        (["replay", GOLDEN, "--refine", "asimilate"], "--refine: refine.method = 'asimilate'"),
        (["replay", GOLDEN, "--observer", "kalmann"], "--observer: observer.method = 'kalmann'"),
        (["replay", GOLDEN, "--controller", "polizy"], "--controller: control.method = 'polizy'"),
        (["replay", GOLDEN, "--set", "plan.speed_share=5"], "--set: plan.speed_share = 5: must be from 0.01 to 1"),
    ],
)
def test_the_flag_that_was_typed_is_named(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(words) == 2
    line = capsys.readouterr().err.strip()
    assert said in line
    nearest = {"astr": "astar_", "asimilate": "assimilate", "kalmann": "kalman", "polizy": "policy", "vektor": "vector"}
    for wrong, right in nearest.items():
        if f"'{wrong}'" in line:
            assert f"the nearest is {right}" in line


def test_a_file_is_named_for_what_it_sets(tmp_path: Path) -> None:
    path = tmp_path / "own.toml"
    path.write_text("[control]\nkp_per_s = -3.0\n")
    with pytest.raises(UsageError, match=r"own\.toml: control\.kp_per_s = -3: "):
        load_config(path, ["simulated.seed=2"])


def test_a_replay_that_fails_over_a_recorded_setting_outside_of_its_range_names_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    session = Session(GOLDEN)
    absurd = replace(session.config, health=replace(session.config.health, window_s=0.0))
    monkeypatch.setitem(vars(session), "config", absurd)
    with pytest.raises(Exception) as caught:  # noqa: PT011 - any: a traceback is what it must not be
        replay.replay_session(session, replay.Change())
    assert "health.window_s = 0: " in str(caught.value)
