"""`python -m tests.perf.registration`: errors of `flowrec calibrate image` over chips, transformations and looks.

Every look of tests/physics/chip/looks.py and the simulated microscope, as it is and inverted, meets every
transformation; chips and textures change from case to case. Then pictures that do not show the chip: how many are
refused.

FLOWREC_REFERENCE_DATA adds real vessels to the chips, and real images as textures (also `--textures DIR`).
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from flowrec.core import ChipError
from flowrec.measure.picture_registration import register
from flowrec.physics import Calibration, Chip, ChipSettings, load_chip
from flowrec.rigs.simulated.microscope import DrawnRobot, Microscope
from flowrec.stages import CameraSettings, SimulatedImage
from tests.physics.chip.looks import LOOKS, picture

SIZE_PX, ABOUT_UM, CHIP_UM = (640, 512), 10.0, 20.0
# Turn in degrees, mirror, shift in um, scale.
TRANSFORMATIONS: dict[str, tuple[float, bool, float, float]] = {
    "as assumed": (0.0, False, 0.0, 1.0),
    "2 degrees": (2.0, False, 0.0, 1.0),
    "90 degrees": (90.0, False, 0.0, 1.0),
    "180 degrees": (180.0, False, 0.0, 1.0),
    "mirrored": (0.0, True, 0.0, 1.0),
    "shifted 300 um": (0.0, False, 300.0, 1.0),
    "scale + 3 %": (0.0, False, 0.0, 1.03),
    "scale - 3 %": (0.0, False, 0.0, 0.97),
    "all": (37.0, True, 300.0, 1.03),
    "half in view": (-63.0, False, 600.0, 0.6),
}


@dataclass(frozen=True)
class Case:
    look: str
    transformation: str
    chip: Chip
    truth: Calibration
    image: np.ndarray
    seed: int

    @property
    def about_um(self) -> float:
        """um per pixel as a person would state it before."""
        return ABOUT_UM * (0.6 if self.transformation == "half in view" else 1.0)


def chips() -> list[Chip]:
    found = [load_chip(ChipSettings("vessels", seed=seed)) for seed in range(6)] + [load_chip(ChipSettings())]
    data = os.environ.get("FLOWREC_REFERENCE_DATA")
    if data:
        for number in (0, 4, 7):
            found.append(replace(load_chip(ChipSettings(path=f"{data}/vessels/case_{number:02}.npz")), um_per_px=50.0))
        for name in ("hrf_10_dr", "hrf_12_h"):
            mask = cv2.imread(f"{data}/masks/{name}.png", cv2.IMREAD_GRAYSCALE)
            small = cv2.resize(mask, (584, 389), interpolation=cv2.INTER_AREA) > 100
            found.append(replace(found[0], name=name, mask=small, um_per_px=11.0))
    return found


def textures(folder: Path | None) -> list[np.ndarray]:
    data = os.environ.get("FLOWREC_REFERENCE_DATA")
    files = sorted(folder.glob("*.png")) if folder else []
    files += [Path(data) / "movies" / name / "000.png" for name in ("bulk_water", "brightfield")] if data else []
    images = [cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) for file in files]
    return [image for image in images if image is not None]


def cases(seed: int, laid: list[np.ndarray]) -> Iterator[Case]:
    rng, available, number = np.random.default_rng(seed), chips(), seed
    for look in (*LOOKS, "microscope", "microscope, inverted"):
        for name, (turn, mirror, shift_um, scale) in TRANSFORMATIONS.items():
            chip = available[number % len(available)]
            if chip.name == "bifurcation" and mirror:  # which is its own mirror image
                chip = available[(number + 1) % len(available)]
            fill = max(chip.size_um[0] / SIZE_PX[0], chip.size_um[1] / SIZE_PX[1]) / ABOUT_UM  # of this chip
            centre = np.array(chip.size_um) / 2 - chip.um_per_px / 2
            way = rng.uniform(0, 2 * np.pi)
            centre = centre + shift_um * fill * np.array((np.cos(way), np.sin(way)))
            truth = Calibration.centre_on(ABOUT_UM * fill * scale, centre, SIZE_PX, turn, mirror)
            texture = laid[number % len(laid)] if laid and number % 3 else None
            if look in LOOKS:
                contrast = 0.25 * max(abs(v) for v in (LOOKS[look].line, LOOKS[look].channel, LOOKS[look].shade))
                image = picture(chip.mask, chip.um_per_px, truth, SIZE_PX, LOOKS[look], rng, texture, contrast)
            else:
                camera = CameraSettings(*SIZE_PX)
                seen = Microscope(chip.mask, chip.um_per_px, truth, camera, SimulatedImage(), number)
                robot = np.array(truth.to_um((300.0, 200.0)))
                image = seen.image([DrawnRobot(robot, 5 * truth.um_per_px)])
                image = 255 - image if "inverted" in look else image
            yield Case(look, name, replace(chip, um_per_px=chip.um_per_px / fill), rescaled(truth, fill), image, number)
            number += 1


def rescaled(truth: Calibration, fill: float) -> Calibration:
    """So that every chip fills an image of 10 um a pixel, and um mean the same in all cases."""
    x, y = truth.origin_um
    return Calibration(truth.um_per_px / fill, (x / fill, y / fill), truth.angle_deg, truth.mirror)


def errors(found: Calibration, truth: Calibration) -> dict[str, float]:
    """Angle in degrees, shift of the image's centre and worst corner in um, scale in percent."""
    width, height = SIZE_PX
    corners = np.array([(0, 0), (width, 0), (0, height), (width, height)])
    middle = (np.array(SIZE_PX) - 1) / 2
    turned = abs((found.angle_deg - truth.angle_deg + 180.0) % 360.0 - 180.0)
    return {
        "angle_deg": turned if found.mirror == truth.mirror else 180.0,
        "centre_um": float(np.hypot(*(found.to_um(middle) - truth.to_um(middle)))),
        "corner_um": float(np.hypot(*(found.to_um(corners) - truth.to_um(corners)).T).max()),
        "scale_percent": 100.0 * abs(found.um_per_px / truth.um_per_px - 1.0),
    }


def measure(case: Case) -> dict[str, object]:
    began = time.process_time()
    row: dict[str, object] = {"look": case.look, "transformation": case.transformation, "chip": case.chip.name}
    try:
        fits = register(case.image, case.chip, (case.about_um / 1.12, case.about_um * 1.12))
    except ChipError as error:
        return row | {"refused": str(error), "cpu_s": time.process_time() - began}
    row["cpu_s"] = time.process_time() - began
    nearest = min(fits, key=lambda fit: errors(fit.calibration, case.truth)["corner_um"])
    row |= {"ways": len(fits), "found": nearest.found, "explained": nearest.explained, "std": nearest.std.tolist()}
    return row | errors(nearest.calibration, case.truth) | {"residual_um": nearest.residual_um}


@dataclass(frozen=True)
class Stranger:
    """A picture that does not show the chip as it is asked for."""

    kind: str
    chip: Chip
    image: np.ndarray
    about_um: float
    mirrors: tuple[bool, ...] = (False, True)


def strangers(seed: int, laid: list[np.ndarray]) -> Iterator[Stranger]:
    """Another chip, the mirror image where none is expected, another scale, textures alone, noise."""
    rng, available, looks = np.random.default_rng(seed), chips(), list(LOOKS.values())
    kinds = ("another chip", "another chip near by", "mirror image", "another scale", "texture", "noise")
    for number in range(len(kinds) * len(available)):
        chip, kind = available[number % len(available)], kinds[number // len(available)]
        about_um = max(chip.size_um[0] / SIZE_PX[0], chip.size_um[1] / SIZE_PX[1])
        if chip.name == "bifurcation" and kind == "mirror image":  # which is its own mirror image
            continue
        if kind in ("texture", "noise"):
            if kind == "texture" and laid:
                image = cv2.resize(laid[number % len(laid)], SIZE_PX)
            else:
                smooth = cv2.GaussianBlur(rng.standard_normal(SIZE_PX[::-1]), (0, 0), float(rng.uniform(0.5, 12)))
                image = cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
            yield Stranger(kind, chip, image, about_um)
            continue
        shown = chip
        if kind.startswith("another chip"):
            shown = available[(number + 1 + int(rng.integers(len(available) - 1))) % len(available)]
        fill = max(shown.size_um[0] / SIZE_PX[0], shown.size_um[1] / SIZE_PX[1])
        scale = {"another chip near by": 0.6, "another scale": float(rng.choice((0.7, 1.4)))}.get(kind, 1.0)
        centre = np.array(shown.size_um) / 2 + rng.uniform(-0.1, 0.1, 2) * shown.size_um
        turn, mirror = float(rng.uniform(0, 360)), kind == "mirror image"
        view = Calibration.centre_on(fill * scale, centre, SIZE_PX, turn, mirror)
        image = picture(shown.mask, shown.um_per_px, view, SIZE_PX, looks[number % len(looks)], rng)
        mirrors = (False,) if mirror else (False, True)
        yield Stranger(kind, chip, image, about_um * (scale if "near" in kind else 1.0), mirrors)


def refused(case: Stranger) -> dict[str, object]:
    began = time.process_time()
    row: dict[str, object] = {"kind": case.kind, "chip": case.chip.name}
    try:
        fit = register(case.image, case.chip, (case.about_um / 1.12, case.about_um * 1.12), case.mirrors)[0]
        row |= {"accepted": True, "found": fit.found, "explained": fit.explained, "std": fit.std.tolist()}
    except ChipError as error:
        row |= {"accepted": False, "why": str(error)}
    return row | {"cpu_s": time.process_time() - began}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--every", type=int, default=1, help="only every N-th case")
    parser.add_argument("--textures", type=Path, help="folder of PNG images")
    parser.add_argument("--refusals", action="store_true", help="only pictures without the chip")
    asked = parser.parse_args()
    laid = textures(asked.textures)
    if asked.refusals:
        for number, stranger in enumerate(strangers(asked.seed, laid)):
            if number % asked.every == 0:
                print(json.dumps(refused(stranger)), flush=True)
        return
    for number, case in enumerate(cases(asked.seed, laid)):
        if number % asked.every == 0:
            print(json.dumps(measure(case)), flush=True)


if __name__ == "__main__":
    main()
