"""Windows of the data about as large as a shape, which may be one thing among others."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import torch
from torch import Tensor

from torchreg.alignment.fit.free_space_term import FreeSpaceTerm
from torchreg.alignment.fit.problem import AlignProblem
from torchreg.geometry.neighbors import k_nearest_others
from torchreg.geometry.sampling import farthest_points


@dataclass(frozen=True)
class _Windowing:
    """Numbers of windows; lengths are shares of the shape's size."""

    radius: float = 0.55  # the shape fits in, in any pose
    centers: int = 8  # at most
    moves: int = 2  # of a center to the mean of what is around it
    same: float = 0.2  # windows nearer than this are one
    inside: float = 0.95  # share of the data in a first window with which there are no others
    least: int = 60  # data in a window
    neighbors: int = 4  # of a datum, the farthest of which tells how dense the data are
    dense: float = 3.0  # medians of that distance up to which a datum is not scattered


_WINDOWING = _Windowing()


Problem = TypeVar("Problem", bound=AlignProblem)


@dataclass(frozen=True, eq=False)
class DataWindows(Generic[Problem]):
    """Windows of the data of B problems: the problem (W rows) of each, and of which problem it is, (W,)."""

    problem: Problem
    row: Tensor

    @classmethod
    def of(cls, problem: Problem) -> DataWindows[Problem]:
        """Return the windows of a batch: one where the data fit in it, and in crops of pictures."""
        whole = problem.factor(FreeSpaceTerm) is not None
        masks = [
            [valid] if whole else ball_windows(points, valid, _WINDOWING.radius * problem.size)
            for points, valid in zip(problem.data, problem.valid, strict=True)
        ]
        row = torch.arange(len(masks)).repeat_interleave(torch.tensor([len(several) for several in masks]))
        valid = torch.stack([mask for several in masks for mask in several])
        return cls(replace(problem.rows(row.to(valid.device)), valid=valid), row)

    def best(self, costs: Tensor) -> Tensor:
        """Return the window (B,) of each problem with the least cost (W,)."""
        table = costs.new_full((int(self.row.max()) + 1, len(self.row)), torch.inf)
        number = torch.arange(len(self.row))
        table[self.row, number] = costs
        return table.argmin(1)


def ball_windows(data: Tensor, valid: Tensor, radius: float) -> list[Tensor]:
    """Return the masks (M,) of data (M, 3) in balls around what is dense: of all where they fit in one."""
    points, apart = data[valid], _WINDOWING.same / _WINDOWING.radius * radius
    if len(points) > _WINDOWING.neighbors:
        # Scattered outliers are no other thing.
        gaps = k_nearest_others(points, _WINDOWING.neighbors)[1].amax(-1)
        points = points[gaps <= _WINDOWING.dense * gaps.median()]

    def around(center: Tensor) -> Tensor:
        return ((data - center).norm(dim=-1) < radius) & valid

    if len(points) == 0:
        return [valid]
    near = (points - points.median(0).values).norm(dim=-1) < radius
    if float(near.double().mean()) > _WINDOWING.inside:
        return [valid]
    centers: list[Tensor] = []
    for center in points[farthest_points(points, min(_WINDOWING.centers, len(points)))]:
        for _ in range(_WINDOWING.moves):
            center = data[around(center)].mean(0)
        if all(float((center - other).norm()) > apart for other in centers):
            centers.append(center)
    return [window for window in map(around, centers) if int(window.sum()) >= _WINDOWING.least] or [valid]
