"""Which parts moved as one."""

from __future__ import annotations

import torch
from torch import Tensor


def joined_alike(apart: Tensor, counts: Tensor, meet: Tensor, tolerance: float) -> Tensor:
    """Return the part of each piece when the two that meet and moved most alike are joined again and again.

    What was joined moves as its larger piece then. So chains of pieces, each of which moves much like the next, do not
    make one part of all. It ends when, of any two that meet, the motion of neither leaves the other's points within the
    tolerance of where they went, in the mean.

    Args:
        apart: (T, B, B) how far the motion of piece a takes the points of piece b from where they went, ``[t, a, b]``,
            in all, in each of T frames.
        counts: (B,) points of each piece; those without any are not joined.
        meet: (B, B) bool, which pieces meet, symmetric.
        tolerance: in the unit of ``apart``, in the mean over the points, in the worst frame.

    Returns:
        (B,) int64, the number of one of the pieces of each part.
    """
    apart, counts, meet = apart.clone(), counts.clone(), meet.clone().fill_diagonal_(False)
    part = torch.arange(len(counts), device=counts.device)
    meet &= (counts > 0) & (counts > 0).unsqueeze(1)
    while bool(meet.any()):
        mean = apart / counts.clamp_min(1)
        gap = torch.minimum(mean, mean.mT).amax(0).masked_fill(~meet, torch.inf)
        one, other = divmod(int(gap.argmin()), len(counts))
        if float(gap[one, other]) > tolerance:
            break
        if counts[other] > counts[one]:
            one, other = other, one
        apart[..., one] += apart[..., other]
        counts[one] += counts[other]
        meet[one] |= meet[other]
        meet[:, one] |= meet[:, other]
        meet[other], meet[:, other], meet[one, one] = False, False, False
        part[part == other] = one
    return part
