"""An edit of a session after the recording, wherever it is made, is found by `check` or by `replay --verify`."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Metadata, Schema

from flowrec.core import (
    TOPICS,
    Appearance,
    AxesCheck,
    Background,
    CameraLosses,
    Clocks,
    Drops,
    Hand,
    Health,
    Measured,
    Observations,
    Role,
    Shift,
    Tick,
    Tracers,
    TracerTruth,
)
from flowrec.physics import load_chip
from flowrec.stages import load_config
from flowrec.stages.resolve import resolve
from flowrec.store import SessionHeader, digest_faults, session_header
from flowrec.store.session_file import Split
from flowrec.store.viewer_topics import VIEWER_TOPICS
from flowrec.verbs.check import check
from flowrec.verbs.compare import compare
from tests.conftest import answered
from tests.rewritten import EDITS, leaves_of, parser_of, rewrite
from tests.short_missions import SMALL
from tests.store.made_up import ticks_of, write_session

AGAIN = pytest.mark.slow("verifies a mission again")

GOLDEN = Path(__file__).parents[2] / "sessions" / "golden.mcap"
PATHS = [topic.path for topic in TOPICS]
VIEWS = [mirror.path for mirror in VIEWER_TOPICS if mirror.schema.wire is not None]


def header() -> SessionHeader:
    config = load_config(None, SMALL)
    chip = load_chip(config.chip)
    return session_header(resolve(config, chip), chip)


def every_topic() -> list[Tick]:
    """A few ticks with a message of each topic."""
    ticks = [tick for number, tick in enumerate(ticks_of(21, shape=(16, 24))) if number in (0, 10, 12, 20)]
    now, bank = ticks[0].stamp_ns, np.zeros(24)
    health = Health(now, "", 2.0, 0.0, 1.0, 2.0, 0.1, 0.2, bank, bank, bank, np.zeros(2), 0.0)
    clocks = Clocks(now, 1, 2, 0.0, 0, 0, 3, 4, 5, 1.0, True, 0.0, 0.0, 0, 0, 0, 0, 0, 0.0)
    drops = Drops(now, "/camera/frame", 1, 0, 1)
    losses = CameraLosses(now, 12, 2, 1, 2, 3, 4, 5, 6)
    look = Appearance(now, "dark", 1.0, 0.5, 4.0, np.zeros(2), np.ones((1, 5, 5)))
    axes = AxesCheck(
        now, 1, 2, 0.5, 3, np.ones(2), np.ones(2), np.ones(2), 50.0, 20.0, 4, np.eye(6), np.ones((6, 2)), np.ones(2),
        np.eye(2), 0.1, np.ones(2), "agrees", "as stated",
    )  # fmt: skip
    seen = {"background": Background(now, np.ones((3, 5)), 1.0), "shift": Shift(now, np.ones(2), True, 0.9)}
    two, places = np.array([1.0, 2.0]), np.array([[10.0, 20.0], [30.0, 40.0]])
    bodies = {
        "measured": Measured(now, np.arange(3.0), np.arange(3.0)),
        "hand": Hand(now, True, np.array([0.6, -0.8]), 0.01, "gamepad", "released"),
        "tracers": Tracers(now, two, places, places, two, two, two, two, two, two, places, two, 3),
        "tracer_flow": Observations(now, places, places, two, None, two, None, two, two),
        "true_tracers": TracerTruth(now, two, places, places, 0.3 * two, two, two),
    }
    more = {"health": health, "clocks": clocks, "drops": drops, "losses": losses, "appearance": look, "axes": axes}
    return [replace(tick, mapless=tick.estimate, **more, **seen, **bodies) for tick in ticks]


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file of a few kilobytes with a message of each topic; the stages have nothing to do with it."""
    path = tmp_path_factory.mktemp("small") / "small.mcap"
    return write_session(path, every_topic(), header())


def digest_findings(path: Path) -> list[str]:
    """What `flowrec check` says of the digest."""
    return [finding.text for finding in check(path).findings if finding.about == "digest"]


def fields_of(path: Path, topic: str) -> list[str]:
    """All values in the first message of a topic, by the schema in the file."""
    with path.open("rb") as file:
        schema, _, message = next(iter(make_reader(file).iter_messages(topics=[topic])))
        assert schema is not None
        return [name for name, _ in leaves_of(parser_of(schema).FromString(message.data))]


@pytest.mark.parametrize("every", [12, pytest.param(1, marks=pytest.mark.slow("rewrites a file for each value"))])
def test_every_value_of_a_message_is_under_the_digest(every: int, small: Path, tmp_path: Path) -> None:
    edited, seen = tmp_path / "edited.mcap", 0
    for topic in [*PATHS, *VIEWS]:
        names = fields_of(small, topic)
        assert names, topic
        for number, name in [*enumerate(names)][::every]:
            todo = [number]

            def edit(channel: Any, _: Any, wire: Any, topic: str = topic, todo: list[int] = todo) -> bool:
                if channel.topic != topic or not todo:
                    return False
                leaves_of(wire)[todo.pop()][1]()
                return True

            assert rewrite(small, edited, edit) == 1
            (faults,) = digest_faults(edited).values()
            assert len(faults) == 1 and faults[0].startswith(f"{topic}, in its messages"), (topic, name, faults)
            seen += 1
    assert seen > 200 / every
    # What `check` makes of it, once: of the edit that was the last.
    assert digest_findings(edited)[0].startswith(f"damaged or edited at {VIEWS[-1]}, in its messages")


@pytest.mark.parametrize(
    "names", [[*EDITS][::6], pytest.param([*EDITS], marks=pytest.mark.slow("rewrites a file for each of fifty edits"))]
)
def test_an_edit_is_a_difference_and_check_never_says_more_than_it_knows(
    names: list[str], small: Path, tmp_path: Path
) -> None:
    left, out, again = (tmp_path / f"{kind}.mcap" for kind in ("left", "out", "again"))
    for name in names:
        arguments, different = EDITS[name]
        rewrite(small, left, **arguments())
        rewrite(small, out, **arguments(), keep_digest=False)
        rewrite(small, again, **arguments(), redigest=True)
        # Between whom wrote the digest nothing tells: of a file that agrees with itself no more is said.
        assert [check(path).integrity.partition(" at ")[0] for path in (left, out)] == ["damaged or edited"] * 2, name
        assert check(again).integrity == "consistent, unsigned", name
        # A comparison goes by no digest: by none that is right before the edit, and by none that is right after it.
        for path in (left, again):
            found = compare(small, path)
            assert found.exit_status == 3 and found.as_json()["same"] is False, name
            assert different in found.as_json()["different"], (name, found.lines())
    status, said = answered("compare", small, out, "--json")
    assert status == 3 and different in json.loads(said)["different"]


def test_one_pixel_of_a_large_image_is_under_the_digest(tmp_path: Path) -> None:
    write_session(tmp_path / "large.mcap", ticks_of(2, shape=(300, 400)), header(), frames="raw")

    def edit(channel: Any, message: Any, wire: Any) -> bool:
        if channel.topic != "/camera/frame" or message.sequence:
            return False
        assert len(wire.data) == 300 * 400
        wire.data = wire.data[:-1] + bytes([wire.data[-1] ^ 1])
        return True

    assert digest_findings(tmp_path / "large.mcap") == []
    assert rewrite(tmp_path / "large.mcap", tmp_path / "edited.mcap", edit) == 1
    assert digest_findings(tmp_path / "edited.mcap")


def test_the_time_and_the_number_of_a_message_are_under_the_digest(small: Path, tmp_path: Path) -> None:
    for attribute in ("log_time", "sequence"):

        def edit(channel: Any, message: Any, _: Any, attribute: str = attribute) -> bool:
            if channel.topic == "/camera/frame":
                setattr(message, attribute, getattr(message, attribute) + 1)
            return False

        rewrite(small, tmp_path / "edited.mcap", edit)
        assert digest_findings(tmp_path / "edited.mcap"), attribute


def test_every_record_of_the_head_is_under_the_digest(small: Path, tmp_path: Path) -> None:
    for name in ("flowrec.provenance", "flowrec.parent", "flowrec.outcome", "config.toml", "chip.toml", "chip.png"):

        def edit_head(record: Attachment | Metadata | Schema | Channel, name: str = name) -> None:
            if isinstance(record, Metadata) and record.name == name:
                record.metadata["operator"] = "somebody else"
            elif isinstance(record, Attachment) and record.name == name:
                record.data += b"\n"

        rewrite(small, tmp_path / "edited.mcap", None, edit_head)
        assert check(tmp_path / "edited.mcap").exit_status == 1
        (finding,) = digest_findings(tmp_path / "edited.mcap")
        assert finding.startswith("damaged or edited at the head"), name


def test_what_is_declared_of_a_topic_is_under_the_digest(small: Path, tmp_path: Path) -> None:
    for what in ("depth of the images", "schema", "role"):

        def edit_head(record: Attachment | Metadata | Schema | Channel, what: str = what) -> None:
            if isinstance(record, Channel) and record.topic == "/camera/frame":
                if what == "role":
                    del record.metadata["role"]
                elif what != "schema":
                    record.metadata["bits"] = "8"  # as before, but nobody has declared it
            elif isinstance(record, Schema) and what == "schema":
                record.data = record.data.replace(b"frame_id", b"frame_it")

        rewrite(small, tmp_path / "edited.mcap", None, edit_head)
        found = digest_findings(tmp_path / "edited.mcap")
        assert "damaged or edited at /camera/frame, in its schema or metadata" in found, what


def test_a_message_that_was_taken_out_is_missed_by_number(small: Path, tmp_path: Path) -> None:
    rewrite(small, tmp_path / "edited.mcap", drop="/operator/events")
    found = digest_findings(tmp_path / "edited.mcap")
    assert found == ["damaged or edited at /operator/events, in its messages, 0 where 1 were"]


def test_a_digest_that_was_taken_out_is_missed(small: Path, tmp_path: Path) -> None:
    rewrite(small, tmp_path / "edited.mcap", keep_digest=False)
    assert digest_findings(tmp_path / "edited.mcap") == ["damaged or edited at the digest, which was taken out"]


def test_what_another_program_adds_is_no_edit(small: Path, tmp_path: Path) -> None:
    rewrite(small, tmp_path / "more.mcap", notes={"who": "the lab's own program"})
    assert digest_findings(tmp_path / "more.mcap") == []


@pytest.mark.slow("writes and verifies a mission anew")
def test_an_unchanged_session_written_anew_by_another_program_passes(session: Path, tmp_path: Path) -> None:
    rewrite(session, tmp_path / "again.mcap")
    assert check(tmp_path / "again.mcap").exit_status == 0
    status, said = answered("replay", tmp_path / "again.mcap", "--verify")
    assert status == 0, said
    assert "every tick identical" in said


@AGAIN
def test_an_edit_that_no_replay_can_see_fails_verify_by_the_digest(session: Path, tmp_path: Path) -> None:
    def edit(channel: Any, _: Any, wire: Any) -> bool:
        if channel.topic != "/truth/robot" or edited:
            return False
        wire.contacts += 1
        edited.append(True)
        return True

    edited: list[bool] = []
    assert rewrite(session, tmp_path / "edited.mcap", edit) == 1
    status, said = answered("replay", tmp_path / "edited.mcap", "--verify", "--json")
    found = json.loads(said)
    assert status == 3 and not found["same"]
    assert found["different_ticks"] == 0
    assert "/truth/robot" in found["digest_faults"][0]


def test_the_replay_itself_finds_an_edit_of_each_topic_that_it_computes(session: Path, tmp_path: Path) -> None:
    edited: set[str] = set()
    # The map of this mission is not good enough for the observer, so nothing is computed without it. It neither checks
    # the axes nor registers images, and follows no tracers.
    absent = {"/robot/estimate_without_map", "/run/axes", "/camera/background", "/camera/shift"}
    absent |= {"/tracers/tracks", "/tracers/observations"}
    computed = {topic.path for topic in TOPICS if topic.role is Role.OUTPUT} - absent

    def edit(channel: Any, message: Any, wire: Any) -> bool:
        # Not the first, which is the state of the start as well; but the robot's appearance is found once.
        first = not message.sequence and channel.topic != "/robot/appearance"
        if channel.topic not in computed - edited or first:
            return False
        edited.add(channel.topic)
        # Of a foxglove.Log only time, level and text are flowrec's; the bytes of an array may change within tolerance.
        changes = {name: change for name, change in leaves_of(wire) if "." not in name}
        changes.get("message", list(changes.values())[-1])()
        return True

    rewrite(session, tmp_path / "edited.mcap", edit, keep_digest=False)
    assert edited == computed
    status, said = answered("replay", tmp_path / "edited.mcap", "--verify", "--json")
    assert status == 3
    topics = json.loads(said)["topics"]
    assert {topic for topic in computed if topics[topic]["different"] == 1} == computed
    # Which is which.
    text = topics["/run/events"]["first"]
    assert text["recorded"] == text["replayed"] + "x"


@pytest.mark.parametrize(
    ("topic", "field", "from_s"),
    [
        pytest.param("/flow/assumed", "pressure_pa.data", None, marks=AGAIN),
        pytest.param("/flow/refined", "note", "2.0", marks=AGAIN),
        ("/flow/refined", "boundary_values", None),
        pytest.param("/plan/route", "arrival_s", "2.4", marks=AGAIN),
        ("/plan/route", "request", None),
    ],
)
def test_the_replay_itself_finds_an_edit_of_what_the_worker_gave(
    topic: str, field: str, from_s: str | None, tmp_path: Path
) -> None:
    edited: list[str] = []

    def edit(channel: Any, message: Any, wire: Any) -> bool:
        if channel.topic != topic or (from_s is not None and message.log_time < 2.5e9 and topic == "/plan/route"):
            return False
        edited.append(topic)
        if field == "pressure_pa.data":
            pressure = np.frombuffer(wire.pressure_pa.data, "<f4").copy()
            pressure[np.argmax(pressure)] *= 1.001
            wire.pressure_pa.data = pressure.tobytes()
        else:
            dict(leaves_of(wire))[field]()
        return True

    assert rewrite(GOLDEN, tmp_path / "edited.mcap", edit) > 0
    status, said = answered(
        "replay", tmp_path / "edited.mcap", "--verify", "--json", *(["--from", from_s] if from_s else [])
    )
    found = json.loads(said)
    assert status == 3
    assert found["topics"][topic]["different"] > 0


@AGAIN
def test_what_verify_prints_of_a_file_has_its_control_characters_escaped(tmp_path: Path) -> None:
    def edit(channel: Any, _: Any, wire: Any) -> bool:
        if channel.topic in ("/flow/refined", "/run/events"):
            setattr(wire, "method" if channel.topic == "/flow/refined" else "message", "\x1b]0;gone\x07")
            return True
        return False

    assert rewrite(GOLDEN, tmp_path / "edited.mcap", edit) > 1
    status, said = answered("replay", tmp_path / "edited.mcap", "--verify")
    assert status == 3
    assert "\x1b" not in said
    assert "\\x1b]0;gone\\x07" in said


def test_each_part_of_a_run_has_a_digest_of_its_own(tmp_path: Path) -> None:
    write_session(tmp_path / "run.mcap", every_topic(), header(), files=Split(seconds=0.1))
    parts = sorted(tmp_path.glob("run.part*.mcap"))
    assert len(parts) > 1
    for part in parts:
        assert check(part).facts["digest"].startswith("consistent, unsigned")


def test_a_session_of_the_first_release_is_said_to_have_no_digest() -> None:
    verdict = check(GOLDEN)
    assert verdict.exit_status == 0
    assert verdict.facts["digest"] == "none: recorded by an older flowrec"
