"""The bench of the store compares like with like."""

import pytest
from mcap.reader import make_reader

from flowrec.bench.store_kills import kills
from flowrec.bench.store_loop import soak
from flowrec.bench.store_writers import LOADS, WRITERS


@pytest.mark.parametrize("load", LOADS[:2], ids=lambda load: load.name)  # the third is the second, larger
def test_every_writer_writes_every_message(load, tmp_path):
    data = load.data()
    assert load.rival in load.writers
    for number, name in enumerate(load.writers):
        path = tmp_path / f"{number}.mcap"
        WRITERS[name](path, data, 5)
        with path.open("rb") as stream:
            counts = make_reader(stream).get_summary().statistics.channel_message_counts
        assert 5 in counts.values(), name


def test_a_soak_and_a_kill_say_what_they_saw(tmp_path):
    seen = soak(0.01, tmp_path)
    assert seen["dropped"] == 0 and seen["file_mb"] > 1.0 and seen["memory_mb"]
    cost = kills(1, tmp_path)
    assert cost["broken"] == 0 and cost["kills"] == 1 and not list(tmp_path.iterdir())
