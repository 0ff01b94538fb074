"""Frame to Track: where is the robot?

Acquisition searches the whole channel with a matched filter and takes the darkest good likeness: debris is paler and
smaller. Once locked, only a region around the last position is searched; it grows while the robot is out of sight,
until the whole image is searched again. The centre is then fitted to a fraction of a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from flowrec.chip.calibration import Calibration
from flowrec.chip.chip import Chip
from flowrec.messages import Frame, Track
from flowrec.robot import Robot
from flowrec.vision.appearance import reach_px, template
from flowrec.vision.fluid import FluidView, fluid_view
from flowrec.vision.subpixel import Fit, fit_centre

_COARSE_RADIUS_PX = 5.0  # a larger robot is first looked for in a smaller image


@dataclass(frozen=True, slots=True)
class Tracker:
    """Finds the robot; its memory is the previous Track."""

    least_likeness: float = 0.45  # of filter and fit, 0 to 1, to be taken for the robot while locked
    acquire_likeness: float = 0.6  # the same without knowing where to look
    least_contrast: float = 12.0  # grey levels
    search_radii: float = 2.5  # the region reaches so many radii around the last position ...
    search_px: float = 8.0  # ... and at least so many pixels
    reacquire_after: int = 10  # frames without the robot, then the whole image is searched
    candidates: int = 6  # best likenesses that are fitted and compared when acquiring

    def track(self, previous: Track | None, frame: Frame, chip: Chip, calibration: Calibration, robot: Robot) -> Track:
        """The robot in this frame; `seen` False keeps the last position (the image's centre before the first)."""
        radius_px = robot.radius / calibration.um_per_px
        view = fluid_view(chip, calibration, frame.image.shape, radius_px)
        locked = previous is not None and (previous.seen or 0 < previous.lost_frames <= self.reacquire_after)
        if locked and previous is not None and previous.score > 0:
            region = self._region(previous, calibration, radius_px, view)
            # Out of sight a poor likeness is rather a piece of debris that came along.
            least = self.acquire_likeness if previous.lost_frames else self.least_likeness
            fits = self._find(frame.image, view, region, radius_px, least, 2)
        else:
            region = view.box
            fits = self._find(frame.image, view, region, radius_px, self.acquire_likeness, self.candidates)
        roi = np.array(region, np.float64)
        if not fits:
            return self._unseen(previous, frame, calibration, radius_px, roi)
        best = max(fits, key=lambda fit: fit.contrast * fit.likeness)
        return Track(
            stamp_ns=frame.stamp_ns,
            seen=True,
            position_um=calibration.to_um(best.centre_px),
            score=min(max(best.likeness, 0.0), 1.0),
            lost_frames=0,
            radius_px=radius_px,
            roi_px=roi,
        )

    def _region(
        self, previous: Track, calibration: Calibration, radius_px: float, view: FluidView
    ) -> tuple[int, int, int, int]:
        """Where to search: x0, y0, x1, y1 of possible centres around the last position."""
        x, y = calibration.to_px(previous.position_um)
        margin = max(self.search_radii * radius_px, self.search_px) * (1 + previous.lost_frames)
        x0, y0, x1, y1 = view.box
        left, top = max(x0, int(x - margin)), max(y0, int(y - margin))
        return left, top, max(left + 1, min(x1, int(x + margin) + 2)), max(top + 1, min(y1, int(y + margin) + 2))

    def _find(
        self,
        image: NDArray[np.uint8],
        view: FluidView,
        region: tuple[int, int, int, int],
        radius_px: float,
        least_likeness: float,
        candidates: int,
    ) -> list[Fit]:
        """Fits of the best likenesses with centres in the region."""
        shrink = max(1, int(radius_px / _COARSE_RADIUS_PX))
        x0, y0, x1, y1 = region
        reach = reach_px(radius_px / shrink)
        pad = reach * shrink
        # A border of the image is filled in, so that a robot half outside is still found.
        left, top = x0 - pad, y0 - pad
        right, bottom = x1 + pad + shrink, y1 + pad + shrink
        cut: NDArray[Any] = image[max(top, 0) : min(bottom, image.shape[0]), max(left, 0) : min(right, image.shape[1])]
        outside = (max(-top, 0), max(bottom - image.shape[0], 0), max(-left, 0), max(right - image.shape[1], 0))
        if any(outside):
            cut = cv2.copyMakeBorder(cut, *outside, cv2.BORDER_REPLICATE)
        allowed = view.centres[y0:y1, x0:x1]
        if shrink > 1:
            cut = cv2.resize(cut, None, fx=1 / shrink, fy=1 / shrink, interpolation=cv2.INTER_AREA)
        likeness = cv2.matchTemplate(
            cut.astype(np.float32), template(round(radius_px / shrink, 3)), cv2.TM_CCOEFF_NORMED
        )
        rows = min(likeness.shape[0], -(-allowed.shape[0] // shrink))
        columns = min(likeness.shape[1], -(-allowed.shape[1] // shrink))
        likeness = np.where(allowed[::shrink, ::shrink][:rows, :columns], likeness[:rows, :columns], -1.0)
        fits: list[Fit] = []
        for _ in range(candidates):
            _, peak, _, (column, row) = cv2.minMaxLoc(likeness)
            if peak < 0.8 * least_likeness:
                break
            start = (x0 + column * shrink + 0.5 * (shrink - 1), y0 + row * shrink + 0.5 * (shrink - 1))
            fit = fit_centre(image, view.open, start, radius_px)
            if (
                fit is not None
                and fit.contrast >= self.least_contrast
                and fit.likeness >= least_likeness
                and max(abs(fit.centre_px[0] - start[0]), abs(fit.centre_px[1] - start[1])) <= 1.0 + shrink
            ):
                fits.append(fit)
            cv2.circle(likeness, (column, row), max(2, round(radius_px / shrink)), -1.0, -1)
        return fits

    @staticmethod
    def _unseen(
        previous: Track | None,
        frame: Frame,
        calibration: Calibration,
        radius_px: float,
        roi: NDArray[np.float64],
    ) -> Track:
        rows, columns = frame.image.shape
        centre = calibration.to_um(((columns - 1) / 2, (rows - 1) / 2))
        return Track(
            stamp_ns=frame.stamp_ns,
            seen=False,
            position_um=centre if previous is None else previous.position_um,
            score=0.0 if previous is None else previous.score,
            lost_frames=1 if previous is None else previous.lost_frames + 1,
            radius_px=radius_px,
            roi_px=roi,
        )
