"""Writing surfaces that deform freely as animated glTF (.glb): every frame is a morph target."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pygltflib
import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_shape
from torchreg.errors import InputError
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.upright import Direction, to_y_up
from torchreg.io.gltf_file.builder import (
    DEFAULT_COLOR,
    Array,
    GltfBuilder,
    checked_numbers,
    checked_path,
    checked_times,
    checked_triangles,
    unit_rows,
)


def save_vertex_animation(
    path: str | Path, frames: Tensor, faces: Tensor, times: Tensor, colors: Tensor | None = None,
    *, up: Direction | None = None,
) -> Path:  # fmt: skip
    """Write a mesh whose vertices (T, V, 3) move straight from frame to frame as a .glb file; return its path.

    The first frame is the mesh, the others are morph targets, of which the animation mixes two at a time: glTF 2.0,
    section 3.7.2.2. Times (T,) are seconds, strictly increasing.
    """
    target = checked_path(path)
    moving = as_float_tensor(frames, "frames")
    check_shape(moving, "frames", ("T", "V", 3))
    points = checked_numbers(moving, "frames", tuple(moving.shape))
    if len(points) < 2:
        raise InputError(f"frames must hold two at least, got {len(points)}")
    triangles = checked_triangles(faces, "faces", points.shape[1])
    seconds = checked_times(times)
    if len(seconds) != len(points):
        raise InputError(f"times must be one per frame ({len(points)}), got {len(seconds)}")
    normals = _normals(moving, faces)

    document = GltfBuilder()
    attributes = document.mesh_attributes(points[0], torch.from_numpy(normals[0]), colors)
    mesh = document.add_mesh("surface", attributes, triangles, None if colors is not None else DEFAULT_COLOR)
    primitive = document.gltf.meshes[mesh].primitives[0]
    stored = points.astype(np.float32)
    primitive.targets = [
        {
            # From the rounded first frame, so that errors do not add up.
            "POSITION": document.add(stored[frame] - stored[0], target=pygltflib.ARRAY_BUFFER, bounds=True),
            "NORMAL": document.add((normals[frame] - normals[0]).astype(np.float32), target=pygltflib.ARRAY_BUFFER),
        }
        for frame in range(1, len(points))
    ]
    document.gltf.meshes[mesh].weights = [0.0] * (len(points) - 1)
    node = document.add_node("surface", None if up is None else to_y_up(up).numpy())
    document.gltf.nodes[node].mesh = mesh
    # One number per target at every time: all zero for the first frame.
    shares = np.eye(len(points), dtype=np.float32)[:, 1:].reshape(-1)
    sampler = pygltflib.AnimationSampler(
        input=document.add(seconds, bounds=True), output=document.add(shares), interpolation=pygltflib.ANIM_LINEAR
    )
    channel = pygltflib.AnimationChannel(sampler=0, target=pygltflib.AnimationChannelTarget(node=node, path="weights"))
    document.gltf.animations.append(pygltflib.Animation(name="motion", samplers=[sampler], channels=[channel]))
    return document.write(target, [node])


def _normals(frames: Tensor, faces: Tensor) -> Array:
    """Return unit normals (T, V, 3) at the vertices."""
    normals = [TriangleMesh(frame, faces).vertex_normals() for frame in frames.detach().cpu().double()]
    return unit_rows(torch.stack(normals).numpy())
