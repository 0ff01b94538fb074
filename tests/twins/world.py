"""The world of a lab's rig in real time: the simulated microscope and robot, moved by what the coils really did.

Its images go into a folder from which pylon's camera emulator reads them; the currents come from the file in which the
twin of an amplifier notes its outputs. Nothing of the recorder's commands is used: the field that the currents make
turns, and the robot rolls with it.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from flowrec.config import ResolvedConfig
from flowrec.pipeline import Pipeline
from flowrec.rigs.simulated.bodies import Swimmer
from flowrec.rigs.simulated.rig import SimulatedRig
from flowrec.units import NS_PER_S, seconds

Samples = Callable[[], tuple[np.ndarray, np.ndarray]]  # (n,) times in ns of the monotonic clock; (n, 3) currents in A
_FILES = 3  # of the folder; the emulator reads one after the other, and keeps a file in memory where there is only one
_LATE_NS = 5_000_000  # after a moment its samples are in the file
_PIECE_NS = 4_000_000  # during which the robot rolls straight
_FEATURES = """# {{05D8C294-F295-4dfb-9D01-096BD04049F4}}
# GenApi persistence file (version 3.1.0)
Width\t{width}
Height\t{height}
PixelFormat\tMono8
TestImageSelector\tOff
ImageFilename\t{folder}
ImageFileMode\tOn
"""


def turns_of(times_ns: np.ndarray, field_mt: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n,) times and (n, 2) turns until then along x and y, of a field (n, 3) that rolls a robot on the floor.

    B = z cos(theta) + h sin(theta) turns by dtheta = (B x dB)/B^2 about z x h.
    """
    before, after = field_mt[:-1], field_mt[1:]
    cross = np.cross(before, after)
    square = np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
    angle = np.where(
        square > 1e-6, np.arcsin(np.clip(np.linalg.norm(cross, axis=1) / np.maximum(square, 1e-12), 0, 1)), 0.0
    )
    direction = (
        np.stack([cross[:, 1], -cross[:, 0]], axis=1) / np.maximum(np.linalg.norm(cross, axis=1), 1e-12)[:, None]
    )
    turns = np.concatenate([np.zeros((1, 2)), np.cumsum(direction * angle[:, None] / (2.0 * np.pi), axis=0)])
    return times_ns, turns


class TwinWorld(SimulatedRig):
    """A simulated rig whose coils are driven by a twin of an amplifier, at the pace of the host's clock."""

    samples: Samples
    mt_per_a: np.ndarray
    began_ns = 0

    def _advance(self, swimmer: Swimmer, until_ns: int) -> np.ndarray:
        time.sleep(max(0.0, seconds(self.began_ns + until_ns + _LATE_NS - time.monotonic_ns())))
        times_ns, currents = self.samples()
        turns = np.zeros(2)
        if not currents.any():  # the robot is let go when the coils hold it
            return turns
        field = currents @ self.mt_per_a.T
        times, rolled = turns_of(times_ns - self.began_ns, field)
        ends = np.append(np.arange(self._now_ns, until_ns, _PIECE_NS)[1:], until_ns)
        begin = self._now_ns
        for end in ends.tolist():
            both = np.stack([np.interp([begin, end], times, rolled[:, axis]) for axis in (0, 1)], axis=1)
            step, lasts_s = both[1] - both[0], (end - begin) / NS_PER_S
            if lasts_s > 0.0:
                on = float(np.linalg.norm(step) > 0.0)
                swimmer.advance(lasts_s, float(np.linalg.norm(step)) / lasts_s, float(np.arctan2(step[1], step[0])), on)
            turns += step
            begin = end
        return turns


@contextmanager
def live_images(
    pipeline: Pipeline, config: ResolvedConfig, samples: Samples, folder: Path
) -> Iterator[tuple[Path, list[np.ndarray]]]:
    """The world while it runs; yields pylon's feature file for its images, and the robot's true positions so far."""
    images, drafts = folder / "images", folder / "drafts"  # the emulator reads every file of its folder
    images.mkdir()
    drafts.mkdir()
    world = TwinWorld.of(pipeline, config)
    world.samples, world.mt_per_a = samples, np.array(config.coils.mt_per_a)
    positions: list[np.ndarray] = []
    over, begun = threading.Event(), threading.Event()

    def show(image: np.ndarray) -> None:
        data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
        for number in range(_FILES):
            draft = drafts / f"{number}.png"
            draft.write_bytes(data)
            draft.replace(images / f"{number}.png")

    def run() -> None:
        world.began_ns = time.monotonic_ns()
        for inputs in world.inputs():
            show(inputs.frame.image)
            positions.append(inputs.truth.position_um)
            begun.set()
            if over.is_set():
                return

    thread = threading.Thread(target=run, name="world", daemon=True)
    thread.start()
    begun.wait(60.0)
    features = folder / "camera.pfs"
    features.write_text(
        _FEATURES.format(width=config.camera.width_px, height=config.camera.height_px, folder=images), encoding="utf-8"
    )
    try:
        yield features, positions
    finally:
        over.set()
        thread.join()
