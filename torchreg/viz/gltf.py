"""Moving shapes for any glTF viewer."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_positive, check_shape
from torchreg.datasets.hand import faces_of, surface_skin
from torchreg.geometry.creases import welded
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.upright import Direction
from torchreg.io.gltf_write import save_animated_skin
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.skin import LinearBlendSkin


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

    Triangles that hardly share vertices are given shared ones, see `geometry.creases.welded`.

    Each part becomes a joint; its bending weights become the weights of the file's skin, so that a viewer shows exactly
    the vertices of the skin in each pose.

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
    skin = surface_skin(shape) if skin is None else skin
    faces = faces_of(skin)
    with torch.no_grad():
        moving = shape.part_transforms(poses)
        rest = shape.part_transforms(skin.reference_pose)
    vertices, weights = skin.points, skin.weights
    if len(vertices) > len(faces):  # hardly shared, as in STL files: shared ones are half as many as triangles
        kept, faces, normals = welded(vertices, faces, weights)
        vertices, weights = vertices[kept], weights[kept]
    else:
        normals = TriangleMesh(vertices, faces).vertex_normals()
    return save_animated_skin(
        path,
        vertices=vertices,
        faces=faces,
        weights=weights,
        joint_names=shape.part_names,
        parents=shape.part_parents,
        rest_transforms=rest,
        joint_transforms=moving,
        times=seconds,
        normals=normals,
        up=up,
    )
