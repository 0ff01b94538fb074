from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest

from flowrec.rigs.lab.cameras.device_counts import BlockIds


def unwrapped(ids: Iterable[int], bits: int, rate_hz: float = 0.0, period_ns: int = 10_000_000) -> list[int]:
    """The index after each id, of blocks that arrive one by one."""
    unwrap = BlockIds()
    unwrap.reset(bits, rate_hz)
    found = []
    for n, block_id in enumerate(ids):
        unwrap.step(block_id, n * period_ns)
        found.append(unwrap.index)
    return found


def device_ids(start: int, count: int, bits: int) -> np.ndarray:
    """What a device sends that begins with an id, by the standards: 16 bits leave out 0, others do not."""
    if bits == 16:
        return (start - 1 + np.arange(count)) % 65_535 + 1
    return np.array([(start + n) % (1 << bits) for n in range(count)], object)


@pytest.mark.parametrize(("bits", "start"), [(16, 1), (16, 65_401), (32, 2**32 - 9), (64, 0), (64, 1), (64, 2**64 - 3)])
def test_ids_of_every_width_are_unwrapped_across_their_overflow(bits: int, start: int) -> None:
    assert unwrapped(map(int, device_ids(start, 70_000 if bits == 16 else 50, bits)), bits)[-1] == (
        69_999 if bits == 16 else 49
    )


@pytest.mark.parametrize("bits", [16, 32, 64])
def test_whatever_is_left_out_the_index_is_that_of_the_device(bits: int) -> None:
    rng = np.random.default_rng(bits)
    ids = device_ids(int(rng.integers(60_000, 65_536)) if bits == 16 else 2**bits - 500, 9_000, bits)
    kept = np.flatnonzero(rng.random(len(ids)) < 0.3)
    assert unwrapped((int(ids[n]) for n in kept), bits) == list(kept - kept[0])


def test_a_16_bit_camera_that_does_send_block_0_is_believed() -> None:
    assert unwrapped([65_534, 65_535, 0, 1, 2], 16) == [0, 1, 2, 3, 4]
    assert unwrapped([0, 1, 2], 16) == [0, 1, 2]


def test_blocks_that_come_late_or_twice_do_not_move_the_index() -> None:
    unwrap = BlockIds()
    unwrap.reset(16)
    assert [unwrap.step(block, 0) for block in (65_534, 2, 65_535, 1, 2, 3)] == [1, 3, -2, -1, 0, 1]
    assert unwrap.index == 4


def test_a_device_that_counts_anew_goes_on_with_the_next_index() -> None:
    assert unwrapped([70_000, 70_001, 1, 2], 64) == [0, 1, 2, 3]
    assert unwrapped([40_000, 40_001, 1, 2], 16, rate_hz=100.0) == [0, 1, 2, 3]
    unwrap = BlockIds()
    unwrap.reset(64)
    unwrap.step(5, 0)
    unwrap.reset(16)
    assert unwrap.step(9, 0) == 1 and unwrap.index == 1


def test_a_long_gap_after_a_stall_of_the_host_is_a_gap() -> None:
    # 100 Hz; the host stands still for 5 s, then takes 8 blocks that the driver had kept, and the newest one.
    unwrap = BlockIds()
    unwrap.reset(16, 100.0)
    for n in range(10):
        unwrap.step(n + 1, n * 10_000_000)
    late_ns = 5_100_000_000
    for n in range(8):
        unwrap.step(n + 11, late_ns + n)
    assert unwrap.step(510, late_ns + 8) == 492 and unwrap.restarts == 0
