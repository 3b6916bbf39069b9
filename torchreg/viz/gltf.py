"""Moving scenes for any glTF viewer."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_positive, check_shape
from torchreg.datasets.hand import surface_skin
from torchreg.errors import InputError
from torchreg.geometry.creases import welded
from torchreg.geometry.mesh import TriangleMesh, concatenate
from torchreg.geometry.rigid import invert_rigid, transform_points
from torchreg.geometry.upright import Direction
from torchreg.io.gltf_write import save_animated_parts, save_animated_skin
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.viz.posed_scenes import skinned_shape
from torchreg.viz.scene import Scene, SkinnedMesh


@torch.no_grad()
def gltf_of_scene(path: str | Path, scene: Scene, *, most_weights: int | None = None) -> Path:
    """Return the path of a .glb file with the visible skinned meshes of a scene, moved by the joints of the first.

    Frames in which the joints were not found are left out. Rigid meshes become nodes, a mesh for each joint, in its
    color. Others become one skin, in their colors, translucent where they are; a viewer shows exactly its vertices.

    Args:
        path: to write; the suffix must be .glb.
        scene: with skinned meshes; its upright direction, where it has one, is turned to glTF's y.
        most_weights: of a vertex, see `save_animated_skin`.

    Raises:
        InputError: if the suffix is not .glb, no mesh is skinned, or the joints were never found.
    """
    meshes = [layer for layer in scene.layers if isinstance(layer, SkinnedMesh) and layer.visible]
    if not meshes:
        raise InputError(
            f"the scene must have a mesh that joints move, but has {', '.join(x.name for x in scene.layers)}"
        )
    joints = meshes[0].joints
    found = joints.moving.flatten(1).isfinite().all(-1).cpu()
    if not bool(found.any()):
        raise InputError("the scene must hold a pose to be written, but the shape was never found")
    moving = joints.moving[found.to(joints.moving.device)]
    seconds = torch.tensor(scene.seconds, dtype=torch.float64)[found]
    if meshes[0].rigid:
        return _save_links(path, meshes[0], moving, seconds, scene.up)
    parts = [TriangleMesh(mesh.vertices.detach().cpu(), mesh.faces.cpu()) for mesh in meshes]
    surface = concatenate(parts)
    normals = [
        part.vertex_normals() if mesh.normals is None else mesh.normals.cpu()
        for part, mesh in zip(parts, meshes, strict=True)
    ]
    plain = len(meshes) == 1 and not isinstance(meshes[0].paint, Tensor)
    return save_animated_skin(
        path,
        vertices=surface.vertices,
        faces=surface.faces,
        weights=torch.cat([mesh.weights.cpu() for mesh in meshes]),
        joint_names=joints.names,
        parents=joints.parents,
        rest_transforms=joints.rest,
        joint_transforms=moving,
        times=seconds,
        normals=torch.cat(normals),
        colors=None if plain else torch.cat([_rgba(mesh) for mesh in meshes]),
        most_weights=most_weights,
        up=scene.up,
    )


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
        poses: (T, num_dofs), one per frame; frames that are not finite are left out.
        times: (T,) seconds, strictly increasing; one frame every 1 / fps by default.
        fps: frames per second where no times are given.
        skin: the surface, with faces; by default `surface_skin`, which is made anew at every call.
        up: the axis that is upright, turned to glTF's y; left as it is by default.

    Raises:
        InputError: if sizes do not fit, the suffix is not .glb, the skin has no faces, or no pose is finite.
    """
    check_shape(poses, "poses", ("T", shape.num_dofs))
    check_positive(fps, "fps")
    seconds = torch.arange(len(poses), dtype=torch.float64) / fps if times is None else as_float_tensor(times, "times")
    mesh = skinned_shape(shape, poses, surface_skin(shape) if skin is None else skin)
    mesh = replace(mesh, rigid=mesh.rigid and skin is None)
    return gltf_of_scene(path, Scene("shape", (mesh,), seconds, up))


def _rgba(mesh: SkinnedMesh) -> Tensor:
    """Return the colors (V, 4) of a mesh with its opacity."""
    paint = mesh.paint.detach().cpu() if isinstance(mesh.paint, Tensor) else torch.tensor(mesh.paint)
    count = len(mesh.vertices)
    return torch.cat(
        (paint.double().expand(count, 3), torch.full((count, 1), mesh.opacity, dtype=torch.float64)), dim=1
    )


def _save_links(path: str | Path, mesh: SkinnedMesh, moving: Tensor, seconds: Tensor, up: Direction | None) -> Path:
    """Write the meshes of rigid links as nodes, each with shared vertices where it is smooth."""
    joints, faces = mesh.joints, mesh.faces.cpu()
    to_parts = invert_rigid(joints.rest).cpu().double()
    joint = mesh.weights.argmax(-1).cpu()
    owner = joint[faces[:, 0]]
    meshes: list[TriangleMesh | None] = [None] * len(joints.names)
    normals: list[Tensor | None] = [None] * len(joints.names)
    for part in owner.unique().tolist():
        kept, corners, directions = welded(mesh.vertices, faces[owner == part])
        normals[part] = directions @ to_parts[part, :3, :3].mT
        meshes[part] = TriangleMesh(transform_points(to_parts[part], mesh.vertices.cpu().double()[kept]), corners)
    colors = None
    if isinstance(mesh.paint, Tensor):
        colors = torch.ones(len(joints.names), 3)
        colors[joint] = mesh.paint.detach().cpu().float()
    return save_animated_parts(
        path, meshes, moving, seconds, joints.names, colors, part_normals=normals, parents=joints.parents, up=up
    )
