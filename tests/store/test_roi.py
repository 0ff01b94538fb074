"""Images of which a window is kept: which, what a reader is told, and that a replay does not notice."""

from dataclasses import replace

import numpy as np
import pytest

from flowrec.core import UsageError
from flowrec.stages import load_config
from flowrec.store import SessionReader, nonzero_window, recover
from flowrec.store.frame_encodings import ENCODINGS
from flowrec.store.roi import Region, WindowSelector
from flowrec.verbs import Change
from flowrec.verbs import session_replay as verb
from flowrec.verbs.check import check
from flowrec.verbs.info import info
from flowrec.verbs.record import record
from tests.short_missions import SMALL
from tests.store.made_up import PERIOD_NS, ticks_of, write_session

EVERYWHERE = (0, 0, 200, 160)
REGION = Region(pad_px=5, everywhere_px=EVERYWHERE, full_every_s=0.5)


def seen_at(tick, roi, **more):
    track = replace(tick.track, seen=True, roi_px=np.array(roi, float), **more)
    return replace(tick, track=track)


def written(path, ticks, frames="zstd", block=True):
    write_session(path, ticks, frames=frames, region=REGION, block=block)
    return SessionReader(path)


@pytest.mark.parametrize("frames", [name for name, one in ENCODINGS.items() if one.lossless])
@pytest.mark.parametrize("block", [True, False])
def test_a_window_holds_what_was_searched_and_its_pad_and_is_black_elsewhere(tmp_path, frames, block):
    ticks = [
        seen_at(tick, (40 + n, 30, 60 + n, 50) if n % 10 != 3 else EVERYWHERE)
        for n, tick in enumerate(ticks_of(40, shape=(160, 200)))
    ]
    ticks[7] = replace(ticks[7], track=replace(ticks[7].track, seen=False))
    ticks[8] = replace(ticks[8], track=ticks[6].track)  # what a stage that failed leaves: a track of another image
    ticks[15] = seen_at(ticks[15], (-3, 150, 20, 171))  # at the edge
    reader = written(tmp_path / "s.mcap", ticks, frames, block)
    assert reader.region == replace(REGION, everywhere_px=(0, 0, 0, 0), cut=False)
    whole, last_whole_ns = [], -(10**18)
    for number, (tick, back) in enumerate(zip(ticks, reader.ticks(), strict=True)):
        image, kept = tick.frame.image, back.frame.image
        x0, y0, x1, y1 = (int(value) for value in tick.track.roi_px)
        expected = np.zeros_like(image)
        window = slice(max(y0 - 5, 0), y1 + 5), slice(max(x0 - 5, 0), x1 + 5)
        expected[window] = image[window]
        due = tick.stamp_ns - last_whole_ns >= 500_000_000
        if due or number % 10 == 3 or number in (7, 8):
            expected, last_whole_ns = image, tick.stamp_ns
            whole.append(number)
        assert np.array_equal(kept, expected), number
    assert whole[:3] == [0, 3, 7] and int(0.5e9 // PERIOD_NS) + 1 > 20
    assert reader.outcome["frames_windows"].startswith(f"{40 - len(whole)} of 40 images")
    assert nonzero_window(ticks[0].frame.image) == (0, 0, 200, 160)


def test_where_an_image_is_lit_is_found():
    image = np.zeros((40, 60), np.uint8)
    assert nonzero_window(image) == (0, 0, 0, 0) and nonzero_window(image[:0]) == (0, 0, 0, 0)
    image[10, 20] = image[30, 7] = 3
    assert nonzero_window(image) == (7, 10, 21, 31)
    image[0] = image[-1] = 1
    assert nonzero_window(image) == (0, 0, 60, 40)


@pytest.mark.slow("flies a mission and replays it from several times")
def test_a_mission_in_windows_replays_exactly_from_anywhere_and_says_what_it_is(session, tmp_path, capsys):
    sets = [*SMALL, "recording.region=robot", "recording.full_every_s=3", "duration_s=4"]
    path = record(load_config(None, sets), tmp_path / "s.mcap").path
    for from_s in (None, 2.345):
        done = verb.replay_session(path, Change(), from_s=from_s, verify=True)
        same, lines = done.same, done.lines()
        assert same and done.comparison.identical, lines
    assert "black" not in capsys.readouterr().err
    # The run itself is the one of whole images.
    for whole, cut in zip(SessionReader(session).ticks(), SessionReader(path).ticks(), strict=False):
        assert whole.track.same_as(cut.track) and whole.currents.same_as(cut.currents)
        x0, y0, x1, y1 = nonzero_window(cut.frame.image)
        assert np.array_equal(whole.frame.image[y0:y1, x0:x1], cut.frame.image[y0:y1, x0:x1])
    verdict = check(path)
    assert verdict.exit_status == 0 and "exact for the recorded tracker" in verdict.facts["windows"]
    assert "black elsewhere" in info(path)["frames_windows"]
    # Another controller looks at the same pixels; another tracker may not.
    out = tmp_path / "r.mcap"
    verb.replay_session(path, Change(sets=("tracker.search_radii=4",)), out=out, frames=True)
    assert "black" in capsys.readouterr().err
    assert SessionReader(out).region == SessionReader(path).region is not None
    for was, now in zip(SessionReader(path).messages("frame"), SessionReader(out).messages("frame"), strict=False):
        assert was.same_as(now)


def test_a_cut_session_of_windows_is_still_told_as_such_when_recovered(tmp_path):
    ticks = (seen_at(tick, (40, 30, 60, 50)) for tick in ticks_of(60, shape=(160, 200)))
    written(tmp_path / "s.mcap", ticks).close()
    data = (tmp_path / "s.mcap").read_bytes()
    cut = tmp_path / "cut.mcap.partial"
    cut.write_bytes(data[: int(0.7 * len(data))])
    saved = recover(cut)
    assert SessionReader(saved.path).region == SessionReader(tmp_path / "s.mcap").region is not None


def test_settings_that_make_no_sense_are_refused_in_one_line():
    with pytest.raises(UsageError, match=r"recording\.full_every_s = -1"):
        load_config(None, ["recording.full_every_s=-1"])


def test_a_whole_image_comes_at_the_interval_of_the_region():
    selector = WindowSelector(REGION)
    ticks = [seen_at(tick, (50, 50, 60, 60)) for tick in ticks_of(91, shape=(160, 200))]
    whole_ns = [tick.stamp_ns for tick in ticks if selector.window_of(tick.frame, tick.track) is None]
    # Every half second, which 30 periods of 16.67 ms just exceed.
    assert whole_ns == [ticks[0].stamp_ns + 30 * number * PERIOD_NS for number in range(4)]
