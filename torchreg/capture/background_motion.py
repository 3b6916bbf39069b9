"""How the background moved between two depth pictures: the rigid motion that most of their pixels share."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.capture.depth import plane_normals
from torchreg.capture.depth_frame import DepthFrame
from torchreg.geometry.rigid import invert_rigid, se3_exp, se3_log, transform_points
from torchreg.solvers.robust import geman_mcclure_weight


@dataclass(frozen=True)
class _Rule:
    """Numbers of the search. Depth errors are at one metre; they grow with the square of the depth."""

    widest: float = 0.1  # first width of the kernel, metres; std of a camera's motion in a hand, metres and radians
    ratio: float = 0.7  # from one width to the next
    num_steps: int = 25
    deviations: float = 2.0  # of the noise, the last width
    least: float = 1e-4  # metres, the last width of depths without noise
    radius: int = 3  # of the windows that normals are fitted to, in every stride-th pixel
    steepest: float = 1.0  # tangent of the slope within a window: planes do not cross steps in depth
    num_patches: int = 64  # of a picture that err on their own: neighboring pixels err together


_RULE = _Rule()


def depth_noise(differences: Tensor) -> float:
    """Return the standard deviation of differences (N,) of which the most are noise, not motion."""
    return float(differences.abs().median()) / 0.6745 if len(differences) else 0.0


@torch.no_grad()
def background_motion(source: DepthFrame, target: DepthFrame) -> Tensor:
    """Return the rigid motion (4, 4) of the world, float64, that most of two pictures share; the identity if none does.

    Projective point-to-plane ICP (Newcombe et al. 2011) from the pictures as they are, from each to the other, with a
    kernel that narrows to the noise. The better motion of both must be likelier than none by Schwarz's criterion.
    """
    frames = (source, target), (target, source)
    still = torch.eye(4, dtype=torch.float64, device=source.depth.device)
    motions, noises = [still, still], [_RULE.widest, _RULE.widest]
    # Normals come from windows as wide as the noise asks for, which is known only after a first fit.
    for _ in range(2):
        pairs = [_Pair.of(*both, noise) for both, noise in zip(frames, noises, strict=True)]
        motions = [pair.fitted(motion) for pair, motion in zip(pairs, motions, strict=True)]
        noises = [pair.noise(motion) for pair, motion in zip(pairs, motions, strict=True)]

    def deviation(motion: Tensor) -> float:
        return math.sqrt(pairs[0].noise(motion) * pairs[1].noise(invert_rigid(motion)))

    best = min(motions[0], invert_rigid(motions[1]), key=deviation)
    likelier = _RULE.num_patches * math.log(deviation(still) / deviation(best)) > 3 * math.log(_RULE.num_patches)
    return best if likelier else still


@dataclass(frozen=True, eq=False)
class _Pair:
    """Points of a picture, and the planes around the points of the other one that are seen at their pixels.

    Args:
        points: (M, 3) of the first picture.
        frame: the second picture.
        planes: (H', W', 3) points of every stride-th of its pixels.
        normals: (H', W', 3) of these; zero where there is none.
    """

    points: Tensor
    frame: DepthFrame
    planes: Tensor
    normals: Tensor

    @classmethod
    def of(cls, source: DepthFrame, target: DepthFrame, noise: float) -> _Pair:
        column, row = target.pixels.unbind(-1)
        camera, step = target.camera.to(dtype=torch.float64, device=target.depth.device), target.stride
        depth = (target.depth * target.measured)[::step, ::step].double()
        normals = plane_normals(
            depth, (camera.intrinsics / step).tolist(), noise, radius=_RULE.radius, max_steepness=_RULE.steepest
        )
        planes = torch.zeros_like(normals)
        planes[row // step, column // step] = target.points.double()
        return cls(source.points.double(), target, planes, normals @ camera.world_to_camera[:3, :3])

    def noise(self, motion: Tensor) -> float:
        """Return the standard deviation of distances to planes, at one metre."""
        return max(depth_noise(self.linearized(motion)[0]), _RULE.least)

    def fitted(self, motion: Tensor) -> Tensor:
        """Return the motion (4, 4) that robust steps reach."""
        width = _RULE.widest
        for _ in range(_RULE.num_steps):
            residuals, rows = self.linearized(motion)
            width = max(_RULE.ratio * width, _RULE.deviations * depth_noise(residuals), _RULE.least)
            weighted = geman_mcclure_weight((residuals / width).square())[:, None] * rows
            # What no surface holds, as a slide along a single wall, stays near zero.
            held = (width / _RULE.deviations / _RULE.widest) ** 2 * len(rows) / _RULE.num_patches
            normal = weighted.mT @ rows + held * torch.eye(6).to(rows)
            gradient = weighted.mT @ residuals + held * se3_log(motion)
            motion = se3_exp(-torch.linalg.solve(normal, gradient)) @ motion
        return motion

    def linearized(self, motion: Tensor) -> tuple[Tensor, Tensor]:
        """Return distances to planes (M',), at one metre, and their derivatives (M', 6) by the motion's twist."""
        moved = transform_points(motion, self.points)
        place, depth = self.frame.camera.project(moved)
        column, row = (place / self.frame.stride).round().long().unbind(-1)
        height, width = self.normals.shape[:2]
        inside = (depth > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        at = row.clamp(0, height - 1), column.clamp(0, width - 1)
        inside &= self.normals[at].any(-1) & self.planes[at].any(-1)
        moved, planes = moved[inside], self.planes[at][inside]
        normals = self.normals[at][inside] / depth[inside].square()[:, None]
        residuals = ((moved - planes) * normals).sum(-1)
        return residuals, torch.cat((normals, torch.linalg.cross(moved, normals)), dim=-1)
