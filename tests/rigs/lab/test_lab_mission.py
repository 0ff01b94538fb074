"""Whole missions of `record --rig lab` on twins of camera and coils, with a simulated world between them.

The recorder is a process of its own, as in a lab. The world is moved by the outputs of the amplifier's twin alone.
"""

from __future__ import annotations

import os
import re
import select
import threading
import tty
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import numpy as np
import pytest

from flowrec.physics import load_chip, relative_rmse
from flowrec.rigs import emulated_world
from flowrec.stages import assemble, load_config
from flowrec.stages.resolve import resolve
from flowrec.store import Session
from flowrec.verbs import replay_session
from flowrec.verbs.check import check
from tests.conftest import feeds_an_output, needs_quiet, run
from tests.extras import why
from tests.perf.camera_killed import trial
from tests.short_missions import set_words
from tests.twins.coils import Device, device
from tests.twins.emulator import emulated
from tests.twins.gige import installed
from tests.twins.lab import COMMON, PATIENT, RATE, recorder
from tests.twins.world import EmulatedView

pytestmark = [needs_quiet, feeds_an_output]
GOAL_UM = (2480.0, 3343.0)


def test_a_mission_whose_camera_is_killed_on_the_way_has_no_field_meanwhile_and_arrives(tmp_path: Path) -> None:
    """By the GigE Vision protocol and the serial firmware."""
    pytest.importorskip("viva_genicam", reason=why("viva_genicam"))
    if not installed:
        pytest.skip("needs aravis-tools")
    killed = trial(tmp_path)
    assert killed.status == 0, killed.said
    assert killed.off_s < 3.0 and killed.back_s < 10.0, "a bound for this test; tests.perf.cameras measures"
    assert "the field is off until there is an image again" in killed.said and "the camera is back" in killed.said
    assert killed.closest_um < 150.0, "the robot of the world was at the goal"
    with Session(killed.session) as recorded:
        assert recorded.outcome["outcome"] == "reached"
        ticks = list(recorded.ticks())
    losses = [tick.losses for tick in ticks if tick.losses is not None][-1]
    assert losses.reconnections == 1
    assert losses.ids == losses.frames + losses.link + losses.incomplete + losses.driver + losses.backlog
    assert any(tick.applied is not None and tick.applied.without_image for tick in ticks)
    assert replay_session(killed.session, verify=True).same
    assert check(killed.session).exit_status in (0, 3)


def test_a_mission_that_surveys_and_refines_arrives_and_replays_exactly(tmp_path: Path) -> None:
    """By pylon's emulator and the twin of NI's server."""
    pytest.importorskip("pypylon", reason=why("pypylon"))
    pytest.importorskip("nidaqmx", reason=why("nidaqmx"))
    mission = ("mission.phases=survey,refine,plan,navigate", f"mission.goal={list(GOAL_UM)}", "robot.delay_s=0.19")
    # The inlet of this world is 32 % slower or faster than assumed: a busy computer costs the survey some percent.
    kind = ("simulated.world=kind", "simulated.seed=7")
    config = load_config(None, [*COMMON, *mission, *kind, "camera.rate_hz=40.0"])
    chip = load_chip(config.chip)
    resolved = resolve(config, chip)
    sets = (*COMMON, *PATIENT, *mission, RATE, "recording.anonymous=true", "refine.method=assimilate")
    session, errors = tmp_path / "s.mcap", tmp_path / "stderr"
    view = EmulatedView(tmp_path, resolved)
    with (
        device("ni", tmp_path) as coils,
        emulated_world(assemble(resolved, chip), resolved, coils, view) as (world, truths),
        recorder(session, *sets, *view.sets, *coils.sets, errors=errors) as process,
    ):
        status = process.wait(240.0)
    assert status == 0, errors.read_text()[-2000:]
    _, volts = coils.outputs()
    truth = world.true_field
    away_um = np.hypot(*(np.array([one.position_um for one in truths]) - GOAL_UM).T)
    assert away_um.min() < 150.0, "the robot of the world was at the goal"
    assert np.abs(volts).max() > 1.0 and not volts[-1].any()
    with Session(session) as recorded:
        assert recorded.outcome["outcome"] == "reached"
        fields = recorded.fields
        turns = np.array([tick.applied.turns for tick in recorded.ticks() if tick.applied is not None])
    assert 25.0 * float(np.hypot(*turns.T).sum()) > 300.0, "the coils did the work, to and fro"
    errors_v = {name: float(relative_rmse(field, truth, chip.mask).v) for name, field in fields.items()}
    assert errors_v["refined"] < errors_v["assumed"], errors_v
    assert replay_session(session, verify=True).same
    assert check(session).exit_status in (0, 3)


@contextmanager
def nothing_else(_on: Device) -> Iterator[tuple[str, ...]]:
    """Nobody but the recorder is at the devices."""
    yield ()


@contextmanager
def other_words(_on: Device) -> Iterator[tuple[str, ...]]:
    """A port at which another device answers every line."""
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    over = threading.Event()

    def answer() -> None:
        while not over.is_set():
            if select.select([ours], [], [], 0.05)[0] and os.read(ours, 4096):
                os.write(ours, b"Grbl 1.1f ['$' for help]\r\nerror:2\r\n")

    thread = threading.Thread(target=answer)
    thread.start()
    yield (f'lab.serial.port="{os.ttyname(theirs)}"',)
    over.set()
    thread.join()
    os.close(ours)
    os.close(theirs)


@contextmanager
def port_in_use(on: Device) -> Iterator[tuple[str, ...]]:
    """Another program has opened the port."""
    import serial

    with serial.Serial(on.address, exclusive=True):
        yield ()


@contextmanager
def outputs_in_use(on: Device) -> Iterator[tuple[str, ...]]:
    """Another program puts out zeros at one of the outputs; they stay its own."""
    nidaqmx = pytest.importorskip("nidaqmx", reason=why("nidaqmx"))
    from flowrec.rigs.lab.amplifiers.ni_device import grpc_options

    with nidaqmx.Task(grpc_options=grpc_options(on.address)) as other:
        other.ao_channels.add_ao_voltage_chan("cDAQ1Mod1/ao1")
        other.timing.cfg_samp_clk_timing(1000.0, sample_mode=nidaqmx.constants.AcquisitionType.CONTINUOUS)
        other.write(np.zeros(1000))
        other.start()
        yield ()
        assert not other.is_task_done()


@pytest.mark.parametrize(
    ("kind", "cameras", "meanwhile", "sets", "told"),
    [
        ("serial", 0, nothing_else, (), "pylon: no camera found"),
        ("serial", 2, nothing_else, (), "pylon: 2 cameras found; set lab.device"),
        ("serial", 1, nothing_else, ("coils.max_current_a=50.0",), "coils.max_current_a = 50 A: .* makes at most 5 A"),
        ("serial", 1, other_words, (), "another device than flowrec-coils answers"),
        ("serial", 1, port_in_use, (), "another program uses this port"),
        ("ni", 1, outputs_in_use, (), "another program uses the outputs"),
        ("ni", 1, nothing_else, ('lab.ni.channels="cDAQ1Mod1/ao7:9"',), "the device has no such channel"),
    ],
)
def test_devices_that_are_not_there_or_can_not_do_it_are_one_line_and_leave_no_file_and_no_field(
    kind: str,
    cameras: int,
    meanwhile: Callable[[Device], AbstractContextManager[tuple[str, ...]]],
    sets: tuple[str, ...],
    told: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The verb itself, in this process."""
    pytest.importorskip("pypylon", reason=why("pypylon"))
    out = tmp_path / "out"
    out.mkdir()
    with emulated(cameras), device(kind, tmp_path) as on, meanwhile(on) as more:
        begin = on.end()
        given = set_words((*COMMON, RATE, "lab.camera=pylon", *on.sets, *more, *sets))
        status = run(["record", "--rig", "lab", "--out", out / "s.mcap", *given])
        assert not on.energised(begin)
    assert status in (1, 2)
    stderr = capsys.readouterr().err
    lines = [line for line in stderr.splitlines() if line.startswith("flowrec: ")]
    assert len(lines) == 1 and "Traceback" not in stderr
    assert re.search(told, lines[0]), lines[0]
    assert not list(out.iterdir())
