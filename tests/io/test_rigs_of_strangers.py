"""Rigs as strangers make them, against the surface that a viewer shows: skins, scales, armatures, rigid parts."""

import sys

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import torchreg as tr
from tests.io.helpers import FACES, TURN, UPPER, VERTICES, Scene, shift
from tests.tables import each_row, refused
from torchreg.io.gltf import load_rig

FileWarning = tr.errors.FileWarning
LYING = list(Rotation.from_euler("x", -90, degrees=True).as_quat())  # what makes z up stand along y
SMALL = np.diag([0.01, 0.01, 0.01, 1]) @ shift(-500, 0, 0)


@pytest.fixture
def scene():
    return Scene()


def shown(path):
    return tr.load_mesh(path, dtype=torch.float64).vertices.numpy()


def at_zero(path, **options):
    shape = tr.ArticulatedShape.from_gltf(path, dtype=torch.float64, **options)
    return shape, shape.file_skin()(torch.zeros(shape.num_dofs, dtype=torch.float64)).numpy()


def second_skin(scene, joints, inverse, vertices=VERTICES, **changes):
    mesh = scene.mesh(scene.primitive(vertices=vertices, **changes))
    scene.node(root=True, name="clothes", mesh=mesh, skin=scene.skin(joints, inverse, name="clothes"))


@each_row(
    ([1, 0], [shift(0, 0, 0), shift(0, -1, 0)], VERTICES),  # in the order root, tip, as is the body
    ([0, 1], [shift(0, -1, 0), shift(0, 0, 0)], VERTICES),
    # Stored in centimetres, and elsewhere.
    ([1, 0], [SMALL, shift(0, -1, 0) @ SMALL], 100 * VERTICES + np.array([500, 0, 0])),
)
def test_skins_on_one_skeleton_are_one_shape(tmp_path, scene, joints, inverse, place):
    scene.rig()
    second_skin(scene, joints, inverse, vertices=place)
    path = scene.save(tmp_path / "a.glb")
    shape, vertices = at_zero(path)
    assert (shape.part_names, shape.num_dofs, len(vertices)) == (("root", "tip"), 9, 72)
    np.testing.assert_allclose(vertices, shown(path), atol=1e-5)
    assert len(at_zero(path, skin="clothes")[1]) == 36
    owners = [0, 1] if joints[0] == 1 else [1, 0]
    np.testing.assert_allclose(load_rig(path).weights[36:, owners[1]], UPPER)


def test_a_skin_on_joints_below_those_of_another_stands_beside_it_in_any_pose(tmp_path, scene):
    tip = scene.rig(tip={"rotation": TURN})
    hair = scene.node(name="hair", translation=[0, 1, 0])
    scene.json["nodes"][tip]["children"] = [hair]
    # Bound on its own, at the origin.
    second_skin(scene, [hair], [np.eye(4)], vertices=VERTICES, weights=0 * UPPER)
    rig = load_rig(scene.save(tmp_path / "a.glb"))
    assert (rig.joint_names, rig.parents) == (("root", "tip", "hair"), (-1, 0, 1))
    np.testing.assert_allclose(rig.vertices[36:], VERTICES + np.array([0, 2, 0]), atol=1e-6)
    np.testing.assert_allclose(rig.joint_transforms[2, :3, 3], [0, 2, 0], atol=1e-6)


def test_a_skeleton_that_is_written_once_per_skin_is_one(tmp_path, scene):
    for _ in range(2):
        scene.rig()
    path = scene.save(tmp_path / "a.glb")
    with pytest.warns(FileWarning, match=r"a\.glb: 2 joints of several skins have one name and one place"):
        shape, vertices = at_zero(path)
    assert (shape.num_parts, len(vertices)) == (2, 72)


@pytest.mark.parametrize("tip", [{}, {"rotation": TURN}, {"rotation": list(Rotation.from_euler("x", 0.4).as_quat())}])
@pytest.mark.parametrize("joint", [False, True])
def test_an_armature_that_turns_its_rig_stands_it_up(tmp_path, tip, joint):
    """A bar along z, in centimetres, stood up along y by the node above the skeleton, or by its root."""
    scene, unit = Scene(), 100.0
    lying = VERTICES @ Rotation.from_quat(LYING).as_matrix() * unit
    number = scene.node(name="tip", translation=[0, 0, unit], **tip)
    placed = {"rotation": LYING, "scale": [1 / unit] * 3, "translation": [3, 0, 2]}
    base = scene.node(name="root", children=[number], root=joint, **(placed if joint else {}))
    skin = scene.skin([base, number], [shift(0, 0, 0), shift(0, 0, -unit)])
    body = scene.node(mesh=scene.mesh(scene.primitive(vertices=lying)), skin=skin)
    if joint:
        scene.json["scenes"][0]["nodes"].append(body)
    else:
        scene.node(root=True, name="Armature", children=[base, body], **placed)
    path = scene.save(tmp_path / "a.glb")
    shape, vertices = at_zero(path)
    assert shape.up == (0, 1, 0)
    np.testing.assert_allclose(np.ptp(vertices, axis=0), [0.3, 2, 0.3], atol=1e-5)
    assert vertices[UPPER > 0, 1].min() > vertices[UPPER == 0, 1].max()
    if not tip:
        np.testing.assert_allclose(vertices, shown(path), atol=1e-5)
    if not joint:
        np.testing.assert_allclose(vertices, VERTICES + np.array([3, 0, 2]), atol=1e-5)
    # In the pose of the nodes, it is what a viewer shows.
    turn = Rotation.from_quat(tip.get("rotation", [0, 0, 0, 1])).as_euler("XYZ")
    pose = torch.tensor([0.0] * 6 + list(turn), dtype=torch.float64)
    moved = shape.file_skin()(pose).numpy()
    off = moved - shown(path)
    np.testing.assert_allclose(off - off.mean(0), 0, atol=1e-5)


@each_row(
    ([1, 1, 1.3], "0.3 of it unlike others: 'tip'; this is baked"),
    ([2, 2, 2], "1 of it unlike others: 'tip'; this is baked"),
    ([1, 1, -1], "2 of it unlike others: 'tip'; this is baked"),
    ([1.5, 0.8, 1], "0.5 of it unlike others: 'tip'; this is baked"),
    ([1.02, 1.02, 1.02], "0.02 of it unlike others: 'tip'; this is left out"),
    ([1, 0.99, 1], "0.01 of it unlike others: 'tip'; this is left out"),
)
def test_scales_of_bones_are_baked_unless_they_are_small(tmp_path, scene, scale, told):
    scene.rig(tip={"scale": scale, "rotation": TURN} if max(scale) > 1.1 else {"scale": scale})
    path = scene.save(tmp_path / "a.glb")
    with pytest.warns(FileWarning, match=told):
        shape, vertices = at_zero(path)
    np.testing.assert_allclose(vertices, shown(path) if "baked" in told else VERTICES, atol=1e-5)
    frames = shape.part_transforms(shape.rest_pose())
    np.testing.assert_allclose(frames[1, :3, 3], [0, 1, 0], atol=1e-5)
    np.testing.assert_allclose(frames[:, :3, :3] @ frames[:, :3, :3].mT, np.eye(3)[None].repeat(2, 0), atol=1e-6)
    if "baked" in told:
        refused((lambda: shape.to_gltf(tmp_path / "b.glb", path), r"a\.glb|unlike"), error=tr.errors.InputError)


@pytest.mark.parametrize("scale", [[1, 1, 5], [0, 0, 0], [3, 3, 3]])
def test_bones_that_move_no_vertex_may_scale_as_they_like(tmp_path, scene, scale):
    tip = scene.rig()
    end = scene.node(name="end", translation=[0, 1, 0], scale=scale)
    scene.json["nodes"][tip]["children"] = [end]
    scene.skin([1, 0, end], [shift(0, 0, 0), shift(0, -1, 0), shift(0, -2, 0) @ np.diag([1, 2, 3, 1.0])])
    scene.json["skins"].pop(0)
    _, vertices = at_zero(scene.save(tmp_path / "a.glb"))
    np.testing.assert_allclose(vertices, VERTICES, atol=1e-6)


def test_rigid_meshes_follow_their_joints_and_others_are_named(tmp_path, scene):
    tip = scene.rig(tip={"rotation": TURN})
    mesh = scene.mesh(scene.plain())
    grip = scene.node(name="grip", translation=[0.5, 0, 0], children=[len(scene.json["nodes"]) + 1])
    scene.node(name="sword", scale=[0.1, 0.5, 0.1], mesh=mesh)
    scene.node(root=True, name="ground", mesh=mesh)
    scene.json["nodes"][tip]["children"] = [grip]
    path = scene.save(tmp_path / "a.glb")
    with pytest.warns(FileWarning) as caught:
        shape, vertices = at_zero(path)
    told = " ".join(str(row.message) for row in caught)
    assert "1 meshes without a skin are rigid parts of the joints they hang on: 'sword' on 'tip'" in told
    assert "1 meshes without a skin hang on no joint and are left out: 'ground'" in told
    np.testing.assert_allclose(vertices[36:], VERTICES * [0.1, 0.5, 0.1] + np.array([0.5, 1, 0]), atol=1e-6)
    assert bool((shape.surface.weights[36:, 1] == 1).all())
    pose = torch.tensor([0.0] * 6 + list(Rotation.from_quat(TURN).as_euler("XYZ")), dtype=torch.float64)
    moved = shape.file_skin()(pose).numpy()
    np.testing.assert_allclose(np.sort(moved, axis=0), np.sort(shown(path)[: len(moved)], axis=0), atol=1e-5)


def machine(scene):
    """Add a post, an arm that hangs on it by a node without a mesh, a piston on the arm, and a floor."""
    meshes = [scene.mesh(scene.plain()) for _ in range(3)]
    piston = scene.node(name="part", mesh=meshes[2], translation=[0, 2, 0], scale=[0.5, 0.5, 0.5])
    arm = scene.node(name="part", mesh=meshes[1], rotation=TURN, children=[piston])
    pivot = scene.node(name="pivot", translation=[0, 2, 0], children=[arm])
    scene.node(root=True, name="post", mesh=meshes[0], children=[pivot])
    return piston, arm, pivot


def test_a_file_without_skins_is_a_shape_of_the_parts_that_its_clip_moves(tmp_path, scene):
    piston, arm, pivot = machine(scene)
    still = [[0, 2, 0]] * 2
    tracks = {(arm, "rotation"): [TURN, [0, 0, 0, 1]], (piston, "translation"): [[0, 2, 0], [0, 2.5, 0]]}
    scene.clip([0, 1], tracks | {(pivot, "translation"): still})
    path = scene.save(tmp_path / "machine.glb")
    with pytest.warns(FileWarning, match="1 joints have the name of another and are told apart: 'part'"):
        shape, vertices = at_zero(path)
    names = ("machine", "part#2", "part") if shape.part_names[1] != "part" else ("machine", "part", "part#2")
    assert shape.part_names == names
    assert shape.part_parents == (-1, 0, 1)
    assert shape.surface.is_rigid
    np.testing.assert_allclose(np.sort(vertices, axis=0), np.sort(shown(path), axis=0), atol=1e-5)
    arm_name, piston_name = names[1:]
    assert shape.dof_names[6:] == tuple(
        [f"{arm_name}_{axis}" for axis in "xyz"] + [f"{piston_name}_slide_{axis}" for axis in "xyz"]
    )
    pose = torch.zeros(12, dtype=torch.float64)
    pose[8], pose[10] = np.pi / 2, 0.5
    moved = shape.file_skin()(pose).numpy()
    late = tr.load_mesh(path, dtype=torch.float64, time=1.0).vertices.numpy()
    np.testing.assert_allclose(np.sort(moved, axis=0), np.sort(late, axis=0), atol=1e-5)


def test_without_a_clip_meshes_that_hang_on_meshes_are_the_parts(tmp_path, scene):
    machine(scene)
    with pytest.warns(FileWarning) as caught:
        shape, _ = at_zero(scene.save(tmp_path / "a.glb"))
    assert any("each of 3 nodes with a mesh is a rigid part" in str(row.message) for row in caught)
    assert (shape.num_parts, shape.num_dofs) == (3, 12)
    flat = Scene()
    flat.node(root=True, mesh=flat.mesh(flat.plain()))
    words = "no node carries both a mesh and a skin, no clip moves a mesh"
    refused((lambda: load_rig(flat.save(tmp_path / "flat.glb")), words), error=tr.errors.ModelError)


def test_degrees_of_freedom_that_have_the_name_of_a_joint_are_told_apart(tmp_path, scene):
    tip = scene.rig()
    scene.json["nodes"][tip]["name"] = "root_x"
    scene.json["nodes"][tip]["children"] = [scene.node(name="root_x_y", translation=[0, 0.5, 0])]
    scene.skin([1, 0, tip + 3], [shift(0, 0, 0), shift(0, -1, 0), shift(0, -1.5, 0)])
    scene.json["skins"].pop(0)
    with pytest.warns(FileWarning, match="a degree of freedom is called 'root_x_y#', as a joint is called 'root_x_y'"):
        shape = tr.ArticulatedShape.from_gltf(scene.save(tmp_path / "a.glb"))
    assert shape.dof_names[6:9] == ("root_x_x", "root_x_y#", "root_x_z")


def compressed(scene, encode):
    """Put the bar into one block of bytes, its accessors without data of their own."""
    primitive = scene.primitive()
    names = {"POSITION": 8, "JOINTS_0": 5, "WEIGHTS_0": 7}
    shares = np.stack([1 - UPPER, UPPER, 0 * UPPER, 0 * UPPER], 1).astype("f4")
    joints = np.tile(np.array([0, 1, 0, 0], "u1"), (36, 1))
    content = encode(joints, shares)
    view = scene.json["accessors"][scene.add(np.frombuffer(content, "u1"))]["bufferView"]
    for accessor in (*primitive["attributes"].values(), primitive["indices"]):
        del scene.json["accessors"][accessor]["bufferView"]
    packed = {"bufferView": view, "attributes": names}
    primitive["extensions"] = {"KHR_draco_mesh_compression": packed}
    scene.json["extensionsRequired"] = ["KHR_draco_mesh_compression"]
    scene.rig([primitive])
    return packed


def test_draco_is_read_by_its_library(tmp_path, scene):
    draco = pytest.importorskip("DracoPy")
    packed = compressed(scene, lambda joints, shares: draco.encode(
        VERTICES.astype("f4"), FACES.astype("u4"), quantization_bits=16, preserve_order=True,
        generic_attributes={5: joints, 7: shares},
    ))  # fmt: skip
    path = scene.save(tmp_path / "a.glb")
    rig = load_rig(path)
    np.testing.assert_allclose(rig.vertices, VERTICES, atol=1e-4)
    np.testing.assert_allclose(rig.weights[:, 1], UPPER, atol=1e-3)
    assert rig.faces.tolist() == FACES.tolist()
    np.testing.assert_allclose(shown(path), VERTICES, atol=1e-4)
    packed["attributes"]["JOINTS_0"] = 77
    words = r"a\.glb: JOINTS_0 .* must be 36 x 4 numbers, which its Draco data are not"
    refused((lambda: load_rig(scene.save(path)), words))
    packed["bufferView"] = 0
    refused((lambda: load_rig(scene.save(path)), r"a\.glb: the Draco data of .* are damaged"))


def test_draco_without_its_library_names_the_extra(tmp_path, scene, monkeypatch):
    monkeypatch.setitem(sys.modules, "DracoPy", None)
    compressed(scene, lambda *_: b"DRACO")
    path = scene.save(tmp_path / "a.glb")
    words = r"compressed by KHR_draco.*pip install 'torchreg-articulated\[draco\]'"
    refused((lambda: load_rig(path), words), (lambda: tr.load_mesh(path), words))
