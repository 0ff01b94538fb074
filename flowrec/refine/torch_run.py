"""A run of torch that gives the same bytes every time and leaves torch's global state as it was."""

from __future__ import annotations

import contextlib
import os
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

    if device == "cuda":
        if not torch.cuda.is_available():
            raise FlowError(f"{setting} = 'cuda', but torch sees no GPU: set it to 'cpu'")
        # Without it cuBLAS refuses to be deterministic; it is read when cuBLAS starts.
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    before, strict = torch.get_num_threads(), torch.are_deterministic_algorithms_enabled()
    torch.set_num_threads(threads)
    try:
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            torch.use_deterministic_algorithms(True)
            yield
    finally:
        torch.use_deterministic_algorithms(strict)
        torch.set_num_threads(before)
