"""The bench of the store compares like with like."""

import numpy as np
import pytest
from mcap.reader import make_reader

from flowrec.store.channels import message_codec
from tests.perf import store_equal, store_kills
from tests.perf.store_kills import kills
from tests.perf.store_loop import soak
from tests.perf.store_writers import LOADS, WRITERS


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


@pytest.mark.slow("kills writers in processes of their own")
def test_a_soak_and_a_kill_say_what_they_saw(tmp_path, monkeypatch):
    monkeypatch.setattr(store_kills, "_LONGEST_S", 0.8)
    seen = soak(0.01, tmp_path)
    assert seen["dropped"] == 0 and seen["file_mb"] > 1.0 and seen["memory_mb"]
    cost = kills(1, tmp_path)
    assert {name: row["faults"] for name, row in cost["kinds"].items() if row["faults"]} == {}
    assert cost["kills"] == len(cost["kinds"]) and not list(tmp_path.iterdir())


@pytest.mark.slow("writes with every rival")
def test_at_equal_terms_every_writer_packs_the_same_bytes_as_well(tmp_path):
    load = store_equal.loads(0.0)[1]
    sizes = []
    for number, name in enumerate(store_equal.WRITERS):
        path = tmp_path / f"{number}.mcap"
        file = store_equal.WRITERS[name](path, load.field, load.schema)
        for stamp_ns, payload in enumerate(load.payloads, 1):
            file.put(payload, stamp_ns)
        file.close()
        with path.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True)
            stored = [message.data for _, _, message in reader.iter_messages()]
            schemas = sum(len(schema.data) for schema in reader.get_summary().schemas.values())
        assert stored == load.payloads, name
        sizes.append(path.stat().st_size - 2 * schemas)  # among the messages and in the summary
    assert np.ptp(sizes) < 0.03 * sizes[0]


def test_at_equal_terms_protobuf_reads_the_same_messages_from_both_encoders():
    for what, (given, _, _) in store_equal.messages().items():
        ours, its_own = (make(type(given[0])) for make in store_equal.ENCODERS.values())
        parse = message_codec(type(given[0])).schema.wire.FromString
        assert all(parse(ours(message)) == parse(its_own(message)) for message in given[:9]), what
