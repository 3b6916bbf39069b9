"""``torchreg train-initializer``: train the network that proposes poses of a shape."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchreg.cli.outputs import Quiet, with_ending, written_to
from torchreg.cli.reporting import reporting
from torchreg.cli.shape_argument import Shape, ShapeOptions

if TYPE_CHECKING:
    from torchreg.alignment.train_initializer import TrainingRow


@reporting
def train_initializer(
    shape: Shape,
    output: Annotated[Path, written_to("OUT.safetensors", "The weights; beside it a checkpoint and a curve.")] = Path(
        "initializer.safetensors"
    ),
    *,
    minutes: Annotated[float, typer.Option(help="Of training; again with more to go on where it ended.")] = 30.0,
    batch: Annotated[int, typer.Option(help="Made-up clouds per step; 512 on a GPU.")] = 64,
    seed: Annotated[int, typer.Option(help="Of the network and of the clouds.")] = 0,
    device: Annotated[str, typer.Option(help="cpu or cuda.")] = "cpu",
    options: ShapeOptions,
    quiet: Quiet = False,
) -> None:
    """Train a network that proposes poses of a shape, on made-up clouds of it; again to go on."""
    from torchreg.alignment.train_initializer import TrainInitializerConfig, train_initializer

    path = with_ending(output, (".safetensors",), add=True)
    model = options.load(shape).to(device)
    config = TrainInitializerConfig(minutes=minutes, batch=batch, seed=seed)
    train_initializer(model, path, config, progress=None if quiet else _show)
    if not quiet:
        typer.echo(f"wrote {path}")


def _show(row: TrainingRow) -> None:
    typer.echo(
        f"step {row.step}  {row.seconds / 60:.1f} min  loss {row.loss:.3f}  of clouds not trained on: error "
        f"{row.error:.1%} of the size, {row.near:.0%} within 5 %"
    )
