"""The simulated rig: a microscope, coils and a robot in a flow that differs from the assumed one.

Only `truth` and `true_field` hold what no stage may know. The world is a function of the seed and of the
commands, and does not depend on the time that the loop takes. In real time, stamps are made as for a real camera, from
its own clock and from the arrival of its frames.
"""

from __future__ import annotations

import math
import time
from collections.abc import Generator, Iterator, Sequence
from copy import copy
from dataclasses import replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from flowrec.core import (
    NS_PER_S,
    Applied,
    Currents,
    DeviceClock,
    Floats,
    FlowField,
    Frame,
    Image,
    RigError,
    Truth,
    check_ranges,
    nanoseconds,
    seconds,
)
from flowrec.physics import Calibration, Chip, Robot, check_point
from flowrec.rigs.simulated.beads import Beads
from flowrec.rigs.simulated.bodies import Debris, Swimmer
from flowrec.rigs.simulated.microscope import DrawnRobot, Microscope, Particles
from flowrec.rigs.simulated.others import OtherRobot, other_robots
from flowrec.rigs.simulated.pump import PumpSensor
from flowrec.rigs.simulated.world import (
    Shake,
    TrueCoils,
    World,
    misregister,
    true_depth_um,
    true_pump,
    true_robot,
    world_of,
)
from flowrec.rigs.streams.stream import SampleStream
from flowrec.stages import (
    Coils,
    FieldCommand,
    FieldState,
    Inputs,
    Pipeline,
    ResolvedCamera,
    ResolvedConfig,
    Simulated,
    StreamSettings,
    field_motion,
    registration_of,
)

_COILS = 3  # of a rig without settings of coils
_SKEW_PPM = 50.0  # of a crystal, at most
_STEADY_S = 0.1  # a field that has not risen for so long is up
_STARTED_S = 3600.0  # ago, at most


class _CameraClock:
    """The camera's clock: ns since it was switched on, slightly too fast or too slow; and the delays of its frames."""

    def __init__(self, simulated: Simulated) -> None:
        rng = np.random.default_rng([simulated.seed, 6])
        drawn_ppm, started_s = float(rng.uniform(-_SKEW_PPM, _SKEW_PPM)), float(rng.uniform(0.0, _STARTED_S))
        skew_ppm = drawn_ppm if simulated.clock_skew_ppm is None else simulated.clock_skew_ppm
        self._rate = 1.0 + 1e-6 * skew_ppm
        self._started = round(started_s * NS_PER_S)
        self._jitter_s = simulated.arrival_jitter_s
        self._rng = rng

    def device(self, world_ns: int) -> int:
        """Its count."""
        return self._started + round(self._rate * world_ns)

    def delay_s(self) -> float:
        """Delay of the next frame beyond that of the earliest ones."""
        return self._jitter_s * float(self._rng.standard_exponential())


def true_view(config: ResolvedConfig, chip: Chip) -> Calibration:
    """The camera's true view of the chip, which [camera] states as it is assumed."""
    keys, camera = ("um_per_px", "angle_deg", "mirror", "centre_um"), config.camera
    true = {key: value for key in keys if (value := getattr(config.simulated, key)) is not None}
    stated = registration_of(replace(camera, **true), chip)
    return misregister(stated, config.simulated, camera.size_px)


class SimulatedRig:
    """Camera, coils and the world between them; see rigs.rig.Rig.

    Parameters
    ----------
    chip, calibration : the assumed chip, and the camera's true view of it.
    robot : as it is assumed, with its delay from `apply` to motion; `simulated` says how it truly differs.
    start_um : (2,) centre of the robot on the first frame.
    duration_s : None: without end.
    realtime : pace the frames to the host's clock and stamp them by the camera's clock, fitted to it; no frame is
        skipped.
    true_field : a flow to use instead of a drawn one, between the chip's own walls.
    coils : the relation of field and currents; None: always the full field, with the commanded currents.
    hold_s : for how long, and until the field is up, the robot is held at the start, as by a pipette.

    Raises RigError, ChipError or UsageError for settings that do not describe a world.
    """

    @classmethod
    def of(
        cls,
        pipeline: Pipeline,
        config: ResolvedConfig,
        duration_s: float | None = None,
        realtime: bool = False,
        true_field: FlowField | None = None,
    ) -> Self:
        """The rig of a resolved configuration."""
        return cls(
            pipeline.chip,
            config.robot,
            true_view(config, pipeline.chip),
            config.camera,
            config.simulated,
            config.mission.start,
            duration_s=duration_s,
            realtime=realtime,
            true_field=true_field,
            coils=config.coils,
            hold_s=config.mission.hold_start_s,
        )

    def __init__(
        self,
        chip: Chip,
        robot: Robot,
        calibration: Calibration,
        camera: ResolvedCamera,
        simulated: Simulated,
        start_um: ArrayLike,
        duration_s: float | None = None,
        realtime: bool = False,
        true_field: FlowField | None = None,
        coils: Coils | None = None,
        hold_s: float = 0.0,
    ) -> None:
        check_ranges(camera, "camera")
        check_ranges(simulated, "simulated")
        check_point(chip, start_um, "start", robot.radius_um)
        self._chip = chip
        self._robot = robot
        self.calibration = calibration
        self._camera = camera
        self._simulated = simulated
        x, y = (float(value) for value in np.asarray(start_um, np.float64))
        self._start_um = (x, y)
        self._rate_hz = camera.rate_hz
        self._frames = math.inf if duration_s is None else max(1.0, math.floor(duration_s * self._rate_hz) + 1)
        self._realtime = realtime
        self._given = true_field
        self._world: World | None = None
        self._true_robot = true_robot(robot, simulated)
        self.pump = true_pump(simulated)
        self._shake = Shake.of(simulated)
        self._delay_ns = nanoseconds(self._true_robot.delay_s)
        self._now_ns = 0
        self._coils = coils
        self._count = _COILS if coils is None else coils.count
        self._true_coils = TrueCoils.of(coils, simulated)
        # For how much longer the robot is held at its start, and the field's strength before; None: it is not held.
        self._hold: tuple[float, float] | None = (hold_s, 0.0) if hold_s > 0.0 else None
        # The command in effect and the state of its field; commands on their way, as (stamp of their effect, command).
        self._acting: Currents | None = None
        self._rotation = FieldState()
        self._coming: list[tuple[int, Currents]] = []
        self._latest: Currents | None = None
        # Set by zero(), in any thread: one attribute, which the loop's thread reads before every step of the world. A
        # lock could be held by an interrupted loop.
        self._cut = False
        self.epoch_ns: int | None = None

    def stream(self, name: str, settings: StreamSettings) -> SampleStream:
        """The flow sensor at its pump; see rigs.rig.Measuring."""
        sensor = self._simulated.sensor
        return PumpSensor(
            self.pump, sensor.rate_hz, sensor.noise_share, sensor.delay_s, self._simulated.seed, lambda: self._now_ns
        )

    def __enter__(self) -> SimulatedRig:
        self._cut = False
        return self

    def __exit__(self, *error: object) -> None:
        self.zero()

    def apply(self, currents: Currents) -> None:
        """Send a command; the field changes after the delay. The same message again is no new command."""
        if currents is self._latest or (self._cut and currents.amplitude_mt > 0.0):
            return
        self._latest = currents
        self._coming.append((self._now_ns + self._delay_ns, currents))

    def zero(self) -> None:
        """Switch the field off at once, until the rig is entered again."""
        self._cut = True

    def _microscope(self) -> Microscope:
        world, simulated = self.true_world(), self._simulated
        return Microscope(
            world.mask,
            world.mask_um_per_px,
            self.calibration,
            self._camera,
            simulated.image,
            simulated.seed,
            simulated.value("optics"),
            world.mask_origin_um,
        )

    def picture(self) -> Image:
        """The chip alone."""
        return self._microscope().image(())

    def inputs(self) -> Iterator[Inputs]:
        """Frame after frame, at index / rate seconds; the first comes with the true flow field."""
        world = self.true_world()
        field, walls = world.field, world.clearance_um
        radius, seed = self._robot.radius_um, self._simulated.seed
        swimmer, others = self._swimmers(world)
        debris = Debris(self._chip, self._simulated.image.debris, radius, field, walls, seed)
        microscope = self._microscope()
        depth_um = true_depth_um(self._chip, self._simulated, radius)
        beads = Beads(self._chip, self._simulated, radius, depth_um, field, walls, self.pump)
        moving = slice(0, len(debris.points_um) - debris.still)
        radii = np.concatenate((debris.radii_um[moving], beads.radii_um))
        darkness = np.concatenate((debris.darkness[moving], beads.darkness))
        for n in range(moving.stop, len(debris.points_um)):
            microscope.add_still(debris.points_um[n], float(debris.radii_um[n]), float(debris.darkness[n]))
        debris.drift(0.0)  # compiles, so that the second frame is not late
        camera_clock, host_clock, fit = _CameraClock(self._simulated), DeviceClock(), None
        began_ns: int | None = None
        index = 0
        while index < self._frames:
            stamp = round(index * NS_PER_S / self._rate_hz)
            before = swimmer.position_um
            turns = self._advance([swimmer, *others], stamp)
            elapsed = seconds(stamp - self._now_ns)
            if elapsed > 0:
                debris.drift(elapsed)
                beads.drift(elapsed)
            self._now_ns = stamp
            robots = [each.look(elapsed) for each in others if not each.gone]
            if not swimmer.gone:
                velocity = (swimmer.position_um - before) / elapsed if elapsed > 0 else np.zeros(2)
                robots.append(DrawnRobot(swimmer.position_um, radius, velocity))
            particles = Particles(np.concatenate((debris.points_um[moving], beads.points_um)), radii, darkness)
            stage_um = None if self._shake is None else self._shake.at(seconds(stamp))
            image = microscope.image(robots, particles, stage_um)
            arrival_ns = stamp + nanoseconds(camera_clock.delay_s())
            if self._realtime:
                # An image arrives after its exposure. The first one, with all its preparation, sets the clock.
                over_ns = nanoseconds(0.5 * self._camera.exposure_s)
                began_ns = time.monotonic_ns() - over_ns if began_ns is None else began_ns
                self.epoch_ns = began_ns
                time.sleep(max(0.0, seconds(began_ns + arrival_ns + over_ns - time.monotonic_ns())))
                arrival_ns = time.monotonic_ns() - began_ns - over_ns
            fit = host_clock.take(fit, camera_clock.device(stamp), arrival_ns)
            stamped = fit.stamp_ns if self._realtime else stamp
            yield Inputs(
                stamp_ns=stamped,
                frame=Frame(stamped, index, image, self._camera.bits),
                applied=self._field_message(stamped, turns),
                truth=Truth(stamped, swimmer.position_um, swimmer.flow_um_s, swimmer.clearance_um, swimmer.contacts),
                true_field=field if index == 0 else None,
                true_tracers=beads.truth(stamped) if self._simulated.tracers else None,
                clock=fit,
                extra=dict(each.truth(stamped) for each in others),
            )
            index += 1

    def _swimmers(self, world: World) -> tuple[Swimmer, list[OtherRobot]]:
        """The robot of the mission and the others, at their starts."""
        robot, simulated, start_um, px = self._true_robot, self._simulated, self._start_um, self._chip.um_per_px
        field, walls, pump, hindrance = world.field, world.clearance_um, self.pump, world.hindrance
        first = Swimmer(start_um, robot, simulated, field, walls, px, pump, hindrance)
        common = {"field": field, "pump": pump, "hindrance": hindrance}
        return first, other_robots(self._chip, robot, simulated, start_um, walls, **common)

    def tried(self) -> Generator[Inputs]:
        """Run on a copy of this rig with the same world and camera; a later run does not depend on it."""
        self.true_world()  # once for both
        yield from copy(self).inputs()

    def true_world(self) -> World:
        """Flow and walls as they truly are, for evaluation."""
        if self._given is not None and self._given.velocity_um_s.shape[:2] != self._chip.mask.shape:
            raise RigError(
                f"true flow has {self._given.velocity_um_s.shape[:2]} pixels, the chip {self._chip.mask.shape}; "
                "solve it on this chip"
            )
        if self._world is None:
            clear_um = np.array([self._start_um])
            self._world = world_of(self._chip, self._robot, self._simulated, self._given, clear_um)
        return self._world

    def _advance(self, swimmers: Sequence[Swimmer], until_ns: int) -> Floats:
        """Advance the world to a stamp; the field changes exactly when commands take effect. Returns the turns (2,)."""
        turns = np.zeros(2)
        now = self._now_ns
        while True:
            if self._cut:
                self._coming.clear()
                self._acting = Currents(now, 0.0, 0.0, 0.0, 0.0, np.zeros(self._count), False)
            switch = self._coming[0][0] if self._coming else until_ns
            end = min(max(switch, now), until_ns)
            lasts_s = seconds(end - now)
            if lasts_s and self._acting is None:
                self._move(swimmers, lasts_s, 0.0, 0.0, 0.0)
            elif lasts_s and self._acting is not None:
                turns += self._turn(swimmers, self._acting, lasts_s)
            now = end
            if not (self._coming and self._coming[0][0] <= now):
                return turns
            self._acting = self._coming.pop(0)[1]

    def _turn(self, swimmers: Sequence[Swimmer], command: Currents, duration_s: float) -> Floats:
        """Let the field turn, and the robots with it, as control/field_rotation.py has it. Returns the turns (2,)."""
        way = field_motion(self._rotation, _order(command))
        self._rotation = way.after(duration_s)
        turns = np.zeros(2)
        full_mt = self._coils.amplitude_mt if self._coils is not None else 0.0
        strength = min(command.amplitude_mt / full_mt, 1.0) if full_mt > 0.0 else float(command.amplitude_mt > 0.0)
        for leg in way.segments(duration_s):
            self._move(swimmers, leg.duration_s, leg.frequency_hz, leg.heading_rad, strength)
            if strength > 0.0:
                heading = np.array([math.cos(leg.heading_rad), math.sin(leg.heading_rad)])
                turns += leg.frequency_hz * leg.duration_s * heading
        return turns

    def _move(
        self, swimmers: Sequence[Swimmer], duration_s: float, frequency_hz: float, heading_rad: float, strength: float
    ) -> None:
        """Let the robots move, but the first one only while nothing holds it."""
        swimmer, *others = swimmers
        true_rad, part = (heading_rad, 1.0) if self._true_coils is None else self._true_coils.motion(heading_rad)
        for each in others if self._hold is not None else swimmers:
            each.advance(duration_s, frequency_hz, true_rad, strength * part)
        if self._hold is None:
            return
        swimmer.wait(duration_s)
        left_s, before = self._hold
        rises = strength > before or strength == 0.0
        left_s = max(left_s, _STEADY_S) if rises else left_s - duration_s
        self._hold = (left_s, strength) if left_s > 0.0 else None

    def _field_message(self, stamp_ns: int, turns: Floats) -> Applied:
        command, now = self._acting, self._rotation
        if command is None:
            return Applied(stamp_ns, 0.0, 0.0, 0.0, np.zeros(self._count), turns)
        currents = command.currents_a
        if self._coils is not None:
            field = self._coils.field_mt(now.phase_rad, now.plane_rad, command.amplitude_mt)
            currents = self._coils.currents_a(field, command.amplitude_mt)
        heading = field_motion(now, _order(command)).heading_rad(0.0)
        return Applied(stamp_ns, command.frequency_hz, heading, command.amplitude_mt, currents, turns)


def _order(command: Currents) -> FieldCommand:
    """Field of a command; its amplitude, already on a ramp, at once."""
    c = command
    return FieldCommand(c.frequency_hz, c.heading_rad, c.amplitude_mt, c.limit_hz)
