"""Where a range scan ends although the surface goes on: behind something nearer to the camera."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg._checks import check_positive, check_same_kind, check_shape
from torchreg.geometry.neighbors import k_nearest, sampling_distance
from torchreg.geometry.visibility import view_rotation

# Neighbors in the picture that are looked at, and how many spacings of the samples there they may be away.
_NEIGHBORS, _BESIDE = 8, 2.5
# A camera of which nothing is known stands so many times the scan's radius away: its rays are nearly parallel.
_FAR = 6.0
# Mean of unit normals below which the scan was not seen from one side; half a ball has a half.
_ONE_SIDE = 0.2
# Share of the normals that count as the most slanted; how many steps follow them, and how long.
_SLANTED, _STEPS, _STEP = 0.1, 30, 0.2
# Points nearer to the camera's plane than this share of its distance, or behind it, count as that near.
_LEAST_DEPTH = 1e-3


@dataclass(frozen=True, eq=False)
class PinholeView:
    """What a camera sees, as places in the plane through the middle of what it looks at.

    Args:
        viewpoint: (3,).
        rotation: (3, 3) ``R_camera_world``, rows right, down, forward.
        distance: of the plane.
    """

    viewpoint: Tensor
    rotation: Tensor
    distance: Tensor

    @classmethod
    def of(cls, points: Tensor, viewpoint: Tensor) -> PinholeView:
        """Return what a camera sees that looks at the middle of points (S, 3); along z if it is there."""
        middle = points.mean(0)
        distance = (middle - viewpoint).norm()
        rotation = view_rotation(viewpoint, middle) if float(distance) > 0 else torch.eye(3).to(viewpoint)
        return cls(viewpoint, rotation.to(points), distance)

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return places (..., 2) in the plane, in the unit of the points, and depths (...)."""
        local = (points - self.viewpoint) @ self.rotation.mT
        depth = local[..., 2]
        nearest = (_LEAST_DEPTH * self.distance).clamp_min(torch.finfo(local.dtype).tiny)
        return local[..., :2] * (self.distance / depth.clamp_min(nearest)).unsqueeze(-1), depth


def likely_viewpoint(points: Tensor, normals: Tensor) -> Tensor | None:
    """Return about where the camera (3,) was that saw a surface; None if unclear.

    It was where nothing is seen from behind: from the mean normal the direction goes on such that the most slanted
    normals slant to all sides alike.

    Args:
        points: (S, 3) spread evenly.
        normals: (S, 3) unit vectors.

    Differentiable: no.
    """
    check_shape(points, "points", ("S", 3))
    check_shape(normals, "normals", tuple(points.shape))
    facing = normals.detach().mean(0)
    if len(points) == 0 or float(facing.norm()) < _ONE_SIDE:
        return None
    normals = normals.detach()
    facing = torch.nn.functional.normalize(facing, dim=0)
    number = max(1, round(_SLANTED * len(normals)))
    for _ in range(_STEPS):
        slanted = normals[(normals @ facing).topk(number, largest=False).indices].mean(0)
        facing = torch.nn.functional.normalize(facing + _STEP * (slanted - (slanted @ facing) * facing), dim=0)
    middle = points.detach().mean(0)
    radius = (points.detach() - middle).norm(dim=-1).max()
    return middle + _FAR * radius * facing


@torch.no_grad()
def occlusion_edges(edges: Tensor, surface: Tensor, viewpoint: Tensor, depth: float) -> Tensor:
    """Return the edge points (E,) bool beside which, in the picture, the surface is nearer to the camera.

    There the scan ends since something hides the rest. Where it ends because the surface turns away, or is at its end,
    nothing nearer lies beside.

    Args:
        edges: (E, 3) points on the scan's boundary.
        surface: (S, 3) samples of the whole scan, spread evenly.
        viewpoint: (3,) where the camera was.
        depth: how much nearer it must be, in the unit of the points: more than the surface slopes from edge to sample.

    Raises:
        InputError: if a shape does not fit or the depth is not positive.
        InputTypeError: if dtypes or devices differ.

    Differentiable: no.
    """
    check_shape(edges, "edges", ("E", 3))
    check_shape(surface, "surface", ("S", 3))
    check_shape(viewpoint, "viewpoint", (3,))
    check_same_kind(edges, "edges", surface, "surface")
    check_same_kind(viewpoint, "viewpoint", surface, "surface")
    check_positive(depth, "depth")
    if len(edges) == 0 or len(surface) < 2:
        return torch.zeros(len(edges), dtype=torch.bool, device=edges.device)
    picture = PinholeView.of(surface, viewpoint)
    (flat, far), (flat_edges, far_edges) = picture.project(surface), picture.project(edges)
    index, apart = k_nearest(flat_edges, flat, min(_NEIGHBORS, len(flat)))
    return ((apart < _BESIDE * sampling_distance(flat)) & (far[index] < far_edges.unsqueeze(1) - depth)).any(1)
