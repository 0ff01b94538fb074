"""A run is steered from another process of the same user, and only from there."""

from __future__ import annotations

import contextlib
import stat
import sys
import tempfile
import threading
from collections.abc import Iterator
from multiprocessing.connection import Client
from pathlib import Path

import pytest

from flowrec.core import Action, FlowrecError
from flowrec.run import CommandSocket, RemoteControl, RunControl, remote_control
from tests.conftest import until

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="the folder of the sockets is looked at")


@pytest.fixture
def places(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of temporary files with a short name: the path of a socket has 103 characters at most."""
    with tempfile.TemporaryDirectory() as folder:
        monkeypatch.setattr("tempfile.tempdir", folder)
        yield Path(folder)


def test_commands_of_another_process_become_events_and_are_refused_as_those_of_the_page(places: Path) -> None:
    control, told = RunControl(), list[str]()
    with CommandSocket(places / "a.mcap", control, told.append):
        remote = RemoteControl(places / "x" / ".." / "a.mcap")
        assert remote.obey({"command": "goal", "x_um": 12.0, "y_um": 34.0}) == ""
        event = control.next_event(10**9, held=False)
        assert event is not None and event.goal_um is not None
        assert (event.action, event.goal_um.tolist()) == (Action.GOAL, [12.0, 34.0])
        assert "speed limit -5" in remote.obey({"command": "speed", "limit_um_s": -5})
        for words in ({}, {"command": "jump", "text": ""}, {"command": "goal", "x_um": "here", "y_um": 1}):
            assert "not understood" in remote.obey(words)
        assert remote.obey({"command": "zero", "text": ""}) == ""
        assert control.reason == "operator: zero field (console)"
        assert "the run ends" in remote.obey({"command": "goal", "x_um": 1.0, "y_um": 1.0})
    assert told == []
    assert remote.obey({"command": "stop", "text": ""}) != ""
    with pytest.raises(FlowrecError, match="commands"):
        RemoteControl(places / "a.mcap")


def test_a_connection_that_says_nothing_or_too_much_does_not_keep_others_out(
    places: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(remote_control, "_PATIENCE_S", 0.05)
    control = RunControl()
    with CommandSocket(places / "a.mcap", control, print):
        remote = RemoteControl(places / "a.mcap")
        address = str(next(places.rglob("*.sock")))
        silent = Client(address)
        for rubbish in (b"\xff", b"[]", b"{", bytes(100_000)):
            with Client(address) as loud, contextlib.suppress(BrokenPipeError):
                loud.send_bytes(rubbish)
            assert remote.obey({"command": "mark", "text": ""}) == "", rubbish[:2]
        silent.close()
    until(lambda: not [thread for thread in threading.enumerate() if thread.name == "commands"])


def test_the_socket_is_in_a_folder_of_the_user_and_a_killed_run_leaves_none_in_the_way(places: Path) -> None:
    told = list[str]()
    with CommandSocket(places / "a.mcap", RunControl(), told.append):
        (address,) = places.rglob("*.sock")
        for folder in (address.parent, address.parent.parent):
            assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert not address.exists()
    address.touch()  # as of a run that was killed
    control = RunControl()
    with CommandSocket(places / "a.mcap", control, told.append):
        assert RemoteControl(places / "a.mcap").obey({"command": "mark", "text": ""}) == ""
    assert told == []
    address.parent.chmod(0o777)  # others could put their own socket there
    with CommandSocket(places / "a.mcap", control, told.append), pytest.raises(FlowrecError):
        RemoteControl(places / "a.mcap")
    assert "console" in told[0]
