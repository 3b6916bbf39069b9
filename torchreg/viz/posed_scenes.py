"""Scenes of shapes in poses, with what was measured: the surface, its bones, inliers and outliers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import torch
from torch import Tensor

from torchreg._checks import check_shape
from torchreg.alignment.fit.problem import INLIER_SHARE
from torchreg.datasets.hand import faces_of
from torchreg.errors import InputError
from torchreg.geometry.upright import Direction
from torchreg.result import Status
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.skin import BendingSkin, LinearBlendSkin
from torchreg.tracking.results import TrackResult
from torchreg.viz.bone_colors import bone_palette
from torchreg.viz.scene import (
    PREDICTED_COLOR,
    SKIN_COLOR,
    Cloud,
    Color,
    Curves,
    Frames,
    Joints,
    Layer,
    Scene,
    SkinnedMesh,
)

# Which data (M, 3) of a frame are inliers, (M,) bool.
Inliers = Callable[[int, Tensor], Tensor]


@dataclass(frozen=True)
class _DataColors:
    """Colors of data."""

    inlier: Color = (0.04, 0.31, 0.62)
    outlier: Color = (0.62, 0.62, 0.62)
    unknown: Color = (0.08, 0.50, 0.42)  # data that may be inliers or not
    palest: float = 0.35  # share of its color in an inlier of posterior zero, the rest white


DATA_COLORS = _DataColors()


def posed_scene(
    shape: ArticulatedShape, poses: Tensor, clouds: Sequence[Tensor] = (),
    inliers: Sequence[Tensor] | Inliers | None = None, *, skin: LinearBlendSkin | None = None,
    usable: Sequence[bool] | None = None, captions: Sequence[str] = (), times: Tensor | None = None,
    up: Direction | None = None, title: str = "",
) -> Scene:  # fmt: skip
    """Return the scene of a shape in poses and of data: inliers blue, others gray, green where it is not known.

    Args:
        shape: the articulated shape.
        poses: (T, num_dofs); frames without a finite one show the data alone.
        clouds: T clouds (M_t, 3), metres, or none; each is read when its frame is shown, unless it is in a list.
        inliers: T masks (M_t,) bool, or what makes them.
        skin: the surface, with faces; by default `coarse_skin`.
        usable: per frame, whether data support the pose; the surface is gray where they do not.
        captions: of the frames.
        times: (T,) seconds.
        up: the upright direction.
        title: of the scene.

    Raises:
        InputError: if sizes do not fit, or the skin has no faces.
    """
    layers = shape_layers(shape, poses, skin, usable)
    if len(clouds):
        for name, values in (
            ("clouds", clouds),
            *([] if callable(inliers) or inliers is None else [("inliers", inliers)]),
        ):
            if len(values) != len(poses):
                raise InputError(f"{name} must hold one entry per pose ({len(poses)}), got {len(values)}")
        layers.append(_data_layer(clouds, inliers))
    return Scene(title, tuple(layers), times, up, captions=captions)


def _data_layer(clouds: Sequence[Tensor], inliers: Sequence[Tensor] | Inliers | None) -> Cloud:
    """Return the layer of data, painted by whether they are inliers, without points that are not finite."""
    given = isinstance(clouds, (list, tuple))

    @lru_cache(maxsize=None if given else 1)
    def frame(number: int) -> tuple[Tensor, Tensor]:
        data = clouds[number].detach().cpu()
        check_shape(data, "data", ("M", 3))
        known = data.isfinite().all(-1)
        if inliers is None:
            return data[known], torch.tensor(DATA_COLORS.unknown).expand(int(known.sum()), 3)
        if callable(inliers):
            mask = inliers(number, data[known])
        else:
            mask = inliers[number].cpu()
            check_shape(mask, "inliers", (len(data),))
            mask = mask[known]
        if mask.dtype != torch.bool:
            raise InputError(f"inliers must be bool, got {mask.dtype}; compare with a threshold first")
        return data[known], inlier_paint(mask, torch.ones(len(mask)))

    count = len(clouds)
    return Cloud("data", Frames(count, lambda k: frame(k)[0]), Frames(count, lambda k: frame(k)[1]))


def skinned_shape(shape: ArticulatedShape, poses: Tensor, skin: LinearBlendSkin) -> SkinnedMesh:
    """Return the layer of a shape's surface in poses (T, num_dofs), NaN in frames without a pose."""
    poses = poses.detach().to(shape.rest)
    check_shape(poses, "poses", ("T", shape.num_dofs))
    found = poses.isfinite().all(-1)
    faces = faces_of(skin)
    with torch.no_grad():
        moving = shape.part_transforms(torch.where(found.unsqueeze(-1), poses, shape.rest_pose()))
        joints = Joints(
            shape.part_names, shape.part_parents, shape.part_transforms(skin.reference_pose),
            torch.where(found[:, None, None, None], moving, torch.nan),
        )  # fmt: skip
    colors = None if shape.surface is None else shape.surface.colors
    paint = SKIN_COLOR if colors is None else colors[skin.weights.argmax(-1).cpu()].float()
    rigid = shape.surface is not None and shape.surface.is_rigid and len(skin) == len(shape.surface.vertices)
    return SkinnedMesh(
        name="shape", vertices=skin.points, faces=faces, paint=paint, weights=skin.weights, joints=joints, rigid=rigid
    )


def coarse_skin(shape: ArticulatedShape) -> LinearBlendSkin:
    """Return the surface of a shape: the mesh of its file, else a coarse one, fine enough for small pictures."""
    if shape.surface is not None:
        return shape.file_skin()
    mesh = shape.coarse_surface_mesh()
    return BendingSkin(shape, mesh.vertices, shape.rest_pose(), faces=mesh.faces)


def shape_layers(
    shape: ArticulatedShape | None, poses: Tensor, skin: LinearBlendSkin | None = None,
    usable: Sequence[bool] | None = None,
) -> list[Layer]:  # fmt: skip
    """Return the surface and the bones of a shape in poses (T, num_dofs), NaN in frames without a pose."""
    if shape is None:
        return []
    surface = skinned_shape(shape, poses, coarse_skin(shape) if skin is None else skin)
    moving = surface.joints.moving
    layers: list[Layer] = [surface]
    if usable is not None:
        kept = torch.tensor(usable, device=moving.device)[:, None, None, None]
        held = torch.where(kept, torch.nan, moving)
        if bool(held.isfinite().any()):
            parts = (
                ("shape", moving.where(kept, torch.nan), surface.paint),
                ("predicted shape", held, PREDICTED_COLOR),
            )
            layers = [
                replace(surface, name=name, joints=replace(surface.joints, moving=shown), paint=paint)
                for name, shown, paint in parts
            ]
    pairs = [(parent, part) for part, parent in enumerate(shape.part_parents) if parent >= 0]
    if pairs:
        origins = moving[..., :3, 3].float()
        layers.append(Curves("bones", origins[:, torch.tensor(pairs)], bone_palette(len(pairs)), visible=False))
    return layers


def frame_label(frame: int, status: Status, acquired: str) -> str:
    """Return the label of a frame: its number, and the stage that acquired its pose, or its status without one."""
    return f"frame {frame}: {acquired if status.usable else status.value}"


def frame_labels(result: TrackResult) -> list[str]:
    """Return the label of each frame."""
    return [frame_label(*item) for item in zip(range(len(result.poses)), result.statuses, result.acquired, strict=True)]


def near_surface(shape: ArticulatedShape, poses: Tensor, reach: float | None = None) -> Inliers:
    """Return the function that marks the data of a frame near the shape in its pose (T, num_dofs); none without a pose.

    Args:
        shape: the articulated shape.
        poses: (T, num_dofs).
        reach: distance from the surface, metres; the share of the size that alignments count by default.
    """
    poses = poses.to(shape.rest)
    if reach is None:
        points = coarse_skin(shape).points
        reach = INLIER_SHARE * float((points.amax(0) - points.amin(0)).norm())

    def inliers(frame: int, data: Tensor) -> Tensor:
        if not len(data) or not bool(poses[frame].isfinite().all()):
            return torch.zeros(len(data), dtype=torch.bool)
        with torch.no_grad():
            return (shape.distance(data.to(shape.rest), poses[frame]).abs() < reach).cpu()

    return inliers


def inlier_paint(inliers: Tensor, posterior: Tensor) -> Tensor:
    """Return colors (M, 3): outliers gray, inliers from pale to full blue by their posterior."""
    share = posterior.double().nan_to_num(0.0)
    share = (share / share.max().clamp(min=1e-12) if len(share) else share).unsqueeze(-1).clamp(0, 1)
    strength = DATA_COLORS.palest + (1 - DATA_COLORS.palest) * share
    blue = 1 - strength * (1 - torch.tensor(DATA_COLORS.inlier, dtype=torch.float64))
    return torch.where(inliers.unsqueeze(-1), blue, torch.tensor(DATA_COLORS.outlier, dtype=torch.float64)).float()
