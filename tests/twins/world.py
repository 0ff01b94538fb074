"""The world of a lab's rig in real time: the simulated microscope and robot, moved by what the coils really did.

Its images go to a twin of a camera; the currents come from the file in which the twin of an amplifier notes its
outputs. Nothing of the recorder's commands is used: the field that the currents make turns, and the robot rolls with
it.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from flowrec.core.declarations import Image
from flowrec.core.messages import FlowField, Truth
from flowrec.core.system.processes import Priority, realtime_priority
from flowrec.core.units import NS_PER_S, seconds
from flowrec.rigs.simulated.bodies import Swimmer
from flowrec.rigs.simulated.rig import SimulatedRig
from flowrec.stages.config import ResolvedConfig
from flowrec.stages.pipeline import Pipeline
from tests.twins.coils import Device

_FILES = 3  # of the folder; the emulator reads one after the other, and keeps a file in memory where there is only one
_LATE_NS = 5_000_000  # after a moment its samples are in the file
_PIECE_NS = 25_000_000  # during which the robot rolls straight; shorter ones show the delays of a twin as fast turns
_KEPT_NS = 1_000_000_000
_FEATURES = """# {{05D8C294-F295-4dfb-9D01-096BD04049F4}}
# GenApi persistence file (version 3.1.0)
Width\t{width}
Height\t{height}
PixelFormat\tMono8
TestImageSelector\tOff
ImageFilename\t{folder}
ImageFileMode\tOn
"""


class Rolled:
    """How far the field has rolled a robot on the floor, by the outputs of a twin as they come.

    B = z cos(theta) + h sin(theta) turns by dtheta = (B x dB)/B^2 about z x h.

    Attributes
    ----------
    energised : whether there has been a field.
    times_ns, turns : (n,) and (n, 2), of the last second and more; the turns until then along x and y.
    """

    def __init__(self, coils: Device, mt_per_a: np.ndarray) -> None:
        self.energised = False
        self.times_ns, self.turns = np.zeros(1, np.int64), np.zeros((1, 2))
        self._coils, self._mt_per_a, self._field = coils, mt_per_a, np.zeros((1, 3))
        self._byte = coils.end()

    def take(self) -> None:
        """Take in what has been put out since the last call."""
        times_ns, currents = self._coils.outputs(self._byte)
        if not len(times_ns):
            return
        self._byte += len(times_ns) * self._coils.sample_bytes
        self.energised |= bool(currents.any())
        field = np.concatenate([self._field, currents @ self._mt_per_a.T])
        before, after = field[:-1], field[1:]
        cross = np.cross(before, after)
        sine, square = np.linalg.norm(cross, axis=1), np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
        angle = np.where(square > 1e-6, np.arcsin(np.clip(sine / np.maximum(square, 1e-12), 0, 1)), 0.0)
        direction = np.stack([cross[:, 1], -cross[:, 0]], axis=1) / np.maximum(sine, 1e-12)[:, None]
        turns = self.turns[-1] + np.cumsum(direction * angle[:, None] / (2.0 * np.pi), axis=0)
        kept = self.times_ns > times_ns[-1] - _KEPT_NS
        kept[-1] = True
        self.times_ns = np.concatenate([self.times_ns[kept], times_ns])
        self.turns = np.concatenate([self.turns[kept], turns])
        self._field = field[-1:]

    def until(self, at_ns: np.ndarray) -> np.ndarray:
        """Turns (m, 2) until these times."""
        return np.stack([np.interp(at_ns, self.times_ns, self.turns[:, axis]) for axis in (0, 1)], axis=1)


class TwinWorld(SimulatedRig):
    """A simulated rig whose coils are driven by a twin of an amplifier, at the pace of the host's clock."""

    rolled: Rolled
    began_ns = 0

    @property
    def true_field(self) -> FlowField:
        """The flow in which the robot swims."""
        return self.true_world().field

    def _advance(self, swimmer: Swimmer, until_ns: int) -> np.ndarray:
        time.sleep(max(0.0, seconds(self.began_ns + until_ns + _LATE_NS - time.monotonic_ns())))
        self.rolled.take()
        ends = np.append(np.arange(self._now_ns, until_ns, _PIECE_NS), until_ns)
        if not self.rolled.energised or len(ends) < 2:  # the robot is let go when the coils hold it
            return np.zeros(2)
        turns = self.rolled.until(ends + self.began_ns)
        for lasts_s, (x, y) in zip(np.diff(ends) / NS_PER_S, np.diff(turns, axis=0), strict=True):
            turned = float(np.hypot(x, y))
            swimmer.advance(float(lasts_s), turned / float(lasts_s), float(np.arctan2(y, x)), float(turned > 0.0))
        return turns[-1] - turns[0]


@contextmanager
def live_world(
    pipeline: Pipeline, config: ResolvedConfig, coils: Device, show: Callable[[Image], None]
) -> Iterator[tuple[TwinWorld, list[Truth]]]:
    """The world while it runs, from its first image on; yields it, and the truth of its images so far."""
    world = TwinWorld.of(pipeline, config)
    world.rolled = Rolled(coils, np.array(config.coils.mt_per_a))
    truths: list[Truth] = []
    over, begun = threading.Event(), threading.Event()

    def run() -> None:
        with realtime_priority(Priority.GUARDIAN):  # a world does not wait for the computer's other work
            world.began_ns = time.monotonic_ns()
            for inputs in world.inputs():
                assert inputs.frame is not None and inputs.truth is not None
                show(inputs.frame.image)
                truths.append(inputs.truth)
                begun.set()
                if over.is_set():
                    return

    _ = world.true_field  # solved before the clock of the world begins
    thread = threading.Thread(target=run, name="world", daemon=True)
    thread.start()
    assert begun.wait(60.0), "the world has begun"
    try:
        yield world, truths
    finally:
        over.set()
        thread.join()


class EmulatedView:
    """Where pylon's emulator finds the latest image.

    Attributes
    ----------
    sets : settings of a recorder.
    """

    def __init__(self, folder: Path, config: ResolvedConfig) -> None:
        # The emulator reads every file of its folder, so that a file is written beside it first.
        self._images, self._drafts = folder / "images", folder / "drafts"
        for made in (self._images, self._drafts):
            made.mkdir()
        width, height = config.camera.width_px, config.camera.height_px
        features = folder / "camera.pfs"
        features.write_text(_FEATURES.format(width=width, height=height, folder=self._images), encoding="utf-8")
        self.sets = ("lab.camera=pylon", f'lab.device_config="{features}"')

    def __call__(self, image: Image) -> None:
        """Show an image from now on."""
        data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
        for number in range(_FILES):
            draft = self._drafts / f"{number}.png"
            draft.write_bytes(data)
            draft.replace(self._images / f"{number}.png")


class FileView:
    """Where gige_images.py finds the latest image: `file`."""

    sets = ("lab.camera=genicam",)

    def __init__(self, folder: Path) -> None:
        self.file = folder / "image.raw"
        self._draft = folder / "image.draft"

    def __call__(self, image: Image) -> None:
        """Show an image from now on."""
        self._draft.write_bytes(image.tobytes())
        self._draft.replace(self.file)
