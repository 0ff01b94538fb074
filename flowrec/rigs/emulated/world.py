"""The world of emulated devices in real time: the simulated microscope and robot, moved by what the coils really did.

Its images go to an emulated camera; the currents come from the file in which an emulated amplifier notes its outputs.
Nothing of the recorder's commands is used: the field that the currents make turns, and the robot rolls with it.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np

from flowrec.core import (
    NS_PER_S,
    Floats,
    FlowField,
    Image,
    Ints,
    Priority,
    RigError,
    Truth,
    nanoseconds,
    realtime_priority,
    seconds,
)
from flowrec.rigs.emulated.coils import OutputSamples
from flowrec.rigs.simulated.bodies import Swimmer
from flowrec.rigs.simulated.rig import SimulatedRig
from flowrec.stages import Pipeline, ResolvedConfig

_LATE_NS = 5_000_000  # so long after a moment its samples are in the file
_PIECE_NS = 25_000_000  # during which the robot rolls straight; shorter ones show the delays of a board as fast turns
_KEPT_NS = NS_PER_S
_BEGIN_S = 60.0  # for the first image


class Rolled:
    """Turns by which the field has rolled a robot on the floor, by the outputs of an amplifier as they come.

    B = z cos(theta) + h sin(theta) turns by dtheta = (B x dB)/B^2 about z x h.

    Attributes
    ----------
    energised : whether there has been a field.
    times_ns, turns : (n,) and (n, 2), of the last second and more; the turns until then along x and y.
    """

    def __init__(self, samples: OutputSamples, mt_per_a: Floats) -> None:
        self.energised = False
        self.times_ns, self.turns = np.zeros(1, np.int64), np.zeros((1, 2))
        self._samples, self._mt_per_a, self._field = samples, mt_per_a, np.zeros((1, 3))
        self._byte = samples.end()

    def take(self) -> None:
        """Take in what has been put out since the last call."""
        times_ns, currents = self._samples.outputs(self._byte)
        if not len(times_ns):
            return
        self._byte += len(times_ns) * self._samples.sample_bytes
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

    def until(self, at_ns: Ints) -> Floats:
        """Turns (m, 2) until these times."""
        return np.stack([np.interp(at_ns, self.times_ns, self.turns[:, axis]) for axis in (0, 1)], axis=1)

    def off_s(self, now_ns: int) -> float:
        """For how long the outputs have been zero; 0: they are not."""
        return 0.0 if self._field.any() else seconds(now_ns - int(self.times_ns[-1]))

    def let_go(self) -> None:
        """There is no field, as if there had been none."""
        self.energised = False


class EmulatedWorld(SimulatedRig):
    """A simulated rig whose coils are driven by an emulated amplifier, at the pace of the host's clock.

    Attributes
    ----------
    rolled : of the amplifier.
    began_ns : stamp 0 on the host's monotonic clock.
    again_after_s : time without a field after which the robot is put back to its start; None: never.
    """

    rolled: Rolled
    began_ns = 0
    again_after_s: float | None = None

    @property
    def true_field(self) -> FlowField:
        """The flow in which the robot swims."""
        return self.true_world().field

    def _advance(self, swimmers: Sequence[Swimmer], until_ns: int) -> Floats:
        time.sleep(max(0.0, seconds(self.began_ns + until_ns + _LATE_NS - time.monotonic_ns())))
        rolled = self.rolled
        rolled.take()
        again_s = self.again_after_s
        if rolled.energised and again_s is not None and rolled.off_s(self.began_ns + until_ns) > again_s:
            rolled.let_go()
            swimmers[0].position_um, swimmers[0].gone = np.array(self._start_um), False
        ends = np.append(np.arange(self._now_ns, until_ns, _PIECE_NS), until_ns)
        if not rolled.energised or len(ends) < 2:  # the robot is let go when the coils hold it
            return np.zeros(2)
        turns = rolled.until(ends + self.began_ns)
        for lasts_s, (x, y) in zip(np.diff(ends) / NS_PER_S, np.diff(turns, axis=0), strict=True):
            turned = float(np.hypot(x, y))
            for swimmer in swimmers:
                swimmer.advance(float(lasts_s), turned / float(lasts_s), float(np.arctan2(y, x)), float(turned > 0.0))
        return turns[-1] - turns[0]


@contextmanager
def emulated_world(
    pipeline: Pipeline,
    config: ResolvedConfig,
    samples: OutputSamples,
    show: Callable[[Image], None],
    camera_delay_s: float = 0.0,
    again_after_s: float | None = None,
) -> Iterator[tuple[EmulatedWorld, list[Truth]]]:
    """The world while it runs, from its first image on; yields it, and the truth of its images so far.

    Raises RigError: it has not begun.

    Parameters
    ----------
    show : takes each image.
    camera_delay_s : from the end of an exposure to `show`; an image that is made later is shown at once.
    again_after_s : see EmulatedWorld; the truth is then not kept, because the world may run for days.
    """
    world = EmulatedWorld.of(pipeline, config)
    world.rolled = Rolled(samples, np.array(config.coils.mt_per_a))
    world.again_after_s = again_after_s
    truths: list[Truth] = []
    over, begun = threading.Event(), threading.Event()
    late_ns = nanoseconds(0.5 * config.camera.exposure_s + camera_delay_s) if camera_delay_s else 0

    def run() -> None:
        with realtime_priority(Priority.GUARDIAN):  # a world does not wait for the computer's other work
            world.began_ns = time.monotonic_ns()
            for inputs in world.inputs():
                assert inputs.frame is not None and inputs.truth is not None
                if late_ns:
                    time.sleep(max(0.0, seconds(world.began_ns + inputs.stamp_ns + late_ns - time.monotonic_ns())))
                show(inputs.frame.image)
                if again_after_s is None:
                    truths.append(inputs.truth)
                begun.set()
                if over.is_set():
                    return

    _ = world.true_field  # solved before the clock of the world begins
    thread = threading.Thread(target=run, name="world", daemon=True)
    thread.start()
    if not begun.wait(_BEGIN_S):
        raise RigError(f"the emulated world has shown no image in {_BEGIN_S:g} s; is this computer too busy?")
    try:
        yield world, truths
    finally:
        over.set()
        thread.join()
