"""Chips with made-up flows."""

import numpy as np

from flowrec.core import FlowField
from flowrec.physics import Chip, Opening, Robot
from flowrec.stages import SurveyOrder, SurveyPlanner

PX = 10.0


def robot(speed_um_s=100.0, radius_um=10.0):
    return Robot(radius_um=radius_um, max_speed_um_s=speed_um_s, step_out_hz=1e6, step_out_margin=1.0)


def chip_of(mask, openings=()):
    return Chip("made up", np.asarray(mask, bool), PX, tuple(openings), 1.0, 1000.0)


def field_of(mask, vx, vy=0.0, pressure=0.0):
    """Velocity (um/s) as constants, rasters or functions of (x, y) in um; zero in solid."""
    h, w = np.shape(mask)
    y, x = np.mgrid[0:h, 0:w] * PX
    parts = [np.broadcast_to(part(x, y) if callable(part) else part, (h, w)) * mask for part in (vx, vy, pressure)]
    return FlowField(0, 0, "made up", PX, np.stack(parts[:2], -1), parts[2], None, np.zeros(0), 1.0, 1000.0, "")


def open_water(h=80, w=120):
    return np.ones((h, w), bool)


def channel(h=40, w=120, wall=8):
    mask = np.zeros((h, w), bool)
    mask[wall:-wall] = True
    return mask


def poiseuille(mask, peak):
    """Parallel flow along x, parabolic between the walls of a straight channel."""
    rows = np.nonzero(mask.any(1))[0]
    middle, half = 0.5 * (rows[0] + rows[-1]), 0.5 * len(rows)
    return field_of(mask, lambda x, y: peak * np.maximum(1.0 - ((y / PX - middle) / half) ** 2, 0.0))


def loop(fast=140.0, slow=40.0):
    """A ring of two branches between two stubs, both 9 px wide: the short one above flows fast, the long one slowly."""
    mask = np.zeros((90, 140), bool)
    vx, vy = np.zeros(mask.shape), np.zeros(mask.shape)
    mask[16:25, :] = True
    vx[16:25, :] = 60.0
    vx[16:25, 35:105] = fast
    mask[16:75, 26:35] = mask[16:75, 105:114] = mask[66:75, 26:114] = True
    vy[25:66, 26:35], vy[25:66, 105:114] = slow, -slow
    vx[66:75, 26:114] = slow
    inlet, outlet = Opening("left", 16, 24, "inlet", 60.0), Opening("right", 16, 24, "outlet", 0.0)
    return chip_of(mask, (inlet, outlet)), field_of(mask, vx, vy, lambda x, y: 1400.0 - x)


def length_um(route):
    return float(np.hypot(*np.diff(route.waypoints_um, axis=0).T).sum())


def downstream(field, start_um, chip, swimmer, **settings):
    """The route of a survey downstream."""
    planner = SurveyPlanner(method="downstream", **settings)
    return planner.plan(SurveyOrder(field, np.array(start_um, float), chip, swimmer))
