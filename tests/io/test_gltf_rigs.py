"""Rigs from glTF: round trips, hand-made documents, flat hierarchies, and everything that is refused."""

import base64
import copy
import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from torchreg.errors import FileWarning, FormatError, ModelError
from torchreg.io.gltf import load_rig
from torchreg.io.gltf_write import save_animated_skin
from torchreg.io.limits import FILE_BUDGET, FileLimits

KINDS = {"i1": 5120, "u1": 5121, "u2": 5123, "u4": 5125, "f4": 5126}
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
HAND = Path(__file__).resolve().parents[3] / "shared" / "data" / "webxr_hand_right.glb"

POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], dtype="f4")
JOINTS = np.array([[0, 1, 0, 0]] * 4, dtype="u1")
WEIGHTS = np.array([[1, 0, 0, 0], [0.5, 0.5, 0, 0], [0.25, 0.75, 0, 0], [0, 1, 0, 0]], dtype="f4")
FACES = np.array([0, 1, 2, 1, 3, 2], dtype="u2")
INVERSE_BIND = np.tile(np.eye(4, dtype="f4"), (2, 1, 1))
INVERSE_BIND[1, 0, 3] = -1.0  # the second joint sits at x = 1


class Builder:
    """A glTF document made by hand, independent of the writer."""

    def __init__(self) -> None:
        self.blob = b""
        self.json: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "accessors": [],
            "bufferViews": [],
            "buffers": [],
            "nodes": [
                {"name": "mesh", "mesh": 0, "skin": 0},
                {"name": "root", "children": [2]},
                {"name": "tip", "translation": [1, 0, 0]},
            ],
            "skins": [{"name": "rig", "joints": [1, 2]}],
            "meshes": [{"name": "body", "primitives": []}],
        }

    def add(self, values: np.ndarray, normalized: bool = False, stride: int = 0) -> int:
        width = 1 if values.ndim == 1 else values.shape[1]
        rows = values.reshape(len(values), width)
        data = b"".join(row.tobytes().ljust(stride, b"\xee") for row in rows)
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(self.blob), "byteLength": len(data)}
        if stride:
            view["byteStride"] = stride
        self.json["bufferViews"].append(view)
        self.json["accessors"].append(
            {
                "bufferView": len(self.json["bufferViews"]) - 1,
                "componentType": KINDS[values.dtype.str[1:]],
                "count": len(values),
                "type": TYPES[width],
                "normalized": normalized,
            }
        )
        self.blob += data.ljust(-(-len(data) // 4) * 4, b"\0")
        return len(self.json["accessors"]) - 1

    def matrices(self, matrices: np.ndarray) -> int:
        return self.add(np.ascontiguousarray(matrices.transpose(0, 2, 1)).reshape(-1, 16).astype("f4"))

    def primitive(self, indices: np.ndarray | None = FACES, mode: int = 4, **attributes: int) -> dict[str, Any]:
        primitive: dict[str, Any] = {"attributes": attributes, "mode": mode}
        if indices is not None:
            primitive["indices"] = self.add(indices)
        self.json["meshes"][0]["primitives"].append(primitive)
        return primitive

    def skinned(self, indices: np.ndarray | None = FACES, mode: int = 4) -> "Builder":
        """Fill in the usual two-joint strip."""
        self.primitive(indices, mode, POSITION=self.add(POINTS), JOINTS_0=self.add(JOINTS), WEIGHTS_0=self.add(WEIGHTS))
        self.json["skins"][0]["inverseBindMatrices"] = self.matrices(INVERSE_BIND)
        return self

    def glb(self, path: Path) -> Path:
        document = copy.deepcopy(self.json)
        document["buffers"] = document.get("buffers") or [{"byteLength": len(self.blob)}]
        text = json.dumps(document).encode()
        text = text.ljust(-(-len(text) // 4) * 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text
        chunks += struct.pack("<I4s", len(self.blob), b"BIN\0") + self.blob
        path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
        return path

    def gltf(self, path: Path, uri: str | None = None) -> Path:
        uri = uri or "data:application/octet-stream;base64," + base64.b64encode(self.blob).decode()
        path.write_text(json.dumps(self.json | {"buffers": [{"byteLength": len(self.blob), "uri": uri}]}))
        return path


def test_writer_and_reader_agree(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    rest = np.tile(np.eye(4), (5, 1, 1))
    rest[:, :3, :3] = Rotation.random(5, random_state=rng).as_matrix()
    rest[:, :3, 3] = rng.normal(size=(5, 3))
    weights = rng.dirichlet(np.ones(5), size=40)
    vertices, normals = rng.normal(size=(2, 40, 3))
    faces = rng.integers(0, 40, size=(30, 3))
    names, parents = ["a", "b", "c", "d", "e"], [-1, 0, 4, -1, 1]
    arrays = [torch.from_numpy(a) for a in (vertices, faces, weights, rest, rest[None], np.zeros(1), normals)]
    path = tmp_path / "rig.glb"
    save_animated_skin(path, *arrays[:3], names, parents, *arrays[3:])
    rig = load_rig(path)
    assert (rig.joint_names, rig.parents, rig.name) == (tuple(names), tuple(parents), "skin")
    for got, want in (
        (rig.vertices, vertices),
        (rig.weights, weights),
        (rig.joint_transforms, rest),
        (rig.rest_transforms, rest),
        (rig.normals, normals / np.linalg.norm(normals, axis=1, keepdims=True)),
    ):
        assert got is not None
        assert got.dtype == torch.float64
        np.testing.assert_allclose(got, want, atol=2e-6)
    assert rig.faces.dtype == torch.int64
    assert rig.faces.tolist() == faces.tolist()
    np.testing.assert_allclose(rig.weights.sum(1), 1, atol=1e-14)


@pytest.mark.parametrize("form", ["glb", "data", "file"])
def test_three_ways_to_store_buffers(tmp_path: Path, form: str) -> None:
    builder = Builder().skinned()
    if form == "glb":
        path = builder.glb(tmp_path / "rig.glb")
    elif form == "data":
        path = builder.gltf(tmp_path / "rig.gltf")
    else:
        (tmp_path / "my data.bin").write_bytes(builder.blob + b"trailing")
        path = builder.gltf(tmp_path / "rig.gltf", "my%20data.bin")
    rig = load_rig(path)
    assert (rig.name, rig.joint_names, rig.parents) == ("rig", ("root", "tip"), (-1, 0))
    assert rig.joint_transforms[1, :3, 3].tolist() == [1, 0, 0]
    assert rig.vertices.tolist() == POINTS.tolist()
    assert rig.weights.tolist() == WEIGHTS[:, :2].tolist()
    assert rig.faces.tolist() == [[0, 1, 2], [1, 3, 2]]
    assert rig.normals is None


def test_normalized_strided_and_second_weight_sets(tmp_path: Path) -> None:
    builder = Builder()
    builder.json["skins"][0]["inverseBindMatrices"] = builder.matrices(INVERSE_BIND)
    quarter = np.array([[64, 0, 0, 0]] * 4, dtype="u1")
    rest = np.array([[32768, 16384, 0, 0]] * 4, dtype="u2")
    builder.primitive(
        FACES.astype("u4"),
        POSITION=builder.add(POINTS, stride=20),
        NORMAL=builder.add(np.tile(np.float32([0, 0, 1]), (4, 1))),
        JOINTS_0=builder.add(np.ones((4, 4), dtype="u2")),
        WEIGHTS_0=builder.add(quarter, normalized=True),
        JOINTS_1=builder.add(np.zeros((4, 4), dtype="u1")),
        WEIGHTS_1=builder.add(rest, normalized=True),
    )
    rig = load_rig(builder.glb(tmp_path / "rig.glb"))
    first = 64 / 255
    second = 49152 / 65535
    np.testing.assert_allclose(rig.weights[2], [second / (first + second), first / (first + second)], atol=1e-15)
    assert rig.vertices.tolist() == POINTS.tolist()
    assert rig.normals is not None


def test_sparse_accessors(tmp_path: Path) -> None:
    builder = Builder().skinned()
    rows, values = builder.add(np.array([3], dtype="u2")), builder.add(np.float32([[7, 8, 9]]))
    views = [builder.json["accessors"][index]["bufferView"] for index in (rows, values)]
    sparse = {
        "count": 1,
        "indices": {"bufferView": views[0], "componentType": 5123},
        "values": {"bufferView": views[1]},
    }
    accessor = builder.json["accessors"][0]
    accessor["sparse"] = sparse
    want = POINTS.copy()
    want[3] = [7, 8, 9]
    assert load_rig(builder.glb(tmp_path / "rig.glb")).vertices.tolist() == want.tolist()
    del accessor["bufferView"]
    assert load_rig(builder.glb(tmp_path / "rig.glb")).vertices.tolist() == [[0, 0, 0]] * 3 + [[7, 8, 9]]
    for change, message in (
        ({"count": 5}, "5 entries"),
        ({"indices": None}, "lacks indices"),
        ({"indices": {"bufferView": 0, "componentType": 5126}}, "unusable type"),
        ({"indices": {"bufferView": 2, "componentType": 5125}}, "points at element"),
    ):
        accessor["sparse"] = sparse | change
        with pytest.raises(FormatError, match=message):
            load_rig(builder.glb(tmp_path / "rig.glb"))


@pytest.mark.parametrize(
    ("mode", "indices", "faces"),
    [
        (4, None, [[0, 1, 2]]),
        (5, [0, 1, 2, 3], [[0, 1, 2], [2, 1, 3]]),
        (6, [0, 1, 2, 3], [[0, 1, 2], [0, 2, 3]]),
    ],
)
def test_triangle_modes(tmp_path: Path, mode: int, indices: list[int] | None, faces: list[list[int]]) -> None:
    builder = Builder().skinned(None if indices is None else np.array(indices, dtype="u1"), mode)
    if indices is None:
        for index in range(3):
            builder.json["accessors"][index]["count"] = 3
    assert load_rig(builder.glb(tmp_path / "rig.glb")).faces.tolist() == faces


def test_primitives_and_meshes_are_joined(tmp_path: Path) -> None:
    builder = Builder().skinned()
    shared = builder.json["meshes"][0]["primitives"][0]["attributes"]
    builder.primitive(np.array([3, 2, 1], dtype="u1"), **shared)
    builder.primitive(np.array([0, 1], dtype="u1"), mode=1, **shared)
    other = {"attributes": dict(shared, POSITION=builder.add(POINTS + 5)), "indices": builder.add(FACES)}
    builder.json["meshes"].append({"name": "shoe", "primitives": [other]})
    builder.json["nodes"].append({"mesh": 1, "skin": 0})
    path = builder.glb(tmp_path / "rig.glb")
    rig = load_rig(path)
    assert len(rig.vertices) == 8  # vertices that two primitives share are not doubled
    assert rig.faces.tolist() == [[0, 1, 2], [1, 3, 2], [3, 2, 1], [4, 5, 6], [5, 7, 6]]
    assert load_rig(path, mesh="shoe").vertices.tolist() == (POINTS + 5).tolist()
    assert len(load_rig(path, mesh=0, skin="rig").faces) == 3
    for wanted in ({"mesh": "hat"}, {"skin": 4}):
        with pytest.raises(ModelError, match="known: 0"):
            load_rig(path, **wanted)  # type: ignore[arg-type]


def test_one_of_several_skins_is_chosen(tmp_path: Path) -> None:
    builder = Builder().skinned()
    builder.json["skins"].append({"name": "second", "joints": [2, 1]})
    builder.json["nodes"].append({"mesh": 0, "skin": 1})
    path = builder.glb(tmp_path / "rig.glb")
    both = load_rig(path)
    assert (both.name, both.joint_names, len(both.vertices)) == ("rig", ("root", "tip"), 8)
    assert load_rig(path, skin="second").joint_names == ("tip", "root")
    builder.json["skins"].append({"name": "idle", "joints": [2]})
    with pytest.raises(ModelError, match="no node carries both a mesh and a skin with mesh=None, skin='idle'"):
        load_rig(builder.glb(path), skin="idle")


def test_parents_replace_a_flat_hierarchy(tmp_path: Path) -> None:
    builder = Builder().skinned()
    builder.json["nodes"][1] = {"name": "root"}
    path = builder.glb(tmp_path / "rig.glb")
    assert load_rig(path).parents == (-1, -1)
    assert load_rig(path, parents={"tip": "root"}).parents == (-1, 0)
    assert load_rig(path, parents={"root": "tip", "tip": None}).parents == (1, -1)
    with pytest.raises(ModelError, match="unknown joints thumb; known: root, tip"):
        load_rig(path, parents={"tip": "thumb"})
    with pytest.raises(ModelError, match="cyclic at joints root, tip"):
        load_rig(path, parents={"tip": "root", "root": "tip"})


def test_joints_below_other_nodes_and_without_names(tmp_path: Path) -> None:
    builder = Builder().skinned()
    turn = Rotation.from_rotvec([0.3, -0.4, 0.5])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_rotvec([0, 0, 1]).as_matrix(), [0, 2, 0]
    builder.json["nodes"] += [
        {"children": [4], "rotation": list(turn.as_quat()), "translation": [1, 2, 3], "scale": [2, 2, 2]},
        {"children": [1], "matrix": matrix.T.reshape(-1).tolist()},
    ]
    builder.json["nodes"][1] = {"children": [5]}
    builder.json["nodes"].append({"children": [2]})
    del builder.json["nodes"][2]["name"]
    builder.json["skins"][0]["inverseBindMatrices"] = builder.matrices(INVERSE_BIND)
    rig = load_rig(builder.glb(tmp_path / "rig.glb"))
    assert rig.joint_names == ("joint_0", "joint_1")
    assert rig.parents == (-1, 0)
    rotation = turn.as_matrix() @ matrix[:3, :3]
    root = turn.as_matrix() @ (2 * matrix[:3, 3]) + [1, 2, 3]
    np.testing.assert_allclose(rig.rest_transforms[0, :3, :3], rotation, atol=1e-12)
    np.testing.assert_allclose(rig.rest_transforms[0, :3, 3], root, atol=1e-12)
    np.testing.assert_allclose(rig.rest_transforms[1, :3, 3], root + 2 * rotation[:, 0], atol=1e-12)
    # The skeleton shows the skin turned, moved, and twice as large as stored.
    np.testing.assert_allclose(rig.vertices, 2 * POINTS @ rotation.T + root, atol=1e-12)
    np.testing.assert_allclose(rig.joint_transforms, rig.rest_transforms, atol=1e-12)


def test_scale_that_the_inverse_bind_undoes(tmp_path: Path) -> None:
    builder = Builder().skinned()
    small = np.diag([0.01, 0.01, 0.01, 1.0])
    builder.json["nodes"].append({"children": [1], "scale": [0.01] * 3})
    builder.json["nodes"][2]["translation"] = [100, 0, 0]
    bind = np.stack([small, small])
    bind[1, 0, 3] = 1.0
    builder.json["skins"][0]["inverseBindMatrices"] = builder.matrices(np.linalg.inv(bind))
    rig = load_rig(builder.glb(tmp_path / "rig.glb"))
    assert rig.vertices.tolist() == POINTS.tolist()
    np.testing.assert_allclose(rig.joint_transforms, rig.rest_transforms, atol=1e-6)


def test_without_inverse_bind_matrices_the_nodes_count(tmp_path: Path) -> None:
    builder = Builder().skinned()
    del builder.json["skins"][0]["inverseBindMatrices"]
    rig = load_rig(builder.glb(tmp_path / "rig.glb"))
    assert torch.equal(rig.joint_transforms, rig.rest_transforms)
    assert rig.rest_transforms[1, :3, 3].tolist() == [1, 0, 0]


def test_repeated_names_are_told_apart(tmp_path: Path) -> None:
    builder = Builder().skinned()
    builder.json["nodes"][2]["name"] = "root"
    builder.json["nodes"].append({"name": "root#1"})
    builder.json["skins"][0]["joints"].append(3)
    del builder.json["skins"][0]["inverseBindMatrices"]
    told = r"1 joints have the name of another and are told apart: 'root' \(number 1\) is called \"root#1'\""
    with pytest.warns(FileWarning, match=told):
        rig = load_rig(builder.glb(tmp_path / "rig.glb"))
    assert rig.joint_names == ("root", "root#1'", "root#1")


def change(path: str, value: Any) -> Any:
    """Return an edit of a document: set the entry at a dotted path."""

    def edit(builder: Builder) -> None:
        place: Any = builder.json
        *keys, last = [int(key) if key.isdigit() else key for key in path.split(".")]
        for key in keys:
            place = place[key]
        place[last] = value

    return edit


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (change("nodes.2.children", [1]), "cyclic at 'root', 'tip'"),
        (change("nodes.0.children", [2]), "node 'tip' has two parents"),
        (change("nodes.0.skin", None), "no node carries both"),
        (change("nodes.1.rotation", [0, 0, 0, 0]), "rotation of node 'root' is a zero quaternion"),
        (change("nodes.1.translation", [0, 1e999, 0]), "translation of node 'root' is not finite"),
        (change("nodes.1.matrix", [0] * 16), "not finite or not affine"),
        (change("nodes.1.scale", [0] * 3), "scales the skin by 0"),
        (change("nodes.1.scale", [1e200] * 3), r"scales the skin by 1e\+200"),
        (change("nodes.1.scale", [1e-250] * 3), "scales the skin by 1e-250"),
        (change("skins.0.joints", []), "1 to 1000 different joints, got 0"),
        (change("skins.0.joints", [1, 1]), r"different joints, got 2 \(1 different\)"),
        (lambda b: b.json["meshes"][0]["primitives"][0]["attributes"].pop("JOINTS_0"), "not skinned"),
        (change("meshes.0.primitives.0.mode", 1), "no triangles"),
        (change("meshes.0.primitives", []), "no triangles"),
    ],
)
def test_impossible_rigs(tmp_path: Path, edit: Any, message: str) -> None:
    builder = Builder().skinned()
    edit(builder)
    with pytest.raises(ModelError, match=message) as caught:
        load_rig(builder.glb(tmp_path / "rig.glb"))
    assert "rig.glb" in str(caught.value)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (change("accessors.0.count", 10**12), "12|elements"),
        (change("accessors.0.count", 5), r"POSITION of primitive 0 of mesh 'body' reaches beyond its buffer"),
        (change("accessors.0.count", 3), "float or normalized weights for each of its 3 vertices"),
        (change("accessors.0.byteOffset", -4), "byteOffset of POSITION"),
        (change("accessors.0.type", "VEC2"), "POSITION.*must be VEC3"),
        (change("accessors.0.componentType", 9999), "known component type"),
        (change("accessors.0.bufferView", 99), "must be an index below"),
        (change("accessors.0.bufferView", None), "has no data"),
        (change("bufferViews.0.byteOffset", 10**9), "reaches beyond its buffer"),
        (change("bufferViews.0.buffer", 3), "must be an index below 1"),
        (change("meshes.0.primitives.0.attributes.WEIGHTS_0", None), "the accessor of WEIGHTS_0"),
        (change("meshes.0.primitives.0.attributes.WEIGHTS_0", 1), "float or normalized weights"),
        (change("meshes.0.primitives.0.attributes.NORMAL", 4), "must be VEC3"),
        (change("meshes.0.primitives.0.indices", 0), "must be SCALAR"),
        (change("skins.0.joints", [1]), "refers to joint 1 of a skin with 1"),
        (change("skins.0.joints", [1, 77]), "a joint of skin 0 must be an index below 3"),
        (change("nodes.1.children", [77]), "a child of node 1"),
        (change("nodes.1.translation", [1, 2]), "translation of node 'root' must hold 3 numbers"),
        (change("nodes.1.translation", [1, 2, "x"]), "not a readable glTF document"),
        (change("nodes.1", None), "nodes must be a list of objects"),
        (change("nodes", 3), "not a readable glTF document"),
        (change("extensionsRequired", ["EXT_meshopt_compression"]), "save it again without mesh compression"),
        (change("buffers", [{"byteLength": 10**6}]), "buffer 0 should have 1000000 bytes"),
        (change("buffers", [{"byteLength": 4, "uri": "http://example.org/a.bin"}]), "must lie in the file's folder"),
        (change("buffers", [{"byteLength": 4, "uri": "../a.bin"}]), "must lie in the file's folder"),
        (change("buffers", [{"byteLength": 4, "uri": "/etc/passwd"}]), "must lie in the file's folder"),
        (change("buffers", [{"byteLength": 4, "uri": "gone.bin"}]), r"gone\.bin.*not there"),
        (change("buffers", [{"byteLength": 4, "uri": "data:text/plain,abcd"}]), "must be base64"),
        (change("buffers", [{"byteLength": 4, "uri": "data:a;base64,%%%"}]), "not valid base64"),
    ],
)
def test_damaged_documents(tmp_path: Path, edit: Any, message: str) -> None:
    builder = Builder().skinned()
    edit(builder)
    with pytest.raises(FormatError, match=message) as caught:
        load_rig(builder.glb(tmp_path / "rig.glb"))
    assert "rig.glb" in str(caught.value)


def test_numbers_that_are_refused(tmp_path: Path) -> None:
    def build(points: Any = POINTS, weights: Any = WEIGHTS, inverse: Any = INVERSE_BIND, faces: Any = FACES) -> Path:
        builder = Builder()
        builder.primitive(
            faces, POSITION=builder.add(points), JOINTS_0=builder.add(JOINTS), WEIGHTS_0=builder.add(weights)
        )
        builder.json["skins"][0]["inverseBindMatrices"] = builder.matrices(inverse)
        return builder.glb(tmp_path / "rig.glb")

    with pytest.raises(ModelError, match="POSITION of primitive 0 of mesh 'body' holds non-finite"):
        load_rig(build(points=POINTS * np.float32("nan")))
    with pytest.raises(ModelError, match="none of 4 vertices has a skin weight"):
        load_rig(build(weights=0 * WEIGHTS))
    with pytest.raises(ModelError, match="negative skin weights"):
        load_rig(build(weights=-WEIGHTS))
    with pytest.raises(ModelError, match="joint 'tip' is singular"):
        load_rig(build(inverse=INVERSE_BIND * np.float32([1, 0])[:, None, None]))
    with pytest.raises(FormatError, match="2 joints but 1 inverse bind"):
        load_rig(build(inverse=INVERSE_BIND[:1]))
    with pytest.raises(FormatError, match="integers from 0 to 3, got 3 from 0 to 4"):
        load_rig(build(faces=np.array([0, 1, 4], dtype="u1")))
    with pytest.raises(FormatError, match="4 triangle corners, not a multiple of three"):
        load_rig(build(faces=np.array([0, 1, 2, 3], dtype="u1")))
    with pytest.raises(FormatError, match="4 vertices with 2 joints; at most 3 vertices"):
        load_rig(build(), limits=FileLimits(max_points=3))
    with pytest.raises(FormatError, match="the limit is 64"):
        load_rig(build(), limits=FileLimits(max_bytes=64))


def test_overflow_along_the_hierarchy(tmp_path: Path) -> None:
    builder = Builder().skinned()
    builder.json["nodes"] += [{"scale": [1e200] * 3, "children": [4]}, {"scale": [1e200] * 3, "children": [1]}]
    with pytest.raises(ModelError, match="rest transform of joint 'root' is not finite"):
        load_rig(builder.glb(tmp_path / "rig.glb"))


def test_uneven_normals_are_refused(tmp_path: Path) -> None:
    builder = Builder().skinned()
    builder.json["meshes"][0]["primitives"][0]["attributes"]["NORMAL"] = builder.add(POINTS[:2])
    with pytest.raises(FormatError, match="4 positions but 2 normals"):
        load_rig(builder.glb(tmp_path / "rig.glb"))


def test_damaged_containers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = Builder().skinned().glb(tmp_path / "whole.glb").read_bytes()
    path = tmp_path / "rig.glb"
    cases = {
        b"glTF": "at least 20 bytes",
        whole[:200]: "expected glTF 2",
        whole[:4] + struct.pack("<I", 1) + whole[8:]: "says version 1",
        whole[:12] + struct.pack("<I", 10**6) + whole[16:]: "chunk at byte 12 reaches beyond",
        whole[:16] + b"ELSE" + whole[20:]: "must begin with a JSON chunk",
        whole.replace(b'"asset"', b'"asset ', 1): "not a readable glTF document",
        b"{}": "no node carries",
        b"[" * 100_000: "not a readable glTF document",
        b"\xff\xfe": "not a readable glTF document",
        b'{"buffers": 3}': "not a readable glTF document|no node",
    }
    for content, message in cases.items():
        path.write_bytes(content)
        with pytest.raises((FormatError, ModelError), match=message):
            load_rig(path)
    only_json = struct.unpack_from("<I", whole, 12)[0] + 20
    path.write_bytes(whole[:8] + struct.pack("<I", only_json) + whole[12:only_json])
    with pytest.raises(FormatError, match="neither an address nor a binary chunk"):
        load_rig(path)
    path.write_bytes(whole)
    monkeypatch.setattr("torchreg.io.gltf_document.FILE_BUDGET", replace(FILE_BUDGET, nodes=2))
    with pytest.raises(FormatError, match="3 nodes, at most 2"):
        load_rig(path)


def leaves(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Every place in a JSON document, containers included."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path for path in [path] if path] + [leaf for key, inner in items for leaf in leaves(inner, (*path, key))]


@settings(max_examples=150, deadline=None)
@given(
    st.integers(0, 10**6),
    st.sampled_from([None, True, -1, 0, 1, 7, 2**31, 10**30, 0.5, 1e308, float("nan"), "", "x", [], [0], [None], {}]),
)
def test_any_damaged_entry_gives_an_error_or_a_rig(
    tmp_path_factory: pytest.TempPathFactory, seed: int, value: Any
) -> None:
    builder = Builder().skinned()
    builder.json["buffers"] = [{"byteLength": len(builder.blob)}]
    places = leaves(builder.json)
    *keys, last = places[seed % len(places)]
    place = builder.json
    for key in keys:
        place = place[key]
    place[last] = value
    path = builder.glb(tmp_path_factory.mktemp("fuzz") / "rig.glb")
    try:
        rig = load_rig(path)
    except (FormatError, ModelError):
        return
    assert bool(torch.isfinite(rig.vertices).all())
    assert bool(torch.isfinite(rig.joint_transforms).all())


@pytest.mark.skipif(not HAND.is_file(), reason="needs the shared data")
def test_a_real_hand() -> None:
    flat = load_rig(HAND)
    assert flat.parents == (-1,) * 25
    names = flat.joint_names
    chains = {
        name: None if name == "wrist" else "wrist" if "metacarpal" in name else names[index - 1]
        for index, name in enumerate(names)
    }
    rig = load_rig(HAND, parents=chains)
    assert rig.parents[:6] == (-1, 0, 1, 2, 3, 0)
    assert (rig.vertices.shape, rig.faces.shape, rig.weights.shape) == ((1360, 3), (2314, 3), (1360, 25))
    # The file shows the hand as it was bound.
    np.testing.assert_allclose(rig.joint_transforms, rig.rest_transforms, atol=1e-6)
    tip = names.index("index-finger-tip")
    distal = rig.vertices[rig.weights[:, tip - 1] > 0.5]
    distances = (distal - rig.joint_transforms[tip, :3, 3]).norm(dim=1)
    assert 0.002 < float(distances.min()) < float(distances.max()) < 0.04
