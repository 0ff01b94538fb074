"""OpenCV: a movie file, and a stream of JPEG images over HTTP, as a network camera sends it."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import cv2
import numpy as np
import pytest

from flowrec.core import RigError
from flowrec.rigs import Wanted
from flowrec.rigs.lab.cameras.grabber import Grabber
from flowrec.rigs.lab.cameras.opencv import OpencvCamera
from tests.rigs.lab.cameras.watching import absent, adds_up, frames_of

WANTED = Wanted(width_px=64, height_px=48, rate_hz=50.0)


def picture(level: int) -> np.ndarray:
    return np.full((48, 64), level, np.uint8)


@contextmanager
def network_camera(port: int = 0) -> Iterator[int]:
    """A camera that sends one JPEG image after another; yields its port."""
    over = threading.Event()

    class Stream(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=next")
            self.end_headers()
            level = 0
            while not over.wait(0.02):
                data = cv2.imencode(".jpg", picture(40 + level % 100))[1].tobytes()
                head = f"--next\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
                try:
                    self.wfile.write(head.encode() + data + b"\r\n")
                except OSError:
                    return
                level += 1

        def log_message(self, *_: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", port), Stream) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        try:
            yield server.server_port
        finally:
            over.set()
            server.shutdown()
            thread.join()


def test_a_movie_is_played_at_the_rate_and_its_images_are_grey_as_they_are(tmp_path: Path) -> None:
    path = tmp_path / "movie.avi"
    movie = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"FFV1"), 25.0, (64, 48), False)
    for level in range(20):
        movie.write(picture(10 * level))
    movie.release()
    wanted = replace(WANTED, device=str(path))
    before_ns = time.monotonic_ns()
    with Grabber(lambda: OpencvCamera.of(wanted), wanted) as grabber:
        frames = frames_of(grabber, 20)
    assert [int(frame.image[20, 30]) for frame in frames] == [10 * level for level in range(20)]
    assert all((frame.image == frame.image[0, 0]).all() for frame in frames)
    assert all(frame.arrival_ns >= before_ns + 20_000_000 * frame.index for frame in frames)  # never before its time
    assert "does not number its images" in " ".join(grabber.notes)


def test_a_network_camera_that_is_gone_is_opened_again() -> None:
    with network_camera() as port:
        wanted = replace(WANTED, device=f"http://127.0.0.1:{port}/")
        grabber = Grabber(lambda: OpencvCamera.of(wanted), wanted)
        grabber.__enter__()
        first = frames_of(grabber, 5)
    assert "gone" in absent(grabber)
    with network_camera(port):
        second = frames_of(grabber, 5)
        grabber.close()
    assert second[0].index > first[-1].index and second[-1].losses.reconnections == 1 and adds_up(second[-1].losses)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"device": "missing.avi"}, "no such file; opencv takes a number, a file or a URL"),
        ({"device": "99"}, "no camera answers at 99"),
        ({"device": "http://127.0.0.1:9/"}, "no camera answers at http://127.0.0.1:9/"),
        ({"trigger": "Line1"}, "opencv knows no trigger"),
    ],
)
def test_what_can_not_be_opened_is_one_line(change: dict[str, object], complaint: str) -> None:
    with pytest.raises(RigError) as raised:
        OpencvCamera.of(replace(WANTED, **change)).open()  # type: ignore[arg-type]
    assert complaint in str(raised.value) and "\n" not in str(raised.value)


def test_a_driver_that_refuses_its_settings_is_told_before_the_camera_could_have_answered() -> None:
    wanted = replace(WANTED, pixel_format="BayerRG8")
    began_s = time.monotonic()
    with pytest.raises(RigError, match="Mono8"), Grabber(lambda: OpencvCamera.of(wanted), wanted):
        pass
    assert time.monotonic() < began_s + 10.0  # the grabber gives a camera 20 s to answer


def test_another_size_or_colours_are_said(tmp_path: Path) -> None:
    path = tmp_path / "colour.avi"
    movie = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"FFV1"), 25.0, (64, 48))
    movie.write(np.dstack([picture(10), picture(100), picture(200)]))
    movie.release()
    with pytest.raises(RigError, match="64 x 48"):
        OpencvCamera.of(replace(WANTED, device=str(path), width_px=32)).open()
    camera = OpencvCamera.of(replace(WANTED, device=str(path)))
    assert any("luminance" in note for note in camera.open().notes)
    camera.close()
