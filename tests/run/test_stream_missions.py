"""A mission with a stream: recorded beside the stages, replayed as an input, checked, compared, exported and shown."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from flowrec.core import SessionError, UsageError
from flowrec.exports import export, write_layouts
from flowrec.rigs.simulated.world import true_pump
from flowrec.stages import config_from_toml, load_config, to_toml
from flowrec.store import Session, observations_of
from flowrec.verbs import replay_session
from flowrec.verbs.check import check
from flowrec.verbs.compare import compare
from flowrec.verbs.record import record
from flowrec.verbs.replay_segments import verify
from tests.short_missions import SMALL
from tests.view.test_rrd import File

PULSE = [
    "simulated.pulsation_share=0.2",
    "simulated.pulsation_hz=0.5",
    "simulated.step_share=0.7",
    "simulated.step_s=1",
]
PUMP = ["streams.pump.kind=simulated", "simulated.sensor.rate_hz=50", "simulated.sensor.noise_share=0.02"]


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("streams") / "run.mcap"
    record(load_config(None, [*SMALL, *PULSE, *PUMP]), path, duration_s=2.0)
    return path


def test_the_sensor_measures_the_true_pump_with_its_noise_and_nothing_else(flown: Path) -> None:
    with Session(flown) as session:
        measured = session.stream("pump/flow")
        pump = true_pump(session.config.simulated)
    true = np.array([pump.strength(float(time)) for time in measured.time_s])
    assert len(true) == 101 and np.diff(measured.time_s) == pytest.approx(0.02)
    error = measured.value / true - 1.0
    assert 0.015 < error.std() < 0.025 and abs(error.mean()) < 0.01
    assert measured.value[:40].mean() > 1.2 * measured.value[-40:].mean()  # the step


def test_what_beads_tell_is_the_flow_at_the_nominal_pump_where_its_stream_is_followed(tmp_path: Path) -> None:
    beads = ["tracker.tracers=true", "simulated.tracers=40", "tracker.tracer.stretch_radii=0.5"]
    told = []
    for number, follows in enumerate(([], ["pump.channel=pump/flow"])):
        path = tmp_path / f"{number}.mcap"
        record(load_config(None, [*SMALL, *PULSE, *PUMP, *beads, *follows]), path, duration_s=4.0)
        with Session(path) as session:
            told.append(list(session.ticks())[-1].tracer_flow)
            pump = true_pump(session.config.simulated)
    raw, nominal = told
    assert raw is not None and nominal is not None
    raw = raw.only(slice(len(nominal.tracer)))  # of the last one the pump's samples may not be there yet
    assert np.array_equal(raw.tracer, nominal.tracer)
    shares = np.hypot(*raw.flow_um_s.T) / np.hypot(*nominal.flow_um_s.T)
    true = np.array([pump.strength(float(time)) for time in raw.time_s])
    assert len(shares) > 10 and np.ptp(true) > 0.3
    assert np.median(np.abs(shares / true - 1.0)) < 0.06
    table = Path(export(path, tmp_path / "tables", file_format="csv")) / "observed_flow.tracers.csv"
    again = observations_of(table)  # as flowrec.refine reads it
    assert again.tracer is not None and np.array_equal(again.tracer, nominal.tracer)
    assert np.array_equal(again.flow_um_s, nominal.flow_um_s)


def test_a_replay_has_the_same_samples_at_the_same_ticks_and_is_identical(flown: Path, tmp_path: Path) -> None:
    assert verify(flown).identical
    assert replay_session(flown, verify=True, from_s=1.0).identical
    replayed = tmp_path / "again.mcap"
    replay_session(flown, out=replayed)
    with Session(flown) as one, Session(replayed) as other:
        for topic in ("/streams/samples", "/streams/state"):
            pairs = list(zip(one.messages(topic), other.messages(topic), strict=True))
            assert pairs and all(a.stamp_ns == b.stamp_ns for a, b in pairs)
        assert np.array_equal(one.stream("pump/flow").value, other.stream("pump/flow").value)


def test_check_states_the_samples_and_compare_finds_other_ones(flown: Path, tmp_path: Path) -> None:
    assert check(flown).facts["streams"].startswith("pump: ")
    other = tmp_path / "other.mcap"
    record(load_config(None, [*SMALL, *PULSE, *PUMP, "simulated.sensor.noise_share=0.03"]), other, duration_s=2.0)
    assert "/streams/samples" in "\n".join(compare(flown, other).lines())


def test_exports_have_a_row_a_sample(flown: Path, tmp_path: Path) -> None:
    folder = Path(export(flown, tmp_path / "tables", file_format="csv"))
    with (folder / "stream_samples.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    with Session(flown) as session:
        measured = session.stream("pump/flow")
    assert [float(row["value"]) for row in rows] == measured.value.tolist()
    assert {(row["channel"], row["unit"]) for row in rows} == {("pump/flow", "1")}
    listed = json.loads((folder / "datapackage.json").read_text(encoding="utf-8"))["resources"]
    assert "stream_samples.csv" in {each["path"] for each in listed}


def test_rerun_and_foxglove_plot_the_channels_by_name(flown: Path, tmp_path: Path) -> None:
    drawn = File(Path(export(flown, tmp_path / "run.rrd")))
    assert drawn.rows["/extra/streams/pump"] > 50
    assert [["flow"]] in [each for each in drawn.columns["/extra/streams/pump"].values() if each]
    layouts = write_layouts(flown, tmp_path)
    text = layouts.foxglove.read_text(encoding="utf-8")
    assert "/streams/samples.latest[0]" in text and "pump/flow (1)" in text


def test_a_session_without_streams_has_none_and_says_so(tmp_path: Path) -> None:
    record(load_config(None, SMALL), tmp_path / "plain.mcap", duration_s=0.2)
    with Session(tmp_path / "plain.mcap") as session:
        assert "/streams/samples" not in session.topics and "[streams" not in session.header.config_toml
        with pytest.raises(SessionError, match="'pump/flow'"):
            session.stream("pump/flow")


@pytest.mark.parametrize(
    ("sets", "complaint"),
    [
        (["streams.pump.kind=usb"], r"streams\.pump\.kind = 'usb': must be one of lsl, serial, log, simulated"),
        (["streams.pump.outlett=x"], r"unknown key streams\.pump\.outlett; did you mean streams\.pump\.outlet"),
        (["streams.pump.silence_s=0"], r"streams\.pump\.silence_s = 0: must be from 0\.01"),
        (["streams.pump.on_silence=halt"], r"streams\.pump\.on_silence = 'halt': must be one of note, hold, stop"),
        (["streams.pump=3"], r"streams\.pump is a section with settings"),
        (["streams=3"], r"write a section \[streams\.NAME\]"),
        (["streams.a-b.unit=x"], r"name it with letters, digits and _"),
    ],
)
def test_wrong_settings_of_a_stream_are_refused_in_one_line(sets: list[str], complaint: str) -> None:
    with pytest.raises(UsageError, match=complaint) as refused:
        load_config(None, sets)
    assert "\n" not in str(refused.value)


def test_a_channel_that_its_stream_does_not_have_is_refused_before_there_is_a_file(tmp_path: Path) -> None:
    config = load_config(None, [*SMALL, *PUMP, "pump.channel=pump/pressure"])
    with pytest.raises(UsageError, match=r"pump\.channel = 'pump/pressure': .*, but flow"):
        record(config, tmp_path / "x.mcap", duration_s=0.1)
    assert list(tmp_path.iterdir()) == []


def test_streams_of_other_programs_need_real_time(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--realtime"):
        record(load_config(None, [*SMALL, "streams.pump.kind=log"]), tmp_path / "run.mcap", duration_s=0.1)


def test_settings_of_streams_survive_the_head_of_a_session(flown: Path) -> None:
    with Session(flown) as session:
        assert config_from_toml(to_toml(session.config), "again") == session.config
