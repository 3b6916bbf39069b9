"""Which hand it is: given, or the better of both."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated

import typer

from torchreg.errors import InputError

if TYPE_CHECKING:
    from torchreg.alignment.results import AlignResult
    from torchreg.shapes.hand import Hand

Side = Annotated[
    str | None,
    typer.Option(
        metavar="right|left|either",
        help="Of the shape hand: which one it is; either tries both on the first file and keeps the better one.",
    ),
]
_HANDS = {"right": "hand", "left": "hand-left", "either": "hand"}


def shape_of_side(shape: str, side: str | None) -> str:
    """Return the name of the shape for a side; InputError where a side has no meaning."""
    from torchreg._checks import check_choice

    if side is None:
        return shape
    check_choice(side, "--side", tuple(_HANDS))
    if shape != "hand":
        raise InputError(f"--side has no meaning for {shape}; leave it out, or name the shape hand")
    return _HANDS[side]


def better_hand(align: Callable[[Hand], AlignResult]) -> Hand:
    """Return the hand, right or left, whose alignment leaves less unexplained: of other crops, the surer one."""
    from torchreg.shapes.hand import Hand

    hands = [Hand("right"), Hand("left")]
    right, left = (align(hand) for hand in hands)
    if len(right.distances) == len(left.distances):
        return hands[int(bool(left.cost < right.cost))]
    surer = [0.0 if found.confidence is None else float(found.confidence) for found in (right, left)]
    return hands[int(surer[1] > surer[0])]
