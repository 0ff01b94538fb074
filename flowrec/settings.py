"""Settings of the rig: plain data, so that a config can be read without starting a camera or a solver."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """What the camera sees, real or simulated."""

    width_px: int = 640
    height_px: int = 512
    rate_hz: float | None = None  # None: chosen to fit the robot's speed
    um_per_px: float | None = None  # None: the whole chip fills the image
    exposure_s: float = 0.004
    # From here on of the simulated camera only.
    blur_px: float = 0.8  # optics, one sigma
    background: float = 172.0  # grey level of the open channel in the middle of the image
    illumination: float = 0.18  # how much darker the corners are, as a share
    photons_per_level: float = 40.0  # electrons per grey level: shot noise is sqrt(level / this), grey levels
    read_noise: float = 0.8  # grey levels, one sigma
    debris: int = 24  # particles that drift with the flow; a sixth as many more lie still


@dataclass(frozen=True, slots=True)
class Simulated:
    """How the simulated world differs from what is assumed about it, and how the robot jitters. Drawn from the seed."""

    seed: int = 0
    inlet_speed_error: float = 0.25  # each true inlet speed is the assumed one times 1 +- (a third of this to all)
    outlet_pressure_error: float = (
        0.1  # each true outlet pressure differs by up to this share of the chip's pressure drop
    )
    viscosity_error: float = 0.1  # the true viscosity is the assumed one times 1 +- this, uniformly
    position_noise_um: float = 1.0  # random walk of the robot after one second, per axis, one sigma
    heading_noise_rad: float = 0.03  # the robot rolls off its heading: one sigma, forgotten within a second
    speed_noise: float = 0.02  # the same for its speed, as a share
    delay_s: float | None = None  # from command to motion; None: what the robot is assumed to have
    pulsation_share: float = 0.0  # the true flow is the steady one times 1 + this sin(2 pi pulsation_hz t)
    pulsation_hz: float = 1.0
    k: int = 1  # cells of the true flow per pixel side
    clock_skew_ppm: float | None = None  # by which the camera's clock runs fast; None: drawn, up to 50 either way
    arrival_jitter_s: float = 3e-4  # by which frames reach the host late, on average
