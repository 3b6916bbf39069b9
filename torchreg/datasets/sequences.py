"""Made-up sequences of clouds of a moving hand or any shape, from a pair of cameras or from one, with exact truth."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg._checks import check_shape
from torchreg.datasets.hand import HandCloud, hand_motion, make_hand_cloud, surface_skin
from torchreg.datasets.stereo import StereoView, stereo_clouds, tube
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.rotation import so3_exp
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.hand import Hand
from torchreg.shapes.skin import LinearBlendSkin


@dataclass(frozen=True)
class _BarForm:
    """The obstacle in "occlusion"; lengths as shares of the distance of the hand."""

    distance: float = 0.7
    half_width: float = 0.05  # more or less by up to a tenth
    half_thickness: float = 0.01
    max_slant: float = math.radians(20)
    num_pieces: int = 20  # along its length of one: the rasterizer looks at the whole bounding box of a face


_BAR = _BarForm()


def hand_sequence(
    motion: str = "bending_palm",
    num_frames: int = 100,
    fps: float = 20.0,
    *,
    shape: ArticulatedShape | None = None,
    stereo: StereoView | None = None,
    skin: LinearBlendSkin | None = None,
    num_points: int = 600,
    outlier_ratio: float = 0.3,
    obstacle: TriangleMesh | None = None,
    bend: float = 0.6,
    distance: float = 0.6,
    seed: int = 0,
) -> list[HandCloud]:
    """Return the clouds of a moving hand, frame by frame, as a pair of cameras measures it, with the exact truth.

    The motion is a kind of `hand_motion`; "occlusion" puts a bar between the cameras and the path of the hand, of a
    width and slant drawn from the seed, unless an obstacle is given. All else is as in `stereo_clouds`; the shape is an
    adult right hand by default, with 500 to 1,000 points per frame. Dewaele et al. 2006, section 5.
    """
    shape = Hand() if shape is None else shape
    poses = hand_motion(shape, motion, num_frames, fps, bend=bend, distance=distance, seed=seed)
    if motion == "occlusion" and obstacle is None:
        obstacle = _bar(distance, torch.Generator().manual_seed(seed)).to(poses)
    return stereo_clouds(
        shape, poses, stereo=stereo, skin=skin, num_points=num_points, outlier_ratio=outlier_ratio, obstacle=obstacle,
        seed=seed,
    )  # fmt: skip


def range_clouds(
    shape: ArticulatedShape,
    poses: Tensor,
    *,
    num_points: int = 500,
    noise: float = 0.0015,
    outlier_ratio: float = 0.33,
    camera: Tensor | None = None,
    skin: LinearBlendSkin | None = None,
    seed: int = 0,
) -> list[HandCloud]:
    """Return the clouds of a shape in given poses, as a range camera or an all-round scanner sees it, with the truth.

    See `make_hand_cloud` for the arguments; poses (T, num_dofs) of `hand_motion` pass before a camera at zeros (3,).
    """
    check_shape(shape.check_pose(poses, "poses"), "poses", ("T", shape.num_dofs))
    skin, generator = surface_skin(shape) if skin is None else skin, torch.Generator().manual_seed(seed)
    return [
        make_hand_cloud(
            shape, pose, num_points=num_points, noise=noise, outlier_ratio=outlier_ratio, camera=camera, skin=skin,
            generator=generator,
        )
        for pose in poses
    ]  # fmt: skip


def _bar(distance: float, generator: torch.Generator) -> TriangleMesh:
    """Return a slanted, upright bar in the middle of the picture, before a hand that passes at ``distance``."""
    draws = 2 * torch.rand(2, generator=generator, dtype=torch.float64) - 1
    along = torch.linspace(-0.5, 0.5, _BAR.num_pieces + 1, dtype=torch.float64).unsqueeze(-1)
    across = _BAR.half_width * (1 + 0.1 * draws[0]) * along.new_tensor([1.0, 1.0, -1.0, -1.0])
    deep = _BAR.half_thickness * along.new_tensor([-1.0, 1.0, 1.0, -1.0])
    corners = torch.stack(torch.broadcast_tensors(across, along, deep), dim=-1)
    turn = so3_exp(torch.cat([torch.zeros_like(draws), _BAR.max_slant * draws[1:]]))
    return tube(distance * (corners @ turn.mT + corners.new_tensor([0.0, 0.0, _BAR.distance])))
