"""What a shell offers for a setting."""

from __future__ import annotations

from pathlib import Path

import pytest

from flowrec.stages import PLANNERS
from flowrec.stages.setting_rows import setting_rows
from flowrec.verbs import completion
from flowrec.verbs.completion import complete_section, complete_setting


@pytest.fixture(autouse=True)
def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The file of a user who has completed nothing yet."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "flowrec" / "settings.json"


def test_all_settings_are_offered_and_of_a_single_one_its_values() -> None:
    assert complete_setting("") == [row.key for row in setting_rows()]
    assert complete_setting("plan.meth") == [f"plan.method={name}" for name in PLANNERS.names()]
    assert complete_setting("plan.method=astar_t") == ["plan.method=astar_time"]
    assert complete_setting("plan.refi") == ["plan.refine=true", "plan.refine=false"]
    assert complete_setting("lab.output.rest") == ["lab.output.rest_s=600.0"]
    assert complete_setting("robot.radius") == ["robot.radius_um="]  # has no default
    assert complete_setting("no.such") == complete_setting("no.such=1") == []


def test_sections_are_offered_with_their_settings() -> None:
    assert complete_section("lab.outp")[0] == "lab.output"
    assert {"lab", "lab.output", "lab.output.rest_s"} <= set(complete_section("la"))


def test_the_settings_are_kept_until_the_package_changes(kept: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    complete_setting("")
    kept.write_text(kept.read_text().replace("lab.output.rest_s", "lab.output.kept"))
    assert complete_setting("lab.output.k") == ["lab.output.kept=600.0"]
    kept.write_text(kept.read_text()[:-9])
    assert complete_setting("lab.output.k") == []  # a damaged file is made again
    kept.write_text(kept.read_text().replace("lab.output.rest_s", "lab.output.kept"))
    monkeypatch.setattr(completion, "_STAGES", completion._STAGES.parent)
    assert complete_setting("lab.output.k") == []


def test_without_a_place_to_keep_them_the_settings_are_offered_all_the_same(kept: Path) -> None:
    kept.parent.write_text("")  # a file, where the folder should be
    assert complete_setting("lab.output.rest") == ["lab.output.rest_s=600.0"]
