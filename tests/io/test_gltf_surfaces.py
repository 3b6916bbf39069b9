"""glTF surfaces as viewers show them: nodes, skins, instances, morph targets, moments of clips, and what is refused."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

import torchreg as tr
from tests.io.helpers import TURN, UPPER, VERTICES, Scene, bar, put, read, shift
from tests.tables import each, each_row, refused, refusing
from torchreg.io.limits import FileLimits

FormatError, InputError = tr.errors.FormatError, tr.errors.InputError
RIG = Path(__file__).parents[3] / "shared" / "data" / "webxr_hand_right.glb"
SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], "<f4")
STRAIGHT, BENT = [[-0.15, 0, -0.15], [0.15, 2, 0.15]], [[-0.15, 0, -0.15], [1, 1.15, 0.15]]


@pytest.fixture
def scene():
    return Scene()


def flat_square():
    """Return a square of two triangles (strip order 0 1 3 2) with normals: accessors 0, 1 and 2."""
    scene = Scene()
    attributes = {"POSITION": scene.add(SQUARE)}
    indices = scene.add(np.array([0, 1, 2, 0, 2, 3], "u2"))
    attributes["NORMAL"] = scene.add(np.array([[0, 0, 1]] * 4, "f4"))
    scene.node(root=True, mesh=scene.mesh({"attributes": attributes, "indices": indices}))
    return scene


@pytest.fixture
def square():
    return flat_square()


def load(folder, scene, **options):
    return read(folder, "a.glb", scene.content(), **options)


def corners(path, **options):
    points = tr.load_points(path, dtype=torch.float64, **options).points
    return np.stack([points.amin(0), points.amax(0)]).round(4)


@each(
    {},
    {"translation": [1, 2, 3], "rotation": [0.5, 0.5, 0.5, 0.5], "scale": [2, 1, -1]},
    {"matrix": [0, 2, 0, 0, -1, 0, 0, 0, 0, 0, 3, 0, 5, 6, 7, 1]},
    {"rotation": [0, 0, math.sin(0.3), math.cos(0.3)]},
)
def test_node_transforms_agree_with_trimesh(tmp_path, square, node):
    square.json["nodes"] = [{"children": [1], "scale": [1, 3, 1]}, {"mesh": 0, **node}]
    cloud = load(tmp_path, square)
    oracle = trimesh.load_scene(tmp_path / "a.glb", process=False).to_mesh()
    np.testing.assert_allclose(cloud.points, oracle.vertices, atol=1e-6)
    # Faces turn with mirrors, so that their normals stay on the side of the vertex normals.
    normals = cloud.to_mesh().face_normals()
    torch.testing.assert_close((normals * cloud.normals[0]).sum(dim=-1).abs(), torch.ones(2, dtype=torch.float64))
    transformed = trimesh.Trimesh(oracle.vertices, oracle.faces, process=False)
    np.testing.assert_allclose(normals, transformed.face_normals, atol=1e-6)


@pytest.mark.skipif(not RIG.exists(), reason="the rig lies beside the working copy only")
def test_a_rig_made_elsewhere():
    mesh = tr.load_mesh(RIG)
    oracle = trimesh.load_scene(RIG, process=False).to_mesh()
    assert (mesh.num_vertices, mesh.num_faces) == (len(oracle.vertices), len(oracle.faces))
    np.testing.assert_allclose(mesh.face_areas().sum(), oracle.area, rtol=1e-3)


def test_several_primitives_share_vertices_and_nodes_repeat_them(tmp_path, square):
    square.node(root=True, mesh=0, translation=[0, 0, 5])
    square.json["meshes"][0]["primitives"] *= 2
    cloud = load(tmp_path, square)
    np.testing.assert_array_equal(cloud.points, np.concatenate((SQUARE, SQUARE + np.float32([0, 0, 5]))))
    assert cloud.faces.tolist() == [[0, 1, 2], [0, 2, 3]] * 2 + [[4, 5, 6], [4, 6, 7]] * 2
    assert cloud.normals.tolist() == [[0, 0, 1]] * 8
    refused(
        (lambda: load(tmp_path, square, limits=FileLimits(max_points=7)), "claims 8 points"),
        (lambda: load(tmp_path, square, limits=FileLimits(max_faces=5)), "claims 6 faces"),
    )
    # Without scenes, all roots are read.
    del square.json["scenes"], square.json["scene"]
    square.json["nodes"] = [{"mesh": 0}, {"children": [0], "translation": [1, 0, 0]}, {"mesh": 0}]
    wanted = np.concatenate((SQUARE + np.float32([1, 0, 0]), SQUARE))
    np.testing.assert_array_equal(load(tmp_path, square).points, wanted)


@each_row((5, [[0, 1, 2], [2, 1, 3]]), (6, [[0, 1, 2], [0, 2, 3]]), (0, None), (3, None))
def test_other_modes(tmp_path, square, mode, faces):
    primitive = square.json["meshes"][0]["primitives"][0]
    primitive["mode"] = mode
    del primitive["indices"]
    cloud = load(tmp_path, square)
    assert len(cloud) == 4
    assert (cloud.faces if faces is None else cloud.faces.tolist()) == faces


def test_quantized_and_interleaved_data(tmp_path, scene):
    rows = np.zeros(3, [("p", "<i2", 3), ("pad", "<u2"), ("c", "u1", 4)])
    rows["p"], rows["c"] = [[0, 0, 0], [32767, 0, 0], [0, -32768, 0]], [[255, 0, 51, 9]] * 3
    scene.node(root=True, mesh=scene.mesh({"attributes": {"POSITION": 0, "COLOR_0": 1}}))
    scene.blob = rows.tobytes()
    scene.append("bufferViews", {"buffer": 0, "byteLength": 36, "byteStride": 12})
    for kind, width, offset in ((5122, "VEC3", 0), (5121, "VEC4", 8)):
        accessor = {"bufferView": 0, "byteOffset": offset, "componentType": kind, "count": 3, "type": width}
        scene.append("accessors", accessor | {"normalized": True})
    cloud = load(tmp_path, scene)
    assert cloud.points.tolist() == [[0, 0, 0], [1, 0, 0], [0, -1, 0]]
    torch.testing.assert_close(cloud.colors, torch.tensor([[1, 0, 0.2]] * 3, dtype=torch.float64))
    assert cloud.faces.tolist() == [[0, 1, 2]]


def reading(folder, path, value):
    scene = flat_square()
    scene.change(path, value)
    load(folder, scene)


test_damaged_documents = refusing(reading)(
    ("scene", 3, r"refers to scenes\[3\], but there are 1"),
    ("scenes.0.nodes", [], "holds no surface in its default scene"),
    ("nodes.0.children", [0], "cyclic or shared"),
    ("nodes.0.mesh", 7, r"refers to meshes\[7\]"),
    ("accessors.0.count", 10**12, "claims 1000000000000 points"),
    ("accessors.1.count", 10**12, "claims 333333333333 faces"),
    ("accessors.1.count", 5, "5 triangle corners, not a multiple of three"),
    ("accessors.0.type", "VEC2", "a POSITION must hold 3 numbers"),
    ("accessors.2.count", 3, "a NORMAL does not fit its 4 vertices"),
    ("meshes.0.primitives.0.indices", 0, "vertex outside|whole numbers|not a multiple"),
    ("meshes.0.primitives.0.attributes", {}, "holds no surface"),
)


def test_the_pose_of_the_nodes_bends_the_skin(tmp_path, scene):
    scene.rig(tip={"rotation": TURN})
    path = scene.save(tmp_path / "a.glb")
    np.testing.assert_allclose(corners(path), BENT)
    # The same vertex by vertex: the upper half turns about the joint.
    wanted = VERTICES.copy()
    upper = UPPER > 0
    wanted[upper] = np.stack([VERTICES[upper, 1] - 1, 1 - VERTICES[upper, 0], VERTICES[upper, 2]], 1)
    np.testing.assert_allclose(tr.load_points(path).points, wanted, atol=1e-6)


def test_transforms_above_the_skeleton_count_and_those_of_the_mesh_do_not(tmp_path, scene):
    inverse, tip = [shift(0, 0, 0), shift(0, -100, 0)], {"translation": [0, 100, 0]}
    scene.rig([scene.primitive(bar(unit=100.0)[0])], tip=tip, inverse=inverse, above={"scale": [0.01] * 3})
    scene.json["nodes"][2]["translation"] = [9, 9, 9]
    np.testing.assert_allclose(corners(scene.save(tmp_path / "a.glb")), STRAIGHT)


def test_skins_props_and_instances_stand_side_by_side(tmp_path, scene):
    scene.rig(tip={"rotation": TURN})
    scene.rig(translation=[5, 0, 0])
    places = scene.add(np.array([[0, 0, 1], [0, 0, 2]], "f4"))
    sizes = scene.add(np.array([[1, 1, 1], [2, 1, 1]], "f4"))
    instances = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": places, "SCALE": sizes}}}
    scene.node(root=True, mesh=scene.mesh(scene.plain()), translation=[10, 0, 0], extensions=instances)
    points = tr.load_points(scene.save(tmp_path / "a.glb")).points.reshape(4, -1, 3)
    wanted = np.array([BENT, STRAIGHT, STRAIGHT, [[-0.3, 0, -0.15], [0.3, 2, 0.15]]])
    wanted += np.array([[0, 0, 0], [5, 0, 0], [10, 0, 1], [10, 0, 2]])[:, None]
    np.testing.assert_allclose(np.stack([points.amin(1), points.amax(1)], 1), wanted, atol=1e-6)


def test_morph_targets_stand_at_their_weights(tmp_path, scene):
    targets = [{"POSITION": scene.add(np.full((36, 3), value, "f4"))} for value in (1.0, 10.0)]
    mesh = scene.mesh(scene.plain() | {"targets": targets})
    scene.json["meshes"][mesh]["weights"] = [0.5, 0.0]
    scene.node(root=True, mesh=mesh)
    scene.node(root=True, mesh=mesh, weights=[0.0, 1.0])
    points = tr.load_points(scene.save(tmp_path / "a.glb")).points.reshape(2, -1, 3)
    np.testing.assert_allclose(points, np.stack([VERTICES + 0.5, VERTICES + 10]), atol=1e-6)


@pytest.mark.parametrize("kind", ["LINEAR", "STEP", "CUBICSPLINE"])
def test_moments_of_an_animation(tmp_path, scene, kind):
    keys = np.array([[0, 0, 0, 1], TURN], "f4")
    if kind == "CUBICSPLINE":
        keys = np.concatenate([np.zeros_like(keys), keys, np.zeros_like(keys)], 1).reshape(-1, 4)
    scene.clip(np.array([0, 2], "f4"), {(scene.rig(), "rotation"): keys}, interpolation=kind)
    path = scene.save(tmp_path / "a.glb")
    for moment in ({}, {"time": 0.0}, {"frame": 0}, {"time": -3.0}):
        np.testing.assert_allclose(corners(path, **moment), STRAIGHT)
    for moment in ({"time": 2.0}, {"frame": 1}, {"frame": -1}, {"time": 99.0}):
        np.testing.assert_allclose(corners(path, **moment), BENT)
    half, angle = corners(path, time=1.0), np.pi / 4  # by symmetry an eighth of a turn
    if kind == "STEP":
        np.testing.assert_allclose(half, STRAIGHT)
    else:
        np.testing.assert_allclose(half[1, 0], np.sin(angle) + 0.15 * np.cos(angle), atol=1e-3)
    scene.json.pop("animations")
    still, text = scene.save(tmp_path / "still.glb"), put(tmp_path, "a.xyz", "0 0 0\n")
    refused((lambda: tr.load_points(still, time=1.0), r"still\.glb: holds no animation"))
    refused(
        (lambda: tr.load_points(text, time=1.0), "time choose a moment of an animation, which XYZ"),
        (lambda: tr.load_points(path, frame=2), "frame must be below 2, the number of keyframes; got 2"),
        (lambda: tr.load_points(path, frame=1, time=1.0), "give one of them"),
        error=InputError,
    )


def test_mirrored_skins_keep_their_outside(tmp_path, scene):
    plain = Scene()
    scene.rig(above={"scale": [-1, 1, 1]})
    plain.rig()
    mesh, other = (tr.load_mesh(s.save(tmp_path / f"{s is plain}.glb"), dtype=torch.float64) for s in (scene, plain))
    torch.testing.assert_close(mesh.face_normals() * torch.tensor([-1.0, 1, 1]), other.face_normals())


def test_buffers_are_in_the_file_as_text_or_beside_it(tmp_path, square):
    path = put(tmp_path, "a.gltf", square.text())
    np.testing.assert_array_equal(tr.load_points(path).points, SQUARE)
    put(tmp_path, "my data.bin", square.blob + b"trailing")
    path.write_text(json.dumps(square.json | {"buffers": [{"byteLength": len(square.blob), "uri": "my%20data.bin"}]}))
    np.testing.assert_array_equal(tr.load_points(path).points, SQUARE)
    assert tr.load_mesh(path).faces.tolist() == [[0, 1, 2], [0, 2, 3]]
