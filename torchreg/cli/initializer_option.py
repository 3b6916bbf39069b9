"""The option of a network that proposes where a shape is."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from torchreg.errors import InputError

if TYPE_CHECKING:
    from torchreg.alignment.pose_proposer import PoseProposer
    from torchreg.shapes.articulated import ArticulatedShape

Initializer = Annotated[
    Path | None,
    typer.Option(
        metavar="WEIGHTS.safetensors",
        help="Network that proposes poses where there is no start, as `torchreg train-initializer` writes it for the "
        "shape; the shape hand has one.",
    ),
]


def read_initializer(path: Path | None, shape: ArticulatedShape, side: str | None = None) -> PoseProposer | None:
    """Return the network of a file for a shape, None for None; FormatError if it is for another shape."""
    if path is None:
        return None
    if side == "either":
        raise InputError("--initializer cannot be used with --side either; it is a network for one of the hands")
    from torchreg.alignment.pose_proposer import PoseProposer

    return PoseProposer.load(path, shape)
