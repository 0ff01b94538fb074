"""A configuration is refused in one line, or it is exactly what was asked for."""

from __future__ import annotations

import json
import math
import re
import tomllib
from dataclasses import asdict, replace
from functools import reduce
from operator import attrgetter
from pathlib import Path

import numpy as np
import pytest
import tomli_w

import flowrec
from flowrec.core import FlowrecError, SessionError, UnreachableError, UsageError
from flowrec.physics import ChipSettings, load_chip, median_width_um
from flowrec.run import refuse_below
from flowrec.stages import Config, config_from_toml, load_config, to_toml, with_sets
from flowrec.stages.config import _BEFORE, _MOVED
from flowrec.stages.resolve import resolve
from flowrec.store import SessionReader
from flowrec.verbs import prepare
from flowrec.verbs.run_summary import Recorded
from tests.conftest import run


def test_a_configuration_survives_its_own_toml() -> None:
    config = resolve(load_config(None, ["simulated.seed=7", "control.method=ff_fb"]), load_chip(Config().chip))
    assert config_from_toml(to_toml(config), "test") == config


@pytest.mark.parametrize(
    ("given", "key"),
    [
        ("robot.um_per_rev=100000", "robot.step_out_hz"),
        ("robot.max_speed_um_s=0.01", "robot.step_out_hz"),
        ("coils.amplifier.a_per_v=1e-06", "robot.max_speed_um_s"),
        ("camera.width_px=8", "camera.um_per_px"),
    ],
)
def test_what_follows_from_settings_and_could_not_be_read_again_is_refused_by_its_name(given: str, key: str) -> None:
    config = load_config(None, [given])
    chip = load_chip(config.chip)
    if key.startswith("camera"):
        chip = replace(chip, um_per_px=100.0)  # 32 mm on 8 pixels
    told = rf"^{re.escape(key)} = \S+: must be from .* follows from other settings [^\n]*$"
    with pytest.raises(UsageError, match=told):
        resolve(config, chip)


def test_a_session_from_before_a_setting_has_the_value_with_which_it_replays_unchanged() -> None:
    config = resolve(load_config(None, []), load_chip(Config().chip))
    older = tomllib.loads(to_toml(config))
    for key in _BEFORE:
        *sections, name = key.split(".")
        reduce(dict.__getitem__, sections, older).pop(name, None)
    read = config_from_toml(tomli_w.dumps(older), "test")
    assert {key: attrgetter(key)(read) for key in _BEFORE} == _BEFORE
    stated = {"plan.policy_points_per_px": 4, "health.step_out.learned": False, "mission.replan_slower": 0.0}
    assert stated.items() <= _BEFORE.items()
    assert all(attrgetter(key)(config) != value for key, value in stated.items()), "new sessions have another one"


def test_a_session_is_read_by_the_former_key_of_a_setting_and_a_person_is_told_the_new_one() -> None:
    config = load_config(None, ["simulated.image.debris=7", "lab.serial.port='/dev/x'", "lab.ni.server='a:1'"])
    resolved = resolve(config, load_chip(config.chip))
    tree = tomllib.loads(to_toml(resolved))
    for old, new in _MOVED.items():
        section, _, name = old.partition(".")
        outer, inner, key = new.split(".")
        tree[section][name] = tree[outer][inner].pop(key)
        with pytest.raises(UsageError, match=rf"--set: {re.escape(old)} is now {re.escape(new)}; write that"):
            load_config(None, [f"{old}=1"])
    assert config_from_toml(tomli_w.dumps(tree), "a session") == resolved


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ("observer.metod=kalman", r"observer\.metod; .*observer\.method\?"),
        ("control.method=telepathy", r"control\.method = 'telepathy'"),
        ("robot.max_speed_um_s=-1", r"robot\.max_speed_um_s = -1: .* 0\.01$"),
        ("mission.phases=survey,dance", "dance': .*survey"),
        ("rig=simulatd", "rig = 'simulatd': .* simulated$"),
    ],
)
def test_an_unknown_key_or_value_is_refused_by_its_name_with_what_is_nearest(wrong: str, told: str) -> None:
    with pytest.raises(UsageError, match=told):
        load_config(None, [wrong])


def test_phases_may_be_given_as_words_with_commas() -> None:
    assert load_config(None, ["mission.phases=survey,refine"]).mission.phases == ("survey", "refine")


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"nowhere\.toml: no such configuration"):
        load_config(tmp_path / "nowhere.toml")


def test_every_example_configuration_resolves() -> None:
    examples = sorted((Path(__file__).parents[2] / "sessions").glob("*.toml"))
    assert examples
    for path in examples:
        config = load_config(path)
        resolved = resolve(config, load_chip(config.chip))
        assert resolved.robot.radius_um > 0
        assert isinstance(resolved.mission.goal, tuple)


def test_a_goal_in_a_wall_or_outside_or_at_no_place_of_the_chip_is_refused() -> None:
    config = load_config(None, [])
    chip = load_chip(config.chip)
    for goal, named in (("[0.0, 0.0]", "goal"), ("[1e6, 0.0]", "goal"), ("outlet:9", "outlet:9.*inlet, outlet")):
        with pytest.raises(UsageError, match=named):
            resolve(with_sets(config, [f"mission.goal={goal}"]), chip)


def last_line(words: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    return run(words), capsys.readouterr().err.strip().splitlines()[-1]


@pytest.mark.parametrize(
    "swift", [["chip.inlet_speed_um_s=60000"], ["robot.max_speed_um_s=600", "chip.inlet_speed_um_s=3000"]]
)
def test_a_goal_that_is_found_unreachable_before_the_run_fails_as_one_found_during_it(
    swift: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    words = [word for setting in swift for word in ("--set", setting)]
    status, line = last_line(["record", "--dry-run", *words], capsys)
    assert (status, line[:22]) == (1, "flowrec: unreachable: ")


@pytest.mark.parametrize(
    ("sets", "goal"),
    [
        ([], "start"),
        (["mission.start=[4400.0, 1500.0]"], "start"),
        (["mission.phases=plan,navigate"], "outlet"),
        (["mission.goal=outlet"], "outlet"),
    ],
)
def test_a_robot_without_a_goal_comes_back_from_a_survey_and_goes_to_the_outlet_without_one(
    sets: list[str], goal: str
) -> None:
    config = load_config(None, sets)
    chip = load_chip(config.chip)
    mission = resolve(config, chip).mission
    outlet = resolve(with_sets(config, ["mission.goal=outlet"]), chip).mission.goal
    assert mission.goal == (mission.start if goal == "start" else outlet) and mission.start != outlet


def test_the_configuration_of_the_folder_is_used_where_none_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "flowrec.toml").write_text('[plan]\nmethod = "astr"\n', encoding="utf-8")
    (tmp_path / "other.toml").write_text("[plan]\nspeed_share = 7.0\n", encoding="utf-8")
    status, line = last_line(["record", "--dry-run"], capsys)
    assert status == 2 and line.startswith("flowrec: flowrec.toml: plan.method = 'astr'")
    status, line = last_line(["record", "other.toml", "--dry-run"], capsys)
    assert status == 2 and line.startswith("flowrec: other.toml: plan.speed_share = 7")


def test_a_goal_in_another_channel_is_unreachable() -> None:
    config = load_config(None, ["chip.name=straight", "robot.max_speed_um_s=600", "mission.goal=outlet"])
    chip = load_chip(config.chip)
    mask = chip.mask.copy()
    mask[:, mask.shape[1] // 2] = False
    with pytest.raises(FlowrecError, match="lies in another channel") as caught:
        resolve(config, replace(chip, mask=mask))
    assert caught.value.exit_status == 1


def test_a_rig_that_is_not_simulated_needs_its_robot_and_camera_measured() -> None:
    config = replace(Config(), rig="bench")  # type: ignore[arg-type]
    chip = load_chip(config.chip)
    with pytest.raises(UsageError) as caught:
        resolve(config, chip)
    for key in ("robot.radius_um", "robot.max_speed_um_s", "robot.delay_s", "camera.um_per_px"):
        assert key in str(caught.value)
    robot = replace(config.robot, radius_um=50.0, max_speed_um_s=600.0, step_out_hz=30.0, delay_s=0.04)
    camera = replace(config.camera, um_per_px=10.0, rate_hz=30.0)
    assert asdict(resolve(replace(config, robot=robot, camera=camera), chip).robot) == asdict(robot)


def test_a_robot_of_a_coarse_camera_is_assumed_to_be_no_larger_than_a_quarter_of_the_channel() -> None:
    config = load_config(None, [])
    chip = load_chip(config.chip)
    fine, coarse = (
        resolve(with_sets(config, [f"camera.um_per_px={um:g}"]), chip).robot.radius_um
        for um in (10.0, 0.2 * median_width_um(chip))
    )
    assert fine == 50.0 < coarse == pytest.approx(0.25 * median_width_um(chip), abs=0.01)


def test_a_limit_that_the_method_of_the_survey_does_not_read_is_refused_with_those_it_reads() -> None:
    config = load_config(None, ["survey.share=0.5"])
    with pytest.raises(UsageError, match=r"survey\.share = 0\.5 .*survey\.method = 'information'.*distance"):
        resolve(config, load_chip(config.chip))
    resolve(with_sets(config, ["survey.method=downstream"]), load_chip(config.chip))


def test_what_was_derived_is_said_and_kept_in_the_file(mission: Recorded, capsys: pytest.CaptureFixture[str]) -> None:
    kept = json.loads(SessionReader(mission.path).header.provenance.get("derived", "{}"))
    assert kept.get("robot.max_speed_um_s") == 600.0
    assert kept["robot.radius_um"] == 60.0  # three of its pixels
    assert kept == dict(mission.derived)
    assert "robot.um_per_rev" not in kept
    assert run(["record", "--dry-run", "--set", "robot.radius_um=50"]) == 0
    said = next(line for line in capsys.readouterr().err.splitlines() if line.startswith("derived"))
    assert "robot.max_speed_um_s = 600" in said
    assert "robot.radius_um" not in said


def test_a_robot_that_is_held_at_an_outlet_starts_there_whatever_time_the_coils_take():
    ends = ["chip.name=straight", "chip.inlet_speed_um_s=3000", "mission.start=outlet", "mission.goal=inlet"]
    config, chip, *_ = prepare(load_config(None, ends))
    end_um = (chip.mask.shape[1] - 0.5) * chip.um_per_px
    assert config.mission.hold_start_s == 1.0
    assert end_um - config.mission.start[0] < 6.0 * config.robot.radius_um
    assert prepare(load_config(None, [*ends[:2]]))[0].mission.hold_start_s == 0.0, "an inlet is no such place"


def test_a_start_called_outlet_is_where_the_robot_can_be_held_while_the_field_comes_up():
    def start_of(*sets):
        ends = ["mission.start=outlet", "mission.goal=inlet", "mission.hold_start_s=0"]
        config, chip, *_ = prepare(load_config(None, [*ends, *sets]))
        end_um = (chip.mask.shape[1] - 0.5) * chip.um_per_px
        return (end_um - config.mission.start[0]) / config.robot.radius_um

    slow, swift = start_of("chip.name=straight"), start_of("chip.name=straight", "chip.inlet_speed_um_s=3000")
    assert slow < 6.0 < swift
    # No place would do: it is refused as before.
    with pytest.raises(UnreachableError, match="too near the outlet"):
        start_of("chip.name=straight", "chip.inlet_speed_um_s=3000", "coils.ramp_s=5")


def test_the_paths_of_a_file_begin_at_its_folder_from_wherever_it_is_read(tmp_path, monkeypatch):
    (tmp_path / "chips").mkdir()
    lab, elsewhere = tmp_path / "lab", tmp_path / "elsewhere"
    lab.mkdir()
    elsewhere.mkdir()
    for name in ("chips/a.png", "lab/log.csv", "elsewhere/typed.png"):
        (tmp_path / name).write_text("")
    (lab / "lab.toml").write_text(
        '[chip]\npath = "../chips/a.png"\n[movie]\ncoils = "log.csv"\npath = "none.avi"\n'
        '[start]\nfield = "s3://bucket/a.mcap"\n'
    )
    for folder, file in ((tmp_path, "lab/lab.toml"), (elsewhere, "../lab/lab.toml"), (lab, "lab.toml")):
        monkeypatch.chdir(folder)
        config = load_config(Path(file))
        assert Path(config.chip.path).resolve() == tmp_path / "chips" / "a.png"
        assert Path(config.movie.coils).resolve() == lab / "log.csv"
        assert Path(config.movie.path).resolve() == lab / "none.avi"  # whoever opens it says that it is not there
        assert config.start.field == "s3://bucket/a.mcap"
    monkeypatch.chdir(tmp_path)
    assert load_config(Path("lab/lab.toml")).chip.path == str(Path("chips/a.png"))
    monkeypatch.chdir(elsewhere)
    assert load_config(Path("../lab/lab.toml"), ["chip.path=typed.png"]).chip.path == "typed.png"  # as other arguments


def test_a_path_that_is_there_only_from_the_working_directory_is_not_guessed(tmp_path, monkeypatch):
    (tmp_path / "lab").mkdir()
    (tmp_path / "a.png").write_text("")
    (tmp_path / "lab" / "lab.toml").write_text('[chip]\npath = "a.png"\n')
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UsageError, match=r"lab\.toml: chip\.path = 'a\.png' .*'\.\./a"):
        load_config(Path("lab/lab.toml"))


def test_the_example_configurations_find_their_chips_from_any_folder(tmp_path, monkeypatch):
    files = [file.absolute() for file in Path("sessions").rglob("*.toml") if file.parent.name != "chips"]
    monkeypatch.chdir(tmp_path)
    for file in files:
        load_chip(load_config(file).chip)


def made_to_fit(width_px, um_per_px, inlet_speed_um_s):
    """The robot of the simulated rig that fits a straight channel, and the fastest flow in it, um/s."""
    mask = np.zeros((29, 61), np.bool_)
    mask[14 - width_px // 2 : 15 + width_px // 2] = True
    chip = load_chip(ChipSettings(um_per_px=um_per_px, inlet_speed_um_s=inlet_speed_um_s), mask)
    config = resolve(load_config(None, ["mission.phases=survey"]), chip)
    return config.robot, float(np.linalg.norm(config.flow.solve(chip).velocity_um_s, axis=-1).max())


def test_a_robot_that_is_made_to_fit_is_faster_than_the_fastest_flow_by_three_tenths():
    robot, peak_um_s = made_to_fit(17, 13.0, 997.0)
    assert peak_um_s > 1000.0
    assert robot.max_speed_um_s == pytest.approx(1.3 * peak_um_s, rel=1e-3)
    assert made_to_fit(17, 13.0, 7.0)[0].max_speed_um_s == 600.0  # the usual one


def test_a_robot_in_a_narrow_channel_is_answered_before_it_has_crossed_a_fifth_of_it():
    robot, _ = made_to_fit(5, 7.0, 11.0)
    assert robot.delay_s * robot.max_speed_um_s == pytest.approx(0.2 * 5 * 7.0, rel=0.2)
    assert made_to_fit(17, 13.0, 7.0)[0].delay_s == 0.04  # the usual one


def test_the_defaults_keep_the_promises_of_the_documentation(tmp_path):
    recording = flowrec.Config().recording
    text = Path("notebooks/08_lab.ipynb").read_text(encoding="utf-8")
    assert float(re.search(r"images a kill costs ([\d.]+) s", text)[1]) == recording.flush_s
    assert float(re.search(r"A power cut costs ([\d.]+) s", text)[1]) == recording.sync_s
    refuse_below(recording.disk_floor_gb, tmp_path, lambda _: 2_000_000_000)
    with pytest.raises(SessionError, match="GB left on this disk"):
        refuse_below(recording.disk_floor_gb, tmp_path, lambda _: 500_000_000)


TYPED = {
    "recording.operator": ("007", "007"),
    "recording.notes": ("true", "true"),
    "recording.sample": ("1e3", "1e3"),
    "chip.path": (Path("""/a "b" 'c', d.png"""), """/a "b" 'c', d.png"""),
    "robot.radius_um": (0.1 + 0.2, 0.30000000000000004),
    "simulated.seed": (np.int64(3), 3),
    "coils.mt_per_a": ([(1.0, 0.0, 0.1), (0, 1, 0), np.eye(3)[2]], ((1.0, 0.0, 0.1), (0, 1, 0), (0, 0, 1))),
    "recording.split_mb": (None, None),
    "recording.accept_losses": (True, True),
}


def test_a_setting_from_python_arrives_as_it_is(tmp_path: Path) -> None:
    given = {key: value for key, (value, _) in TYPED.items()}
    loaded = load_config(None, given)
    file = tmp_path / "own.toml"
    file.write_text(to_toml(loaded))
    for config in (loaded, with_sets(Config(), given), load_config(file)):
        found = {key: attrgetter(key)(config) for key in given}
        assert found == {key: value for key, (_, value) in TYPED.items()}
        assert type(found["simulated.seed"]) is int


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("robot.radius_um", math.nan),
        ("mission.goal", (1.0, math.nan)),
        ("recording.operator", 7),
        ("recording.operator", None),
        ("recording.accept_losses", "maybe"),
        ("mission.goal", object()),
        ("mission.goal", {"x": 1.0}),
        ("coils.mt_per_a", [(1.0, 0.0), (0.0, 1.0)]),
    ],
)
def test_a_setting_from_python_that_fits_none_is_refused_in_a_line_that_names_it(key: str, value: object) -> None:
    with pytest.raises(UsageError, match=rf"^[^\n]*{key}[^\n]*$"):
        load_config(None, {key: value})


def test_of_two_settings_of_a_command_line_the_last_counts() -> None:
    assert load_config(None, ["robot={radius_um = 20.0}", "robot.radius_um=30"]).robot.radius_um == 30.0
    texts = ["robot.radius_um=30", "robot={radius_um = 20.0}", "robot.radius_um=40"]
    assert load_config(None, texts).robot.radius_um == 40.0
