"""Instruments and a hand at emulated devices: a Hall probe, an ammeter, and the cable of the camera."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from flowrec.core import coil_names, seconds
from flowrec.rigs.emulated.camera import EmulatedCamera
from flowrec.rigs.emulated.coils import OutputSamples
from flowrec.stages import Coils

_PROBE_MT = 0.02  # noise of a reading, one sigma
_STEADY_S = 0.5  # at zero for so long: the current is gone
_POLL_S = 0.02
_TAIL = 100_000  # of the newest samples, which are seconds of a field that turns


class EmulatedInstruments:
    """Readings that a person takes at emulated devices, and the cable that a person pulls.

    Parameters
    ----------
    samples : of the outputs of the amplifier.
    camera : whose cable is pulled.
    coils : as they truly are.
    """

    def __init__(self, samples: OutputSamples, camera: EmulatedCamera, coils: Coils) -> None:
        self._samples, self._camera, self._coils = samples, camera, coils

    def field_table(self, file: Path) -> None:
        """Write what a Hall probe reads, as `flowrec calibrate coils` takes it: each coil alone, twice, both ways."""
        names = coil_names(self._coils.count)
        level_a = 0.5 * self._coils.max_current_a
        currents = np.concatenate([sign * level_a * np.eye(len(names)) for sign in (1.0, -1.0)] * 2)
        field = currents @ np.array(self._coils.mt_per_a).T + np.array(self._coils.bias_mt)
        field += np.random.default_rng(1).normal(0.0, _PROBE_MT, field.shape)
        head = ",".join([*(f"i_{name}_a" for name in names), "b_x_mt", "b_y_mt", "b_z_mt"])
        rows = [",".join(f"{value:.4f}" for value in row) for row in np.concatenate([currents, field], axis=1)]
        file.write_text("\n".join([head, *rows]) + "\n", encoding="utf-8")

    def zero_after_s(self, since_ns: int, within_s: float) -> float:
        """Time from a moment on the monotonic clock until no coil has a current any more; inf: not within that time."""
        samples = self._samples
        while True:
            times_ns, currents = samples.outputs(max(samples.end() - _TAIL * samples.sample_bytes, 0))
            on = np.flatnonzero(currents.any(axis=1))
            now_ns = time.monotonic_ns()
            ended = not len(on) or on[-1] + 1 < len(times_ns)
            last_ns = 0 if not len(on) else int(times_ns[on[-1] + 1]) if ended else now_ns
            if ended and seconds(now_ns - max(last_ns, since_ns)) > _STEADY_S:
                return max(seconds(last_ns - since_ns), 0.0)
            if seconds(now_ns - since_ns) > within_s:
                return float("inf")
            time.sleep(_POLL_S)

    def pull_cable(self, *, pulled: bool) -> None:
        """Pull the cable of the camera, or plug it in again."""
        self._camera.plugged = not pulled
