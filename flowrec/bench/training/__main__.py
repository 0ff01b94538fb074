"""`python -m flowrec.bench.training DIR FILE`: train the weights that flowrec ships."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from flowrec.bench.training.train import Training, train
from flowrec.core import FlowrecError

_DEFAULT = Training()


def main(
    lessons: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of lessons; missing ones are made.")],
    out: Annotated[Path, typer.Argument(metavar="FILE", help="Weights to write (*.safetensors).")],
    network: Annotated[Literal["pi_unet", "unet"], typer.Option(help="Which network.")] = "pi_unet",
    count: Annotated[int, typer.Option(min=4, help="Number of lessons.")] = _DEFAULT.lessons,
    steps: Annotated[int, typer.Option(min=1, help="Optimiser steps of four lessons each.")] = _DEFAULT.steps,
    device: Annotated[Literal["cpu", "cuda"], typer.Option(help="Where to train.")] = "cpu",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the lessons and of the initial weights.")] = 0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing output file.")] = False,
) -> None:
    """Train the weights of a network on random vessel networks; flowrec's own solver computes the truth."""
    try:
        figures = train(
            lessons, out, Training(network, count, steps, device=device, seed=seed), typer.echo, overwrite=overwrite
        )
    except FlowrecError as error:
        raise SystemExit(str(error)) from None
    typer.echo(f"wrote {out}: error {figures['best']:.4f} after {figures['cpu_s']:.0f} s")


if __name__ == "__main__":
    typer.run(main)
