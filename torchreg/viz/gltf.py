"""Moving shapes for any glTF viewer."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_positive, check_shape
from torchreg.datasets.hand import faces_of, surface_skin
from torchreg.geometry.creases import welded
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.rigid import invert_rigid, transform_points
from torchreg.geometry.upright import Direction
from torchreg.io.gltf_write import save_animated_parts, save_animated_skin
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.shapes.spec import RigSurface


def save_shape_animation(
    path: str | Path,
    shape: ArticulatedShape,
    poses: Tensor,
    times: Tensor | None = None,
    *,
    fps: float = 20.0,
    skin: LinearBlendSkin | None = None,
    up: Direction | None = None,
) -> Path:
    """Return the path of a .glb file in which the shape's skinned surface moves through poses.

    The meshes of robots become rigid nodes, in the colors of the file. Of other shapes each part becomes a joint; its
    bending weights become the weights of the file's skin, so that a viewer shows exactly the vertices of the skin in
    each pose.

    Args:
        path: to write; the suffix must be .glb.
        shape: the articulated shape.
        poses: (T, num_dofs), one per frame.
        times: (T,) seconds, not negative, strictly increasing; one frame every 1 / fps by default.
        fps: frames per second where no times are given.
        skin: the surface, with faces; by default `surface_skin`, which is made anew at every call.
        up: the axis that is upright, turned to glTF's y; left as it is by default.

    Raises:
        InputError: if sizes do not fit, the suffix is not .glb or the skin has no faces.
    """
    poses = shape.check_pose(poses, "poses").detach()
    check_shape(poses, "poses", ("T", shape.num_dofs))
    check_positive(fps, "fps")
    seconds = torch.arange(len(poses), dtype=torch.float64) / fps if times is None else as_float_tensor(times, "times")
    check_shape(seconds, "times", (len(poses),))
    if skin is None and shape.surface is not None and shape.surface.is_rigid:
        return _save_links(path, shape, shape.surface, poses, seconds, up)
    skin = surface_skin(shape) if skin is None else skin
    faces = faces_of(skin)
    with torch.no_grad():
        moving = shape.part_transforms(poses)
        rest = shape.part_transforms(skin.reference_pose)
    return save_animated_skin(
        path,
        vertices=skin.points,
        faces=faces,
        weights=skin.weights,
        joint_names=shape.part_names,
        parents=shape.part_parents,
        rest_transforms=rest,
        joint_transforms=moving,
        times=seconds,
        normals=TriangleMesh(skin.points, faces).vertex_normals(),
        up=up,
    )


@torch.no_grad()
def _save_links(
    path: str | Path,
    shape: ArticulatedShape,
    surface: RigSurface,
    poses: Tensor,
    seconds: Tensor,
    up: Direction | None,
) -> Path:
    """Write the meshes of rigid links as nodes, each with shared vertices where it is smooth."""
    moving = shape.part_transforms(poses)
    to_parts = invert_rigid(shape.part_transforms(torch.zeros_like(shape.rest))).cpu().double()
    owner = surface.weights.argmax(-1).cpu()[surface.faces.cpu()[:, 0]]
    meshes: list[TriangleMesh | None] = [None] * shape.num_parts
    normals: list[Tensor | None] = [None] * shape.num_parts
    for part in owner.unique().tolist():
        kept, faces, normals[part] = welded(surface.vertices, surface.faces.cpu()[owner == part])
        normals[part] = normals[part] @ to_parts[part, :3, :3].mT
        meshes[part] = TriangleMesh(transform_points(to_parts[part], surface.vertices.cpu().double()[kept]), faces)
    return save_animated_parts(
        path,
        meshes,
        moving,
        seconds,
        shape.part_names,
        surface.colors,
        part_normals=normals,
        parents=shape.part_parents,
        up=up,
    )
