"""Settings of the simulated rig: how the simulated world differs from the assumed one; the table of named worlds.

A setting that is None has the value of the preset that `simulated.world` names. Most of them bound an error that is
drawn from the seed. Where a setting states the true value itself, None means that it is drawn: `inlet_speed_share`,
`depth_um`, `um_per_rev_share`, `delay_s`, `step_out_share`, `um_per_px`, `angle_deg`, `centre_um`, `pulsation_hz`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal

from flowrec.core import OneOf, Range, Seed, Share
from flowrec.physics import ViscositySettings
from flowrec.stages.rig_settings import Angle, PointUm

Optics = Literal["disc", "oblique"]
_Size = Annotated[float, Range(0.0, 10.0)]
_PartOf = Annotated[float, Range(0.0, 0.99)]
_TrueOverAssumed = Annotated[float, Range(0.01, 10.0)]
_Rate = Annotated[float, Range(0.0, 1e3)]

# The world of every session that was recorded before there was more than one.
FIRST_WORLD = "kind"


@dataclass(frozen=True, slots=True)
class SimulatedImage:
    """Section [simulated.image]: light, noise and debris in the images of the simulated microscope."""

    blur_px: Annotated[float, Range(0.0, 100.0)] = 0.8  # optical blur, one sigma
    background: Annotated[float, Range(1.0, 255.0)] = 172.0  # grey level of the open channel in the middle of the image
    illumination: Share = 0.18  # relative loss of light in the corners
    # electrons per grey level: the shot noise is sqrt(level / photons_per_level) grey levels
    photons_per_level: Annotated[float, Range(1e-3, 1e9)] = 40.0
    read_noise: Annotated[float, Range(0.0, 255.0)] = 0.8  # grey levels, one sigma
    debris: Annotated[int, Range(0, 10_000)] = 24  # particles that drift with the flow; a sixth as many more lie still


@dataclass(frozen=True, slots=True)
class PumpSensorSettings:
    """Section [simulated.sensor]: the flow sensor at the simulated pump, a stream of the kind `simulated`."""

    rate_hz: Annotated[float, Range(0.01, 1e4)] = 10.0  # samples per second
    noise_share: Annotated[float, Range(0.0, 1.0)] = 0.01  # standard deviation of a sample, as a ratio of the flow
    delay_s: Annotated[float, Range(0.0, 60.0)] = 0.0  # time from a change of the flow to the sample that shows it


@dataclass(frozen=True, slots=True)
class Simulated:
    """Differences between the simulated and the assumed world, and noise; drawn from the seed.

    "Up to 1 +- e" is uniform. Each error has random numbers of its own, so that to state one leaves the others as they
    are.
    """

    # named world, from kind to hard: it states the settings of this section that are None
    world: Literal["kind", "moderate", "hard"] = "moderate"
    seed: Seed = 0  # seed of all that is drawn: world, noise, bodies
    # Each true inlet speed is the assumed one times 1 +- (a third of this to all of it).
    inlet_speed_error: _PartOf | None = None
    inlet_speed_share: _TrueOverAssumed | None = None  # ratio of all true inlet speeds to the assumed ones; None: drawn
    # each true outlet pressure differs by up to this fraction of the chip's pressure drop
    outlet_pressure_error: _Size | None = None
    viscosity_error: _PartOf | None = None  # the true viscosity is the assumed one times up to 1 +- this
    # the true law of viscosity; what it leaves out is as assumed
    viscosity: ViscositySettings = field(default_factory=ViscositySettings)
    depth_error: _PartOf | None = None  # the true depth is the stated one times up to 1 +- this
    # mean of the true depth where the chip states none, in median channel widths; 0: two-dimensional, as assumed
    unstated_depth_widths: Annotated[float, Range(0.0, 100.0)] | None = None
    depth_um: Annotated[float, Range(0.0, 1e5)] | None = None  # the true depth; 0: two-dimensional; None: drawn
    # The true walls lie up to this far from those of the mask, in patches, in pixels of the mask. If it is not 0, or a
    # branch is blocked, the true flow is solved on a mask of half the pixel size, with these walls.
    wall_error_px: Annotated[float, Range(0.0, 1.5)] | None = None
    # part of the width of one branch that is blocked, at one place
    blocked_share: Annotated[float, Range(0.0, 0.9)] | None = None
    # One standard deviation of the pump's drift, a random process. The true flow is the steady one times (1 + drift) (1
    # + pulsation_share sin(2 pi hz t + phase)).
    drift_share: Annotated[float, Range(0.0, 0.3)] | None = None
    drift_s: Annotated[float, Range(0.1, 1e5)] | None = None  # correlation time of the drift
    pulsation_share: _PartOf | None = None  # amplitude of the pump's pulsation, as a ratio of the inflow
    # frequency of the pump's pulsation; None, also in the preset: drawn from 0.05 to 2, uniformly in the logarithm
    pulsation_hz: _Rate | None = None
    # phase of the pump's pulsation; None, also in the preset: drawn from 0 to 360
    pulsation_phase_deg: Angle | None = None
    # The true flow changes once, to this ratio of what it was, after step_s.
    step_share: Annotated[float, Range(0.0, 10.0)] = 1.0
    step_s: Annotated[float, Range(0.0, 1e6)] = 0.0  # time of that change
    sensor: PumpSensorSettings = field(default_factory=PumpSensorSettings)
    k: Annotated[int, OneOf(1, 2, 4)] | None = None  # cells of the true flow per pixel side of the true walls' mask
    # True um per revolution: the assumed one times up to 1 +- this.
    um_per_rev_error: _PartOf | None = None
    # ratio of the true um per revolution to the assumed one; None: drawn
    um_per_rev_share: _TrueOverAssumed | None = None
    slip: _PartOf | None = None  # fraction of the rolled distance that is lost; alone it is a smaller um per revolution
    # Drag of the side walls: 0 none, 1 as for a sphere (rigs/simulated/hindrance.py), on its own motion and on how the
    # flow carries it.
    hindrance: Share | None = None
    # random walk of the robot after one second, per axis, one sigma
    position_noise_um: Annotated[float, Range(0.0, 1e3)] | None = None
    # temperature of the fluid in K, which makes the robot's Brownian motion; it is added to that random walk
    temperature_k: Annotated[float, Range(0.0, 1e3)] | None = None
    # deviation of the rolling direction from the heading: one sigma, correlated over a second
    heading_noise_rad: Annotated[float, Range(0.0, math.pi)] | None = None
    speed_noise: Share | None = None  # relative deviation of the rolling speed: one sigma, correlated over a second
    delay_error: _PartOf | None = None  # The true time from command to motion is the assumed one times up to 1 +- this.
    delay_s: Annotated[float, Range(0.0, 10.0)] | None = None  # true time from command to motion; None: drawn
    step_out_error: _PartOf | None = None  # the true step-out frequency is the assumed one times up to 1 +- this
    # ratio of the true step-out frequency to the assumed one; None: drawn
    step_out_share: _TrueOverAssumed | None = None
    # each coil's true field per ampere differs by up to this fraction of itself, in each of the three directions
    coil_error: _PartOf | None = None
    # The chip lies shifted in the image by half of this to all of it, in a drawn direction, from where [camera] puts
    # it; turned by up to angle_error_deg, scaled by up to 1 +- scale_error.
    offset_px: Annotated[float, Range(0.0, 1e3)] | None = None
    # angle by which the chip lies turned at most from where the registration puts it
    angle_error_deg: Annotated[float, Range(0.0, 45.0)] | None = None
    scale_error: _PartOf | None = None  # ratio by which the image scale differs at most from the stated one
    # true size of an image's pixel on the chip; None: drawn
    um_per_px: Annotated[float, Range(1e-3, 1e3)] | None = None
    angle_deg: Angle | None = None  # true angle of the camera; None: drawn about the stated one
    # point of the chip that is truly in the middle of the image. None: by the stated registration
    centre_um: PointUm | None = None
    mirror: bool | None = None  # the image truly shows the chip as in a mirror; None: as [camera] states it
    # The stage swings by this amplitude in a drawn direction, and the image with it.
    shake_um: Annotated[float, Range(0.0, 1e3)] | None = None
    shake_hz: _Rate | None = None  # mean frequency of the shaking of the image
    tracers: Annotated[int, Range(0, 10_000)] = 0  # beads that drift with the flow, each at a height of its own
    # density of the beads less that of the fluid: they settle; 50 is polystyrene in water, less in a matched fluid
    tracer_excess_kg_m3: Annotated[float, Range(0.0, 2e4)] = 5.0
    # robots in the chip, all in the same field: the mission's one, and others of different response and look
    robots: Annotated[int, Range(1, 100)] = 1
    image: SimulatedImage = field(default_factory=SimulatedImage)
    # how the robot is drawn: disc, the profile that the tracker fits; oblique, lit from one side
    optics: Optics | None = None
    # relative rate error of the camera's clock; None: drawn, up to 50 either way
    clock_skew_ppm: Annotated[float, Range(-1e5, 1e5)] | None = None
    arrival_jitter_s: Annotated[float, Range(0.0, 1.0)] = 3e-4  # mean delay of a frame on its way to the host

    def value(self, name: str) -> Any:
        """A setting: as stated, else that of the preset; None if it is drawn."""
        stated = getattr(self, name)
        return WORLDS[self.world].get(name) if stated is None else stated

    def with_preset(self) -> Simulated:
        """A copy with the settings of the preset stated, as a session records them."""
        return replace(self, **{name: self.value(name) for name in WORLDS[self.world]})


# What each named world draws. `kind` is the world of the first sessions: model and world share solver, walls and
# unknowns, and robot and registration are known exactly. `moderate` is what a careful lab has, `hard` what a hurried
# one has; where no source is named, the number is an assumption about such a lab. The widths of refine's priors are
# chosen on their own.
# [1] speed = flow rate over cross-section: syringe pump to 1 %, depth to 10 %, a width of 10 px to 2/3 px: 12 to 15 %;
#     `hard`: twice that, for a pump that is not calibrated or a flow driven by gravity
# [2] assumption: half of, and one and a half times, the first world's
# [3] water loses 2.1 to 2.4 % per kelvin at 20 C (CRC Handbook of Chemistry and Physics): 2 K; `hard`: 5 K, a solute
# [4] a depth gauge on a milled chip, or a cut through a cast of a moulded one; `hard`: the drawing alone
# [5] an outline found in a picture: a third of a pixel; `hard`: a mask drawn by hand, a whole pixel
# [6] syringe pumps with stepper motors: a few percent, slow with the screw, pulses of 0.05 to 2 Hz with its steps
# [7] runs of a roller on a straight way differ by 5 to 10 % in um per revolution; `hard`: of another batch of robots
# [8] Goldman, Cox and Brenner (1967), in full: rigs/simulated/hindrance.py
# [9] as in the first world; `hard`: one and a half times
# [10] motion timed with a camera of 30 frames a second: 4 of 40 ms; `hard`: one buffer more or less
# [11] a sweep in steps of 5 % and a field known to 5 %; `hard`: the surface is not the same everywhere
# [12] a chip that was put back after its registration: 5 to 10 um and 0.2 degrees; `hard`: registered by eye
# [13] vibration criterion VC-A for microscopes (Gordon 1991): 50 um/s above 8 Hz, so 1 um; a hundredth of that, and of
#      a camera pixel, passes an isolated table and is left out; `hard`: a bench beside a pump
WORLDS: Mapping[str, Mapping[str, Any]] = {
    "kind": {
        "inlet_speed_error": 0.25,
        "outlet_pressure_error": 0.1,
        "viscosity_error": 0.1,
        "depth_error": 0.0,
        "unstated_depth_widths": 0.0,
        "wall_error_px": 0.0,
        "blocked_share": 0.0,
        "drift_share": 0.0,
        "drift_s": 60.0,
        "pulsation_share": 0.0,
        "pulsation_hz": 1.0,
        "pulsation_phase_deg": 0.0,
        "k": 1,
        "um_per_rev_error": 0.0,
        "slip": 0.0,
        "hindrance": 0.0,
        "position_noise_um": 1.0,
        "temperature_k": 0.0,
        "heading_noise_rad": 0.03,
        "speed_noise": 0.02,
        "delay_error": 0.0,
        "step_out_error": 0.0,
        "coil_error": 0.0,
        "offset_px": 0.0,
        "angle_error_deg": 0.0,
        "scale_error": 0.0,
        "shake_um": 0.0,
        "shake_hz": 3.0,
        "optics": "disc",
    },
    "moderate": {
        "inlet_speed_error": 0.15,  # [1]
        "outlet_pressure_error": 0.05,  # [2]
        "viscosity_error": 0.05,  # [3]
        "depth_error": 0.1,  # [4]
        "unstated_depth_widths": 0.0,  # who measures the depth states it
        "wall_error_px": 0.33,  # [5]
        "blocked_share": 0.0,
        "drift_share": 0.02,  # [6]
        "drift_s": 60.0,  # [6] a turn of the screw takes a minute
        "pulsation_share": 0.0,
        "k": 1,
        "um_per_rev_error": 0.08,  # [7]
        "slip": 0.0,  # part of um per revolution
        "hindrance": 1.0,  # [8]
        "position_noise_um": 1.0,  # [9]
        "temperature_k": 295.0,
        "heading_noise_rad": 0.03,  # [9]
        "speed_noise": 0.02,  # [9]
        "delay_error": 0.1,  # [10]
        "step_out_error": 0.1,  # [11]
        "coil_error": 0.0,
        "offset_px": 1.0,  # [12] 10 um in the default view
        "angle_error_deg": 0.2,  # [12]
        "scale_error": 0.003,  # [12]
        "shake_um": 0.0,  # [13]
        "shake_hz": 3.0,
        "optics": "oblique",
    },
    "hard": {
        "inlet_speed_error": 0.3,  # [1]
        "outlet_pressure_error": 0.15,  # [2]
        "viscosity_error": 0.15,  # [3]
        "depth_error": 0.25,  # [4]
        "unstated_depth_widths": 0.8,  # milled or moulded channels are about as deep as wide
        "wall_error_px": 1.0,  # [5]
        "blocked_share": 0.35,  # an air bubble or debris at a wall that lets a robot pass
        "drift_share": 0.05,  # [6]
        "drift_s": 30.0,
        "pulsation_share": 0.15,  # [6]
        "k": 1,
        "um_per_rev_error": 0.15,  # [7]
        "slip": 0.05,
        "hindrance": 1.0,  # [8]
        "position_noise_um": 1.5,  # [9]
        "temperature_k": 295.0,
        "heading_noise_rad": 0.045,  # [9]
        "speed_noise": 0.03,  # [9]
        "delay_error": 0.3,  # [10]
        "step_out_error": 0.2,  # [11]
        "coil_error": 0.0,
        "offset_px": 2.0,  # [12]
        "angle_error_deg": 0.5,  # [12]
        "scale_error": 0.01,  # [12]
        "shake_um": 1.0,  # [13]
        "shake_hz": 3.0,
        "optics": "oblique",
    },
}
