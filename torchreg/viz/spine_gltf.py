"""Spines for any glTF viewer: curves as tubes in a translucent body that they move."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from torchreg._checks import check_count
from torchreg.errors import InputError
from torchreg.geometry.mesh import TriangleMesh, concatenate
from torchreg.geometry.rigid import rigid_matrix
from torchreg.geometry.skeleton import Skeleton
from torchreg.io.gltf_write import save_animated_skin
from torchreg.spines.labeled_tree import path_lengths
from torchreg.spines.spine import Spine
from torchreg.viz.bone_colors import bone_palette

# Radius of the tubes as a share of the length of all limbs, and their sides.
_TUBE, _SIDES = 0.004, 8
_BODY = (0.80, 0.78, 0.76, 0.35)
_MAX_FACES = 40_000


@torch.no_grad()
def save_spine_animation(
    path: str | Path, spine: Spine, mesh: TriangleMesh | None = None, frame: int = 0, *, num_joints: int = 7,
    fps: float = 20.0,
) -> Path:  # fmt: skip
    """Return the path of a .glb file in which a spine moves, and with it the surface of one of its frames.

    Joints lie along every limb and move as its nodes do. Tubes around the curves, in a color per limb, and the surface,
    translucent, are bound to the joints near them along the limbs: an arm does not hold what it only touches.

    Args:
        path: where to write; the suffix must be .glb.
        spine: its frames are played in their order.
        mesh: the surface of frame ``frame``; None for the curves alone.
        frame: number of the frame that the surface is of.
        num_joints: per limb, at least 2.
        fps: frames per unit of `Spine.times`.

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
    tubes = [_tube(curves[frame, limb], axes[frame, limb], float(skeleton.length)) for limb in range(limbs)]
    parts = [tube.to(torch.float64) for tube in tubes]
    colors = [bone_palette(limbs)[limb].expand(tube.num_vertices, 3) for limb, tube in enumerate(tubes)]
    paint = torch.cat((torch.cat(colors), torch.ones(sum(map(len, colors)), 1)), dim=1)
    if mesh is not None:
        parts.append(TriangleMesh(mesh.vertices.detach().cpu().double(), mesh.faces.cpu()))
        paint = torch.cat((paint, torch.tensor(_BODY).expand(mesh.num_vertices, 4)))
    whole = concatenate(parts)
    moving = rigid_matrix(axes[:, :, picked], curves[:, :, picked]).flatten(1, 2)
    weights = _weights(whole.vertices, skeleton, spine.limb_nodes[:, picked].reshape(-1))
    return save_animated_skin(
        path,
        whole.vertices,
        whole.faces,
        weights,
        [f"limb_{limb}_{k}" for limb in range(limbs) for k in range(len(picked))],
        [-1] * (limbs * len(picked)),
        moving[frame],
        moving,
        (spine.times - spine.times[0]) / fps,
        whole.vertex_normals(),
        paint,
        most_weights=4,  # all that many viewers look at
    )


def _weights(points: Tensor, skeleton: Skeleton, joints: Tensor) -> Tensor:
    """Return how much points (V, 3) hang on the joints, nodes (J,) of the skeleton: by lengths along the limbs."""
    nodes = skeleton.nodes.double()
    holder = torch.cat([(torch.cdist(some, nodes) - skeleton.radii.double()).argmin(-1) for some in points.split(4096)])
    # Joints that share a node share its weight.
    lengths = path_lengths(skeleton, joints)
    spacing = torch.where(lengths[:, joints] > 0, lengths[:, joints], torch.inf).amin(-1).median()
    weights = torch.exp(-0.5 * ((lengths - lengths.amin(0)) / (0.6 * spacing)).square()).mT
    return weights[holder]


def _tube(curve: Tensor, frames: Tensor, size: float) -> TriangleMesh:
    """Return a thin tube around a curve (S, 3), open at its ends."""
    angle = 2 * torch.pi * torch.arange(_SIDES, dtype=curve.dtype) / _SIDES
    ring = torch.stack((angle.cos(), angle.sin(), torch.zeros_like(angle)), dim=-1)
    vertices = curve.unsqueeze(1) + _TUBE * size * (frames.unsqueeze(1) @ ring.unsqueeze(-1)).squeeze(-1)
    here = torch.arange(len(curve) * _SIDES).reshape(len(curve), _SIDES)
    after = here.roll(-1, 1)
    quads = [torch.stack(corners, -1).reshape(-1, 3) for corners in (
        (here[:-1], after[:-1], after[1:]), (here[:-1], after[1:], here[1:])
    )]  # fmt: skip
    return TriangleMesh(vertices.reshape(-1, 3), torch.cat(quads))
