"""Small files made by hand: put on disk, read back, and refused in one table."""

import base64
import json
import struct
from typing import Any

import numpy as np
import torch

import torchreg as tr
from tests.gltf_player import KINDS, TYPES

TURN = [0, 0, -np.sqrt(0.5), np.sqrt(0.5)]  # a quarter turn about z, clockwise


def put(folder, name, content):
    """Write bytes, text or a JSON document; return the path."""
    content = content if isinstance(content, bytes | str) else json.dumps(content)
    (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)
    return folder / name


def read(folder, name, content, **options):
    """Write a file and return its cloud in double precision."""
    return tr.load_points(put(folder, name, content), **{"dtype": torch.float64, **options})


def bar(height=2.0, thick=0.3, rings=9, unit=1.0):
    """Return vertices and triangles of a square bar along y, and 1 for each vertex of its upper half."""
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * thick / 2
    heights = np.linspace(0, height, rings)
    vertices = np.array([[x, y, z] for y in heights for x, z in square]) * unit
    faces = [[4 * k + s, 4 * k + 4 + s, 4 * k + 4 + (s + 1) % 4] for k in range(rings - 1) for s in range(4)]
    faces += [[4 * k + s, 4 * k + 4 + (s + 1) % 4, 4 * k + (s + 1) % 4] for k in range(rings - 1) for s in range(4)]
    return vertices, np.array(faces), (np.repeat(heights, 4) > height / 2 - 1e-9).astype("f4")


VERTICES, FACES, UPPER = bar()


def shift(x, y, z):
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def glb(document, blob):
    """Return a container of a JSON chunk and a binary one."""
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    blob += b"\0" * (-len(blob) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(blob), b"BIN\0") + blob
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


class Scene:
    """A glTF document made by hand, independent of the writer."""

    def __init__(self):
        self.json: dict[str, Any] = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": []}]}
        self.blob = b""

    def append(self, collection, item):
        self.json.setdefault(collection, []).append(item)
        return len(self.json[collection]) - 1

    def add(self, values, normalized=False, stride=0):
        """Append an accessor of rows, which begin at multiples of four bytes; its number."""
        values = np.asarray(values)
        rows = np.ascontiguousarray(values.reshape(len(values), -1))
        width = rows.itemsize * rows.shape[1]
        stride = stride or (width if values.ndim == 1 else -(-width // 4) * 4)
        packed = np.full((len(rows), stride), 0xEE, "u1")
        packed[:, :width] = np.frombuffer(rows.tobytes(), "u1").reshape(len(rows), width)
        self.blob += b"\0" * (-len(self.blob) % 4)
        view = {"buffer": 0, "byteOffset": len(self.blob), "byteLength": packed.size}
        self.blob += packed.tobytes()
        return self.append("accessors", {
            "bufferView": self.append("bufferViews", view | ({"byteStride": stride} if stride != width else {})),
            "componentType": KINDS[values.dtype.str[1:]], "count": len(values), "normalized": normalized,
            "type": TYPES[rows.shape[1]],
        })  # fmt: skip

    def matrices(self, values):
        return self.add(np.swapaxes(np.asarray(values, "f4"), 1, 2).reshape(-1, 16))

    def primitive(self, vertices=VERTICES, faces=FACES, weights=UPPER, **changes):
        """Return a primitive; by default a bar whose upper half follows joint 1."""
        joints = np.tile(np.array([0, 1, 0, 0], "u1"), (len(vertices), 1))
        shares = np.stack([1 - weights, weights, 0 * weights, 0 * weights], 1).astype("f4")
        values = {"POSITION": vertices.astype("f4"), "JOINTS_0": joints, "WEIGHTS_0": shares} | changes
        attributes = {
            name: self.add(*v) if isinstance(v, tuple) else self.add(v) for name, v in values.items() if v is not None
        }
        return {"attributes": attributes, "indices": self.add(faces.reshape(-1).astype("u2"))}

    def plain(self, **changes):
        """Return a primitive without a skin."""
        return self.primitive(JOINTS_0=None, WEIGHTS_0=None, **changes)

    def mesh(self, *primitives):
        return self.append("meshes", {"primitives": list(primitives)})

    def node(self, root=False, **entries):
        number = self.append("nodes", entries)
        if root:
            self.json["scenes"][0]["nodes"].append(number)
        return number

    def skin(self, joints, inverse_binds, **entries):
        return self.append("skins", {"joints": joints, "inverseBindMatrices": self.matrices(inverse_binds), **entries})

    def rig(self, primitives=None, tip=None, inverse=None, above=None, **root):
        """Add a root, a tip a metre above it and the bar that they move; return the tip."""
        number = self.node(name="tip", **{"translation": [0, 1, 0], **(tip or {})})
        base = self.node(root=above is None, name="root", children=[number], **root)
        skin = self.skin([base, number], [shift(0, 0, 0), shift(0, -1, 0)] if inverse is None else inverse)
        body = self.node(root=above is None, name="body", mesh=self.mesh(*primitives or [self.primitive()]), skin=skin)
        if above is not None:
            self.node(root=True, children=[base, body], **above)
        return number

    def clip(self, times, tracks, **sampler):
        """Add an animation: keys by (node, path)."""
        moments, samplers, channels = self.add(np.asarray(times, "f4")), [], []
        for (node, path), keys in tracks.items():
            channels.append({"sampler": len(samplers), "target": {"node": node, "path": path}})
            samplers.append({"input": moments, "output": self.add(np.asarray(keys, "f4")), **sampler})
        self.append("animations", {"samplers": samplers, "channels": channels})

    def change(self, path, value):
        """Set the entry at a dotted path."""
        place: Any = self.json
        *keys, last = [int(key) if key.isdigit() else key for key in path.split(".")]
        for key in keys:
            place = place[key]
        place[last] = value

    def text(self):
        """Return the document with its buffer as text."""
        uri = "data:application/octet-stream;base64," + base64.b64encode(self.blob).decode()
        return json.dumps(self.json | {"buffers": [{"byteLength": len(self.blob), "uri": uri}]})

    def content(self):
        return glb({"buffers": [{"byteLength": len(self.blob)}]} | self.json, self.blob)

    def save(self, path):
        path.write_bytes(self.content())
        return path
