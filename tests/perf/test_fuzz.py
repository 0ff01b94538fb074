"""The first corrupted sessions of `python -m tests.perf.fuzz`, and those that once were a fault."""

import pytest

from flowrec.store import SessionReader
from tests.perf.fuzz import Campaign

# Seeds of files that were once a fault: what recovery passed for whole could not be read; a check that saw less than
# the reader.
KEPT = (15, 50, 70, 125, 230, 374, 1003694, 1004701)


@pytest.fixture(autouse=True)
def no_waiting_for_the_disk(monkeypatch):
    monkeypatch.setattr("os.fsync", lambda fd: None)


@pytest.mark.slow("every verb on 38 corrupted sessions")
def test_whatever_is_done_to_a_session_every_verb_reads_or_refuses_it(tmp_path):
    campaign = Campaign(tmp_path)
    assert not [(seed, faults) for seed in (*KEPT, *range(600, 630)) if (faults := campaign.run(seed))]
    assert len(campaign.kinds) == 8 and campaign.ends["ticks: read"] and campaign.ends["ticks: refused"]


def test_forty_corrupted_sessions_are_opened_and_read_or_refused(tmp_path):
    campaign = Campaign(tmp_path, verbs=("info", "ticks"))
    assert not [(seed, faults) for seed in range(10_000, 10_040) if (faults := campaign.run(seed))]


def test_the_campaign_notices_what_may_not_happen(tmp_path, monkeypatch):
    campaign = Campaign(tmp_path, verbs=("info", "ticks", "check"))

    def careless(self, *_):
        raise KeyError("schema")

    monkeypatch.setattr(SessionReader, "ticks", careless)
    found = {fault for seed in range(12) for fault in campaign.run(seed)}
    assert any("KeyError" in fault for fault in found)
    assert any("but it can not be read" in fault for fault in found)


def test_the_session_that_is_corrupted_holds_every_topic(tmp_path):
    from flowrec.core import TOPICS
    from tests.store.drafts import TICKS, small_draft

    path = tmp_path / "whole.mcap"
    path.write_bytes(small_draft().build())
    with SessionReader(path) as reader:
        assert reader.counts == {topic.field: TICKS for topic in TOPICS}
