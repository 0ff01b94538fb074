"""A replay is the recording, from any tick; hidden state is caught; changed stages change what they should."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from flowrec.core import ANSWERED_BY, WORKER_FIELDS, Estimate, SessionError, Tick, UsageError, WorkOrder
from flowrec.physics import relative_rmse
from flowrec.run import work
from flowrec.stages import Observer, Pipeline, Refiner, load_config
from flowrec.store import Session, SessionReader
from flowrec.verbs import Change, replay_segments
from flowrec.verbs import session_replay as verb
from flowrec.verbs.compare import compare
from flowrec.verbs.record import record
from flowrec.verbs.replay_result import Replay
from flowrec.verbs.run_summary import Recorded
from tests.short_missions import SMALL

AGAIN = pytest.mark.slow("verifies a mission from another time")


@pytest.fixture
def computed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The orders whose results a replay computes."""
    orders: list[str] = []

    def counted(pipeline, order):  # type: ignore[no-untyped-def]
        orders.append(order.mission.wanted)
        return work(pipeline, order)

    monkeypatch.setattr("flowrec.run.workers.work", counted)
    return orders


def test_the_mission_reaches_its_goal_without_touching_a_wall(mission: Recorded) -> None:
    assert mission.report.outcome == "reached"
    assert mission.report.contacts == 0
    assert mission.facts["frames_dropped"] == 0


@pytest.mark.slow("flies a mission once more")
def test_the_same_seed_gives_the_same_messages(session: Path, tmp_path: Path) -> None:
    again = record(load_config(None, SMALL), tmp_path / "again.mcap")
    comparison = compare(session, again.path, only=["inputs", "outputs", "truth", "configuration", "chip"])
    assert comparison.ticks > 200
    assert comparison.identical, str(comparison.first)


def test_a_replay_is_identical_tick_by_tick_and_its_worker_results_can_be_made_again(session: Path) -> None:
    done = verb.replay_session(session, Change(), verify=True)
    same, lines = done.same, done.lines()
    assert same, lines
    assert done.comparison.identical, str(done.comparison.first)
    assert done.worker is not None
    count = len(done.worker.lines)
    assert count >= 4  # solved, surveyed, refined, planned
    assert f"slow results: {count} of {count} computed again" in lines


@pytest.mark.parametrize("share", [0.23, *(pytest.param(each, marks=AGAIN) for each in (0.01, 0.77))])
def test_a_replay_from_any_time_is_identical(session: Path, share: float) -> None:
    reader = SessionReader(session)
    done = verb.replay_session(session, Change(), from_s=round(share * reader.duration_s, 3), verify=True)
    assert done.comparison.ticks > 5
    assert done.comparison.identical, str(done.comparison.first)


SLOW = pytest.mark.slow("verifies most of a survey by information again")
STAGE_OF = {"flow": "solver", "refine": "refiner", "plan": "planner"}  # where it is not named as its section


def with_declared_settings(pipeline: Pipeline, order: Tick) -> object:
    """The result of an order by stages that have nothing but the settings which topics.py says that it reads."""
    assert order.mission is not None
    wanted = WorkOrder(order.mission.wanted)
    made_by = WORKER_FIELDS[ANSWERED_BY[wanted]]
    stages = {each.name: SimpleNamespace() for each in fields(Pipeline)}
    stages |= {"chip": pipeline.chip, "hindsight": None}  # type: ignore[dict-item]
    for setting in made_by.orders[wanted]:
        section, _, name = setting.partition(".")
        stage = STAGE_OF.get(section, section)
        value = getattr(pipeline, stage)
        if setting == "refine.assimilate":
            stages[stage] = Refiner("fvm", place_robot=False, assimilate=value.assimilate)  # type: ignore[assignment]
        elif name:
            setattr(stages[stage], name, getattr(value, name))
        else:
            stages[stage] = value
    known = {name: getattr(order, name) for name in ("mission", *made_by.reads)}
    return work(SimpleNamespace(**stages), Tick(order.stamp_ns, **known))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "where",
    [*(pytest.param(each, marks=SLOW) for each in ("the start", "an order under way", "the survey")), "the end"],
)
def test_a_recording_in_real_time_verifies_from_any_time_by_the_declared_settings_alone(
    realtime_session: Path, where: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("flowrec.verbs.replay_result.work", with_declared_settings)
    reader = SessionReader(realtime_session)
    adopted = sorted(verb.adoption_stamps(reader).values())
    start_ns = {
        "the start": None,
        "an order under way": adopted[1] - 1,
        "the survey": adopted[1] + 100_000_000,
        "the end": adopted[-1] - 1,
    }[where]
    from_s = start_ns / 1e9 if start_ns is not None else None
    done = verb.replay_session(realtime_session, Change(), from_s=from_s, verify=True)
    same, lines = done.same, done.lines()
    assert same and done.comparison.identical, lines
    assert done.worker is not None
    made = sum(stamp_ns >= (start_ns or 0) for stamp_ns in adopted)
    assert len(done.worker.lines) == made >= 1, lines


@pytest.mark.slow("computes a survey by information again")
def test_a_replay_adopts_what_it_computes_anew_on_the_ticks_of_the_recording(
    realtime_session: Path, tmp_path: Path, computed: list[str]
) -> None:
    recorded = verb.adoption_stamps(SessionReader(realtime_session))
    out = tmp_path / "again.mcap"
    done = verb.replay_session(realtime_session, Change(refine="assimilate", sets=("survey.worth=0.0601",)), out=out)
    assert verb.adoption_stamps(SessionReader(out)) == recorded
    assert done.comparison.same
    assert computed == [*["survey_route"] * (len(recorded) - 3), "refine"]  # solved before, planned as was recorded
    assert len(computed) > 2


@pytest.mark.slow("replays two missions with other settings")
def test_a_replay_computes_nothing_whose_settings_and_inputs_are_those_of_the_recording(
    realtime_session: Path, session: Path, computed: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    done = verb.replay_session(realtime_session, Change(refine="assimilate"))
    assert done.comparison.same
    assert computed == ["refine"]  # which was asked for
    computed.clear()
    monkeypatch.setattr(verb, "NUMERICS_VERSION", -1)  # other numerics would give something else
    verb.replay_session(session, Change(controller="ff_fb"))
    assert computed == ["survey_route", "refine", "route"]


@dataclass(frozen=True, slots=True)
class Forgetful(Observer):
    """An observer that breaks the stage contract: it counts its calls outside the messages."""

    calls: tuple[list[int], ...] = ([0],)

    def estimate(self, *known) -> Estimate:  # type: ignore[no-untyped-def]
        self.calls[0][0] += 1
        honest = Observer.estimate(self, *known)
        return replace(honest, flow_um_s=honest.flow_um_s + 1e-3 * self.calls[0][0])


def test_planted_hidden_state_passes_from_the_start_and_is_caught_from_the_middle(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import flowrec.stages.pipeline as pipeline_room

    honest = pipeline_room.assemble

    def planted(config, chip):  # type: ignore[no-untyped-def]
        pipeline = honest(config, chip)
        return replace(pipeline, observer=Forgetful(config.observer.method, calls=([0],)))

    for module in ("flowrec.verbs.preparation", "flowrec.verbs.session_replay"):
        monkeypatch.setattr(f"{module}.assemble", planted)
    path = record(load_config(None, [*SMALL, "duration_s=2"]), tmp_path / "planted.mcap").path
    assert verb.replay_session(path, Change(), verify=True).comparison.identical
    resumed = verb.replay_session(path, Change(), from_s=1.0, verify=True)
    assert not resumed.comparison.identical
    assert resumed.comparison.first is not None
    assert resumed.comparison.first.topic == "/robot/estimate"


def flow_errors(done: Replay) -> list[float]:
    """Errors of the assumed and of the refined flow of a replay, against the recorded truth."""
    truth, maps = done.recorded.true_field, (done.replayed.assumed, done.replayed.refined)
    return [relative_rmse(each, truth, done.session.chip.mask).v for each in maps]


def test_refining_again_by_assimilation_halves_the_flow_error(session: Path, tmp_path: Path) -> None:
    done = verb.replay_session(session, Change(refine="assimilate"), out=tmp_path / "refined.mcap")
    before, after = flow_errors(done)
    assert after < 0.5 * before
    assert done.replayed.refined is not None
    written = SessionReader(tmp_path / "refined.mcap")
    assert written.header.parent["file"] == session.name
    assert written.header.start_unix_ns == SessionReader(session).header.start_unix_ns > 0
    assert written.tick_before(written.last_ns).refined.same_as(done.replayed.refined)  # type: ignore[union-attr]


@pytest.mark.slow("refines a session twice")
def test_a_replay_can_refine_with_what_the_smoother_sees_in_hindsight(session: Path) -> None:
    smoothed = Change(refine="assimilate", sets=("sampler.method=smoothed",))
    done = verb.replay_session(session, smoothed)
    before, after = flow_errors(done)
    assert after < 0.3 * before
    # No later than the work order itself, and other observations than the filter's.
    filtered = verb.replay_session(session, Change(refine="assimilate"))
    assert filtered.replayed.refined is not None and done.replayed.refined is not None
    assert not done.replayed.refined.same_as(filtered.replayed.refined)
    with pytest.raises(UsageError, match="needs observer"):
        verb.replay_session(session, replace(smoothed, observer="luenberger"))


def test_a_run_can_not_smooth_what_is_still_to_come() -> None:
    with pytest.raises(UsageError, match="flowrec replay"):
        record(load_config(None, [*SMALL, "sampler.method=smoothed"]))


@pytest.mark.slow("replays a mission with another controller")
def test_another_controller_changes_the_commands_and_nothing_before_them(session: Path) -> None:
    done = verb.replay_session(session, Change(controller="ff_fb"))
    topics = done.comparison.topics
    assert topics["/control/demand"].different > 0
    assert topics["/robot/track"].different == topics["/robot/estimate"].different == 0
    assert done.commands.changed > 0


@pytest.mark.slow("replays a mission")
def test_another_observer_changes_estimates_and_leaves_tracks(session: Path, computed: list[str]) -> None:
    done = verb.replay_session(session, Change(observer="luenberger"))
    assert computed == ["survey_route", "refine", "route"]  # all of which read something else now
    assert done.comparison.topics["/robot/track"].different == 0
    assert done.comparison.topics["/robot/estimate"].different > 0
    counted = {key: (was, now) for key, was, now in done.before_after}["observations"]
    was, now = (len(tick.observations.position_um) for tick in (done.recorded, done.replayed))  # type: ignore[union-attr]
    assert counted == (was, now) and was != now  # each counts its own


@pytest.mark.slow("flies a survey, refines and plans")
def test_a_survey_alone_can_be_refined_and_planned_afterwards(tmp_path: Path) -> None:
    sets = [*SMALL, "mission.phases=survey"]
    survey = record(load_config(None, sets), tmp_path / "survey.mcap")
    assert survey.report.outcome == "survey complete"
    done = verb.replay_session(survey.path, Change(refine="assimilate"), out=tmp_path / "refined.mcap")
    assert done.replayed.refined is not None
    assert done.replayed.route is not None
    assert done.replayed.route.reachable
    navigate = [*SMALL, "mission.phases=navigate", f"start.field={tmp_path / 'refined.mcap'}"]
    flown = record(load_config(None, navigate), tmp_path / "navigate.mcap")
    assert flown.report.outcome == "reached"
    first = next(iter(SessionReader(flown.path).messages("refined")))
    np.testing.assert_array_equal(first.velocity_um_s, done.replayed.refined.velocity_um_s)  # type: ignore[attr-defined]


def test_what_a_recording_has_settled_can_not_be_set(session: Path) -> None:
    with pytest.raises(UsageError, match="camera"):
        verb.replay_session(session, Change(sets=("camera.rate_hz=60",)))


def test_verify_goes_without_changes(session: Path) -> None:
    with pytest.raises(UsageError, match="--verify compares"):
        verb.replay_session(session, Change(plan="astar_paper"), verify=True)


def test_an_existing_output_is_not_overwritten(session: Path) -> None:
    with pytest.raises(SessionError, match="is read by this command"):
        verb.replay_session(session, Change(), out=session)


@pytest.mark.slow("verifies a session in segments, alone and in two processes")
def test_a_verification_in_segments_finds_what_one_pass_finds(session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(replay_segments, "_TICKS", 40)
    alone = replay_segments.verify(session)
    beside = replay_segments.verify(session, jobs=2)
    assert len(replay_segments._segments(Session(session), 2, None)) > 2
    assert beside.identical
    assert beside.lines() == alone.lines()
    assert beside.as_json() == alone.as_json()


@pytest.mark.slow("refines a mission again")
def test_a_scale_that_the_refined_map_contradicts_is_a_doubt_of_the_replay(
    session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    doubt = "camera.um_per_px = 10 is 5 % too large"
    monkeypatch.setattr(verb, "map_doubts", lambda field, um_per_px: [doubt] * bool(um_per_px and field.method))
    done = verb.replay_session(session, Change(refine="gain"), out=tmp_path / "again.mcap")
    assert done.doubts == [doubt] and done.exit_status == 3
    assert doubt in SessionReader(tmp_path / "again.mcap").outcome["doubts"]
