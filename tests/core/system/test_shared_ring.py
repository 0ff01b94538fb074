"""What one process puts into a ring in shared memory, another one takes out as it was, in order, once."""

import hashlib
import os
import signal
import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flowrec.core import SharedRing
from flowrec.core.system.processes import child_environment
from flowrec.core.system.shared_ring import WORDS
from tests.conftest import HANG_S

STEPS = st.lists(st.one_of(st.binary(max_size=300), st.sampled_from(["take", "release"])), max_size=200)


@given(STEPS, st.integers(8, 700))
def test_records_of_any_size_come_out_as_they_went_in_and_only_a_full_ring_refuses(steps, nbytes):
    ring = SharedRing(nbytes)
    sent, found = [], []
    for step in steps:
        if step == "take":
            record = ring.take()
            found += [] if record is None else [bytes(record)]
            del record
        elif step == "release":
            ring.release()
        elif ring.put((step[:5], step[5:])):
            sent.append(step)
        else:
            assert ring.used_bytes or len(step) + 15 > nbytes // 2
        assert found == sent[: len(found)] and 0 <= ring.used_bytes <= ring.nbytes
    while (record := ring.take()) is not None:
        found.append(bytes(record))
        del record
    ring.release()
    assert found == sent and ring.used_bytes == 0
    ring.close()


PRODUCER = """
import hashlib, sys
from flowrec.core.system.shared_ring import SharedRing
ring = SharedRing(int(sys.argv[1]), handle=sys.argv[2])
for number in range(int(sys.argv[3])):
    content = number.to_bytes(4, "little") * (number % 997)
    while not ring.put((hashlib.sha256(content).digest(), content)):
        pass
ring.words[3] = 1
print("put", flush=True)
sys.stdin.read()
"""


@pytest.mark.skipif(sys.platform == "win32", reason="descriptors are inherited by POSIX processes only")
def test_two_processes_share_a_ring_and_what_a_killed_one_had_put_in_is_there(tmp_path):
    script = tmp_path / "ring_producer.py"
    script.write_text(PRODUCER)
    ring, count = SharedRing(400_000, touched=True), 3000
    words = [sys.executable, script, str(ring.nbytes), ring.handle, str(count)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    producer = subprocess.Popen(words, pass_fds=[int(ring.handle)], env=child_environment(), **pipes)
    for number in range(count):
        while (record := ring.take()) is None:
            assert producer.poll() is None
        content = bytes(record[32:])
        assert bytes(record[:32]) == hashlib.sha256(content).digest()
        assert content == number.to_bytes(4, "little") * (number % 997)
        del record
        if number < count - 50:
            ring.release()
        if number == count - 51:
            assert producer.stdout.readline() == b"put\n"
            os.kill(producer.pid, signal.SIGKILL)
            producer.wait(HANG_S)
    assert ring.words[3] == 1 and len(ring.words) == WORDS
    producer.stdin.close()
    producer.stdout.close()
    ring.close()
