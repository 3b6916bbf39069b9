"""A rigged glTF file with other bones and another skin: weights, materials and clips stay as they are."""

from __future__ import annotations

import itertools
import json
import struct
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from torchreg.errors import FileWarning, InputError
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.rotation import rotation_between
from torchreg.io.atomic import write_atomic
from torchreg.io.clouds.raw_cloud import Array
from torchreg.io.file_format import naming
from torchreg.io.gltf import RigRecord, load_rig
from torchreg.io.gltf_file.builder import checked_numbers, checked_path
from torchreg.io.gltf_file.document import GltfDocument
from torchreg.io.gltf_file.placement import place_skins
from torchreg.io.gltf_file.primitives import rig_primitives
from torchreg.io.gltf_file.skins import Skeleton, ancestors, read_skeleton
from torchreg.io.limits import DEFAULT_LIMITS, local_path, read_bytes

_IMAGES = {b"\x89PNG": "image/png", b"\xff\xd8\xff": "image/jpeg"}


@dataclass(frozen=True)
class _Rounding:
    """Rounding of positions in single precision."""

    position: float = 1e-6  # of the skeleton's extent: shorter bones have no direction
    turn: float = 1e-3  # of a bone's length, by which its end may deviate from its old direction


_ROUNDING = _Rounding()


@dataclass(frozen=True)
class _Stretch:
    """The change of a node's translations: times a factor, and a constant (3,) in its parent's coordinates."""

    factor: float
    offset: Array


def save_refitted_rig(
    path: str | Path,
    source: str | Path,
    vertices: Tensor,
    positions: Mapping[str, Tensor],
    *,
    skin: str | int | None = None,
) -> Path:
    """Return the path of a .glb file, the rig of a file with other vertices and bones of other lengths.

    The bind pose is the new one. Joints keep their rotations, weights and materials stay, and clips play on: with the
    length of a bone at bind in the file, ``l``, and the new one, ``l'``, all translations of its node, at rest and in
    every clip, are multiplied by ``l' / l``. Those of the root are by the ratio of the joints' distances from it, so
    that feet stay on the ground. Normals and tangents turn as the surface does. Morph targets and what hangs on joints
    without being skinned, as a tool in a hand, keep their size.
    """
    target, file = checked_path(path), local_path(source)
    with warnings.catch_warnings(), naming(file):
        warnings.simplefilter("ignore", FileWarning)  # what was warned of when the rig was read
        rig = load_rig(file, skin=skin)
        document = GltfDocument(read_bytes(file, DEFAULT_LIMITS), file, DEFAULT_LIMITS)
        if set(positions) != set(rig.joint_names) or len(vertices) != len(rig.vertices):
            raise InputError(
                f"is not the file of this rig: it has {len(rig.vertices)} vertices and {len(rig.joint_names)} joints "
                f"({', '.join(rig.joint_names[:5])}, ...), the rig {len(vertices)} and {len(positions)} "
                f"({', '.join(list(positions)[:5])}, ...)"
            )
        points = checked_numbers(vertices, "vertices", rig.vertices.shape)
        joints = np.stack([checked_numbers(positions[name], f"positions[{name!r}]", (3,)) for name in rig.joint_names])
        skeleton, output = _skeleton(document, skin), _Rewriter(document)
        _replace_surface(output, skeleton, rig, points)
        _replace_bones(output, skeleton, rig, joints)
        write_atomic(target, output.content())
    return target


def _skeleton(document: GltfDocument, skin: str | int | None) -> Skeleton:
    """Return the joints and skins of a file; InputError where they cannot be written with other bones."""
    read = read_skeleton(document, None, skin, {}, DEFAULT_LIMITS)
    if read is None:
        raise InputError("has no skin: a rig of rigid parts is not written with other bones")
    place_skins(document, read[0])
    if read[0].is_baked or any(one.is_bent for one in read[0].skins):
        raise InputError(
            "has joints that scale their parts of the skin unlike others, or skins that were bound in different poses: "
            "apply scale and pose in the program that made it, then it is written with other bones"
        )
    return read[0]


class _Rewriter:
    """A document of which accessors are replaced; what nothing refers to any more is left out of the new file."""

    def __init__(self, document: GltfDocument) -> None:
        self.document = document
        self._fresh: dict[int, bytes] = {}
        self._replaced = set[int]()

    def replace(self, index: int | None, values: Array, kind: str, *, bounds: bool = False) -> int:
        """Return the accessor of new values (N, W): in place of an old one, unless that has new values already."""
        accessors, views = (self.document.json.setdefault(name, []) for name in ("accessors", "bufferViews"))
        data = np.ascontiguousarray(values, dtype="<f4")
        old = {} if index is None else accessors[index]
        kept = {key: old[key] for key in ("name", "extras") if key in old}
        new = {**kept, "bufferView": len(views), "componentType": 5126, "count": len(data), "type": kind}
        if bounds:
            new |= {"min": data.min(0).tolist(), "max": data.max(0).tolist()}
        view = {} if index is None or old.get("bufferView") is None else views[old["bufferView"]]
        views.append({"target": view["target"]} if "target" in view else {})
        self._fresh[len(views) - 1] = data.tobytes()
        if index is None or index in self._replaced:
            accessors.append(new)
            index = len(accessors) - 1
        else:
            accessors[index] = new
        self._replaced.add(index)
        return index

    def content(self) -> bytes:
        """Return the .glb file, with all its buffers and pictures inside."""
        self._embed_pictures()
        tree, blob = self.document.json, bytearray()
        owners = list(_owners_of_views(tree))
        numbers = {old: new for new, old in enumerate(sorted({owner["bufferView"] for owner in owners}))}
        views = [self._view(index, blob) for index in numbers]
        for owner in owners:
            owner["bufferView"] = numbers[owner["bufferView"]]
        tree["bufferViews"], tree["buffers"] = views, [{"byteLength": len(blob)}]
        text = json.dumps(tree, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(blob), b"BIN\0") + blob
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks

    def _view(self, index: int, blob: bytearray) -> dict[str, Any]:
        """Return a buffer view into the new buffer, to which its bytes are added."""
        view = self.document.item("bufferViews", index)
        data = self._fresh.get(index)
        if data is None:
            start = self.document.entry(view, "byteOffset", int)
            end = start + self.document.entry(view, "byteLength", int)
            data = self.document.buffer(self.document.index("buffers", view.get("buffer")))[start:end]
        placed = {"buffer": 0, "byteOffset": len(blob), "byteLength": len(data)}
        blob += data + bytes(-len(data) % 4)
        return {key: view[key] for key in ("name", "byteStride", "target") if key in view} | placed

    def _embed_pictures(self) -> None:
        """Embed pictures that are separate files; where one is not there, its address stays."""
        for image in self.document.items("images"):
            uri = image.get("uri")
            if not isinstance(uri, str) or uri.startswith("data:"):
                continue
            try:
                data = self.document.external("an image", uri)
            except ValueError:
                continue
            kind = next((kind for magic, kind in _IMAGES.items() if data.startswith(magic)), None)
            if kind is not None:
                views = self.document.json.setdefault("bufferViews", [])
                self._fresh[len(views)] = data
                del image["uri"]
                image |= {"bufferView": len(views), "mimeType": kind}
                views.append({})


def _owners_of_views(value: Any) -> Iterator[dict[str, Any]]:
    """Yield all objects of a document that refer to a buffer view."""
    if isinstance(value, dict):
        if isinstance(value.get("bufferView"), int):
            yield value
        for item in value.values():
            yield from _owners_of_views(item)
    elif isinstance(value, list):
        for item in value:
            yield from _owners_of_views(item)


def _replace_surface(output: _Rewriter, skeleton: Skeleton, rig: RigRecord, vertices: Array) -> None:
    """Replace positions, normals and tangents of skinned meshes by those of new vertices (V, 3)."""
    turns = _surface_turns(rig.vertices, torch.from_numpy(vertices), rig.faces).numpy()
    document, begin = output.document, 0
    replaced = dict[str, dict[str, int]]()
    for skin in skeleton.skins:
        to_stored = np.linalg.inv(skin.to_scene)
        unit = to_stored[:3, :3] / np.cbrt(np.linalg.det(to_stored[:3, :3]))
        own, primitives = set[str](), rig_primitives(document, skin.meshes)[0]
        for primitive, key in [(primitive, primitive.key) for primitive in primitives]:
            attributes = primitive.attributes
            if key not in own:
                rows = slice(begin, begin + document.accessor_count(attributes["POSITION"]))
                begin, block = rows.stop, {"POSITION": vertices[rows] @ to_stored[:3, :3].T + to_stored[:3, 3]}
                own.add(key)
                for name in {"NORMAL", "TANGENT"} & set(attributes):
                    block[name] = document.accessor(attributes[name], name).astype(np.float64)
                    block[name][:, :3] = np.einsum("vij,vj->vi", unit @ turns[rows] @ unit.T, block[name][:, :3])
                replaced[key] = {
                    name: output.replace(attributes[name], values, f"VEC{values.shape[1]}", bounds=name == "POSITION")
                    for name, values in block.items()
                }
            attributes |= replaced[key]


def _surface_turns(before: Tensor, after: Tensor, faces: Tensor) -> Tensor:
    """Return the rotations (V, 3, 3) of a surface's normals from vertices (V, 3) to others, alike on both of a seam."""
    positions, first = torch.unique(before.float(), dim=0, return_inverse=True)
    index = torch.empty(len(positions), dtype=torch.int64).scatter_(0, first, torch.arange(len(before)))
    normals = [TriangleMesh(points[index], first[faces]).vertex_normals()[first] for points in (before, after)]
    known = (normals[0].norm(dim=-1) > 0) & (normals[1].norm(dim=-1) > 0)
    turns = rotation_between(normalize(normals[0], dim=-1), normalize(normals[1], dim=-1))
    return torch.where(known[:, None, None], turns, torch.eye(3, dtype=before.dtype))


def _replace_bones(output: _Rewriter, skeleton: Skeleton, rig: RigRecord, positions: Array) -> None:
    """Replace the bind poses of skins, with joints at new positions (J, 3), and stretch what moves their bones."""
    document, places = output.document, skeleton.places.copy()
    stretches = _stretches(document, skeleton, rig, positions)
    places[:, :3, 3] = positions
    for skin in skeleton.skins:
        inverse = np.linalg.inv(places[skin.joints]) @ skin.to_scene
        inverse[:, 3] = (0.0, 0.0, 0.0, 1.0)
        entry = document.item("skins", skin.index)
        stored = entry.get("inverseBindMatrices")
        entry["inverseBindMatrices"] = output.replace(stored, inverse.swapaxes(1, 2).reshape(-1, 16), "MAT4")
    for number, stretch in stretches.items():
        _stretch_node(document.item("nodes", number), stretch)
    _stretch_clips(output, stretches)


def _stretches(document: GltfDocument, skeleton: Skeleton, rig: RigRecord, positions: Array) -> dict[int, _Stretch]:
    """Return how translations change, by node, with joints at ``positions`` (J, 3), metres, in the bind pose."""
    node_parents, old = document.node_parents(), rig.joint_transforms[:, :3, 3].numpy()
    world, number = document.node_globals(node_parents), skeleton.number
    root = rig.parents.index(-1)
    spans = [np.linalg.norm(points - points[root], axis=1).sum() for points in (old, positions)]
    size = float(spans[1] / spans[0]) if spans[0] > 0 else 1.0
    shortest = _ROUNDING.position * float(np.ptp(old, axis=0).max())
    to_rest = skeleton.world[root, :3, :3] @ np.linalg.inv(skeleton.places[root, :3, :3])
    found = dict[int, _Stretch]()
    for node, joint in number.items():
        chain = list(ancestors(node, node_parents))
        parent = next((number[up] for up in chain if up in number), -1)
        if parent < 0:
            # Beside the first root, others go where the bind pose has them.
            moved = to_rest @ ((positions[joint] - positions[root]) - size * (old[joint] - old[root]))
            above = np.eye(3) if not chain else world[chain[0], :3, :3]
            found[node] = _Stretch(size, np.linalg.solve(above, moved))
            continue
        bones = [points[joint] - points[parent] for points in (old, positions)]
        lengths = [float(np.linalg.norm(bone)) for bone in bones]
        factor = lengths[1] / lengths[0] if lengths[0] > shortest else size
        if np.linalg.norm(bones[1] - factor * bones[0]) > _ROUNDING.turn * lengths[1] + shortest:
            raise InputError(f"the bone to joint {rig.joint_names[joint]!r} has another direction in this file")
        between = itertools.takewhile(lambda up: up not in number, chain)
        found |= dict.fromkeys((node, *between), _Stretch(factor, np.zeros(3)))
    return found


def _stretch_node(node: dict[str, Any], stretch: _Stretch) -> None:
    """Change the translation of a node at rest."""
    matrix = node.get("matrix")
    old = np.array(node.get("translation", (0.0, 0.0, 0.0)) if matrix is None else matrix[12:15], dtype=np.float64)
    new = (stretch.factor * old + stretch.offset).tolist()
    if matrix is not None:
        node["matrix"] = [*matrix[:12], *new, *matrix[15:]]
    elif any(new):
        node["translation"] = new


def _stretch_clips(output: _Rewriter, stretches: Mapping[int, _Stretch]) -> None:
    """Change the translations of nodes in all clips, which may share their numbers."""
    document = output.document
    tracks = dict[int, list[_Track]]()
    for clip in document.items("animations"):
        samplers = document.entry(clip, "samplers", list)
        for channel in document.entry(clip, "channels", list):
            target = document.entry(channel, "target", dict)
            if target.get("path") == "translation":
                stretch = stretches.get(target.get("node", -1), _Stretch(1.0, np.zeros(3)))
                sampler = samplers[document.entry(channel, "sampler", int)]
                tracks.setdefault(sampler["output"], []).append(_Track(samplers, channel, stretch))
    read_by = dict[tuple[int, int], int]()
    for index, users in tracks.items():
        values = document.accessor(index, "an animation").astype(np.float64)
        changed = dict[tuple[float, ...], int]()
        for track in users:
            if track.key not in changed:
                changed[track.key] = output.replace(index, track.stretched(values), "VEC3")
            track.read(changed[track.key], read_by)


@dataclass(frozen=True)
class _Track:
    """What moves a node in a clip."""

    samplers: list[dict[str, Any]]  # of the clip
    channel: dict[str, Any]  # of the clip
    stretch: _Stretch  # of the node

    @property
    def _is_cubic(self) -> bool:
        return bool(self.samplers[self.channel["sampler"]].get("interpolation") == "CUBICSPLINE")

    @property
    def key(self) -> tuple[float, ...]:
        """The same for tracks with the same new numbers."""
        return (self.stretch.factor, *self.stretch.offset.tolist(), float(self._is_cubic))

    def stretched(self, values: Array) -> Array:
        """Return translations (T, 3) after the change; of splines in-tangents, values and out-tangents in turn."""
        moved = self.stretch.factor * values
        moved[1 if self._is_cubic else 0 :: 3 if self._is_cubic else 1] += self.stretch.offset
        return moved

    def read(self, output: int, read_by: dict[tuple[int, int], int]) -> None:
        """Let the channel read an accessor, by a sampler of its own where its sampler already reads another."""
        number = self.channel["sampler"]
        if read_by.setdefault((id(self.samplers), number), output) == output:
            self.samplers[number]["output"] = output
        else:
            self.channel["sampler"] = len(self.samplers)
            self.samplers.append({**self.samplers[number], "output": output})
