"""Settings of the rig: plain data, so that a config can be read without starting a camera or a solver."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from flowrec.ranges import OneOf, Range, Seed, Share


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """What the camera sees, real or simulated."""

    width_px: Annotated[int, Range(8, 16_384)] = 640
    height_px: Annotated[int, Range(8, 16_384)] = 512
    rate_hz: Annotated[float, Range(0.1, 5e3)] | None = None  # None: chosen to fit the robot's speed
    um_per_px: Annotated[float, Range(1e-3, 1e3)] | None = None  # None: the whole chip fills the image
    exposure_s: Annotated[float, Range(0.0, 10.0)] = 0.004
    # From here on of the simulated camera only.
    blur_px: Annotated[float, Range(0.0, 100.0)] = 0.8  # optics, one sigma
    background: Annotated[float, Range(1.0, 255.0)] = 172.0  # grey level of the open channel in the middle of the image
    illumination: Share = 0.18  # how much darker the corners are, as a share
    # electrons per grey level: shot noise is sqrt(level / this), grey levels
    photons_per_level: Annotated[float, Range(1e-3, 1e9)] = 40.0
    read_noise: Annotated[float, Range(0.0, 255.0)] = 0.8  # grey levels, one sigma
    debris: Annotated[int, Range(0, 10_000)] = 24  # particles that drift with the flow; a sixth as many more lie still


@dataclass(frozen=True, slots=True)
class Simulated:
    """How the simulated world differs from what is assumed about it, and how the robot jitters. Drawn from the seed."""

    seed: Seed = 0
    # each true inlet speed is the assumed one times 1 +- (a third of this to all)
    inlet_speed_error: Annotated[float, Range(0.0, 0.99)] = 0.25
    # each true outlet pressure differs by up to this share of the chip's pressure drop
    outlet_pressure_error: Annotated[float, Range(0.0, 10.0)] = 0.1
    # the true viscosity is the assumed one times 1 +- this, uniformly
    viscosity_error: Annotated[float, Range(0.0, 0.99)] = 0.1
    # random walk of the robot after one second, per axis, one sigma
    position_noise_um: Annotated[float, Range(0.0, 1e3)] = 1.0
    # the robot rolls off its heading: one sigma, forgotten within a second
    heading_noise_rad: Annotated[float, Range(0.0, math.pi)] = 0.03
    speed_noise: Share = 0.02  # the same for its speed, as a share
    # from command to motion; None: what the robot is assumed to have
    delay_s: Annotated[float, Range(0.0, 10.0)] | None = None
    # the robot's true step-out frequency is the stated one times this
    step_out_share: Annotated[float, Range(0.01, 10.0)] = 1.0
    # the true flow is the steady one times 1 + this sin(2 pi pulsation_hz t)
    pulsation_share: Annotated[float, Range(0.0, 0.99)] = 0.0
    pulsation_hz: Annotated[float, Range(0.0, 1e3)] = 1.0
    k: Annotated[int, OneOf(1, 2, 4)] = 1  # cells of the true flow per pixel side
    # by which the camera's clock runs fast; None: drawn, up to 50 either way
    clock_skew_ppm: Annotated[float, Range(-1e5, 1e5)] | None = None
    arrival_jitter_s: Annotated[float, Range(0.0, 1.0)] = 3e-4  # by which frames reach the host late, on average


@dataclass(frozen=True, slots=True)
class Safety:
    """When a run that is not steered loses its field. With --realtime, and on hardware."""

    # no tick has ended for so long while the field is on
    guard_timeout_s: Annotated[float, Range(0.01, 60.0)] = 0.5
