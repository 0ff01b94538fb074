"""`flowrec catalog --serve`: a client of Rerun reads a session from a server that nobody else can reach."""

from __future__ import annotations

import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

import flowrec
from flowrec.archive.catalog.refresh import refresh
from flowrec.archive.catalog.serve import FOLDER, recordings_of
from flowrec.core import UsageError
from tests.conftest import HANG_S
from tests.extras import why

GOLDEN = Path(__file__).parents[3] / "sessions" / "golden.mcap"


@pytest.mark.slow("a server and a client of Rerun in processes of their own")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_client_reads_what_is_served_on_this_machine_alone_and_ctrl_c_leaves_nothing(tmp_path: Path) -> None:
    pytest.importorskip("datafusion", reason=why("datafusion"))
    from rerun.catalog import CatalogClient

    shutil.copy(GOLDEN, tmp_path / "a.mcap")
    words = [sys.executable, "-m", "flowrec", "catalog", str(tmp_path), "--serve", "--where", "name = 'a.mcap'"]
    process = subprocess.Popen(words, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stderr is not None
        told = "".join(iter(process.stderr.readline, "Ctrl-C ends the server\n"))
        url = re.search(r"open it with: rerun (\S+)", told)
        assert url is not None, told
        of_all = [process.pid, *(child.pid for child in psutil.Process(process.pid).children(recursive=True))]
        listening = [each.laddr for each in psutil.net_connections("inet") if each.pid in of_all and not each.raddr]
        assert {address.ip for address in listening} == {"127.0.0.1"}
        dataset = CatalogClient(url[1]).get_dataset("sessions")
        (segment,) = dataset.segment_ids()
        assert segment.startswith(flowrec.open(GOLDEN).key)
        process.send_signal(signal.SIGINT)
        assert process.wait(HANG_S) == 0
    finally:
        process.kill()
        process.communicate()
    assert not [pid for pid in of_all if psutil.pid_exists(pid)]
    assert [path.suffix for path in (tmp_path / FOLDER).iterdir()] == [".rrd"]


def test_recordings_are_made_once_and_those_of_others_are_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = []

    def write(_: object, session: flowrec.Session, part: Path, __: object) -> None:
        made.append(session.path.name)
        part.write_bytes(b"RRF" + b"flowrec" + session.key.encode())

    monkeypatch.setattr("flowrec.exports.rrd.RrdExport.write", write)
    for name in ("a.mcap", "b.mcap"):
        shutil.copy(GOLDEN, tmp_path / name)
    catalog = refresh([tmp_path]).path
    said: list[str] = []
    monkeypatch.setattr("flowrec.archive.catalog.serve.say", said.append)
    (first,) = recordings_of(catalog, "name = 'a.mcap'")
    assert recordings_of(catalog, "name = 'a.mcap'") == [first] and made == ["a.mcap"]
    assert str(first) in said[0]
    (second,) = recordings_of(catalog, "name = 'b.mcap'")
    assert list((tmp_path / FOLDER).iterdir()) == [second] and refresh([tmp_path]).sessions == 2
    for where in ("name = 'none'", "true"):
        monkeypatch.setattr("flowrec.archive.catalog.serve.SERVED_LIMIT", 1)
        with pytest.raises(UsageError, match="choose them"):
            recordings_of(catalog, where)
