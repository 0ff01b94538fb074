"""A session states the numerics that computed it; where these are others, a difference is no error of the recording."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import pytest

import flowrec
from flowrec.core import NUMERICS_VERSION
from flowrec.core.provenance import provenance
from flowrec.stages import Kalman
from tests.conftest import run

GOLDEN = Path(__file__).parents[2] / "sessions" / "golden.mcap"


def told(words: list[object], capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    return run(words), capsys.readouterr().out


@pytest.fixture
def other_numerics(monkeypatch: pytest.MonkeyPatch) -> None:
    """This flowrec computes something else than the one that recorded, and states that."""
    honest = Kalman.estimate

    def shifted(self, *arguments):  # type: ignore[no-untyped-def]
        estimate = honest(self, *arguments)
        return replace(estimate, flow_um_s=estimate.flow_um_s + 1.0)

    monkeypatch.setattr(Kalman, "estimate", shifted)
    monkeypatch.setattr("flowrec.verbs.comparison.NUMERICS_VERSION", NUMERICS_VERSION + 1)
    monkeypatch.setattr("flowrec.verbs.check_file.NUMERICS_VERSION", NUMERICS_VERSION + 1)
    monkeypatch.setattr(sys.modules[provenance.__module__], "NUMERICS_VERSION", NUMERICS_VERSION + 1)


def test_a_new_session_states_its_numerics_and_the_first_release_is_version_1(session: Path) -> None:
    assert flowrec.open(session).numerics == str(NUMERICS_VERSION)
    assert "numerics_version" not in flowrec.open(GOLDEN).provenance
    assert flowrec.open(GOLDEN).numerics == "1"


@pytest.mark.slow("verifies a session by other numerics several times")
@pytest.mark.usefixtures("other_numerics")
def test_a_verification_by_other_numerics_says_so_instead_of_different(capsys: pytest.CaptureFixture[str]) -> None:
    status, said = told(["replay", GOLDEN, "--verify"], capsys)
    assert status == 3
    assert f"recorded: version 1, replayed: version {NUMERICS_VERSION + 1}" in said.splitlines()[-1]
    assert "DIFFERENT" not in said and "NOT the same" not in said
    found = json.loads(told(["replay", GOLDEN, "--verify", "--json"], capsys)[1])
    assert not found["same"]
    assert found["other_numerics"]


@pytest.mark.usefixtures("other_numerics")
def test_two_sessions_of_other_numerics_are_compared_as_such_and_check_names_them(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    again = tmp_path / "again.mcap"
    flowrec.replay(GOLDEN, out=again)
    words = ["compare", GOLDEN, again, "--ignore", "diagnostics", "--ignore", "drawings"]  # differ by nature
    status, said = told(words, capsys)
    assert status == 3
    assert f"first: version 1, second: version {NUMERICS_VERSION + 1}" in said
    assert not [line for line in said.splitlines() if line.startswith("/") and "DIFFERENT" in line]
    verdict = flowrec.check(GOLDEN)
    assert verdict.word == "good"
    assert f"version 1; this is {NUMERICS_VERSION + 1}" in verdict.facts["written"]


@pytest.mark.slow("verifies a session by other numerics")
@pytest.mark.usefixtures("other_numerics")
def test_an_edited_file_is_told_as_such_whatever_its_numerics(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr("flowrec.verbs.replay_result.digest_faults", lambda path: {path: ["a message was changed"]})
    _, said = told(["replay", GOLDEN, "--verify"], capsys)
    assert "damaged or edited at a message was changed" in said
    assert "NOT the same" in said.splitlines()[-1]


def test_a_setting_that_a_session_does_not_have_is_the_old_default() -> None:
    from flowrec.stages import config_from_toml, to_toml

    config = flowrec.open(GOLDEN).config
    text = to_toml(config)
    line = next(line for line in text.splitlines() if line.startswith("adopt_after_s"))
    assert config_from_toml(text.replace(line + "\n", ""), "a session").worker == type(config.worker)()
