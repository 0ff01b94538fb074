"""Disk space and CPU time of a long recording, with whole images and with regions around the robot."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from flowrec.core import progress
from flowrec.physics import load_chip
from flowrec.stages import load_config
from flowrec.stages.resolve import resolve
from flowrec.store import SessionWriter, WriterOptions
from flowrec.store.roi import Region
from flowrec.store.session_writer import region_of
from tests.perf.store_writers import made_up_header, pictures, ticks_of

_CAMERAS = ((640, 512, 100.0), (2448, 2048, 60.0))
_ENCODINGS = ("raw", "zstd", "delta")


def regions(folder: Path, seconds: float = 10.0) -> list[dict[str, Any]]:
    """A row per camera, encoding and region: MB per minute, and the CPU time of recording over the duration.

    The windows are those of a robot in sight on the built-in chip, with an image whole every ten seconds.
    """
    rows = []
    with progress("recording", len(_CAMERAS) * len(_ENCODINGS) * 2) as done:
        for width, height, rate_hz in _CAMERAS:
            images = pictures(width, height)
            region, roi = _window(width, height, rate_hz)
            for encoding in _ENCODINGS:
                for kept in (None, region):
                    rows.append(_row(folder / "region.mcap", images, rate_hz, seconds, encoding, kept, roi))
                    done(len(rows))
    return rows


def _row(
    path: Path, images: Any, rate_hz: float, seconds: float, encoding: str, region: Region | None, roi: Any
) -> dict[str, Any]:
    height, width = images[0].shape
    count = round(seconds * rate_hz)
    began = time.process_time()
    with SessionWriter(path, made_up_header(), WriterOptions(frames=encoding, block=True, region=region)) as writer:
        for tick in ticks_of(images, count, rate_hz):
            assert tick.track is not None
            writer.write(replace(tick, track=replace(tick.track, roi_px=roi)))
    cpu_s = time.process_time() - began
    size = path.stat().st_size
    path.unlink()
    return {
        "camera": f"{width}x{height} at {rate_hz:g} Hz",
        "encoding": encoding,
        "region": "whole" if region is None else "robot",
        "mb_per_minute": 60.0 * size / 1e6 / seconds,
        "cores": cpu_s / seconds,
    }


def _window(width: int, height: int, rate_hz: float) -> tuple[Region, Any]:
    """The recorded region around a robot in the middle of the image of a default run, and the tracker's search area."""
    sets = [f"camera.width_px={width}", f"camera.height_px={height}", f"camera.rate_hz={rate_hz}"]
    config = load_config(None, [*sets, "recording.region=robot"])
    chip = load_chip(config.chip)
    config = resolve(config, chip)
    region = region_of(config, chip)
    assert region is not None
    tracker, px = config.tracker, config.camera.um_per_px
    drift_px = tracker.reach_speed * config.robot.speed_limit_um_s / rate_hz / px
    reach_px = max(tracker.search_radii * config.robot.radius_um / px + drift_px, tracker.search_px)
    middle = np.array([width / 2, height / 2, width / 2, height / 2])
    return region, np.rint(middle + reach_px * np.array([-1.0, -1.0, 1.0, 1.0]))
