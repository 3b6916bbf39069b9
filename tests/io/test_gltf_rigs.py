"""Rigs from glTF: round trips, documents made by hand, pieces that are bad, flat hierarchies, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import torchreg as tr
from tests.io.helpers import FACES, UPPER, Scene, put, shift
from tests.tables import refused, refusing
from torchreg.io.gltf import load_rig
from torchreg.io.gltf_write import save_animated_skin
from torchreg.io.limits import FILE_BUDGET, FileLimits

FileWarning, FormatError, ModelError = tr.errors.FileWarning, tr.errors.FormatError, tr.errors.ModelError
POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], "f4")
CORNERS = np.array([[0, 1, 2], [1, 3, 2]])
TIP = np.array([0, 0.5, 0.75, 1], "f4")
WEIGHTS = np.stack([1 - TIP, TIP], 1)
INVERSE = np.stack([shift(0, 0, 0), shift(-1, 0, 0)])
STRIPED = np.array([[0, 1, 0, 0]] * 4, "u1")


def strip(inverse=INVERSE, points=POINTS, faces=CORNERS, tip=TIP, **changes):
    """Return a square on two joints: tip (node 0) at x = 1 on root (1), and the body (2)."""
    scene = Scene()
    primitive = scene.primitive(points, faces, weights=tip, **changes)
    scene.rig([primitive], tip={"translation": [1, 0, 0]}, inverse=inverse)
    scene.json["skins"][0]["name"] = "rig"
    scene.json["meshes"][0]["name"] = "body"
    return scene


@pytest.fixture
def scene():
    return strip()


def loaded(folder, scene, **options):
    return load_rig(scene.save(folder / "rig.glb"), **options)


def test_writer_and_reader_agree(tmp_path):
    rng = np.random.default_rng(1)
    rest = np.tile(np.eye(4), (5, 1, 1))
    rest[:, :3, :3] = Rotation.random(5, random_state=rng).as_matrix()
    rest[:, :3, 3] = rng.normal(size=(5, 3))
    weights = rng.dirichlet(np.ones(5), size=40)
    vertices, normals = rng.normal(size=(2, 40, 3))
    faces = rng.integers(0, 40, size=(30, 3))
    names, parents = ["a", "b", "c", "d", "e"], [-1, 0, 4, -1, 1]
    arrays = [torch.from_numpy(a) for a in (vertices, faces, weights, rest, rest[None], np.zeros(1), normals)]
    save_animated_skin(tmp_path / "rig.glb", *arrays[:3], names, parents, *arrays[3:])
    rig = load_rig(tmp_path / "rig.glb")
    assert (rig.joint_names, rig.parents, rig.name) == (tuple(names), tuple(parents), "skin")
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    for name, want in (("vertices", vertices), ("weights", weights), ("joint_transforms", rest), ("normals", normals)):
        assert getattr(rig, name).dtype == torch.float64
        np.testing.assert_allclose(getattr(rig, name), want, atol=2e-6)
    np.testing.assert_allclose(rig.rest_transforms, rest, atol=2e-6)
    assert rig.faces.dtype == torch.int64
    assert rig.faces.tolist() == faces.tolist()
    np.testing.assert_allclose(rig.weights.sum(1), 1, atol=1e-14)


@pytest.mark.parametrize("form", ["glb", "gltf"])
def test_a_rig_made_by_hand(tmp_path, scene, form):
    rig = load_rig(put(tmp_path, f"rig.{form}", scene.content() if form == "glb" else scene.text()))
    assert (rig.name, rig.joint_names, rig.parents) == ("rig", ("root", "tip"), (-1, 0))
    assert rig.joint_transforms[1, :3, 3].tolist() == [1, 0, 0]
    assert rig.vertices.tolist() == POINTS.tolist()
    assert rig.weights.tolist() == WEIGHTS.tolist()
    assert rig.faces.tolist() == CORNERS.tolist()
    assert rig.normals is None
    del scene.json["skins"][0]["inverseBindMatrices"]  # then the nodes count
    rig = loaded(tmp_path, scene)
    assert torch.equal(rig.joint_transforms, rig.rest_transforms)
    assert rig.rest_transforms[1, :3, 3].tolist() == [1, 0, 0]


def test_normalized_strided_and_second_weight_sets(tmp_path):
    scene = strip(JOINTS_0=np.ones((4, 4), "u2"), WEIGHTS_0=(np.array([[64, 0, 0, 0]] * 4, "u1"), True),
                  JOINTS_1=np.zeros((4, 4), "u1"), WEIGHTS_1=(np.array([[32768, 16384, 0, 0]] * 4, "u2"), True),
                  NORMAL=np.tile(np.float32([0, 0, 1]), (4, 1)), POSITION=(POINTS, False, 20))  # fmt: skip
    rig = loaded(tmp_path, scene)
    first, second = 64 / 255, 49152 / 65535
    np.testing.assert_allclose(rig.weights[2], [second / (first + second), first / (first + second)], atol=1e-15)
    assert rig.vertices.tolist() == POINTS.tolist()
    assert rig.normals.tolist() == [[0, 0, 1]] * 4


def test_primitives_meshes_and_skins_are_joined_or_chosen(tmp_path, scene):
    shared = scene.json["meshes"][0]["primitives"][0]["attributes"]
    for mode, corners in ((4, [3, 2, 1]), (1, [0, 1])):
        part = {"attributes": shared, "mode": mode, "indices": scene.add(np.array(corners, "u1"))}
        scene.json["meshes"][0]["primitives"].append(part)
    shoe = {"attributes": dict(shared, POSITION=scene.add(POINTS + 5)), "indices": 3}
    scene.node(root=True, mesh=scene.append("meshes", {"name": "shoe", "primitives": [shoe]}), skin=0)
    rig = loaded(tmp_path, scene)
    assert len(rig.vertices) == 8  # vertices that two primitives share are not doubled
    assert rig.faces.tolist() == [[0, 1, 2], [1, 3, 2], [3, 2, 1], [4, 5, 6], [5, 7, 6]]
    assert loaded(tmp_path, scene, mesh="shoe").vertices.tolist() == (POINTS + 5).tolist()
    assert len(loaded(tmp_path, scene, mesh=0, skin="rig").faces) == 3
    scene.node(root=True, mesh=0, skin=scene.append("skins", {"name": "second", "joints": [0, 1]}))
    scene.append("skins", {"name": "idle", "joints": [0]})
    both = loaded(tmp_path, scene)
    assert (both.name, both.joint_names, len(both.vertices)) == ("rig", ("root", "tip"), 12)
    assert loaded(tmp_path, scene, skin="second").joint_names == ("tip", "root")
    refused(
        (lambda: loaded(tmp_path, scene, mesh="hat"), "known: 0"),
        (lambda: loaded(tmp_path, scene, skin=4), "known: 0"),
        (lambda: loaded(tmp_path, scene, skin="idle"), "carries both a mesh and a skin with mesh=None, skin='idle'"),
        error=ModelError,
    )


def test_parents_replace_a_flat_hierarchy(tmp_path, scene):
    scene.json["nodes"][1] = {"name": "root"}
    scene.json["scenes"][0]["nodes"].append(0)
    assert loaded(tmp_path, scene).parents == (-1, -1)
    assert loaded(tmp_path, scene, parents={"tip": "root"}).parents == (-1, 0)
    assert loaded(tmp_path, scene, parents={"root": "tip", "tip": None}).parents == (1, -1)
    circle = {"tip": "root", "root": "tip"}
    refused(
        (lambda: loaded(tmp_path, scene, parents={"tip": "thumb"}), "unknown joints thumb; known: root, tip"),
        (lambda: loaded(tmp_path, scene, parents=circle), "cyclic at joints root, tip"),
        error=ModelError,
    )


def test_joints_below_other_nodes_and_without_names(tmp_path, scene):
    turn, matrix = Rotation.from_rotvec([0.3, -0.4, 0.5]), shift(0, 2, 0)
    matrix[:3, :3] = Rotation.from_rotvec([0, 0, 1]).as_matrix()
    between = scene.node(matrix=matrix.T.reshape(-1).tolist(), children=[1])
    placed = {"rotation": list(turn.as_quat()), "translation": [1, 2, 3], "scale": [2, 2, 2]}
    above = scene.node(children=[between], **placed)
    scene.json["nodes"][1] = {"children": [scene.node(children=[0])]}
    del scene.json["nodes"][0]["name"]
    scene.json["scenes"][0]["nodes"] = [above, 2]
    rig = loaded(tmp_path, scene)
    assert (rig.joint_names, rig.parents) == (("joint_0", "joint_1"), (-1, 0))
    rotation = turn.as_matrix() @ matrix[:3, :3]
    root = turn.as_matrix() @ (2 * matrix[:3, 3]) + [1, 2, 3]
    np.testing.assert_allclose(rig.rest_transforms[0, :3, :3], rotation, atol=1e-12)
    np.testing.assert_allclose(rig.rest_transforms[:, :3, 3], [root, root + 2 * rotation[:, 0]], atol=1e-12)
    # The skeleton shows the skin turned, moved, and twice as large as stored.
    np.testing.assert_allclose(rig.vertices, 2 * POINTS @ rotation.T + root, atol=1e-12)
    np.testing.assert_allclose(rig.joint_transforms, rig.rest_transforms, atol=1e-12)


def test_scale_that_the_inverse_bind_undoes(tmp_path):
    small = np.diag([0.01, 0.01, 0.01, 1.0])
    bind = np.stack([small, small])
    bind[1, 0, 3] = 1.0
    scene = strip(inverse=np.linalg.inv(bind))
    scene.json["scenes"][0]["nodes"] = [scene.node(children=[1], scale=[0.01] * 3), 2]
    scene.json["nodes"][0]["translation"] = [100, 0, 0]
    rig = loaded(tmp_path, scene)
    assert rig.vertices.tolist() == POINTS.tolist()
    np.testing.assert_allclose(rig.joint_transforms, rig.rest_transforms, atol=1e-6)


def test_repeated_names_are_kept_apart(tmp_path, scene):
    scene.json["nodes"][0]["name"] = "root"
    scene.json["skins"][0] = {"joints": [1, 0, scene.node(root=True, name="root#1")]}
    words = r"1 joints have the name of another and are told apart: 'root' \(number 1\) is called \"root#1'\""
    with pytest.warns(FileWarning, match=words):
        assert loaded(tmp_path, scene).joint_names == ("root", "root#1'", "root#1")


def reading(folder, path, value):
    scene = strip()
    scene.change(path, value)
    loaded(folder, scene)


test_impossible_rigs = refusing(reading, ModelError, file="rig.glb")(
    ("nodes.0.children", [1], "cyclic at 'tip', 'root'|cyclic at 'root', 'tip'"),
    ("nodes.2.skin", None, "no node carries both"),
    ("nodes.1.matrix", [0] * 16, "not finite or not affine"),
    ("nodes.1.scale", [0] * 3, "scales the skin by 0"),
    ("nodes.1.scale", [1e200] * 3, r"scales the skin by 1e\+200"),
    ("nodes.1.scale", [1e-250] * 3, "scales the skin by 1e-250"),
    ("skins.0.joints", [], "1 to 1000 different joints, got 0"),
    ("skins.0.joints", [1, 1], r"different joints, got 2 \(1 different\)"),
    ("meshes.0.primitives.0.attributes", {"POSITION": 0}, "not skinned"),
    ("meshes.0.primitives.0.mode", 1, "no triangles"),
    ("meshes.0.primitives", [], "no triangles"),
)
test_damaged_documents = refusing(reading, file="rig.glb")(
    ("accessors.0.count", 5, r"POSITION of primitive 0 of mesh 'body' reaches beyond its buffer"),
    ("accessors.0.count", 3, "float or normalized weights for each of its 3 vertices"),
    ("accessors.0.type", "VEC2", "POSITION.*must be VEC3"),
    ("meshes.0.primitives.0.attributes.WEIGHTS_0", None, "the accessor of WEIGHTS_0"),
    ("meshes.0.primitives.0.attributes.WEIGHTS_0", 1, "float or normalized weights"),
    ("meshes.0.primitives.0.attributes.NORMAL", 4, "must be VEC3"),
    ("meshes.0.primitives.0.indices", 0, "must be SCALAR"),
    ("skins.0.joints", [1], "refers to joint 1 of a skin with 1"),
    ("skins.0.joints", [1, 77], "a joint of skin 0 must be an index below 3"),
    ("nodes.1.children", [77], "a node of the scene must be an index below 3"),
    ("extensionsRequired", ["EXT_meshopt_compression"], "save it again without mesh compression"),
    ("buffers", [{"byteLength": 4, "uri": "gone.bin"}], r"gone\.bin.*not there"),
)


test_wrong_numbers = refusing(
    lambda folder, changes, options: loaded(folder, strip(**changes), limits=FileLimits(**options))
)(
    ({"points": POINTS * np.float32("nan")}, {}, ModelError, "POSITION of primitive 0 of mesh 'body' holds non-fin"),
    ({"WEIGHTS_0": np.zeros((4, 4), "f4")}, {}, ModelError, "none of 4 vertices has a skin weight"),
    ({"tip": TIP - 2}, {}, ModelError, "negative skin weights"),
    ({"inverse": INVERSE * np.float32([1, 0])[:, None, None]}, {}, ModelError, "joint 'tip' is singular"),
    ({"inverse": INVERSE[:1]}, {}, FormatError, "2 joints but 1 inverse bind"),
    ({"faces": np.array([0, 1, 4])}, {}, FormatError, "integers from 0 to 3, got 3 from 0 to 4"),
    ({"faces": np.array([0, 1, 2, 3])}, {}, FormatError, "4 triangle corners, not a multiple of three"),
    ({"NORMAL": POINTS[:2]}, {}, FormatError, "4 positions but 2 normals"),
    ({}, {"max_points": 3}, FormatError, "4 vertices with 2 joints; at most 3 vertices"),
    ({}, {"max_bytes": 64}, FormatError, "the limit is 64"),
)


def test_budgets_and_overflow_along_the_hierarchy(tmp_path, scene, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr("torchreg.io.gltf_file.document.FILE_BUDGET", replace(FILE_BUDGET, nodes=2))
        refused((lambda: loaded(tmp_path, scene), "3 nodes, at most 2"))
    large = scene.node(scale=[1e200] * 3, children=[1])
    scene.json["scenes"][0]["nodes"] = [scene.node(scale=[1e200] * 3, children=[large]), 2]
    refused((lambda: loaded(tmp_path, scene), "rest transform of joint 'root' is not finite"), error=ModelError)


def leaves(value, path=()):
    """Return every place in a JSON document, containers included."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path for path in [path] if path] + [leaf for key, inner in items for leaf in leaves(inner, (*path, key))]


@settings(max_examples=150, deadline=None)
@given(
    st.integers(0, 10**6),
    st.sampled_from([None, True, -1, 0, 1, 7, 2**31, 10**30, 0.5, 1e308, float("nan"), "", "x", [], [0], [None], {}]),
)
def test_any_damaged_entry_gives_an_error_or_a_rig(tmp_path_factory, seed, value):
    scene = strip()
    scene.json["buffers"] = [{"byteLength": len(scene.blob)}]
    places = leaves(scene.json)
    scene.change(".".join(map(str, places[seed % len(places)])), value)
    try:
        rig = loaded(tmp_path_factory.mktemp("fuzz"), scene)
    except (FormatError, ModelError):
        return
    assert bool(torch.isfinite(rig.vertices).all())
    assert bool(torch.isfinite(rig.joint_transforms).all())


def test_vertices_without_weight_follow_their_neighbors(tmp_path):
    scene, weights = Scene(), np.stack([1 - UPPER, UPPER, 0 * UPPER, 0 * UPPER], 1).astype("f4")
    weights[[5, 33]], weights[6] = 0, np.nan
    scene.rig([scene.primitive(WEIGHTS_0=weights)])
    with pytest.warns(FileWarning, match=r"rig\.glb: 3 of 36 vertices have no skin weight and follow the nearest"):
        rig = loaded(tmp_path, scene)
    np.testing.assert_allclose(rig.weights[:, 1], UPPER)
    points = tr.load_points(tmp_path / "rig.glb").points  # as viewers do, after the first joint
    np.testing.assert_allclose([points.amin(0).numpy(), points.amax(0).numpy()], [[-0.15, 0, -0.15], [0.15, 2, 0.15]])


def test_primitives_without_positions_or_skin_are_left_out(tmp_path):
    scene, empty = Scene(), Scene()
    whole = scene.primitive()
    nothing = {"attributes": {}, "indices": whole["indices"]}
    scene.rig([whole, nothing, scene.plain()])
    with pytest.warns(FileWarning, match="2 primitives are left out: primitive 1 of mesh 0 has no positions; prim"):
        rig = loaded(tmp_path, scene)
    assert (len(rig.vertices), len(rig.faces)) == (36, len(FACES))
    empty.rig([nothing])
    words = r"rig\.glb: the skinned mesh has no triangles that a skin moves: primitive 0"
    refused((lambda: loaded(tmp_path, empty), words), error=ModelError)


@pytest.mark.parametrize("matrix", [np.eye(4), np.zeros((4, 4))])
def test_joints_that_move_nothing_stand_where_their_nodes_do(tmp_path, matrix):
    scene = Scene()
    tip = scene.rig()
    end = scene.node(name="end", translation=[0, 1, 0])
    scene.json["nodes"][tip]["children"] = [end]
    scene.skin([1, 0, end], [shift(0, 0, 0), shift(0, -1, 0), matrix])
    scene.json["skins"].pop(0)
    with pytest.warns(FileWarning, match="1 joints that move nothing have no bind pose .*: end"):
        rig = loaded(tmp_path, scene)
    assert rig.joint_transforms[:, :3, 3].tolist() == [[0, 0, 0], [0, 1, 0], [0, 2, 0]]


def test_several_trees_of_joints_hang_on_the_largest(tmp_path):
    scene = Scene()
    tip = scene.node(name="tip", translation=[0, 1, 0])
    lower = scene.node(root=True, name="lower", children=[tip])
    upper = scene.node(root=True, name="upper", translation=[0, 1, 0])
    skin = scene.skin([upper, lower, tip], [shift(0, -1, 0), np.eye(4), shift(0, -1, 0)])
    joints = np.tile(np.array([1, 0, 2, 0], "u1"), (36, 1))
    scene.node(root=True, mesh=scene.mesh(scene.primitive(JOINTS_0=joints)), skin=skin)
    with pytest.warns(FileWarning, match=r"a\.glb: the skeleton has 2 roots: 'upper' hang on 'lower'"):
        shape = tr.ArticulatedShape.from_gltf(scene.save(tmp_path / "a.glb"))
    assert set(shape.part_names) == {"lower", "upper"}
    assert [name for name in shape.dof_names if name.startswith("upper")] == ["upper_x", "upper_y", "upper_z"]
    flat = Scene()
    skin = flat.skin([flat.node(root=True, name=f"j{k}", translation=[0, 0.5 * k, 0]) for k in range(4)],
                     [shift(0, -0.5 * k, 0) for k in range(4)])  # fmt: skip
    flat.node(root=True, mesh=flat.mesh(flat.primitive()), skin=skin)
    words = r"a\.glb: the skeleton has 4 roots .* name each joint's parent with parents="
    refused((lambda: tr.ArticulatedShape.from_gltf(flat.save(tmp_path / "a.glb")), words), error=ModelError)


def test_one_skin_of_several_is_chosen(tmp_path):
    scene = Scene()
    for place in (0, 2):
        scene.rig(translation=[place, 0, 0], inverse=[shift(-place, 0, 0), shift(-place, -1, 0)])
    scene.json["skins"][1]["name"] = "right"
    path = scene.save(tmp_path / "a.glb")
    with (
        pytest.warns(FileWarning, match="2 joints have the name of another and are told apart: 'root'"),
        pytest.warns(FileWarning, match="skins 0 and 1 have skeletons of their own.*skin= reads one of them"),
    ):
        assert load_rig(path).parents == (-1, 0, -1, 2)
    for skin, place in (("right", 2.0), (0, 0.0)):
        assert tr.ArticulatedShape.from_gltf(path, skin=skin).keypoints(torch.zeros(9))[0, 0] == place
