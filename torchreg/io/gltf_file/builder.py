"""glTF documents (.glb) under construction: accessors, meshes, nodes, animations, and checks of their content."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchreg._checks import as_float_tensor, check_finite, check_shape
from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.rotation_representations import quaternion_from_rotation
from torchreg.io.atomic import write_atomic

_TYPES = {1: pygltflib.SCALAR, 2: pygltflib.VEC2, 3: pygltflib.VEC3, 4: pygltflib.VEC4, 16: pygltflib.MAT4}
_COMPONENTS = {
    np.dtype(np.uint8): pygltflib.UNSIGNED_BYTE,
    np.dtype(np.uint16): pygltflib.UNSIGNED_SHORT,
    np.dtype(np.uint32): pygltflib.UNSIGNED_INT,
    np.dtype(np.float32): pygltflib.FLOAT,
}
# Matte skin: red, green, blue, opacity.
DEFAULT_COLOR = (0.8, 0.62, 0.52, 1.0)

Array = NDArray[Any]


class GltfBuilder:
    """A glTF document under construction: the JSON part and the bytes it points into."""

    def __init__(self) -> None:
        self.gltf = pygltflib.GLTF2(asset=pygltflib.Asset(version="2.0", generator="torchreg"))
        self.blob = bytearray()

    def add(self, values: Array, *, target: int | None = None, bounds: bool = False) -> int:
        """Return the index of a new accessor over ``values``, one element per row."""
        self.blob.extend(b"\0" * (-len(self.blob) % 4))
        data = np.ascontiguousarray(values).tobytes()
        view = pygltflib.BufferView(buffer=0, byteOffset=len(self.blob), byteLength=len(data), target=target)
        self.blob.extend(data)
        self.gltf.bufferViews.append(view)
        width = 1 if values.ndim == 1 else values.shape[1]
        accessor = pygltflib.Accessor(
            bufferView=len(self.gltf.bufferViews) - 1, byteOffset=0, componentType=_COMPONENTS[values.dtype],
            count=len(values), type=_TYPES[width],
        )  # fmt: skip
        if bounds:
            rows = values.reshape(len(values), width)
            accessor.min, accessor.max = rows.min(0).tolist(), rows.max(0).tolist()
        self.gltf.accessors.append(accessor)
        return len(self.gltf.accessors) - 1

    def mesh_attributes(self, points: Array, normals: Tensor | None, colors: Tensor | None) -> pygltflib.Attributes:
        """Return the vertex attributes that every mesh shares: position, normal, color."""
        attributes = pygltflib.Attributes(
            POSITION=self.add(points.astype(np.float32), target=pygltflib.ARRAY_BUFFER, bounds=True)
        )
        if normals is not None:
            unit = unit_rows(checked_numbers(normals, "normals", (len(points), 3)))
            attributes.NORMAL = self.add(unit.astype(np.float32), target=pygltflib.ARRAY_BUFFER)
        if colors is not None:
            rgba = checked_rgba(colors, "colors", len(points)).astype(np.float32)
            attributes.COLOR_0 = self.add(rgba, target=pygltflib.ARRAY_BUFFER)
        return attributes

    def add_mesh(
        self, name: str, attributes: pygltflib.Attributes, triangles: Array, color: Sequence[float] | None
    ) -> int:
        """Return the index of a new mesh with a new matte material."""
        # The largest index of each type means "restart" in glTF and must not occur.
        small = int(triangles.max()) < np.iinfo(np.uint16).max
        indices = self.add(
            triangles.reshape(-1).astype(np.uint16 if small else np.uint32), target=pygltflib.ELEMENT_ARRAY_BUFFER
        )
        surface = pygltflib.PbrMetallicRoughness(
            baseColorFactor=[float(c) for c in color or (1.0, 1.0, 1.0, 1.0)], metallicFactor=0.0, roughnessFactor=0.8
        )
        material = pygltflib.Material(name=name, pbrMetallicRoughness=surface, doubleSided=True, alphaCutoff=None)
        self.gltf.materials.append(material)
        primitive = pygltflib.Primitive(
            attributes=attributes, indices=indices, material=len(self.gltf.materials) - 1, mode=pygltflib.TRIANGLES
        )
        self.gltf.meshes.append(pygltflib.Mesh(name=name, primitives=[primitive]))
        return len(self.gltf.meshes) - 1

    def add_node(self, name: str, transform: Array | None) -> int:
        """Return the index of a new node at the rigid ``transform`` (4, 4) relative to its parent."""
        node = pygltflib.Node(name=name)
        if transform is not None:
            node.translation = transform[:3, 3].astype(np.float32).tolist()
            node.rotation = _quaternions(transform[None, :3, :3])[0].astype(np.float32).tolist()
        self.gltf.nodes.append(node)
        return len(self.gltf.nodes) - 1

    def animate(self, name: str, seconds: Array, nodes: Sequence[int], local: Array) -> None:
        """Add one animation that moves every node through ``local`` (T, len(nodes), 4, 4)."""
        animation = pygltflib.Animation(name=name)
        time = self.add(seconds, bounds=True)
        for index, node in enumerate(nodes):
            quaternions = _continuous(_quaternions(local[:, index, :3, :3]))
            for track, values in (("translation", local[:, index, :3, 3]), ("rotation", quaternions)):
                output = self.add(values.astype(np.float32))
                animation.samplers.append(
                    pygltflib.AnimationSampler(input=time, output=output, interpolation=pygltflib.ANIM_LINEAR)
                )
                animation.channels.append(
                    pygltflib.AnimationChannel(
                        sampler=len(animation.samplers) - 1,
                        target=pygltflib.AnimationChannelTarget(node=node, path=track),
                    )
                )
        self.gltf.animations.append(animation)

    def write(self, path: Path, roots: list[int]) -> Path:
        """Write the document, whole or not at all, and return its path."""
        self.gltf.scenes.append(pygltflib.Scene(nodes=roots))
        self.gltf.scene = 0
        self.gltf.buffers.append(pygltflib.Buffer(byteLength=len(self.blob)))
        self.gltf.set_binary_blob(bytes(self.blob))
        write_atomic(path, b"".join(self.gltf.save_to_bytes()))
        return path


def checked_path(path: str | Path) -> Path:
    """Return the path of a file to be written; InputError unless it ends in .glb and its folder exists."""
    target = Path(path)
    if target.suffix.lower() != ".glb":
        raise InputError(f"path must end in .glb, got {target.name!r}; rename the output file")
    if not target.parent.is_dir():
        raise InputError(
            f"path must lie in an existing folder, got {str(target)!r}; create {str(target.parent)!r} first"
        )
    return target


def checked_numbers(value: Tensor, name: str, shape: Sequence[int | str]) -> Array:
    """Return finite numbers of a shape as float64; InputError, which calls them ``name``, if they are none."""
    tensor = as_float_tensor(value, name)
    check_shape(tensor, name, shape)
    check_finite(tensor, name)
    if 0 in tensor.shape:
        raise InputError(f"{name} must not be empty, got shape {tuple(tensor.shape)}")
    return tensor.detach().cpu().double().numpy()


def checked_triangles(faces: Tensor, name: str, num_vertices: int) -> Array:
    """Return triangles (F, 3) over vertices, at least one; InputError, which calls them ``name``, if they are none."""
    tensor = torch.as_tensor(faces)
    if tensor.is_floating_point() or tensor.is_complex() or tensor.dtype == torch.bool:
        raise InputTypeError(f"{name} must hold integers, got dtype {tensor.dtype}; convert with .long()")
    check_shape(tensor, name, ("F", 3))
    if not len(tensor):
        raise InputError(f"{name} must hold at least one triangle, got none")
    if int(tensor.min()) < 0 or int(tensor.max()) >= num_vertices:
        raise InputError(
            f"{name} must hold indices from 0 to {num_vertices - 1}, got {int(tensor.min())} to {int(tensor.max())}"
        )
    return tensor.detach().cpu().long().numpy()


def checked_times(times: Tensor) -> Array:
    """Return seconds (T,) as float32; InputError unless they are not negative and increase strictly."""
    seconds = checked_numbers(times, "times", ("T",)).astype(np.float32)
    if seconds[0] < 0 or not (np.diff(seconds) > 0).all():
        raise InputError(
            "times must be in seconds, not negative and strictly increasing, also when rounded to float32; "
            f"got {len(seconds)} from {seconds[0]} to {seconds[-1]}"
        )
    return seconds


def checked_rgba(colors: Tensor, name: str, count: int) -> Array:
    """Return colors with opacity (count, 4); InputError, which calls them ``name``, unless they are from 0 to 1."""
    tensor = as_float_tensor(colors, name)
    check_shape(tensor, name, (count, 4 if tensor.ndim == 2 and tensor.shape[1] == 4 else 3))
    values = checked_numbers(tensor, name, tuple(tensor.shape))
    if values.min() < 0 or values.max() > 1:
        raise InputError(f"{name} must lie in [0, 1], got {values.min()} to {values.max()}; divide 8-bit colors by 255")
    return values if values.shape[1] == 4 else np.concatenate([values, np.ones((count, 1))], axis=1)


def unit_rows(vectors: Array) -> Array:
    """Return vectors (..., 3) of unit length, +z for those of none."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(length > 0, vectors / np.where(length > 0, length, 1.0), np.array([0.0, 0.0, 1.0]))


def _quaternions(rotations: Array) -> Array:
    """Return unit quaternions (T, 4), in glTF's order (x, y, z, w), of rotations (T, 3, 3)."""
    return quaternion_from_rotation(torch.from_numpy(rotations))[:, [1, 2, 3, 0]].numpy()


def _continuous(quaternions: Array) -> Array:
    """Return the same rotations with neighbors in time on the same side, so that viewers take the shorter arc."""
    dots = np.einsum("ti,ti->t", quaternions[1:], quaternions[:-1])
    signs = np.concatenate([[1.0], np.cumprod(np.where(dots < 0, -1.0, 1.0))])
    return quaternions * signs[:, None]
