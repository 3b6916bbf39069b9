"""Files below 10 MB that ask a reader for far more than they hold, each with the reader to give it to."""

from __future__ import annotations

import base64
import io
import json
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from torchreg.io.calibration import load_cameras
from torchreg.io.frames import load_frames
from torchreg.io.gltf import load_rig
from torchreg.io.images import load_depth, load_mask
from torchreg.io.points import load_mesh, load_points
from torchreg.io.swc import load_swc
from torchreg.io.urdf import load_urdf

Read = Callable[[Path], object]
# Of the accessors of one skinned vertex.
_FLOAT, _USHORT, _UINT = 5126, 5123, 5125


def _npy(shape: tuple[int, ...], body: bytes = b"", dtype: str = "<f4") -> bytes:
    text = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}"
    text += " " * (-(len(text) + 11) % 64) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode() + body


def _zip(members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return stream.getvalue()


def _png(width: int, height: int, bits: int, color: int, bytes_per_pixel: int) -> bytes:
    """Return a black picture."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    packer, row = zlib.compressobj(9), b"\0" * (1 + width * bytes_per_pixel)
    body = b"".join(packer.compress(row) for _ in range(height)) + packer.flush()
    head = struct.pack(">IIBBBBB", width, height, bits, color, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", body) + chunk(b"IEND", b"")


def _gltf(**entries: Any) -> bytes:
    return json.dumps({"asset": {"version": "2.0"}, **entries}, separators=(",", ":")).encode()


def _sparse_accessor(count: int, kind: str, component: int) -> dict[str, Any]:
    """Return an accessor of zeros, of which one element is listed."""
    listed = {"count": 1, "indices": {"bufferView": 0, "componentType": _UINT}, "values": {"bufferView": 1}}
    return {"count": count, "type": kind, "componentType": component, "sparse": listed}


def _buffer(content: bytes) -> dict[str, Any]:
    return {
        "byteLength": len(content),
        "uri": "data:application/octet-stream;base64," + base64.b64encode(content).decode(),
    }


def _sparse_gltf(count: int, primitives: int = 1, *, skinned: bool = True) -> bytes:
    content = b"\0" * 64
    accessors = [_sparse_accessor(count, "VEC3", _FLOAT)]
    attributes = {"POSITION": 0}
    if skinned:
        accessors += [_sparse_accessor(count, "VEC4", _USHORT), _sparse_accessor(count, "VEC4", _FLOAT)]
        attributes |= {"JOINTS_0": 1, "WEIGHTS_0": 2}
    views = [{"buffer": 0, "byteLength": 64} for _ in range(2)]
    # Attributes that nobody reads make the primitives differ.
    meshes = [{"primitives": [{"attributes": attributes | {f"_{k}": 0}} for k in range(primitives)]}]
    nodes = [{"mesh": 0, "skin": 0, "children": [1]}, {}] if skinned else [{"mesh": 0}]
    return _gltf(
        accessors=accessors, bufferViews=views, buffers=[_buffer(content)], meshes=meshes, nodes=nodes, scene=0,
        scenes=[{"nodes": [0]}], skins=[{"joints": [1]}] if skinned else [],
    )  # fmt: skip


def _many_nodes(count: int, chain: bool) -> bytes:
    """Return a triangle under many nodes, side by side or one below the other."""
    content = struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0)
    nodes: list[dict[str, Any]] = [
        {"translation": [0, 0, 1], "children": [k + 1]} if chain and k + 1 < count else {"translation": [0, 0, 1]}
        for k in range(count)
    ]
    nodes[-1]["mesh"] = 0
    return _gltf(
        accessors=[{"bufferView": 0, "count": 3, "type": "VEC3", "componentType": _FLOAT}],
        bufferViews=[{"buffer": 0, "byteLength": 36}], buffers=[_buffer(content)],
        meshes=[{"primitives": [{"attributes": {"POSITION": 0}}]}], nodes=nodes, scene=0,
        scenes=[{"nodes": [0] if chain else list(range(count))}],
    )  # fmt: skip


def _dense_rig() -> bytes:
    """Return a skin of as many vertices as 5 MB hold, times a thousand joints."""
    count = 100_000
    blocks = [
        np.random.default_rng(0).random((count, 3)).astype("<f4").tobytes(),
        b"\0" * 8 * count,
        b"\0" * 16 * count,
    ]
    views, accessors, start = [], [], 0
    for block, kind, component in zip(blocks, ("VEC3", "VEC4", "VEC4"), (_FLOAT, _USHORT, _FLOAT), strict=True):
        views.append({"buffer": 0, "byteOffset": start, "byteLength": len(block)})
        accessors.append({"bufferView": len(accessors), "count": count, "type": kind, "componentType": component})
        start += len(block)
    attributes = {"POSITION": 0, "JOINTS_0": 1, "WEIGHTS_0": 2}
    return _gltf(
        accessors=accessors, bufferViews=views, buffers=[_buffer(b"".join(blocks))],
        meshes=[{"primitives": [{"attributes": attributes}]}], scene=0, scenes=[{"nodes": [0]}],
        nodes=[{"mesh": 0, "skin": 0}] + [{"translation": [0, 0, 1]} for _ in range(1000)],
        skins=[{"joints": list(range(1, 1001))}],
    )  # fmt: skip


def _robot(body: str) -> bytes:
    return f'<robot name="r">{body}</robot>'.encode()


def _mimic_chain(count: int) -> bytes:
    links = "".join(f'<link name="l{k}"/>' for k in range(count + 1))
    joints = "".join(
        f'<joint name="j{k}" type="revolute"><parent link="l0"/><child link="l{k + 1}"/><axis xyz="0 0 1"/>'
        f'<limit lower="-1" upper="1"/>' + (f'<mimic joint="j{k + 1}"/>' if k + 1 < count else "") + "</joint>"
        for k in range(count)
    )
    return _robot(links + joints)


def _many_cameras(count: int) -> bytes:
    cameras = [{"width": 4, "height": 4, "fx": 1, "fy": 1, "cx": 1, "cy": 1} for _ in range(count)]
    return json.dumps({"format": "torchreg-cameras", "version": 1, "cameras": cameras}).encode()


def _byte_polygons(count: int) -> bytes:
    """Return a PLY file of polygons whose corners take a byte each."""
    rows = np.zeros((count, 256), np.uint8)
    rows[:, 0] = 255
    head = (
        "ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {count}\nproperty list uchar uchar vertex_indices\nend_header\n"
    )
    return head.encode() + struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0) + rows.tobytes()


def _write(folder: Path, name: str, content: bytes) -> Path:
    path = folder / name
    path.write_bytes(content)
    return path


def _glb_in_robot(folder: Path) -> Path:
    _write(folder, "part.gltf", b"")
    document = _sparse_gltf(19_000_000, skinned=False)
    document += b" " * (-len(document) % 4)
    glb = struct.pack("<4sII", b"glTF", 2, 20 + len(document)) + struct.pack("<I4s", len(document), b"JSON") + document
    _write(folder, "part.glb", glb)
    body = '<link name="a"><visual><geometry><mesh filename="part.glb"/></geometry></visual></link>'
    return _write(folder, "glb.urdf", _robot(body))


def crafted(folder: Path, share: float = 1.0) -> Iterator[tuple[Path, Read, float]]:
    """Yield files with their readers and sizes, written one at a time into a folder.

    Args:
        folder: to write to.
        share: of their size that files have which are read to the end; what is refused by its size stays as it is.
    """
    for name, content, read in _refused():
        yield _write(folder, name, content), read, 1.0
    yield _glb_in_robot(folder), load_urdf, 1.0
    for name, content, read in _read_to_the_end(share):
        yield _write(folder, name, content), read, share


def _refused() -> Iterator[tuple[str, bytes, Read]]:
    """Yield what readers refuse when they see how large it is."""
    yield "frames_without_points.npz", _zip({"points.npy": _npy((100_000_000, 0, 3))}), load_frames
    yield "zeros.npz", _zip({"points.npy": _npy((20_000_000, 3), bytes(240_000_000))}), load_points
    yield "members.npz", _zip({f"f_{k}.npy": _npy((0, 3)) for k in range(30_000)}), load_frames
    yield "rig_sparse_178M.gltf", _sparse_gltf(178_000_000), load_rig
    yield "rig_sparse_19M.gltf", _sparse_gltf(19_000_000), load_rig
    yield "rig_400_primitives.gltf", _sparse_gltf(300_000, 400), load_rig
    yield "sparse_19M.gltf", _sparse_gltf(19_000_000, skinned=False), load_mesh
    yield "primitives_400.gltf", _sparse_gltf(300_000, 400, skinned=False), load_points
    yield "nodes_300k.gltf", _many_nodes(300_000, chain=False), load_points
    yield "rig_dense.gltf", _dense_rig(), load_rig
    yield "elements.urdf", _robot("<a/>" * 2_400_000), load_urdf
    yield "cameras_100k.json", _many_cameras(100_000), load_cameras
    yield "digits.json", b'{"width": ' + b"9" * 4400 + b"}", load_cameras
    yield "brackets.json", b"[" * 9_000_000, load_cameras
    yield "depth.png", _png(4000, 4000, 16, 0, 2), load_depth
    yield "too_many_pixels.png", _png(9000, 9000, 8, 0, 1), load_mask


def _read_to_the_end(share: float) -> Iterator[tuple[str, bytes, Read]]:
    """Yield what has the size that readers allow, or a share of it."""

    def part(count: int) -> int:
        return round(share * count)

    noise = np.random.default_rng(0).integers(0, 2, part(9_000_000), dtype=np.uint8).tobytes()
    yield "ratio_60.npz", _zip({"points.npy": _npy((part(3_000_000), 3), noise * 4)}), load_points
    yield "nodes_100k.gltf", _many_nodes(part(100_000), chain=False), load_points
    yield "chain_100k.gltf", _many_nodes(part(100_000), chain=True), load_points
    yield "mimics.urdf", _mimic_chain(part(1999)), load_urdf
    yield "text.urdf", _robot("<link name='a'>" + "x" * part(9_500_000) + "</link>"), load_urdf
    yield "cameras_2k.json", _many_cameras(part(2_000)), load_cameras
    yield "lists.json", b'{"cameras": [' + b"[]," * part(3_000_000) + b"[]]}", load_cameras
    yield "one_bit.png", _png(8000, part(7990), 8, 0, 1), load_mask
    yield "polygons.ply", _byte_polygons(part(38_000)), load_mesh
    triangle = b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"
    yield "corners.obj", triangle + b"f" + b" 1 2 3" * part(1_600_000) + b"\n", load_mesh
    yield "faces.obj", triangle + b"f 1 2 3\n" * part(1_200_000), load_mesh
    yield "rows.xyz", b"0 0 0\n" * part(1_600_000), load_points
    yield "blank.xyz", b"\n" * part(9_900_000), load_points
    nodes = (b"%d 2 0 0 0 1 %d\n" % (k, k - 1 or -1) for k in range(1, part(300_000)))
    yield "nodes.swc", b"".join(nodes), load_swc
    count = part(700_000)
    yield "points.npy.npz", _zip({"points.npy": _npy((count, 3), bytes(12 * count))}, 0), load_points
