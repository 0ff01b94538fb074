"""Weights of networks on disk, in the safetensors format: reading a file never executes code; tensors are checked."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from flowrec.core import WEIGHTS, FlowError, Output

if TYPE_CHECKING:
    from torch import Tensor, nn

FOLDER = Path(__file__).parent / "weights"
SHIPPED = {"vessels": FOLDER / "pi_unet.safetensors", "unet": FOLDER / "unet.safetensors"}


def write_weights(path: Path, network: nn.Module, facts: Mapping[str, str]) -> None:
    """Store the network's parameters in half precision, with facts about their training. Replaces an existing file."""
    import torch
    from safetensors.torch import save

    halves = {name: value.detach().cpu().to(torch.float16).contiguous() for name, value in network.state_dict().items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    # One entry of metadata: the order of several is not reproducible.
    with Output(path, WEIGHTS, overwrite=True).new_file() as part:
        part.write_bytes(save(halves, {"facts": json.dumps(dict(facts), sort_keys=True)}))


def read_weights(path: Path, network: nn.Module) -> None:
    """Load a file into the network.

    Raises
    ------
    FlowError
        If the file is missing, not a safetensors file or damaged, or its tensors are not those of the network.
    """
    import torch
    from safetensors import SafetensorError
    from safetensors.torch import load

    try:
        stored = load(path.read_bytes())
    except OSError as error:
        raise FlowError(
            f"{path}: weights can not be read ({error.strerror}); a clone of the repository "
            "trains them: 'python -m flowrec.bench.training'"
        ) from error
    except (SafetensorError, ValueError, KeyError, TypeError) as error:
        raise FlowError(f"{path}: not a sound safetensors file ({error}); train the weights anew") from error
    wanted: dict[str, Tensor] = network.state_dict()
    for name in sorted(wanted.keys() | stored.keys()):
        if name not in stored or name not in wanted:
            fault = "unknown" if name in stored else "no"
            raise FlowError(f"{path}: {fault} tensor '{name}'; these weights are of another network")
        if stored[name].shape != wanted[name].shape:
            shapes = f"{tuple(stored[name].shape)}, not {tuple(wanted[name].shape)}"
            raise FlowError(f"{path}: tensor '{name}' is {shapes}; these weights are of another network")
        if not torch.isfinite(stored[name]).all():
            raise FlowError(f"{path}: tensor '{name}' is not finite; train the weights anew")
    network.load_state_dict({name: value.to(torch.float32) for name, value in stored.items()})


def sha256(path: Path) -> str:
    """Hash of a file of weights, '' where there is none."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return ""
