"""`python -m tests.perf.walls`: errors of walls and registration traced in a picture, beside those that were stated.

Every look of tests/physics/chip/looks.py (another renderer than the simulated microscope) of two chips, with a right
mask and with one whose walls are up to 0.8 px off and that lacks a blocked branch. Null models: mask and registration
as stated, and the registration of `wall_fit.py` alone.
"""

from __future__ import annotations

import time

import numpy as np

from flowrec.measure.picture_registration import fit_nearby
from flowrec.measure.wall_trace import trace_walls
from tests.physics.chip.looks import LOOKS
from tests.physics.chip.test_wall_trace import BIFURCATION, VESSELS, Scene, levels


def main() -> None:
    """Print a row for each picture; errors of walls in px of the mask, of registrations in um, root mean square."""
    print("chip          off_px look                stated  wall_fit  traced um   mask  traced px  alike  used  cpu_s")
    for chip in (BIFURCATION, VESSELS):
        for error_px in (0.0, 0.8):
            for look in LOOKS:
                scene = Scene(chip, look, error_px)
                fit = fit_nearby(scene.image, chip, scene.stated)
                began = time.process_time()
                found = trace_walls(scene.image, chip, scene.stated)
                spent_s = time.process_time() - began
                known = f"{chip.name:14}{error_px:5.1f}  {look:18}{scene.off_um(scene.stated):7.1f}"
                known += "        --" if fit is None else f"{scene.off_um(fit.calibration):10.1f}"
                if found is None:
                    print(f"{known}  not shown {spent_s:52.2f}")
                    continue
                drawn, traced = (
                    float(np.sqrt(np.mean(scene.wall_errors_px(level_px, found.calibration) ** 2)))
                    for level_px in (levels(chip.mask), found.level_px)
                )
                print(
                    f"{known}{scene.off_um(found.calibration):8.1f}{drawn:11.2f}{traced:8.2f}{found.alike:10.2f}  "
                    f"{'yes' if found.walls_differ else 'no':4}{spent_s:7.2f}"
                )


if __name__ == "__main__":
    main()
