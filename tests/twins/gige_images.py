"""A GigE Vision camera that shows what stands in a file: `python -m tests.twins.gige_images FILE SERIAL`.

It is the fake camera of Aravis, a library that nobody here wrote, with other pixels. FILE holds the bytes of an image
of the size that the client asks for, and is replaced for the next one. A line on stdout says that it answers.
"""

from __future__ import annotations

import ctypes
import sys
import time
from pathlib import Path

_FILL = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint32, ctypes.c_uint32, ctypes.c_uint32)


def main(file: Path, serial: str, address: str = "127.0.0.1") -> None:
    """Serve until the process is killed."""
    library = ctypes.CDLL("libaravis-0.8.so.0")
    library.arv_buffer_get_data.restype = ctypes.c_void_p
    library.arv_buffer_get_data.argtypes = [ctypes.c_void_p, ctypes.c_void_p]
    library.arv_fake_camera_get_payload.restype = ctypes.c_size_t
    library.arv_fake_camera_get_payload.argtypes = [ctypes.c_void_p]
    library.arv_gv_fake_camera_new.restype = ctypes.c_void_p
    library.arv_gv_fake_camera_get_fake_camera.restype = ctypes.c_void_p
    library.arv_gv_fake_camera_get_fake_camera.argtypes = [ctypes.c_void_p]
    library.arv_fake_camera_set_fill_pattern.argtypes = [ctypes.c_void_p, _FILL, ctypes.c_void_p]

    @_FILL
    def fill(buffer: int, _data: int, _exposure_us: int, _gain: int, _pixel_format: int) -> None:
        image = file.read_bytes()
        size = min(len(image), library.arv_fake_camera_get_payload(camera))
        ctypes.memmove(library.arv_buffer_get_data(buffer, None), image, size)

    server = library.arv_gv_fake_camera_new(address.encode(), serial.encode())
    camera = library.arv_gv_fake_camera_get_fake_camera(server)
    library.arv_fake_camera_set_fill_pattern(camera, fill, None)
    print("ready", flush=True)
    while True:
        time.sleep(3600.0)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
