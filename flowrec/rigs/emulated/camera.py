"""An emulated camera: a stream of images on the loopback, which the driver `opencv` takes from a URL without losses.

The stream is YUV4MPEG2 with grey images, as FFmpeg reads and writes it: a line that states size and rate, then for each
image the line FRAME and its pixels. A client gets the images from the moment of its connection on. One that reads too
slowly loses images, as one of a camera does.
"""

from __future__ import annotations

import contextlib
import socket
import threading
from typing import Self

from flowrec.core import Image, Priority, realtime_priority

_HELD = 2  # images that wait for a slow client before others are thrown away


class EmulatedCamera:
    """A server of images; a context manager.

    Parameters
    ----------
    width_px, height_px, rate_hz : of the images.

    Attributes
    ----------
    url : where a client finds it.
    dropped : images that slow clients did not get.
    plugged : False: its cable is pulled, and no image leaves it.
    """

    def __init__(self, width_px: int, height_px: int, rate_hz: float) -> None:
        rate = f"{round(1000 * rate_hz)}:1000"
        self._head = f"YUV4MPEG2 W{width_px} H{height_px} F{rate} Ip A1:1 Cmono XCOLORRANGE=FULL\n".encode()
        self._bytes = width_px * height_px
        self.dropped = 0
        self.plugged = True
        self._server = socket.create_server(("127.0.0.1", 0))
        self.url = f"tcp://127.0.0.1:{self._server.getsockname()[1]}"
        self._clients: list[_Client] = []
        self._thread = threading.Thread(target=self._accept, name="emulated camera", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        with contextlib.suppress(OSError):  # wakes the thread that accepts
            self._server.shutdown(socket.SHUT_RDWR)
        self._server.close()
        self._thread.join()
        for client in self._clients:
            client.close()

    def __call__(self, image: Image) -> None:
        """Send an image to every client."""
        if not self.plugged:
            return
        data = b"FRAME\n" + image.tobytes()
        for client in list(self._clients):
            if not client.alive:
                self._clients.remove(client)
                client.close()
            elif not client.put(data):
                self.dropped += 1

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._server.accept()
            except OSError:  # closed: the end
                return
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _HELD * self._bytes)
            self._clients.append(_Client(connection, self._head))


class _Client:
    """A connection, with a thread that writes the newest images to it."""

    def __init__(self, connection: socket.socket, head: bytes) -> None:
        self.alive = True
        self._connection = connection
        self._waiting: list[bytes] = [head]
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._write, name="emulated camera's client", daemon=True)
        self._thread.start()

    def put(self, data: bytes) -> bool:
        """Hand an image over; False: it is dropped."""
        with self._changed:
            if len(self._waiting) >= _HELD:
                return False
            self._waiting.append(data)
            self._changed.notify()
        return True

    def close(self) -> None:
        """End the thread and the connection."""
        with self._changed:
            self.alive = False
            self._changed.notify()
        with contextlib.suppress(OSError):
            self._connection.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._connection.close()

    @realtime_priority(Priority.GUARDIAN)  # a camera does not wait for the computer's other work
    def _write(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: bool(self._waiting) or not self.alive)
                if not self.alive:
                    return
                data = self._waiting.pop(0)
            try:
                self._connection.sendall(data)
            except OSError:
                self.alive = False
                return
