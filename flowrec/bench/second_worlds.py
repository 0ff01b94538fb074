"""Worlds of a second generator: surveys whose chip, robot, pump and camera share nothing with the simulated rig.

A survey is a robot that follows the centre lines of a chip of second_chips.py, downstream and back, and the flow that
it measures. The truth is solved on walls that are finer than the mask. Every world has small errors of everything (a
chip depth of 5 %, um per revolution of 2 %, a tenth of a pixel of registration, inlet speeds of 15 %, outlet pressures
of up to 15 % of the pressure drop), and one fault or two, of a size that its seed draws. The laws come from other
sources than the model's and the rig's: drag beside a wall by lubrication (ln of radius over gap), pumps by their
rollers or by their steps, viscosity by Cross (1965).

Seeds under 1000 are for development, those from it on for figures.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.ndimage import binary_dilation, binary_erosion, distance_transform_edt, gaussian_filter, map_coordinates

from flowrec.bench.second_chips import FINE, SIDE_PX, DrawnChip, coarse, draw_chip, draw_discs, side_channel, to_fine
from flowrec.bench.vessels import photograph, threshold_by_neighbours, threshold_by_otsu
from flowrec.core import Bools, Floats, FlowError, FlowField, Observations
from flowrec.physics import CarreauYasuda, Chip, FlowSolver, Opening, find_openings

UM_PER_PX = 10.0
RADIUS_UM = 8.0  # of the robot
STEP_S = 0.05  # of the robot's way
WINDOW, EVERY = 8, 12  # steps over which an observation is a mean, and from one to the next
MOST_STEPS = 3_000  # of a survey
_ATTEMPTS = 40  # chips that are drawn until one can be solved


@dataclass(slots=True)
class SecondWorld:
    """The truth beside the flow; faults change it."""

    drawn_chip: DrawnChip
    rng: np.random.Generator
    fine: list[Bools]  # the truth's walls, over equal parts of the survey
    mask: Bools  # that the laboratory has
    law: CarreauYasuda | None = None
    um_per_rev_share: float = 1.0  # true over stated
    heading_rad: float = 0.0  # of the robot's motion from its stated heading
    response: Callable[[Floats], float] = lambda _: 1.0  # of the own motion at a point (2,) in um
    flow_factor: Callable[[float], float] = lambda _: 1.0  # at a time in s
    drift_um_s: Floats = field(default_factory=lambda: np.zeros(2))  # of the stage
    scale: float = 1.0  # um that the camera states, per um
    clock_s: float = 0.0  # by which the log of the coils is late
    hidden: tuple[Floats, float] | None = None  # centre and radius in um of what nothing is seen behind
    noise: float = 0.05  # of an observation, over the root mean square speed; 5 % is stated


@dataclass(frozen=True, slots=True, eq=False)
class MadeSurvey:
    """Chip and observations of a laboratory, and the truth for scoring alone."""

    chip: Chip
    observations: Observations
    truth_um_s: Floats  # (h, w, 2)
    fluid: Bools  # (h, w) where the truth has fluid
    planted: list[str]  # expressions for the sentences of a refinement that are right


def _otsu(world: SecondWorld) -> None:
    world.mask = threshold_by_otsu(photograph(world.fine[0], 1.0, FINE))


def _adaptive(world: SecondWorld) -> None:
    world.mask = threshold_by_neighbours(photograph(world.fine[0], 1.0, FINE))


def _dilate_mask(world: SecondWorld) -> None:
    world.mask = coarse(binary_dilation(world.fine[0], iterations=round(FINE * world.rng.uniform(0.6, 1.2))))


def _erode_mask(world: SecondWorld) -> None:
    steps = round(FINE * world.rng.uniform(0.6, 1.2))
    world.mask = coarse(binary_erosion(world.fine[0], iterations=steps, border_value=1))


def _roller(world: SecondWorld) -> None:
    """Pulses of a peristaltic pump, which lose flow when a roller leaves the tube, after a start-up."""
    hz, depth, start_s = world.rng.uniform(0.3, 1.2), world.rng.uniform(0.3, 0.8), world.rng.uniform(1.0, 4.0)
    lost = 0.3  # of a period

    def factor(t: float) -> float:
        phase = (hz * t) % 1.0
        dip = depth * np.sin(np.pi * phase / lost) if phase < lost else 0.0
        return float((1.0 - dip) / (1.0 - 2.0 * depth * lost / np.pi) * (1.0 - np.exp(-t / start_s)))

    world.flow_factor = factor


def _syringe(world: SecondWorld) -> None:
    """A plunger that sticks and slips: the flow falls and jumps back, at intervals that vary."""
    jumps = np.cumsum(world.rng.uniform(3.0, 12.0, 100))
    fall, start_s = world.rng.uniform(0.1, 0.3), world.rng.uniform(2.0, 6.0)

    def factor(t: float) -> float:
        number = int(np.searchsorted(jumps, t))
        before = jumps[number - 1] if number else 0.0
        phase = (t - before) / (jumps[number] - before)
        return float((1.0 + fall * (0.5 - phase)) * (1.0 - np.exp(-t / start_s)))

    world.flow_factor = factor


def _drag(world: SecondWorld) -> None:
    """Own motion that falls with the logarithm of the gap to the side wall, and a heading that is turned."""
    strength = world.rng.uniform(0.1, 0.25)
    distance = distance_transform_edt(np.pad(world.fine[0], FINE, mode="edge"))[FINE:-FINE, FINE:-FINE]

    def response(point_um: Floats) -> float:
        gap = max(_at(distance, point_um) / FINE * UM_PER_PX - RADIUS_UM, 0.1 * RADIUS_UM)
        return float(1.0 / (1.0 + strength * np.log1p(5.0 * RADIUS_UM / gap)))

    world.response = response
    world.heading_rad += np.deg2rad(world.rng.uniform(2.0, 5.0) * world.rng.choice([-1.0, 1.0]))


def _slip(world: SecondWorld) -> None:
    """Own motion that is up to 30 % too slow, smoothly by place."""
    rough = gaussian_filter(world.rng.standard_normal(world.mask.shape), 12.0)
    slip = 0.3 * (rough - rough.min()) / np.ptp(rough)
    world.response = lambda point_um: 1.0 - float(_bilinear(slip, point_um / UM_PER_PX))


def _bubble(world: SecondWorld, radii: Floats, along: Floats) -> None:
    """Discs on the centre line of a branch, one after the other, as shares of its half width and of its length."""
    branch = world.drawn_chip.strokes[1]
    fine = world.fine[0]
    world.fine = []
    for radius, share in zip(radii, along, strict=True):
        at = int(share * (len(branch.line) - 1))
        image = fine.astype(np.uint8)
        draw_discs(image, branch.line[[at]], 0.5 * radius * branch.width[[at]], 0)
        world.fine.append(image.astype(bool))


def _moving_bubble(world: SecondWorld) -> None:
    _bubble(world, np.full(3, world.rng.uniform(0.4, 0.7)), world.rng.uniform(0.3, 0.5) + np.array([0.0, 0.08, 0.16]))


def _growing_bubble(world: SecondWorld) -> None:
    _bubble(world, world.rng.uniform(0.6, 0.8) * np.array([0.4, 0.7, 1.0]), np.full(3, world.rng.uniform(0.3, 0.6)))


def _leak(world: SecondWorld) -> None:
    world.fine = [world.drawn_chip.fine_mask(side_channel(world.drawn_chip, world.rng))]


def _drifting_stage(world: SecondWorld) -> None:
    angle = world.rng.uniform(0.0, 2.0 * np.pi)
    px_per_minute = world.rng.uniform(1.0, 2.0)
    world.drift_um_s = px_per_minute * UM_PER_PX / 60.0 * np.array([np.cos(angle), np.sin(angle)])


def _thinning(world: SecondWorld) -> None:
    """Cross's law, 1 / (1 + (time rate)^m): that of Carreau and Yasuda with n = 1 - m and a = m."""
    power = world.rng.uniform(0.4, 0.8)
    world.law = CarreauYasuda(1.0 - power, world.rng.uniform(0.3, 3.0), 0.0, power)


def _late_clock(world: SecondWorld) -> None:
    world.clock_s = world.rng.uniform(0.15, 0.5)


def _occlusion(world: SecondWorld) -> None:
    way = world.drawn_chip.ways[0].line
    centre = way[int(len(way) * world.rng.uniform(0.4, 0.8))] * UM_PER_PX
    world.hidden = centre, UM_PER_PX * world.rng.uniform(12.0, 22.0)


def _scale(world: SecondWorld) -> None:
    world.scale *= 1.0 + world.rng.uniform(0.02, 0.05) * world.rng.choice([-1.0, 1.0])


def _weak_robot(world: SecondWorld) -> None:
    world.um_per_rev_share *= 1.0 + world.rng.uniform(0.08, 0.2) * world.rng.choice([-1.0, 1.0])


def _noisy(world: SecondWorld) -> None:
    world.noise *= 2.0


_KINDS: Mapping[str, tuple[Callable[[SecondWorld], None], str]] = {
    # fault by name: what it changes, and the expression for the sentences of a refinement that name it
    "otsu": (_otsu, "the mask (seems|may be)|the walls seem off"),
    "adaptive": (_adaptive, "the mask (seems|may be)|the walls seem off"),
    "dilated": (_dilate_mask, "the mask (seems|may be).*too wide|the walls seem off"),
    "eroded": (_erode_mask, "the mask (seems|may be).*too narrow|the walls seem off"),
    "roller": (_roller, "the pump pulsates|the flow (changes|wanders)"),
    "syringe": (_syringe, "the pump pulsates|the flow (changes|wanders)"),
    "drag": (_drag, "less per revolution|own course|near walls the robot rolls by .* slower"),
    "slip_by_place": (_slip, "less per revolution|near walls the robot rolls by .* slower"),
    "moving_bubble": (_moving_bubble, "partly blocked|the flow (changes|wanders)"),
    "growing_bubble": (_growing_bubble, "partly blocked|the flow (changes|wanders)"),
    "leak": (_leak, "$^"),
    "drifting_stage": (_drifting_stage, "the chip lies .* from where|the image scale|the chip is turned"),
    "cross_fluid": (_thinning, "viscosity"),
    "late_clock": (_late_clock, "own course"),
    "occlusion": (_occlusion, "$^"),
    "other_scale": (_scale, "the image scale|the chip lies .* from where"),
    "weak_robot": (_weak_robot, "per revolution than stated"),
    "noisy": (_noisy, "$^"),
}
SECOND_WORLDS = ("as_stated", *_KINDS, "two_faults")


def faults_of(world: str, seed: int) -> tuple[str, ...]:
    """The faults of a world; those of `two_faults` are drawn by its seed."""
    if world == "two_faults":
        return tuple(np.random.default_rng([seed, 0x2F]).choice(list(_KINDS), 2, replace=False).tolist())
    return () if world == "as_stated" else (world,)


def _right_words(world: SecondWorld, faults: Sequence[str], offset_px: Floats) -> list[str]:
    """Expressions for the sentences that are right: those of the faults, and of small errors that can be noticed."""
    words = [_KINDS[fault][1] for fault in faults]
    words.append("the walls seem off by [1-4] um")  # a mask of pixels, of walls that lie anywhere in them
    if abs(world.um_per_rev_share - 1.0) > 0.01:
        words.append(f"{'less' if world.um_per_rev_share < 1.0 else 'more'} per revolution than stated")
    if float(np.hypot(*offset_px)) > 0.15:
        words.append("the chip lies .* from where")
    return words


def make_survey(world: str, seed: int) -> MadeSurvey:
    """The survey of a world and a seed; chip and survey of a seed differ between worlds only by their faults.

    Raises FlowError if no flow can be solved on any chip that is drawn.
    """
    faults = faults_of(world, seed)
    for attempt in range(_ATTEMPTS):
        rng = np.random.default_rng([seed, 0x5EC0, attempt])
        drawn = draw_chip(rng)
        fine = drawn.fine_mask()
        made = SecondWorld(drawn, np.random.default_rng([seed, 0xFA, attempt]), [fine], coarse(fine))
        made.um_per_rev_share *= 1.0 + rng.normal(0.0, 0.02)
        made.heading_rad += np.deg2rad(rng.normal(0.0, 0.3))
        for fault in faults:
            _KINDS[fault][0](made)
        try:
            return _survey(made, faults, rng)
        except FlowError:
            continue
    raise FlowError(f"second worlds: no chip of seed {seed} in world '{world}' can be solved; try another seed")


def _survey(world: SecondWorld, faults: Sequence[str], rng: np.random.Generator) -> MadeSurvey:
    speed, depth_px = float(rng.uniform(25.0, 90.0)), float(rng.uniform(5.0, 25.0))
    pressures, errors = rng.uniform(0.0, 0.15, 8), rng.normal(0.0, 1.0, 10)
    chip = Chip("second", world.mask, UM_PER_PX, (), 1.0, 1_000.0, depth_px * UM_PER_PX * (1.0 + 0.05 * errors[0]))
    flows: list[FlowField] = []
    drop = 0.0
    for fine in world.fine:
        true = replace(chip, mask=fine, um_per_px=UM_PER_PX / FINE, depth_um=depth_px * UM_PER_PX)
        true = replace(true, openings=_with_inlet(find_openings(fine), speed), law=world.law)
        drop = drop or float(np.ptp(FlowSolver(1).solve(true).pressure_pa))
        values = [o.value if o.kind == "inlet" else drop * p for o, p in zip(true.openings, pressures, strict=False)]
        flows.append(FlowSolver(1).solve(true.with_boundary(values)))
    openings = _with_inlet(find_openings(world.mask), speed * (1.0 + 0.15 * errors[1]))
    if len(openings) != len(_with_inlet(find_openings(coarse(world.drawn_chip.fine_mask())), speed)):
        raise FlowError("the picture shows other openings")
    offset_px = 0.1 * rng.normal(size=2)
    observations, mean_factor = _observe(world, flows, offset_px, rng)
    centres = (slice((FINE - 1) // 2, None, FINE),) * 2
    return MadeSurvey(
        replace(chip, openings=openings),
        observations,
        mean_factor * flows[-1].velocity_um_s[centres].astype(np.float64),
        coarse(world.fine[-1]),
        _right_words(world, faults, offset_px),
    )


def _with_inlet(openings: tuple[Opening, ...], speed_um_s: float) -> tuple[Opening, ...]:
    if not any(o.side == "left" for o in openings) or len(openings) < 2:
        raise FlowError("the chip has no inlet on the left, or nothing else")
    return tuple(replace(o, kind="inlet", value=speed_um_s) if o.side == "left" else o for o in openings)


def _observe(
    world: SecondWorld, flows: list[FlowField], offset_px: Floats, rng: np.random.Generator
) -> tuple[Observations, float]:
    """The observations of the robot, and the flow's mean factor over the second half of the survey."""
    legs = [leg * UM_PER_PX for leg in _legs(world.drawn_chip, rng)]
    speed = np.hypot(*np.moveaxis(flows[0].velocity_um_s[world.fine[0]], -1, 0))
    typical = float(np.sqrt((speed**2).mean()))
    images = [flow.velocity_um_s.astype(np.float64) for flow in flows]
    places: list[Floats] = []
    velocities: list[Floats] = []
    owns: list[Floats] = []
    c, s = np.cos(world.heading_rad), np.sin(world.heading_rad)
    turn = np.array([[c, -s], [s, c]])
    rolling = np.zeros(2)
    for number, leg in enumerate(legs):
        # Downstream it swims at half of the typical speed, upstream faster than the fastest flow.
        swims = 0.5 * typical if number % 2 == 0 else 1.2 * float(speed.max())
        way = np.r_[0.0, np.cumsum(np.hypot(*np.diff(leg, axis=0).T))]
        gone = 0.0
        while gone < way[-1] - 1.0 and len(places) < MOST_STEPS:
            t = len(places) * STEP_S
            here, ahead = (np.array([np.interp(at, way, leg[:, axis]) for axis in (0, 1)]) for at in (gone, gone + 1.0))
            along = (ahead - here) / max(float(np.hypot(*(ahead - here))), 1e-9)
            image = images[min(int(len(images) * (number + gone / way[-1]) / len(legs)), len(images) - 1)]
            flow = world.flow_factor(t) * np.array([_at(image[..., axis], here) for axis in (0, 1)])
            rolling = rolling * (1.0 - STEP_S / 0.7) + 0.03 * np.sqrt(2.0 * STEP_S / 0.7) * rng.standard_normal(2)
            own = swims * along - (flow - (flow @ along) * along)  # holds its course against the flow across
            ground = own + flow
            share = world.um_per_rev_share * world.response(here) * (1.0 + rolling[0])
            owns.append(turn.T @ (own + rolling[1] * own[::-1] * np.array([-1.0, 1.0])) / share)
            places.append(world.scale * here + UM_PER_PX * offset_px + world.drift_um_s * t)
            velocities.append(world.scale * ground)
            gone += STEP_S * max(float(ground @ along), 0.05 * typical)
    position, measured, rolled = (np.array(each) for each in (places, velocities, owns))
    count = len(position)
    late = round(world.clock_s / STEP_S)
    rolled = np.concatenate([np.repeat(rolled[:1], late, axis=0), rolled])[:count]
    firsts = np.arange(0, count - WINDOW, EVERY)
    firsts = firsts[:: max(1, len(firsts) // 90)]

    def mean(values: Floats) -> Floats:
        return np.stack([np.mean(values[first : first + WINDOW], axis=0) for first in firsts])

    std = 0.05 * typical
    noise = world.noise * typical * np.where(rng.random((len(firsts), 1)) < 0.05, 2.5, 0.9)
    flow_um_s = mean(measured - rolled) + noise * rng.standard_normal((len(firsts), 2))
    seen = np.ones(len(firsts), bool)
    if world.hidden is not None:
        seen = np.hypot(*(mean(position) - world.hidden[0]).T) > world.hidden[1]
    observations = Observations(
        round(1e9 * count * STEP_S),
        mean(position),
        flow_um_s,
        np.full(len(firsts), std),
        mean(rolled),
        STEP_S * (firsts.astype(np.float64) + 0.5 * WINDOW),
        RADIUS_UM,
    )
    times = STEP_S * np.arange(count // 2, count)
    return observations.only(seen), float(np.mean([world.flow_factor(t) for t in times]))


def _legs(chip: DrawnChip, rng: np.random.Generator) -> list[Floats]:
    """Points of the robot's way in pixels of the mask: down one branch, back, and down another one or not."""
    legs: list[Floats] = []
    order = rng.permutation(len(chip.ways))[: int(rng.integers(1, 3))]
    for number in order:
        way = chip.ways[number]
        inside = np.flatnonzero(((way.line > 4.0) & (way.line < SIDE_PX - 5.0)).all(axis=1))
        last = inside[0] + int(len(inside) * rng.uniform(0.7, 0.98))
        swings = rng.uniform(2.0, 5.0) * np.linspace(0.0, 1.0, len(way.width)) + rng.random()
        wander = 0.25 * way.width * np.sin(2.0 * np.pi * swings)
        direction = np.gradient(way.line, axis=0)
        normal = direction[:, ::-1] * np.array([-1.0, 1.0]) / np.maximum(np.hypot(*direction.T), 1e-9)[:, None]
        line = (way.line + wander[:, None] * normal)[inside[0] : last]
        turns_at = len(line) // 3 if len(order) > 1 else len(line) // 2
        legs += [line[turns_at:] if legs else line, line[:turns_at:-1]]
    return legs


def _at(fine: Floats, point_um: Floats) -> float:
    """Value of an image of the truth at a point (2,) in um."""
    return _bilinear(fine, to_fine(point_um / UM_PER_PX))


def _bilinear(image: Floats, point_px: Floats) -> float:
    x, y = point_px
    return float(map_coordinates(image, [[y], [x]], order=1, mode="nearest")[0])
