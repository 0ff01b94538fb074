"""Topics that are left out of a recording."""

import pytest

from flowrec.core import UsageError
from flowrec.store import SessionReader
from flowrec.store.channels import VIEWED, left_out
from tests.store.made_up import ticks_of, write_session

TICKS = list(ticks_of(60))


def test_what_is_left_out_is_not_in_the_file_and_the_rest_is_unchanged(tmp_path):
    for name, patterns in (("all", ()), ("less", ("/view/*", "/truth/*", "/camera/frame"))):
        write_session(tmp_path / f"{name}.mcap", TICKS, leave_out=patterns)
    everything, less = SessionReader(tmp_path / "all.mcap"), SessionReader(tmp_path / "less.mcap")
    gone = everything.counts.keys() - less.counts.keys()
    assert gone == everything.counts.keys() & {"frame", "truth", "true_field"} and "frame" in gone
    assert {name: everything.counts[name] for name in less.counts} == less.counts
    channels = {channel.id: channel.topic for channel in less.file(0).channels.values()}
    counts = less.file(0).statistics.channel_message_counts
    assert not VIEWED & {channels[number] for number in counts}


@pytest.mark.parametrize("pattern", ["/coils/*", "*", "/robot/track", "/run/mission"])
def test_what_a_replay_needs_can_not_be_left_out(pattern):
    with pytest.raises(UsageError, match="a replay needs /"):
        left_out([pattern])


def test_a_name_that_stands_for_nothing_is_refused():
    with pytest.raises(UsageError, match="no topic is called '/cameras/\\*'"):
        left_out(["/cameras/*"])
