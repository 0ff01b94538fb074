"""Each setting is explained, by the comment of its declaration; what `record --dry-run` prints makes the same run."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import pytest

from flowrec.core import UsageError
from flowrec.physics import load_chip
from flowrec.stages import commented_toml, load_config
from flowrec.stages.resolve import resolve
from flowrec.stages.setting_rows import SettingRow, setting_rows
from flowrec.verbs.settings import settings


@cache
def rows() -> dict[str, SettingRow]:
    return {row.key: row for row in setting_rows()}


def test_every_setting_states_what_it_means_and_what_is_valid() -> None:
    assert len(rows()) > 390
    assert [key for key, row in rows().items() if not row.meaning] == []
    assert [key for key, row in rows().items() if not row.facts] == []


def test_every_section_states_what_it_is_about() -> None:
    sections = settings(None)
    assert isinstance(sections, dict) and len(sections) > 20
    assert [name for name, about in sections.items() if not about or "->" in about] == []


def test_the_meaning_of_a_setting_is_the_comment_at_its_own_declaration() -> None:
    assert rows()["plan.speed_share"].meaning == "ratio to the robot's speed limit; the rest is left to the controller"
    assert rows()["plan.idle_speed_um_s"].meaning.startswith("swimming at this speed takes as much power")
    assert (rows()["robot.delay_s"].unit, rows()["robot.delay_s"].valid) == ("s", "number from 0 to 10")
    assert rows()["coils.amplifier.resistance_ohm"].unit == "ohm" and rows()["recording.disk_floor_gb"].unit == "GB"
    assert rows()["plan.policy_share"].read_by == ("time_field",) and rows()["plan.speed_share"].read_by == ()


def test_a_meaning_stands_alone_without_the_name_of_the_setting_or_its_neighbour() -> None:
    words = "of|or|and|in|at|by|for|from|to|that|which|kept|likewise|the same|not set"
    leans_on_another = re.compile(rf"({words})\b", re.IGNORECASE)
    assert [row.key for row in rows().values() if leans_on_another.match(row.meaning)] == []


def test_a_value_that_is_not_there_has_one_name_for_people() -> None:
    assert rows()["plan.idle_speed_um_s"].meaning.endswith("as everything else; not set: half of V")
    assert rows()["recording.split_s"].meaning.endswith("another file. Not set: one file")
    assert rows()["plan.idle_speed_um_s"].lines()[0] == "plan.idle_speed_um_s = (not set)"
    told = "\n".join([*(line for row in rows().values() for line in row.lines()), *settings().values()])
    assert "None" not in told


@pytest.mark.parametrize("changed_only", [False, True])
def test_a_printed_configuration_read_back_is_that_configuration(tmp_path: Path, changed_only: bool) -> None:
    sets = ["mission.goal=[4400.0, 1500.0]", "plan.method=astar_paper", "simulated.world=kind"]
    asked = load_config(None, [*sets, 'recording.notes="a # b"'])
    file = tmp_path / "printed.toml"
    file.write_text(commented_toml(asked, changed_only), encoding="utf-8")
    assert load_config(file) == asked
    resolved = resolve(asked, load_chip(asked.chip))
    file.write_text(commented_toml(resolved), encoding="utf-8")
    again = load_config(file)
    assert resolve(again, load_chip(again.chip)) == resolved


def test_only_what_differs_from_the_defaults_is_printed_in_short() -> None:
    text = commented_toml(load_config(None, ["plan.method=astar_paper"]), changed_only=True)
    assert [line for line in text.splitlines() if not line.startswith("#")] == ["[plan]", 'method = "astar_paper"']


def test_a_word_finds_the_settings_that_have_it_in_their_name_or_their_meaning() -> None:
    assert {"survey.speed_share", "plan.speed_share"} <= {row.key for row in settings("speed_share")}
    assert "chip.viscosity_mpa_s" in [row.key for row in settings("viscosity")]
    assert [row.key for row in settings("images per second")] == ["camera.rate_hz", "movie.rate_hz"]
    with pytest.raises(UsageError, match="xyzzy"):
        settings("xyzzy")


def test_a_misspelt_setting_is_answered_with_the_nearest() -> None:
    for wrong, right in (("sped_share", r"plan\.speed_share"), ("mision", "mission")):
        with pytest.raises(UsageError, match=right):
            settings(wrong)
    # One of another section and a misspelt one: the same answer wherever it is given.
    for wrong, right in (("recording.goal", "mission.goal"), ("plan.sped_share", "plan.speed_share")):
        with pytest.raises(UsageError) as used:
            load_config(None, [f"{wrong}=1"])
        with pytest.raises(UsageError) as asked:
            settings(wrong)
        hint = re.search(r"did you mean [^?]*", str(used.value))
        assert hint is not None and right in hint[0] and hint[0] in str(asked.value)
