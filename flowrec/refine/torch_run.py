"""A run of torch that gives the same bytes every time and leaves torch's global state as it was."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Literal

from flowrec.errors import FlowError

Device = Literal["cpu", "cuda"]


@contextlib.contextmanager
def torch_run(device: Device, threads: int, seed: int, setting: str) -> Iterator[None]:
    """Seeded, with a fixed number of threads; imports torch. `setting` names the device's setting in the error.

    Raises
    ------
    FlowError
        If the device is not there.
    """
    import torch

    if device == "cuda" and not torch.cuda.is_available():
        raise FlowError(f"{setting} = 'cuda', but torch sees no GPU: set it to 'cpu'")
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            yield
    finally:
        torch.set_num_threads(before)
