"""Spines for any glTF viewer: curves as tubes in a translucent surface that they move."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchreg._checks import check_count
from torchreg.errors import InputError
from torchreg.geometry.mesh import TriangleMesh, concatenate
from torchreg.geometry.rigid import rigid_matrix
from torchreg.geometry.skeleton import Skeleton
from torchreg.geometry.upright import Direction
from torchreg.spines.labeled_tree import path_lengths
from torchreg.spines.spine import Spine
from torchreg.viz.bone_colors import bone_palette
from torchreg.viz.gltf import gltf_of_scene
from torchreg.viz.scene import Color, Joints, Scene, SkinnedMesh


@dataclass(frozen=True)
class _SpineStyle:
    """Tubes around the curves, and the surface."""

    radius: float = 0.004  # of the tubes, as a share of the length of all limbs
    num_sides: int = 8  # of the tubes
    body: Color = (0.80, 0.78, 0.76)
    opacity: float = 0.35  # of the surface


_STYLE = _SpineStyle()


@torch.no_grad()
def save_spine_animation(
    path: str | Path, spine: Spine, mesh: TriangleMesh | None = None, frame: int = 0, *, num_joints: int = 7,
    fps: float = 20.0, up: Direction | None = None,
) -> Path:  # fmt: skip
    """Return the path of a .glb file in which a spine moves, and with it the surface of one of its frames.

    Joints lie along every limb and move as its nodes do. Tubes around the curves, in a color per limb, and the
    translucent surface are bound to the joints near them, by distance along the limbs: an arm does not move a surface
    that it only touches.

    Args:
        path: to write; the suffix must be .glb.
        spine: its frames are played in their order.
        mesh: the surface of frame ``frame``; None for the curves alone.
        frame: number of the surface's frame.
        num_joints: per limb, at least 2.
        fps: frames per unit of `Spine.times`.
        up: the axis that is upright, turned to glTF's y; left as it is by default.

    Raises:
        InputError: if the suffix is another, or there is no such frame.
    """
    check_count(num_joints, "num_joints", 2)
    if not 0 <= frame < len(spine.times):
        raise InputError(f"frame must be from 0 to {len(spine.times) - 1}, got {frame}")
    samples = spine.limb_nodes.shape[1]
    picked = torch.linspace(0, samples - 1, min(num_joints, samples)).round().long()
    skeleton = spine.skeleton(float(spine.times[frame]))
    curves = spine(spine.times)
    limbs = spine.num_limbs
    axes = spine.frames(spine.times)
    moving = rigid_matrix(axes[:, :, picked], curves[:, :, picked]).flatten(1, 2)
    names = [f"limb_{limb}_{k}" for limb in range(limbs) for k in range(len(picked))]
    joints = Joints(names, [-1] * len(names), moving[frame], moving)
    tubes = [_tube(curves[frame, limb], axes[frame, limb], float(skeleton.length)) for limb in range(limbs)]
    colors = [color.expand(tube.num_vertices, 3) for color, tube in zip(bone_palette(limbs), tubes, strict=True)]
    parts = [("limbs", concatenate(tubes), torch.cat(colors), 1.0)]
    if mesh is not None:
        body = torch.tensor(_STYLE.body).expand(mesh.num_vertices, 3)
        parts.append(("surface", TriangleMesh(mesh.vertices.detach().cpu(), mesh.faces.cpu()), body, _STYLE.opacity))
    layers = tuple(
        SkinnedMesh(
            name=name, vertices=part.vertices.double(), faces=part.faces, paint=paint, opacity=opacity, joints=joints,
            weights=_weights(part.vertices.double(), skeleton, spine.limb_nodes[:, picked].reshape(-1)),
        )
        for name, part, paint, opacity in parts
    )  # fmt: skip
    scene = Scene("spine", layers, spine.times / fps, up)
    return gltf_of_scene(path, scene, most_weights=4)  # all that many viewers read


def _weights(points: Tensor, skeleton: Skeleton, joints: Tensor) -> Tensor:
    """Return weights (V, J) of points (V, 3) for joints, nodes (J,) of the skeleton, by lengths along the limbs."""
    nodes, radii = skeleton.nodes.double(), skeleton.radii.double()
    nearest = torch.cat([(torch.cdist(chunk, nodes) - radii).argmin(-1) for chunk in points.split(4096)])
    # Joints that share a node share its weight.
    lengths = path_lengths(skeleton, joints)
    spacing = torch.where(lengths[:, joints] > 0, lengths[:, joints], torch.inf).amin(-1).median()
    weights = torch.exp(-0.5 * ((lengths - lengths.amin(0)) / (0.6 * spacing)).square()).mT
    return weights[nearest]


def _tube(curve: Tensor, frames: Tensor, size: float) -> TriangleMesh:
    """Return a thin tube around a curve (S, 3), open at its ends."""
    sides = _STYLE.num_sides
    angle = 2 * torch.pi * torch.arange(sides, dtype=curve.dtype) / sides
    ring = torch.stack((angle.cos(), angle.sin(), torch.zeros_like(angle)), dim=-1)
    vertices = curve.unsqueeze(1) + _STYLE.radius * size * (frames.unsqueeze(1) @ ring.unsqueeze(-1)).squeeze(-1)
    corner = torch.arange(len(curve) * sides).reshape(len(curve), sides)
    beside = corner.roll(-1, 1)
    quads = [torch.stack(corners, -1).reshape(-1, 3) for corners in (
        (corner[:-1], beside[:-1], beside[1:]), (corner[:-1], beside[1:], corner[1:])
    )]  # fmt: skip
    return TriangleMesh(vertices.reshape(-1, 3), torch.cat(quads))
