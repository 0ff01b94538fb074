"""Where the wall lies: from fluid pixels to fluid subcells and to the distance of points from the outline."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.special import ndtri

from flowrec.chip.chip import Walls

# A blurred straight edge is a Gaussian integral, so the blur can be undone into a distance. One pixel is the
# smallest blur that no longer shows the steps of an oblique edge; a channel of three pixels keeps its width.
BLUR_PX = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Outline:
    """The fluid on a grid of k x k subcells a pixel."""

    fluid: NDArray[np.bool_]  # (h k, w k)
    # (h k + 2, w k + 2) distance to the wall at subcell centres, positive in fluid, in subcells, with one ring
    # around the image; None where the wall is the edge of the subcells themselves.
    distance: NDArray[np.float64] | None


def outline(mask: NDArray[np.bool_], k: int, walls: Walls) -> Outline:
    """Cut each pixel into k x k subcells; `smooth` takes the walls from an outline between the pixels.

    The outline is the half level of the blurred mask. With k = 1 the cells stay the mask's pixels and the
    outline only tells how far the wall really is.
    """
    staircase = np.repeat(np.repeat(mask, k, axis=0), k, axis=1)
    if walls == "pixel":
        return Outline(staircase, None)
    margin = 4
    share = gaussian_filter(np.pad(mask.astype(np.float64), margin, mode="edge"), BLUR_PX, truncate=4.0)
    level = BLUR_PX * ndtri(np.clip(share, 1e-4, 1.0 - 1e-4))
    rows, columns = (
        (np.arange(-1, size * k + 1) + 0.5) / k - 0.5 + margin for size in mask.shape
    )  # subcell centres in the padded image
    distance = k * map_coordinates(level, np.meshgrid(rows, columns, indexing="ij"), order=1, mode="nearest")
    fluid = staircase if k == 1 else distance[1:-1, 1:-1] > 0.0
    return Outline(fluid, distance)
