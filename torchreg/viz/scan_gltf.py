"""Registered scans as skinned, animated meshes for any glTF viewer."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_choice, check_finite, check_points, check_shape
from torchreg.errors import InputError
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.rigid import rigid_matrix
from torchreg.geometry.upright import Direction
from torchreg.registration.blend import blend_linear, check_rigid_motions
from torchreg.registration.bones.grid_lbs import GridLBS
from torchreg.viz.bone_colors import weight_colors
from torchreg.viz.gltf import gltf_of_scene
from torchreg.viz.scene import Joints, Scene, SkinnedMesh

HIERARCHIES = ("tree", "flat")


@dataclass(frozen=True)
class GridAnimation:
    """A file with a skinned mesh.

    Args:
        path: of the file.
        residual: largest distance, over vertices and frames, between the file's vertices and the model's: from weights
            beyond the fourth, which are dropped, and blends that glTF does not have.
        parents: of the bones' nodes, -1 for roots.
    """

    path: Path
    residual: float
    parents: tuple[int, ...]


@torch.no_grad()
def save_grid_animation(
    path: str | Path,
    model: GridLBS,
    points: Tensor,
    faces: Tensor,
    poses: Tensor | None = None,
    times: Tensor | None = None,
    *,
    normals: Tensor | None = None,
    colors: Tensor | None = None,
    most_weights: int = 4,
    hierarchy: str = "tree",
    up: Direction | None = None,
) -> GridAnimation:
    """Write a .glb file in which the bones of a model move a mesh through poses, and return its description.

    Each bone is a node of the skeleton of joints, at its joint with its parent. Every node has a track of rotations and
    one of translations relative to its parent: joints of scans open a little, and with both tracks the file shows every
    pose exactly, also of bones that are not connected.

    Args:
        path: to write; the suffix must be .glb.
        model: the bones and weights.
        points: (V, 3) of the mesh before it is moved, such as the source scan's.
        faces: (F, 3) over the points.
        poses: (T, B, 4, 4) to play; by default the rest pose, then the model's own, one or several.
        times: (T,) seconds, not negative, strictly increasing; a second apart by default.
        normals: (V, 3) at the points; those of the faces by default.
        colors: (V, 3) in [0, 1]; those of the weights by default.
        most_weights: weights kept per vertex, 4, or 8, of which some viewers ignore the second four.
        hierarchy: "tree", or "flat" for nodes without parents: between the poses bones then move on straight lines
            instead of about their joints.
        up: the axis that is upright, turned to glTF's y; left as it is by default.

    Returns:
        Path, error and skeleton of the file.

    Raises:
        InputError: if shapes do not fit, a number is not finite, a pose is not rigid or the suffix is not .glb.
        FileNotFoundError: if the folder does not exist.

    References: the glTF 2.0 specification, section 3.7.3, on skins.
    """
    check_choice(hierarchy, "hierarchy", HIERARCHIES)
    if most_weights not in (4, 8):
        raise InputError(f"most_weights must be 4 or 8, got {most_weights}")
    points = as_float_tensor(points, "points", like=model.weights)
    check_points(points, "points", batch=False)
    mesh = TriangleMesh(points, faces)
    moving = _poses(model, poses)
    seconds = torch.arange(len(moving), dtype=torch.float64) if times is None else as_float_tensor(times, "times")
    check_finite(seconds, "times")
    tree = model.skeleton(moving)
    # In double precision: the viewer multiplies the relative motions again.
    identity = torch.eye(3, dtype=torch.float64).expand(model.num_bones, 3, 3)
    rest = rigid_matrix(identity, tree.origins.double().cpu())
    weights = model.vertex_weights(points, most=most_weights)
    exact = weights.double().cpu()
    joints = Joints(
        [f"bone_{number}" for number in range(model.num_bones)],
        tree.parents if hierarchy == "tree" else (-1,) * model.num_bones,
        rest,
        _orthogonal(moving.double().cpu()) @ rest,
    )
    skin = SkinnedMesh(
        name="scan", vertices=points, faces=mesh.faces, joints=joints, normals=normals,
        weights=exact / exact.sum(-1, keepdim=True),
        paint=weight_colors(model.weights_at(points)).clamp(0, 1) if colors is None else colors,
    )  # fmt: skip
    file = gltf_of_scene(path, Scene("scan", (skin,), seconds, up), most_weights=most_weights)
    shown = blend_linear(points, weights, moving)
    residual = torch.linalg.vector_norm(shown - model(points, moving), dim=-1).max()
    return GridAnimation(file, float(residual), tuple(joints.parents))


def _poses(model: GridLBS, poses: Tensor | None) -> Tensor:
    """Return the poses (T, B, 4, 4) to play."""
    if poses is None:
        poses = model.transforms.reshape(-1, model.num_bones, 4, 4)
        rest = torch.eye(4, dtype=poses.dtype, device=poses.device).expand(1, model.num_bones, 4, 4)
        return torch.cat([rest, poses])
    poses = as_float_tensor(poses, "poses", like=model.weights)
    check_shape(poses, "poses", ("T", model.num_bones, 4, 4))
    check_rigid_motions(poses, "poses")
    if len(poses) == 0:
        raise InputError("poses must hold at least one, got none")
    return poses


def _orthogonal(transforms: Tensor) -> Tensor:
    """Return motions with the nearest rotations: errors of single precision add up along chains of nodes."""
    u, _, vt = torch.linalg.svd(transforms[..., :3, :3])
    return rigid_matrix(u @ vt, transforms[..., :3, 3])
