"""Movies of a session, read by PyAV and ffprobe: every image at its stamp; scale, time and session in the file."""

from __future__ import annotations

import json
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import av
import numpy as np
import pytest

import flowrec
from flowrec.core import Applied, Frame, SessionError, Shift, Tick, Tracers
from flowrec.exports import mp4
from flowrec.exports.camera_images import with_images
from flowrec.view import Overlay, Scene, state_text

GOLDEN = Path(__file__).parents[2] / "sessions" / "golden.mcap"
STAMPS_NS = [0, 33_333_333, 66_666_667, 500_000_001, 533_333_333]  # one interval is a loss


@pytest.fixture(scope="module")
def session() -> flowrec.Session:
    return flowrec.open(GOLDEN)


class OfTicks:
    """A session whose ticks are replaced."""

    def __init__(self, session: flowrec.Session, ticks: list[Tick]) -> None:
        self._session, self._ticks = session, ticks

    def __getattr__(self, name: str) -> Any:
        return getattr(self._session, name)

    def ticks(self) -> list[Tick]:
        return self._ticks

    def at(self, _time_s: float) -> Tick:
        return self._ticks[0]


def made(stamps_ns=STAMPS_NS, shape=(120, 160), bits=8, repeated=()) -> list[Tick]:
    """Ticks whose images are noise on a slope."""
    rng, top = np.random.default_rng(1), 2**bits - 1
    dtype = np.uint8 if bits == 8 else np.uint16
    slope = np.linspace(0.1, 0.6, shape[1]) * top * np.ones((shape[0], 1))
    ticks = []
    for index, stamp in enumerate(stamps_ns):
        image = np.clip(slope + rng.normal(0, top / 50, shape), 0, top).astype(dtype)
        since = stamps_ns[index - 1] if index in repeated else stamp
        applied = Applied(stamp, 0.0, 0.0, 0.0, np.zeros(3), np.zeros(2), since)
        ticks.append(Tick(stamp, Frame(stamp, index, image, bits), applied))
    return ticks


def written(exporter: Any, session: Any, path: Path) -> Path:
    exporter.write(session, path, lambda _time_s: None)
    return path


class StreamFacts(NamedTuple):
    """Facts of a stream, which can not be asked when its file is closed."""

    time_base: Fraction
    codec: tuple[str, str]
    size_px: tuple[int, int]


def read(path: Path) -> tuple[list[Any], dict[str, str], StreamFacts]:
    """Decoded frames, metadata, and facts of the stream."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        codec = stream.codec_context.name, str(stream.codec_context.pix_fmt)
        facts = StreamFacts(stream.time_base, codec, (stream.width, stream.height))
        return list(container.decode(stream)), dict(container.metadata), facts


@pytest.mark.parametrize("exporter", [mp4.Mp4Export(), mp4.PlainMp4Export()])
def test_every_image_is_shown_at_its_stamp_to_half_a_microsecond_and_a_loss_stays_a_gap(exporter, session, tmp_path):
    path = written(exporter, OfTicks(session, made(repeated=[2])), tmp_path / "x.mp4")
    frames, _, stream = read(path)
    assert stream.time_base == mp4.TIME_BASE
    shown_ns = [frame.pts * 1000 for frame in frames]
    assert np.abs(np.array(shown_ns) - np.delete(STAMPS_NS, 2)).max() <= 500
    with av.open(str(path)) as container:
        packets = [packet for packet in container.demux(video=0) if packet.size]
    assert [packet.pts for packet in packets] == [0, 33_333, 500_000, 533_333]
    assert [packet.dts for packet in packets] == [0, 33_333, 500_000, 533_333], "who knows no edit list shows the same"
    assert [packet.duration for packet in packets[1:]] == [466_667, 33_333, 33_333]


def test_the_file_is_what_players_open_and_states_scale_time_and_session(session, tmp_path):
    path = written(mp4.Mp4Export(), session, tmp_path / "x.mp4")
    frames, metadata, stream = read(path)
    assert len(frames) == session.topics["/camera/frame"]
    assert stream.codec == ("h264", "yuv420p")
    assert not any(side % 2 for side in stream.size_px)
    data = path.read_bytes()
    assert data.index(b"moov") < data.index(b"mdat"), "a browser can play it while it loads"
    assert metadata["title"].startswith("golden")
    assert f"session {session.key}" in metadata["comment"]
    scale = session.config.camera.um_per_px / 3
    assert f"{scale:.6g} um per pixel" in metadata["comment"]  # the picture is enlarged by 3
    assert metadata["creation_time"][:19] == session.provenance["wall_time"][:19]


def test_the_last_image_and_the_notes_of_the_file_state_how_the_run_ended(session, tmp_path, monkeypatch):
    told = []
    draw = mp4.Overlay.draw

    def spied(self, image, tick, ended=""):
        told.append((ended, self._scene.doubts))
        return draw(self, image, tick, ended)

    monkeypatch.setattr(mp4.Overlay, "draw", spied)
    stopped = OfTicks(session, made(repeated=[2]))
    stopped.outcome = {"outcome": "time over", "duration_s": 0.6, "doubts": "axes"}
    _, metadata, _ = read(written(mp4.Mp4Export(), stopped, tmp_path / "x.mp4"))
    assert told == [("", "axes")] * 3 + [("time over", "axes")]
    assert "Time over after 0.6 s, doubtful; Doubtful: axes" in metadata["comment"]
    mission = session.last.mission
    assert mission.finished and mission.outcome == "reached"
    assert state_text(mission, None, doubtful=True) == "reached, doubtful"
    under_way = replace(mission, finished=False, outcome="", phase="navigate")
    assert state_text(under_way, None, doubtful=True) == "navigate"
    assert state_text(under_way, None, "time over", doubtful=True) == "time over, doubtful"


@pytest.mark.slow("draws a movie")
def test_the_robot_is_in_its_ring_and_nothing_is_drawn_over_it(session, tmp_path):
    frames, _, _ = read(written(mp4.Mp4Export(), session, tmp_path / "x.mp4"))
    ticks = list(with_images(session))
    radius = 3 * session.config.robot.radius_um / session.config.camera.um_per_px
    for place in (20, 60, len(ticks) - 1):
        tick, _ = ticks[place]
        x, y = (3 * (session.calibration.to_px(tick.estimate.position_um) + 0.5) - 0.5).tolist()
        picture = frames[place].to_ndarray(format="rgb24").astype(int)
        rows, columns = np.ogrid[: picture.shape[0], : picture.shape[1]]
        distance = np.hypot(columns - x, rows - y)
        red_over_blue = picture[..., 0] - picture[..., 2]
        assert np.median(red_over_blue[np.abs(distance - radius - 3.0) < 0.8]) > 40, "an orange ring"
        assert np.abs(red_over_blue[distance < radius - 3.0]).mean() < 15, "the camera's grey within it"


def overlay_of(session) -> Overlay:
    size_px = session.at(5.0).frame.image.shape[::-1]
    return Overlay(Scene(session.chip, session.calibration, session.config.robot, "", image_px=size_px), size_px)


def drawn(overlay: Overlay, tick: Tick, shape: tuple[int, int]) -> np.ndarray:
    """The picture (3 h, 3 w, 3) over a grey image (h, w), without the lines below it."""
    return overlay.draw(np.full(shape, 100, np.uint8), tick)[: 3 * shape[0]].astype(int)


def test_flow_route_and_goal_are_where_the_image_shows_them_by_the_registration_that_was_found(session):
    tick = replace(session.at(5.0), estimate=None)
    moved_px = np.array([4.0, -2.0])  # of the camera: the chip lies that far from where the image shows it
    moved_um = session.config.camera.um_per_px * moved_px
    found = replace(tick.refined, registration=np.column_stack((np.eye(2), moved_um)))
    stated, shown = (
        drawn(overlay_of(session), replace(tick, refined=refined), tick.frame.image.shape)
        for refined in (replace(tick.refined, registration=None), found)
    )
    left, down = (3 * moved_px).astype(int)
    expected = np.roll(stated, (-down, -left), (0, 1))
    inside = np.s_[20:-20, 20:-20]
    assert np.abs(shown - stated)[inside].max() > 50
    assert np.abs(shown - expected)[inside].max() <= 8


def two_tracers(session, stamp_ns: int) -> Tracers:
    """One that goes 30 px of the camera to the right in a second, and one that lies still."""
    places_um = session.calibration.to_um(np.array([(60.0, 30.0), (100.0, 90.0)]))
    velocity_um_s = np.array([session.calibration.to_um(np.array([90.0, 30.0])) - places_um[0], (0.0, 0.0)])
    two = np.ones(2)
    return Tracers(
        stamp_ns, two, places_um, velocity_um_s, two, two, two, 9.0 * two, 0.0 * two, 0.0 * two, places_um, two, 2
    )


def test_a_tracer_that_moves_has_a_line_to_where_it_will_be_soon_and_one_that_lies_still_has_none(session):
    tick = Tick(stamp_ns=session.at(5.0).stamp_ns)
    overlay, shape = overlay_of(session), session.at(5.0).frame.image.shape
    bare = drawn(overlay, tick, shape)
    shown = drawn(overlay, replace(tick, tracers=two_tracers(session, tick.stamp_ns)), shape)
    rows, columns = np.nonzero(np.abs(shown - bare).max(axis=-1) > 20)
    assert rows.mean() / 3 == pytest.approx(30.0, abs=0.5)
    assert (columns.min() / 3, columns.max() / 3) == pytest.approx((60.0, 69.0), abs=1.0)  # the way of 0.3 s


def test_route_goal_robot_and_tracers_are_where_a_shaken_image_shows_them(session):
    at_rest = session.at(5.0)
    at_rest = replace(at_rest, shift=None, tracers=two_tracers(session, at_rest.stamp_ns))
    off_px = np.array([4.0, -2.0])
    overlay = overlay_of(session)  # one draws both, as in a movie: the layer is drawn anew for the shift alone
    rest, shaken = (
        drawn(overlay, replace(at_rest, shift=shift), at_rest.frame.image.shape)
        for shift in (None, Shift(at_rest.stamp_ns, off_px, found=True, alike=1.0))
    )
    right, down = (3 * off_px).astype(int)
    inside = np.s_[20:-20, 20:-20]
    assert np.abs(shaken - rest)[inside].max() > 50
    assert np.abs(shaken - np.roll(rest, (down, right), (0, 1)))[inside].max() <= 8


def test_odd_sizes_are_made_even_and_deep_images_keep_the_scale_of_their_levels(session, tmp_path):
    ticks = made(shape=(61, 83), bits=12)
    frames, metadata, _ = read(written(mp4.PlainMp4Export(), OfTicks(session, ticks), tmp_path / "x.mp4"))
    notes = json.loads(metadata["description"])
    assert (frames[0].width, frames[0].height, notes["width_px"], notes["height_px"]) == (84, 62, 83, 61)
    low, high = notes["grey_low"], notes["grey_high"]
    assert 0 < low < 800 and 2000 < high < 4095
    assert f"{low} to {high} of 4095" in metadata["comment"]
    luma = frames[2].to_ndarray()[:61, :83].astype(float)
    expected = np.clip((ticks[2].frame.image.astype(float) - low) * 255 / (high - low), 0, 255)
    assert np.abs(luma - expected).mean() < 2.0


@pytest.mark.parametrize("text", ["<script>alert(1)</script>", "\x1b[31mred\x1b[0m \u202eevil"])
def test_a_sample_from_elsewhere_is_a_title_without_control_characters(text, session, tmp_path, monkeypatch):
    config = replace(session.config, recording=replace(session.config.recording, sample=text))
    monkeypatch.setitem(vars(session), "config", config)
    _, metadata, _ = read(written(mp4.Mp4Export(), OfTicks(session, made()), tmp_path / "x.mp4"))
    assert not set(metadata["title"]) & {"\x1b", "\u202e"}
    assert metadata["title"].startswith("golden: ")


def test_a_session_without_images_or_with_regions_only_is_refused_in_one_line(session, tmp_path, monkeypatch):
    monkeypatch.setitem(vars(session), "topics", {})
    with pytest.raises(SessionError, match=r"golden\.mcap"):
        written(mp4.Mp4Export(), session, tmp_path / "x.mp4")
    config = replace(session.config, recording=replace(session.config.recording, region="robot"))
    monkeypatch.setitem(vars(session), "config", config)
    with pytest.raises(SessionError, match="--format mp4"):
        written(mp4.PlainMp4Export(), session, tmp_path / "x.mp4")
