"""Torch held still: seeded, deterministic, with a fixed number of threads, and as it was before afterwards."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator

import torch

from flowrec.errors import FlowError


@contextlib.contextmanager
def torch_state(threads: int, seed: int, device: str = "cpu") -> Iterator[None]:
    """Inside, the same computation gives the same bytes.

    Raises
    ------
    FlowError
        If the device is not there.
    """
    if device == "cuda":
        if not torch.cuda.is_available():
            raise FlowError("refiner.pi_unet.device = 'cuda', but torch sees no GPU: set it to 'cpu'")
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
