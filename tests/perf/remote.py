"""Requests, round trips, bytes and time of questions about a session at a URL, to two servers that wait first.

    python -m tests.perf.remote [SESSION] [--latency 0.05] [--gb 10]

Of Starlette's static files under uvicorn, and of moto's S3 server, which take the same number. Without a session: of a
sparse one (large.py), whose images are holes, so that it is not asked for them. Requests, round trips and MB of 82 MB,
8 s of 640 x 512 at 60 Hz: open 1, 1, 0.5; one image 2, 2, 1.0; one second of everything 3, 2, 12.5; all poses 2, 2,
1.3; times of all images 1, 1, 0.5; one field 2, 2, 1.1; info 2, 2, 0.5 (one asks for notes). Of 10 GB, 305 s at 100 Hz:
open 1, 1, 0.5; one second without images 2, 2, 0.5; all poses 2, 2, 1.9; times of all images 2, 2, 1.1.

At least one request is for the end of the file, and one for what is asked for; a second of everything stands in two
places, with its images and in the copies of the state. What is asked for at a time is bounded: the poses of 10 GB whose
state takes 150 MB come 16 MB a request, in parallel. The state at one time of so large a file may be as many ranges as
there are topics that seldom have a message, all in the second round trip.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from pathlib import Path

from tests.perf.large import LOADS, write_sparse
from tests.store.far_questions import QUESTIONS, Trips, ask
from tests.store.s3_server import BUCKET, KEYS, S3Server
from tests.store.static_server import static_server

_OF_IMAGES = ("one image", "one second of everything")


def measure(path: Path, latency_s: float, questions: list[str]) -> None:
    """Print what the answers take."""
    trips = Trips(latency_s)
    with static_server(path.parent, trips.arrive) as url:
        for question in questions:
            print(f"starlette, {question}: {ask(question, f'{url}/{path.name}', trips)}", flush=True)
    if path.stat().st_size > 1 << 30:  # moto holds its objects in memory
        return
    server = S3Server()
    os.environ.update(KEYS | {"AWS_ENDPOINT_URL": server.url})
    server.client.create_bucket(Bucket=BUCKET)
    server.client.upload_file(str(path), BUCKET, path.name)
    server.fault = lambda *_: trips.arrive()
    for question in questions:
        print(f"moto, {question}: {ask(question, f's3://{BUCKET}/{path.name}', trips)}", flush=True)
    server.close()


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("session", type=Path, nargs="?")
    parser.add_argument("--latency", type=float, default=0.05)
    parser.add_argument("--gb", type=float, default=10.0)
    asked = parser.parse_args()
    if asked.session is not None:
        measure(asked.session, asked.latency, list(QUESTIONS))
        return
    with tempfile.TemporaryDirectory(prefix="flowrec-remote-") as made:
        for load in LOADS:
            path = Path(made) / f"{load.width_px}.mcap"
            write_sparse(path, load, asked.gb)
            print(f"{load}: {path.stat().st_size / 1e9:.1f} GB")
            measure(path, asked.latency, [name for name in QUESTIONS if name not in _OF_IMAGES])


if __name__ == "__main__":
    main()
