"""What else may explain a picture: a surface that goes on past the shape, a few planes; both speak against a pose."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from torchreg.alignment.fit.problem import AlignProblem
from torchreg.alignment.fit.surface_fit import SURFACE_FIT, surface_noise
from torchreg.capture.depth_frame import DepthFrame
from torchreg.capture.depth_segments import open_rim
from torchreg.geometry.planes import distance_to_plane


@dataclass(frozen=True)
class Alternatives:
    """Numbers of the other explanations."""

    on_shape: float = (
        0.03  # farthest distance of data on the shape, share of its size: a fit of another hand errs by .02
    )
    num_planes: int = 2  # faces that a box shows; more of them follow any surface
    num_data: int = 600  # that planes are fitted to


ALTERNATIVES = Alternatives()


def open_rims(problem: AlignProblem, pose: Tensor, frames: Sequence[DepthFrame]) -> Tensor:
    """Return the share (B,) of the rim of the data on the shape where the surface continues; zero without frames."""
    shares = torch.zeros_like(pose[:, 0])
    for row, frame in enumerate(frames if len(frames) == len(pose) else ()):
        shares[row] = open_rim(frame, partial(_lies_on, problem, pose, row))
    return shares


def _lies_on(problem: AlignProblem, pose: Tensor, row: int, points: Tensor) -> Tensor:
    """Return which points (M, 3) of the world lie on the shape of one row, (M,) bool."""
    local = (points - problem.origin[row].to(points)).to(pose)
    lies_on = local.norm(dim=-1) < 2 * problem.size  # what is farther cannot
    distance = problem.surface.distance(local[lies_on][None], pose[row, None])[0]
    lies_on[lies_on.clone()] = distance.abs() < ALTERNATIVES.on_shape * problem.size
    return lies_on


def planes_instead(problem: AlignProblem, distance: Tensor) -> Tensor:
    """Return by how much better a few planes explain the data on the shape, (B,), from 0 (not at all) to 1."""
    stride = -(-problem.data.shape[1] // ALTERNATIVES.num_data)
    data, distance, valid = (values[:, ::stride] for values in (problem.data, distance, problem.valid))
    on_shape = valid & (distance.abs() < ALTERNATIVES.on_shape * problem.size)
    least = SURFACE_FIT.min_noise(problem.size)
    band = SURFACE_FIT.max_noise(problem.size)
    from_plane = torch.full_like(distance, torch.inf)
    generator = torch.Generator().manual_seed(0)
    for _ in range(ALTERNATIVES.num_planes):
        left = on_shape & (from_plane > band)
        from_plane = torch.minimum(from_plane, distance_to_plane(data, left, band, generator))
    ratio = surface_noise(distance, on_shape, problem.size) / surface_noise(from_plane, on_shape, problem.size)
    return (ratio.log() / math.log(band / least)).clamp(0, 1)
