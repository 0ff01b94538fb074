"""`python -m tests.perf.segmentation`: chips that `flowrec calibrate chip` makes of pictures: walls, flow, refusals.

Pictures of chips in every look of tests/physics/chip/looks.py, in looks of this file and by the simulated microscope,
in several poses; then pictures without a chip. Of each: accepted or refused, intersection over union with the true
mask, distance of the walls from the true ones, and the error of the flow solved on the chip that was found, between the
openings of the true one, at the same mean speed and at the same flux. `--textures DIR`: pictures (PNG) without a chip.
FLOWREC_REFERENCE_DATA adds real vessels and images.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from flowrec.core import FlowrecError
from flowrec.measure.segmentation import chip_mask, iou, segment
from flowrec.physics import (
    WATER_KG_M3,
    WATER_MPA_S,
    Calibration,
    Chip,
    ChipSettings,
    FlowSolver,
    clearance_um,
    find_openings,
    guess_inlets,
    load_chip,
    sample,
    without_pockets,
)
from flowrec.physics.chip.openings import check_openings
from flowrec.rigs.simulated.microscope import DrawnRobot, Microscope
from flowrec.stages import CameraSettings, SimulatedImage
from tests.physics.chip.looks import LOOKS, Look, picture

MORE_LOOKS = {
    "bright channel, dark walls": Look(channel=0.25, line=-0.5, line_um=25.0, vignette=0.3),
    "dark channel, bright walls": Look(channel=-0.2, line=0.35, line_um=30.0, tilt=0.4, noise=0.04),
    "halo": Look(line=-0.4, line_um=20.0, fringe=0.5, channel=-0.1, vignette=0.3),
    "fluorescence": Look(channel=6.0, blur_px=1.5, noise=0.25, vignette=0.8, bits=12),
    "thin faint lines": Look(line=-0.12, line_um=12.0, noise=0.03, vignette=0.5),
    "text": Look(line=-0.35, noise=0.02, vignette=0.3),
}
POSES = {"as it is": (0.0, 1.0), "turned": (17.0, 0.8), "close": (-40.0, 0.5)}  # angle in degrees, scale


@dataclass(frozen=True)
class Case:
    """A picture (h, w), and the true mask in it at twice its resolution."""

    name: str
    image: NDArray[Any]
    truth: NDArray[np.bool_] | None
    um_per_px: float


def chips() -> list[Chip]:
    found = [load_chip(ChipSettings(name, seed=seed)) for name, seed in
             (("bifurcation", 0), ("vessels", 3), ("vessels", 11), ("vessels", 20))]  # fmt: skip
    data = os.environ.get("FLOWREC_REFERENCE_DATA")
    if data:
        found += [load_chip(ChipSettings(path=f"{data}/vessels/case_{number:02}.npz")) for number in (1, 6)]
        mask = cv2.imread(f"{data}/masks/hrf_12_h.png", cv2.IMREAD_GRAYSCALE)
        small = cv2.resize(mask[600:1700, 1000:2400], (420, 330), interpolation=cv2.INTER_AREA) > 127
        found.append(replace(found[0], name="hrf_12_h", mask=small, um_per_px=15.0))
    return [replace(chip, um_per_px=6400.0 / max(chip.mask.shape)) for chip in found]


def seen_mask(chip: Chip, camera: Calibration, size_px: tuple[int, int]) -> NDArray[np.bool_]:
    """The chip's mask at twice the resolution of a picture."""
    pad = max(chip.mask.shape) // 2
    share = cv2.GaussianBlur(np.pad(chip.mask, pad, mode="edge").astype(np.float32), (0, 0), 0.8)
    matrix = camera.matrix / chip.um_per_px @ np.array([[0.5, 0, -0.25], [0, 0.5, -0.25], [0, 0, 1]])
    matrix[:, 2] += pad
    size = 2 * size_px[0], 2 * size_px[1]
    seen = cv2.warpAffine(share, matrix, size, flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
                          borderMode=cv2.BORDER_REPLICATE)  # fmt: skip
    return np.asarray(seen > 0.5)


def cases(seed: int, longest_px: int, wanted: Callable[[int], bool] = lambda _: True) -> Iterator[Case]:
    count = -1
    for number, chip in enumerate(chips()):
        shape = np.array(chip.mask.shape[::-1])
        width, height = (shape * longest_px / shape.max()).round().astype(int).tolist()
        size = width, height
        for look in (*LOOKS, *MORE_LOOKS, "microscope", "microscope, inverted"):
            count += 1
            if not wanted(count):
                continue
            rng = np.random.default_rng([seed, count])
            pose = list(POSES)[0 if rng.random() < 0.5 else 1 + int(rng.random() < 0.5)]
            angle, scale = POSES[pose]
            um = chip.size_um[0] / width * scale
            centre = np.array(chip.size_um) / 2 - chip.um_per_px / 2
            camera = Calibration.centre_on(um, centre + (rng.uniform(-600, 600, 2) if scale < 1 else 0), size, angle)
            known = LOOKS | MORE_LOOKS
            if look in known:
                image = picture(chip.mask, chip.um_per_px, camera, size, known[look], rng)
            else:
                settings = CameraSettings(*size)
                scope = Microscope(chip.mask, chip.um_per_px, camera, settings, SimulatedImage(), seed + number)
                robot = np.array(camera.to_um((0.4 * width, 0.5 * height)))
                image = scope.image([DrawnRobot(robot, 5 * um)])
                image = 255 - image if "inverted" in look else image
            if look == "text":
                top = int(image.max())
                cv2.putText(image, "t = 12.4 s", (10, 25), cv2.FONT_HERSHEY_SIMPLEX, 0.7, top, 2)
                cv2.rectangle(image, (width - 90, height - 20), (width - 15, height - 14), top, -1)
            yield Case(f"{chip.name}, {look}, {pose}", image, seen_mask(chip, camera, size), um)


def without_chip(seed: int, longest_px: int, folder: Path | None) -> Iterator[Case]:
    """Noise of several grains and laws, shades, textures: nothing of which is a chip."""
    rng = np.random.default_rng(seed)
    shape = round(0.8 * longest_px), longest_px
    y, x = np.mgrid[-1 : 1 : shape[0] * 1j, -1 : 1 : shape[1] * 1j].astype(np.float32)

    def levels(scene: NDArray[Any]) -> NDArray[np.uint8]:
        low, high = np.percentile(scene, (0.2, 99.8))
        return np.clip(20 + 215 * (scene - low) / max(high - low, 1e-6), 0, 255).astype(np.uint8)

    for grain in (0.0, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0):
        noise = rng.standard_normal(shape).astype(np.float32)
        noise = cv2.GaussianBlur(noise, (0, 0), grain) if grain else noise
        yield Case(f"noise of {grain:g} px", levels(noise / noise.std()), None, 10.0)
        lit = (2.0 - x * x - y * y) * (1.0 + 0.05 * noise / noise.std())
        yield Case(f"noise of {grain:g} px in a vignette", levels(lit), None, 10.0)
    spots = np.zeros(shape, np.float32)
    for _ in range(200):
        at = int(rng.uniform(0, shape[1])), int(rng.uniform(0, shape[0]))
        cv2.circle(spots, at, int(rng.uniform(2, 9)), float(rng.uniform(-1, 1)), -1, cv2.LINE_AA)
    yield Case("particles", levels(spots + 0.05 * rng.standard_normal(shape)), None, 10.0)
    scratches = np.zeros(shape, np.float32)
    for _ in range(12):
        ends = rng.uniform(0, longest_px, (2, 2)).astype(int).tolist()
        cv2.line(scratches, ends[0], ends[1], float(rng.uniform(-1, 1)), 2, cv2.LINE_AA)
    yield Case("scratches", levels(scratches + 0.1 * rng.standard_normal(shape)), None, 10.0)
    yield Case("flat", np.full(shape, 120, np.uint8), None, 10.0)
    yield Case("gradient", levels(x + 0.02 * rng.standard_normal(shape)), None, 10.0)
    data = os.environ.get("FLOWREC_REFERENCE_DATA")
    files = [Path(data) / "movies" / name for name in ("bulk_water/000.png", "brightfield/000.png")] if data else []
    for file in (*files, *(sorted(folder.glob("*.png")) if folder else [])):
        grey = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        if grey is not None:
            factor = longest_px / max(grey.shape)
            yield Case(f"{file.parent.name}/{file.stem}", cv2.resize(grey, None, fx=factor, fy=factor), None, 10.0)


def solved(mask: NDArray[np.bool_], um_per_px: float, openings: Any) -> tuple[Any, Chip]:
    chip = without_pockets(Chip("found", mask, um_per_px, openings, WATER_MPA_S, WATER_KG_M3))
    return FlowSolver().solve(chip), chip


def flow_error(case: Case, mask: NDArray[np.bool_], um_per_px: float, flux: bool = False) -> float | str:
    """Relative error of the flow on a mask, at the same mean speeds or fluxes; or why there is none."""
    assert case.truth is not None
    true_openings = guess_inlets(find_openings(case.truth))
    true_um = case.um_per_px / 2
    height, width = case.truth.shape
    factor, found = um_per_px / true_um, []
    for o in find_openings(mask):
        along = (height, mask.shape[0]) if o.side in ("left", "right") else (width, mask.shape[1])
        shift = 0.5 * (along[0] - along[1] * factor)
        a, b = o.first * factor + shift, (o.last + 1) * factor + shift
        fits = [
            t for t in true_openings if t.side == o.side and min(b, t.last + 1) - max(a, t.first) > 0.5 * t.width_px
        ]
        if len(fits) == 1:
            speed = fits[0].value * (fits[0].width_px / (o.width_px * factor) if flux else 1.0)
            found.append(replace(o, kind=fits[0].kind, value=speed))
    if len(found) != len(true_openings) or len(find_openings(mask)) != len(found):
        return "openings"
    try:
        check_openings(mask, tuple(found), "")
        truth, true_chip = solved(case.truth, true_um, true_openings)
        ours, _ = solved(mask, um_per_px, tuple(found))
    except FlowrecError as error:
        return str(error)[:80]
    y, x = np.mgrid[1:height:3, 1:width:3]
    at = np.stack((x, y), -1)[true_chip.mask[y, x]].astype(np.float64)
    middle = (np.array((width, height)) - 1) / 2
    off = (np.array(mask.shape[::-1]) - 1) / 2
    one, other = sample(truth, at * true_um), sample(ours, ((at - middle) / factor + off) * um_per_px)
    return float(np.sqrt(np.sum((one - other) ** 2) / np.sum(one**2)))


def compared(case: Case, mask: NDArray[np.bool_], um_per_px: float, flow: bool) -> dict[str, Any]:
    """Errors of a mask that lies over the picture's centre."""
    assert case.truth is not None
    height, width = case.truth.shape
    scale = case.um_per_px / 2 / um_per_px
    matrix = np.array([[scale, 0, (mask.shape[1] - 1) / 2 - scale * (width - 1) / 2],
                       [0, scale, (mask.shape[0] - 1) / 2 - scale * (height - 1) / 2]])  # fmt: skip
    blurred = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 0.7)
    fine = cv2.warpAffine(blurred, matrix, (width, height), flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
                          borderMode=cv2.BORDER_REPLICATE) > 0.5  # fmt: skip
    truth = case.truth
    overlap = iou(fine, truth)
    row: dict[str, Any] = {"iou": round(overlap, 4)}
    if overlap > 0.5:
        away = clearance_um(truth, 0.5)  # picture pixels, positive in fluid
        edge = np.abs(clearance_um(fine, 0.5)) < 0.5
        near = np.clip(away[edge] - clearance_um(fine, 0.5)[edge], -5, 5)
        row |= {"wall_px": round(float(np.sqrt(np.mean(near**2))), 3), "bias_px": round(float(-near.mean()), 3)}
        if flow:
            error = flow_error(case, mask, um_per_px)
            row["flow"] = round(100 * error, 2) if isinstance(error, float) else error
            error = flow_error(case, mask, um_per_px, True) if isinstance(error, float) else error
            row["flow_at_flux"] = round(100 * error, 2) if isinstance(error, float) else error
    return row


def measure(case: Case, flow: bool = True) -> dict[str, Any]:
    began = time.process_time()
    row: dict[str, Any] = {"case": case.name}
    try:
        found = segment(case.image)
    except FlowrecError as error:
        return row | {"refused": str(error)[:100], "cpu_s": round(time.process_time() - began, 2)}
    row |= {"shown": found.shown, **{k: round(float(v), 3) for k, v in found.figures.items()}}
    mask, um = chip_mask(found, case.um_per_px)
    row["cpu_s"] = round(time.process_time() - began, 2)
    row["mask"] = list(mask.shape)
    if case.truth is not None:
        row |= compared(case, mask, um, flow)
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--longest", type=int, default=480, help="longest side of the pictures, px")
    parser.add_argument("--every", type=int, default=1, help="only every N-th case")
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--textures", type=Path, help="folder of pictures (PNG) without a chip")
    parser.add_argument("--only", default="", help="only cases whose name contains this")
    parser.add_argument("--refusals", action="store_true", help="only pictures without a chip")
    parser.add_argument("--no-flow", action="store_true", help="masks only")
    asked = parser.parse_args()
    made = cases(asked.seed, asked.longest, lambda number: number % asked.every == asked.first)
    others = list(without_chip(asked.seed, asked.longest, asked.textures))[asked.first :: asked.every]
    for case in itertools.chain(() if asked.refusals else made, others):
        if asked.only in case.name:
            print(json.dumps(measure(case, not asked.no_flow)), flush=True)


if __name__ == "__main__":
    main()
