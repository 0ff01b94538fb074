"""The flow of a map follows a measured pump: by the right factor, at the right time, only where that is the flow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flowrec.core import (
    NS_PER_S,
    PUMP,
    SAMPLES,
    STREAMS,
    FlowField,
    Observations,
    PumpShare,
    Samples,
    StreamStates,
    Tick,
    UsageError,
)
from flowrec.physics import Chip, FlowSolver, Opening, PowerLaw, sample
from flowrec.stages import as_planned
from flowrec.stages.estimation.pump import PumpFollower, at_pump
from flowrec.stages.estimation.superposition import Superposition, at_share

STEP_S = 0.04


def channel(*values: float) -> Chip:
    """A straight channel from the left to the right with these outlet pressures in Pa, or one."""
    mask = np.zeros((20, 60), bool)
    mask[6:14] = True
    if len(values) == 2:
        mask[:6, 28:32] = True
    outlets = [Opening("right", 6, 13, "outlet", values[0] if values else 0.0)]
    outlets += [Opening("top", 28, 31, "outlet", values[1])] if len(values) == 2 else []
    return Chip("channel", mask, 10.0, (Opening("left", 6, 13, "inlet", 200.0), *outlets), 1.0, 1000.0)


def states_of() -> StreamStates:
    return StreamStates(
        0,
        "pump",
        "pump/other\npump/flow",
        "\nul/min",
        *(np.ones(1, np.int32), *(np.zeros(1, np.int64),) * 5),
        *(np.zeros(1),) * 3,
    )


def samples_of(stamp: int, value: float) -> Samples:
    """A sample of each channel: 99 of the first, this of the second."""
    values = np.array([99.0, value])
    return Samples(stamp, np.array([0, 1], np.int32), np.array([stamp, stamp]), values, values)


def flown(
    pump: PumpFollower, measured: list[float], memory_s: float = 0.0, inlets: Superposition | None = None
) -> list[PumpShare | None]:
    """The share at each tick, with one sample a tick, taken at the tick."""
    states = states_of()
    last, shares = Tick(), list[PumpShare | None]()
    for number, value in enumerate(measured):
        stamp = round(number * STEP_S * NS_PER_S)
        new: dict[str, object] = {STREAMS: states}
        if np.isfinite(value):
            new[SAMPLES] = samples_of(stamp, value)
        tick = Tick(stamp, extra=last.extra.with_messages(new))  # type: ignore[arg-type]
        share = pump.follow(last, tick, inlets, memory_s)
        shares.append(share)
        last = tick if share is None else replace(tick, extra=tick.extra.with_messages({PUMP: share}))
    return shares


def test_the_share_is_the_measured_value_over_the_nominal_one() -> None:
    found = flown(PumpFollower("pump/flow", nominal=12.0, smoothing_s=0.0), [12.0, 12.0, 18.0, 6.0])
    assert [each.share for each in found if each] == pytest.approx([1.0, 1.0, 1.5, 0.5])


def test_a_mean_over_samples_settles_with_its_memory_and_the_slow_mean_later() -> None:
    found = flown(PumpFollower("pump/flow", smoothing_s=0.2), [1.0] + [2.0] * 50)
    times = STEP_S * np.arange(51)
    assert [each.share for each in found if each] == pytest.approx(2.0 - np.exp(-times / 0.2))
    assert 1.2 < found[-1].slow_share < 1.5  # type: ignore[union-attr]


def test_of_a_silent_stream_the_last_value_stays_and_before_the_first_there_is_none() -> None:
    found = flown(PumpFollower("pump/flow", smoothing_s=0.0), [np.nan, 1.3, np.nan, np.nan])
    assert found[0] is None and [each.share for each in found if each] == pytest.approx([1.3] * 3)
    assert len({each.sample_ns for each in found if each}) == 1
    assert flown(PumpFollower(), [1.0, 2.0]) == [None, None]


def test_the_time_that_a_sample_tells_of_lies_the_delay_before_it() -> None:
    found = flown(PumpFollower("pump/flow", delay_s=0.5), [1.0, 1.0])
    assert found[1].sample_ns == round((STEP_S - 0.5) * NS_PER_S)  # type: ignore[union-attr]


def test_a_scaled_field_is_that_of_the_scaled_boundary_values() -> None:
    chip, solver = channel(), FlowSolver(convection=False)
    faster = replace(chip, openings=tuple(replace(each, value=1.3 * each.value) for each in chip.openings))
    of_share, solved = at_share(solver.solve(chip), 1.3), solver.solve(faster)
    assert of_share.velocity_um_s == pytest.approx(solved.velocity_um_s, rel=1e-5, abs=1e-3)
    assert of_share.pressure_pa == pytest.approx(solved.pressure_pa, rel=1e-5, abs=1e-7)


def test_an_observation_is_that_of_the_nominal_flow_with_the_error_of_the_pump_in_it() -> None:
    one = Observations(1, np.zeros((1, 2)), np.array([[130.0, 0.0]]), np.array([5.0]), np.array([[26.0, 0.0]]))
    pump = PumpShare(2, 1.6, 1.0, 1.3, 0)
    first = PumpFollower("pump/flow", error_share=0.1).at_nominal(None, one, pump)
    assert first is not None and first.flow_um_s.tolist() == [[100.0, 0.0]] and first.rolled_um_s is not None
    assert first.std_um_s == pytest.approx([np.hypot(5.0, 13.0) / 1.3]) and first.rolled_um_s.tolist() == [[20.0, 0.0]]
    both = PumpFollower("pump/flow").at_nominal(first, first.followed_by(replace(one, stamp_ns=2)), pump)
    assert both is not None and both.flow_um_s.tolist() == [[100.0, 0.0], [100.0, 0.0]]  # the first only once
    assert PumpFollower("pump/flow").at_nominal(both, both, pump) is both
    still = replace(pump, observed_share=0.0)
    assert PumpFollower("pump/flow").at_nominal(first, both, still) is first


@pytest.mark.parametrize("delay_s", [0.0, 0.3])
def test_what_a_bead_tells_is_over_the_mean_share_of_its_own_stretch_of_time(delay_s: float) -> None:
    def flow(time_s: np.ndarray) -> np.ndarray:
        return 1.0 + 0.5 * np.sin(2.0 * np.pi * 0.7 * time_s)

    ticks_s = STEP_S * np.arange(200)
    pump = PumpFollower("pump/flow", smoothing_s=0.0, error_share=0.1, delay_s=delay_s)
    share = flown(pump, flow(ticks_s - delay_s).tolist(), memory_s=4.0)[-1]
    assert share is not None and len(share.mark_s) < 70  # bounded, however long the run is
    began_s, ended_s = np.array([4.1, 6.0]), np.array([7.0, 6.5])
    means = np.array([flow(np.linspace(a, b, 1000)).mean() for a, b in zip(began_s, ended_s, strict=True)])
    assert pump.mean_share(share, began_s, ended_s) == pytest.approx(means, rel=0.02)
    seen = Observations(1, np.zeros((2, 2)), means[:, None] * np.array([200.0, 0.0]), np.full(2, 5.0), None)
    nominal = pump.stretches_at_nominal(share, seen, began_s, ended_s)
    assert nominal is not None and nominal.flow_um_s[:, 0] == pytest.approx(200.0, rel=0.02)
    assert nominal.std_um_s == pytest.approx(np.hypot(5.0, 20.0 * means) / means, rel=0.02)
    steady = flown(pump, [1.5] * 100, memory_s=4.0)[-1]
    assert steady is not None  # up to now, of which the sensor tells later only
    assert pump.mean_share(steady, np.array([3.0]), np.array([99 * STEP_S])) == pytest.approx(1.5)
    stands = replace(share, flowed_s=np.zeros_like(share.flowed_s), share=0.0)
    assert pump.stretches_at_nominal(stands, seen, began_s, ended_s) is None


def test_routes_are_planned_with_the_slow_mean_of_the_pump() -> None:
    flow = FlowSolver(convection=False).solve(channel())
    tick = Tick(1, assumed=flow)
    planned = as_planned(replace(tick, extra=tick.extra.with_messages({PUMP: PumpShare(1, 3.0, 1.5, 1.0, 0)})))
    assert planned.assumed is not None
    assert planned.assumed.velocity_um_s == pytest.approx(1.5 * flow.velocity_um_s)
    assert as_planned(tick) is tick


@pytest.mark.parametrize(
    ("chip", "streams", "complaint"),
    [
        (channel(), ("scale",), r"there is no section \[streams\.pump\]; there are scale"),
        (channel(0.0, 5.0), ("pump",), "its outlets have different pressures"),
        (replace(channel(), law=PowerLaw(0.6)), ("pump",), "the viscosity of its fluid depends on the flow"),
        (replace(channel(), viscosity_mpa_s=1e-3), ("pump",), r"has inertia \(Reynolds number 16\)"),
    ],
)
def test_a_flow_that_does_not_follow_its_pump_by_a_factor_is_refused(
    chip: Chip, streams: tuple[str, ...], complaint: str
) -> None:
    pump = PumpFollower("pump/flow")
    with pytest.raises(UsageError, match=complaint):
        pump.refuse_unfit(chip, streams, inertia=True, tracers=False)
    pump.refuse_unfit(channel(), ("pump",), inertia=True, tracers=True)
    PumpFollower().refuse_unfit(chip, (), inertia=True, tracers=True)


def junction() -> Chip:
    """A T: two inlets of 200 and 100 um/s at the left and the top, an outlet at the right."""
    mask = np.zeros((40, 60), bool)
    mask[24:32] = True
    mask[:24, 26:32] = True
    openings = (
        Opening("left", 24, 31, "inlet", 200.0),
        Opening("top", 26, 31, "inlet", 100.0),
        Opening("right", 24, 31, "outlet", 0.0),
    )
    return Chip("junction", mask, 10.0, openings, 1.0, 1000.0)


SOLVER = FlowSolver(convection=False)
TWO = PumpFollower(inlets=("pump/other", "pump/flow"), nominals=(99.0, 10.0), smoothing_s=0.0, error_share=0.0)


def driven(*shares: float) -> FlowField:
    chip = junction()
    values = (200.0 * shares[0], 100.0 * shares[1], 0.0)
    openings = tuple(replace(each, value=value) for each, value in zip(chip.openings, values, strict=True))
    return SOLVER.solve(replace(chip, openings=openings))


def test_two_pumps_drive_the_sum_of_what_each_inlet_drives_alone() -> None:
    inlets = Superposition.of(junction(), SOLVER)
    shares = flown(TWO, [10.0, 5.0, 20.0], inlets=inlets)  # of the second one; the first tells its nominal value
    for share, ratio in zip(shares, (1.0, 0.5, 2.0), strict=True):
        assert share is not None and share.share == pytest.approx((1600.0 + 600.0 * ratio) / 2200.0)
        now, true = at_pump(driven(1.0, 1.0), share, inlets), driven(1.0, ratio)
        assert now is not None and now.velocity_um_s == pytest.approx(true.velocity_um_s, rel=1e-4, abs=5e-3)
        assert now.pressure_pa == pytest.approx(true.pressure_pa, rel=1e-4, abs=1e-6)
    # A refined map, here one a tenth faster, keeps what it has learned.
    faster = at_share(driven(1.0, 1.0), 1.1)
    both = replace(shares[0], share=2.0, inlets=np.array([2.0, 2.0, 2.0, 0.0] * 2))  # type: ignore[type-var]
    assert at_pump(faster, both, inlets).velocity_um_s == pytest.approx(2.2 * driven(1.0, 1.0).velocity_um_s, rel=1e-4)  # type: ignore[union-attr]


def test_what_the_robot_observes_between_two_pumps_is_the_nominal_flow() -> None:
    inlets, place_um = Superposition.of(junction(), SOLVER), np.array([[290.0, 200.0], [450.0, 270.0], [100.0, 280.0]])
    seen_um_s, nominal_um_s = sample(driven(1.0, 2.0), place_um), sample(driven(1.0, 1.0), place_um)
    share = flown(TWO, [20.0], inlets=inlets)[0]
    assert share is not None and abs(seen_um_s - nominal_um_s).max() > 50.0
    for place, seen, nominal in zip(place_um, seen_um_s, nominal_um_s, strict=True):
        one = Observations(1, place[None], seen[None], np.array([5.0]), None)
        found = TWO.at_nominal(None, one, share, inlets)
        assert found is not None and found.flow_um_s[0] == pytest.approx(nominal, rel=1e-3, abs=0.1)
    planned = as_planned(Tick(1, assumed=driven(1.0, 1.0), extra=Tick().extra.with_messages({PUMP: share})), inlets)
    assert planned.assumed is not None
    assert planned.assumed.velocity_um_s == pytest.approx(driven(1.0, 2.0).velocity_um_s, rel=1e-4, abs=5e-3)


def test_each_of_two_pumps_is_followed_as_a_single_one_is_and_observed_as_the_observer_sees_it() -> None:
    inlets, measured = Superposition.of(junction(), SOLVER), [10.0, 14.0, 14.0, 6.0, 6.0]
    both = flown(replace(TWO, smoothing_s=0.2), measured, inlets=inlets)
    alone = flown(PumpFollower("pump/flow", nominal=10.0, smoothing_s=0.2), measured)
    for two, one in zip(both, alone, strict=True):
        assert two is not None and one is not None
        assert two.inlets[4:6] == pytest.approx([one.share, one.slow_share])
    uneven = replace(alone[0], inlets=np.array([1.0, 1.0, 3.0, 0.0, 1.0, 1.0, 2.0, 0.0]), observed_share=3.0)  # type: ignore[type-var]
    one_um = Observations(1, np.array([[100.0, 280.0]]), np.array([[600.0, 0.0]]), np.array([5.0]), None)
    found = TWO.at_nominal(None, one_um, uneven, inlets)
    away_um_s = inlets.departure_um_s(one_um.position_um, np.array([3.0, 2.0]))
    assert found is not None and found.flow_um_s == pytest.approx((one_um.flow_um_s - away_um_s) / 3.0)


def test_a_replay_that_follows_two_pumps_or_tracers_from_a_tick_on_begins_there() -> None:
    inlets = Superposition.of(junction(), SOLVER)
    alone = PumpFollower("pump/flow", nominal=10.0)
    recorded = flown(alone, [12.0])[0]
    assert recorded is not None
    last = Tick(0, extra=Tick().extra.with_messages({PUMP: recorded}))
    tick = Tick(1, extra=last.extra.with_messages({STREAMS: states_of(), SAMPLES: samples_of(1, 9.0)}))
    of_two, with_marks = TWO.follow(last, tick, inlets), alone.follow(last, tick, memory_s=4.0)
    assert of_two is not None and of_two.inlets[[0, 4]] == pytest.approx([1.0, 0.9])
    assert with_marks is not None and with_marks.mark_s.tolist() == [1e-9]


@pytest.mark.parametrize(
    ("pump", "tracers", "complaint"),
    [
        (replace(TWO, channel="pump/flow"), False, "pump.channel is of one pump that feeds all inlets"),
        (replace(TWO, inlets=("pump/flow",)), False, "chip 'junction' has 2 inlets; name a channel for each"),
        (replace(TWO, nominals=(1.0,)), False, r"pump\.nominals = \[1\.0\]: give a value for each of 2 inlets"),
        (TWO, True, "tracers follow one pump only"),
        (replace(TWO, inlets=("pump/flow", "scale/flow")), False, r"there is no section \[streams\.scale\]"),
    ],
)
def test_pumps_that_do_not_fit_the_inlets_are_refused(pump: PumpFollower, tracers: bool, complaint: str) -> None:
    with pytest.raises(UsageError, match=complaint):
        pump.refuse_unfit(junction(), ("pump",), inertia=False, tracers=tracers)
    TWO.refuse_unfit(junction(), ("pump",), inertia=False, tracers=False)


def test_a_sample_that_is_no_number_leaves_the_share_as_it_is() -> None:
    pump, nothing = PumpFollower("pump/flow", nominal=10.0, smoothing_s=0.0), samples_of(40_000_000, np.nan)
    first = Tick(0, extra=Tick().extra.with_messages({STREAMS: states_of(), SAMPLES: samples_of(0, 15.0)}))
    share = pump.follow(Tick(), first)
    assert share is not None and share.share == 1.5
    told = replace(first, extra=first.extra.with_messages({PUMP: share}))
    after = pump.follow(told, Tick(40_000_000, extra=told.extra.with_messages({SAMPLES: nothing})))
    assert after is not None and after.share == after.slow_share == 1.5
    assert (
        pump.follow(Tick(), Tick(0, extra=Tick().extra.with_messages({STREAMS: states_of(), SAMPLES: nothing}))) is None
    )


def test_before_the_first_sample_the_pump_is_taken_to_be_as_it_then_was() -> None:
    pump = PumpFollower("pump/flow", nominal=10.0, smoothing_s=0.0)
    last = flown(pump, [15.0] * 50, memory_s=10.0)[-1]
    assert last is not None
    began_s, ended_s = np.array([-5.0, -3.0, 0.5, 1.0]), np.array([1.5, -1.0, 1.0, 1.0])
    np.testing.assert_allclose(pump.mean_share(last, began_s, ended_s), 1.5)
