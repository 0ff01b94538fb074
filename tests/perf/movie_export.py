"""Frame rate of the movie formats over that of PyAV alone with the same preset, and the memory of an export.

    python -m tests.perf.movie_export [SESSION] [--times 3]

PyAV alone encodes the same images from memory, with the preset and quality of the format. Each is done in turn, because
the load of a machine changes, and the medians are compared.

On two cores that were shared with other work, 1001 images of 640 x 512: mp4 0.89 of PyAV alone (75 and 84 frames/s), by
CPU time 0.87; mp4_plain 0.83 and 0.76.
"""

from __future__ import annotations

import argparse
import resource
import statistics
import tempfile
import time
from pathlib import Path

import av
import numpy as np

import flowrec
from flowrec.exports import mp4
from flowrec.exports.camera_images import GreyScale, first_frame, with_images


def bare(images: list[np.ndarray], options: dict[str, str], out: Path) -> tuple[float, float]:
    """Images per second of PyAV alone, by the clock and of CPU time."""
    began_s, began_cpu_s = time.perf_counter(), time.process_time()
    with av.open(str(out), "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=30, options=options)
        stream.height, stream.width = images[0].shape
        stream.pix_fmt = "yuv420p"
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, "gray")))
        container.mux(stream.encode(None))
    return len(images) / (time.perf_counter() - began_s), len(images) / (time.process_time() - began_cpu_s)


def exported(session: Path, exporter: type, out: Path) -> tuple[float, float]:
    """The same of a format, from the file of the session to its own file."""
    opened = flowrec.open(session)
    began_s, began_cpu_s = time.perf_counter(), time.process_time()
    exporter().write(opened, out, lambda _: None)
    count = opened.topics["/camera/frame"]
    return count / (time.perf_counter() - began_s), count / (time.process_time() - began_cpu_s)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("session", type=Path, nargs="?")
    parser.add_argument("--times", type=int, default=3)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        session = asked.session
        if session is None:
            session = Path(folder) / "s.mcap"
            flowrec.record(flowrec.load_config(None, ["duration_s=20"]), session)
        out = Path(folder) / "x.mp4"
        first = first_frame(flowrec.open(session))
        grey = GreyScale.of(flowrec.open(session), first)
        images = [grey(frame.image).copy() for _, frame in with_images(flowrec.open(session))]
        for exporter, crf in ((mp4.Mp4Export, mp4.DRAWN_CRF), (mp4.PlainMp4Export, mp4.PLAIN_CRF)):
            options = {"preset": mp4.PRESET, "crf": str(crf)}
            rates = [(exported(session, exporter, out), bare(images, options, out)) for _ in range(asked.times)]
            for number, what in enumerate(("frames/s", "frames per s of CPU time")):
                ours, alone = (statistics.median(each[place][number] for each in rates) for place in (0, 1))
                print(f"{exporter.__name__}: {ours:.0f} {what}, PyAV alone {alone:.0f}: {ours / alone:.2f}", flush=True)
    most_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    print(f"most memory, the images for PyAV alone included: {most_mb:.0f} MB")


if __name__ == "__main__":
    main()
