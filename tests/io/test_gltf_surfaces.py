"""glTF surfaces: node transforms, modes, buffers, what is refused."""

import base64
import json
import math
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from torchreg.errors import FormatError
from torchreg.io.limits import DEFAULT_LIMITS, FileLimits
from torchreg.io.points import load_mesh, load_points

RIG = Path(__file__).parents[3] / "shared" / "data" / "webxr_hand_right.glb"
SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], "<f4")


def document(**changes):
    """A square of two triangles (strip order 0 1 3 2), with its buffer of positions, indices and normals."""
    indices, normals = np.array([0, 1, 2, 0, 2, 3], "<u2"), np.array([[0, 0, 1]] * 4, "<f4")
    binary = SQUARE.tobytes() + indices.tobytes() + normals.tobytes()
    gltf = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "NORMAL": 2}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": 6, "type": "SCALAR"},
            {"bufferView": 2, "componentType": 5126, "count": 4, "type": "VEC3"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 48},
            {"buffer": 0, "byteOffset": 48, "byteLength": 12},
            {"buffer": 0, "byteOffset": 60, "byteLength": 48},
        ],
        "buffers": [{"byteLength": len(binary)}],
    }
    gltf.update(changes)
    return gltf, binary


def pack(gltf, binary) -> bytes:
    text = json.dumps(gltf).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def load(tmp_path, gltf, binary, **options):
    path = tmp_path / "a.glb"
    path.write_bytes(pack(gltf, binary))
    return load_points(path, dtype=torch.float64, **options)


def change(owner, *keys, value):
    for key in keys[:-1]:
        owner = owner[key]
    owner[keys[-1]] = value


def test_plain_square(tmp_path):
    cloud = load(tmp_path, *document())
    np.testing.assert_array_equal(cloud.points, SQUARE)
    assert cloud.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert cloud.normals.tolist() == [[0, 0, 1]] * 4


@pytest.mark.parametrize(
    "node",
    [
        {"translation": [1, 2, 3], "rotation": [0.5, 0.5, 0.5, 0.5], "scale": [2, 1, -1]},
        {"matrix": [0, 2, 0, 0, -1, 0, 0, 0, 0, 0, 3, 0, 5, 6, 7, 1]},
        {"rotation": [0, 0, math.sin(0.3), math.cos(0.3)]},
    ],
)
def test_node_transforms_agree_with_trimesh(tmp_path, node):
    gltf, binary = document(nodes=[{"children": [1], "scale": [1, 3, 1]}, {"mesh": 0, **node}])
    cloud = load(tmp_path, gltf, binary)
    oracle = trimesh.load_scene(tmp_path / "a.glb", process=False).to_mesh()
    np.testing.assert_allclose(cloud.points, oracle.vertices, atol=1e-6)
    # Faces turn with mirrors, so that their normals stay on the side of the vertex normals.
    normals = cloud.to_mesh().face_normals()
    torch.testing.assert_close((normals * cloud.normals[0]).sum(dim=-1).abs(), torch.ones(2, dtype=torch.float64))
    transformed = trimesh.Trimesh(oracle.vertices, oracle.faces, process=False)
    np.testing.assert_allclose(normals, transformed.face_normals, atol=1e-6)


@pytest.mark.skipif(not RIG.exists(), reason="the rig lies beside the working copy only")
def test_a_rig_made_elsewhere():
    mesh = load_mesh(RIG)
    oracle = trimesh.load_scene(RIG, process=False).to_mesh()
    assert (mesh.num_vertices, mesh.num_faces) == (len(oracle.vertices), len(oracle.faces))
    np.testing.assert_allclose(mesh.face_areas().sum(), oracle.area, rtol=1e-3)


def test_skinned_meshes_ignore_their_node(tmp_path):
    gltf, binary = document(nodes=[{"mesh": 0, "skin": 0, "translation": [9, 9, 9]}])
    np.testing.assert_array_equal(load(tmp_path, gltf, binary).points, SQUARE)


def test_several_primitives_share_vertices_and_nodes_repeat_them(tmp_path):
    gltf, binary = document(nodes=[{"mesh": 0}, {"mesh": 0, "translation": [0, 0, 5]}], scenes=[{"nodes": [0, 1]}])
    gltf["meshes"][0]["primitives"] *= 2
    cloud = load(tmp_path, gltf, binary)
    assert len(cloud) == 8
    assert cloud.faces.shape == (8, 3)
    assert cloud.faces[4:].min() == 4
    with pytest.raises(FormatError, match="claims 8 points"):
        load(tmp_path, gltf, binary, limits=FileLimits(max_points=7))
    with pytest.raises(FormatError, match="claims 6 faces"):
        load(tmp_path, gltf, binary, limits=FileLimits(max_faces=5))


@pytest.mark.parametrize(
    ("mode", "faces"),
    [(5, [[0, 1, 2], [2, 1, 3]]), (6, [[0, 1, 2], [0, 2, 3]]), (0, None), (3, None)],
)
def test_other_modes(tmp_path, mode, faces):
    gltf, binary = document()
    primitive = gltf["meshes"][0]["primitives"][0]
    primitive["mode"] = mode
    del primitive["indices"]
    cloud = load(tmp_path, gltf, binary)
    assert len(cloud) == 4
    assert (cloud.faces is None) if faces is None else (cloud.faces.tolist() == faces)


def test_quantized_and_interleaved_data(tmp_path):
    rows = np.zeros(3, [("p", "<i2", 3), ("pad", "<u2"), ("c", "u1", 4)])
    rows["p"] = [[0, 0, 0], [32767, 0, 0], [0, -32768, 0]]
    rows["c"] = [[255, 0, 51, 9]] * 3
    gltf, _ = document(
        accessors=[
            {"bufferView": 0, "componentType": 5122, "count": 3, "type": "VEC3", "normalized": True},
            {"bufferView": 0, "byteOffset": 8, "componentType": 5121, "count": 3, "type": "VEC4", "normalized": True},
        ],
        bufferViews=[{"buffer": 0, "byteLength": 36, "byteStride": 12}],
        buffers=[{"byteLength": 36}],
        meshes=[{"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}}]}],
    )
    cloud = load(tmp_path, gltf, rows.tobytes())
    assert cloud.points.tolist() == [[0, 0, 0], [1, 0, 0], [0, -1, 0]]
    torch.testing.assert_close(cloud.colors, torch.tensor([[1, 0, 0.2]] * 3, dtype=torch.float64))
    assert cloud.faces.tolist() == [[0, 1, 2]]


def test_without_scenes_all_roots_are_read(tmp_path):
    gltf, binary = document(nodes=[{"mesh": 0}, {"children": [0], "translation": [1, 0, 0]}, {"mesh": 0}])
    del gltf["scenes"], gltf["scene"]
    points = load(tmp_path, gltf, binary).points
    np.testing.assert_array_equal(points, np.concatenate((SQUARE + np.float32([1, 0, 0]), SQUARE)))


def test_gltf_with_buffers_beside_or_inside(tmp_path):
    gltf, binary = document()
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "my data.bin").write_bytes(binary)
    for uri in ("sub/my%20data.bin", "data:application/octet-stream;base64," + base64.b64encode(binary).decode()):
        gltf["buffers"][0]["uri"] = uri
        (tmp_path / "a.gltf").write_text(json.dumps(gltf))
        np.testing.assert_array_equal(load_points(tmp_path / "a.gltf").points, SQUARE)


def test_buffers_from_elsewhere_are_refused(tmp_path):
    gltf, binary = document()
    (tmp_path / "outside.bin").write_bytes(binary)
    folder = tmp_path / "in"
    folder.mkdir()
    (folder / "link.bin").symlink_to(tmp_path / "outside.bin")
    uris = [
        "http://host/a.bin",
        "HTTPS://host/a.bin",
        "//host/a.bin",
        "file:///etc/passwd",
        "../outside.bin",
        "link.bin",
    ]
    uris += [str(tmp_path / "outside.bin"), "sub/../../outside.bin", "%2e%2e/outside.bin", "http%3A//host/a", "s3:/b/c"]
    for uri in uris:
        gltf["buffers"][0]["uri"] = uri
        (folder / "a.gltf").write_text(json.dumps(gltf))
        with pytest.raises(FormatError, match=r"a\.gltf: (refers to the buffer|its buffer .* cannot be read)"):
            load_points(folder / "a.gltf")
    for uri, words in (
        ("none.bin", "cannot be read"),
        ("data:text/plain,abc", "not base64"),
        ("data:x;base64,a!", "damaged base64"),
        ("data:x;base64,YWJj", "shorter than its byteLength"),
    ):
        gltf["buffers"][0]["uri"] = uri
        (folder / "a.gltf").write_text(json.dumps(gltf))
        with pytest.raises(FormatError, match=words):
            load_points(folder / "a.gltf")


@pytest.mark.parametrize(
    ("keys", "value", "words"),
    [
        (("asset",), {}, "must be glTF of version 2"),
        (("extensionsRequired",), ["EXT_meshopt_compression"], "needs the extension EXT_meshopt"),
        (("scene",), 3, r"refers to scenes\[3\], but there are 1"),
        (("scenes", 0, "nodes"), [], "holds no surface in its default scene"),
        (("nodes", 0, "children"), [0], "cyclic or shared"),
        (("nodes", 0, "children"), "all", "'children' must be of type list, got str"),
        (("nodes", 0, "mesh"), 7, r"refers to meshes\[7\]"),
        (("nodes", 0, "mesh"), True, r"refers to meshes\[True\]"),
        (("nodes", 0), 5, r"nodes\[0\] must be an object"),
        (("nodes", 0, "scale"), [1, 1], "scale of node 0 must hold 3 numbers"),
        (("nodes", 0, "translation"), [1, 1, math.nan], "translation of node 0 is not finite"),
        (("nodes", 0, "rotation"), [0, 0, 0, 0], "rotation of node 0 is a zero quaternion"),
        (("nodes", 0, "matrix"), [1], "matrix of node 0 must hold 16 numbers"),
        (("accessors", 0, "count"), 10**12, "claims 1000000000000 points"),
        (("accessors", 0, "count"), 5, r"accessors\[0\] of 5 elements reaches beyond its buffer"),
        (("accessors", 0, "count"), -1, r"accessors\[0\] claims -1 elements"),
        (("accessors", 0, "count"), 4.5, "'count' must be of type int"),
        (("accessors", 1, "count"), 10**12, "claims 333333333333 faces"),
        (("accessors", 1, "count"), 5, "5 triangle corners, not a multiple of three"),
        (("accessors", 0, "byteOffset"), -4, "reaches beyond its buffer"),
        (("accessors", 0, "sparse"), {}, "is sparse"),
        (("accessors", 0, "type"), "VEC2", "a POSITION must hold 3 numbers"),
        (("accessors", 0, "componentType"), 1, "unknown type 1"),
        (("accessors", 2, "count"), 3, "a NORMAL does not fit its 4 vertices"),
        (("bufferViews", 0, "byteLength"), 200, r"bufferViews\[0\] reaches beyond its buffer"),
        (("bufferViews", 0, "byteStride"), -12, "reaches beyond its buffer"),
        (("buffers", 0, "byteLength"), 10**9, "shorter than its byteLength"),
        (("meshes", 0, "primitives", 0, "indices"), 0, "vertex outside|whole numbers|not a multiple"),
        (("meshes", 0, "primitives", 0, "attributes"), {}, "holds no surface"),
    ],
)
def test_damaged_documents_are_refused(tmp_path, keys, value, words):
    gltf, binary = document()
    change(gltf, *keys, value=value)
    with pytest.raises(FormatError, match=words):
        load(tmp_path, gltf, binary)


def test_index_beyond_the_vertices_is_refused(tmp_path):
    gltf, binary = document()
    with pytest.raises(FormatError, match="a face names a vertex outside 0 to 3"):
        load(tmp_path, gltf, binary[:48] + b"\x09" + binary[49:])


def test_damaged_containers_are_refused(tmp_path):
    whole, path = pack(*document()), tmp_path / "a.glb"
    for content, words in (
        (whole[:15], "is cut off in its header"),
        (whole[:-4], "cut off or damaged"),
        (whole + b"\0\0\0\0", "cut off or damaged"),
        (whole[:4] + b"\1" + whole[5:], "says version 1"),
        (whole[:12] + b"\xff\xff" + whole[14:], "chunk at byte 12 reaches beyond the end"),
        (whole.replace(b"JSON", b"JSOM"), "must begin with a JSON chunk"),
        (whole.replace(b"BIN\0", b"BIN1"), "has neither an address nor a binary chunk"),
        (b"[]", "must be glTF of version 2"),
        (b"{" * 10, "not a readable glTF document"),
        (b"[" * 100_000, "not a readable glTF document"),
    ):
        path.write_bytes(content)
        with pytest.raises(FormatError, match=words):
            load_points(path)
    assert DEFAULT_LIMITS.max_points < 10**12
