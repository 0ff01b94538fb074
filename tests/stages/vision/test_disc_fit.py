"""The disc fit against an independent minimisation of the same cost."""

import math

import numpy as np
import pytest
from scipy.optimize import minimize

from flowrec.stages.vision.disc_fit import block_means, fit_disc, fit_radius

RADIUS, EDGE, CONTRAST = 4.0, 1.0, 7.0  # priors in px, and the darkness in grey levels


def disc_and_rim(rho, radius, edge):
    s = (rho - radius) / edge
    return 1.0 / (1.0 + np.exp(2.2 * s)), np.exp(-(((s - 2.0) / 1.1) ** 2))


def model(parameters, dx, dy):
    x, y, radius, edge, level, slope_x, slope_y, darkness, rim = parameters
    disc, ring = disc_and_rim(np.hypot(dx - x, dy - y), radius, edge)
    return level + slope_x * dx + slope_y * dy - darkness * disc + rim * ring


def maximum_a_posteriori(dx, dy, grey, start):
    """Cauchy's cost with residuals of one grey level and the priors r +- 15 %, e +- 40 %, C / A = 0.35 +- 0.5."""
    best = np.array(start)
    for _ in range(20):  # the prior of the rim is that of the darkness found before
        darkness = best[7]

        def cost(p, darkness=darkness):
            residual = grey - model(p, dx, dy)
            rim = (0.35 * darkness - p[8]) / (0.5 * abs(darkness) + 1.0)
            priors = ((RADIUS - p[2]) / (0.15 * RADIUS)) ** 2 + ((EDGE - p[3]) / (0.4 * EDGE)) ** 2 + rim**2
            return (6.0 * np.log1p(residual**2 / 6.0)).sum() + priors

        best = minimize(cost, best, method="BFGS", options={"gtol": 1e-7}).x
    return best


@pytest.mark.parametrize("covered", [0.0, 0.5])  # fraction of the disc that a wall hides
def test_size_and_softness_are_those_of_the_most_probable_disc_with_the_priors_as_documented(covered):
    rows, columns = np.mgrid[0:41, 0:41].astype(float)
    rho = np.hypot(columns - 20.3, rows - 19.8)
    disc, ring = disc_and_rim(rho, 4.4, 0.6)
    image = np.rint(120.0 + 0.1 * columns - CONTRAST * disc + 0.35 * CONTRAST * ring).astype(np.uint8)
    distance = np.where(rows > 19.8 + 4.4 * (1.0 - 2.0 * covered), 10.0, -1.0).astype(np.float32)
    if covered == 0.0:
        distance[:] = 10.0
    dx, dy, grey = block_means(image, distance, 1.0, 20.0, 20.0, fit_radius(RADIUS, EDGE), 1)
    start = [0.3, -0.2, RADIUS, EDGE, 120.0, 0.1, 0.0, CONTRAST, 0.35 * CONTRAST]
    expected = maximum_a_posteriori(dx, dy, grey, start)
    x, y, radius, darkness, _ = fit_disc(image, distance, 1.0, 20.0, 20.0, RADIUS, EDGE, 1)
    assert math.dist((x - 20.0, y - 20.0), expected[:2]) < 1e-3
    assert (radius, darkness) == pytest.approx((expected[2], expected[7]), rel=1e-4)
