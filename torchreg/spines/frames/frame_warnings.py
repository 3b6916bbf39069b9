"""Warnings on the frames of a sequence: irregularities, and the statuses that follow from them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor

from torchreg.geometry.skeleton import Skeleton
from torchreg.result import Status


def statuses_and_warnings(notes: Sequence[Sequence[str]]) -> dict[str, Any]:
    """Return the statuses of the frames and of all, and the warnings, from the notes on each frame."""
    return {
        "statuses": tuple(Status.WITH_WARNINGS if rows else Status.CONVERGED for rows in notes),
        "status": Status.WITH_WARNINGS if any(notes) else Status.CONVERGED,
        "warnings": tuple(f"frame {frame}: {row}" for frame, rows in enumerate(notes) for row in rows),
    }


def irregularities(
    skeleton: Skeleton, notes: Sequence[str], num_named: int, missing: Tensor, transferred: Tensor
) -> list[str]:
    """Return the irregularities of a frame, with missing tips (K,) and transferred limbs (L,)."""
    rows = [*notes, *skeleton.notes]
    superfluous = len(skeleton.tips) - num_named
    if superfluous > 0:
        rows.append(f"{superfluous} superfluous tip(s) left out")
    if bool(missing.any()):
        rows.append(f"tips {_true_numbers(missing)} not found")
    if bool(transferred.any()):
        rows.append(f"limbs {_true_numbers(transferred)} carried over from other frames")
    return rows


def _true_numbers(flags: Tensor) -> str:
    """Return the numbers of flags (n,) that are True, as a list in words."""
    return ", ".join(str(number) for number in flags.nonzero()[:, 0].tolist())
