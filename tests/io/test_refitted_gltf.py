"""Rigs with other bones: bind pose, skin and clips as an evaluation of the files by hand has them, and bad input."""

import json
import struct

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import torchreg as tr
from tests.gltf_player import Player
from tests.io.helpers import Scene, put, shift
from tests.tables import refused
from torchreg.geometry.mesh import unit_sphere
from torchreg.io.gltf import load_rig
from torchreg.io.gltf_file.refit import save_refitted_rig
from torchreg.io.gltf_write import save_animated_skin

NAMES, PARENTS, TIMES = ["hips", "thigh", "shin"], [-1, 0, 1], torch.tensor([0.0, 0.5, 2.0])


def leg(path):
    """Write a leg that hangs down from hips at a height, and a clip in which it walks, bends and its shin slides."""
    ball = unit_sphere(3, dtype=torch.float64)
    vertices = ball.vertices * torch.tensor([0.08, 0.5, 0.06]) + torch.tensor([0.0, 0.5, 0.0])
    shares = torch.sigmoid(40 * (torch.tensor([0.9, 0.45]) - vertices[:, 1:2]))
    weights = torch.stack([1 - shares[:, 0], shares[:, 0] - shares[:, 1], shares[:, 1]], dim=-1).clamp_min(0)
    rest = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    rest[:, 1, 3] = torch.tensor([0.95, 0.9, 0.45])
    rest[:, :3, :3] = torch.from_numpy(Rotation.from_euler("z", [[0.0], [180.0], [170.0]], degrees=True).as_matrix())
    moving = rest.repeat(len(TIMES), 1, 1, 1)
    for frame in range(1, len(TIMES)):
        for joint, parent in enumerate(PARENTS):
            local = rest[joint] if parent < 0 else torch.linalg.solve(rest[parent], rest[joint])
            turn = torch.eye(4, dtype=torch.float64)
            turn[:3, :3] = torch.from_numpy(Rotation.from_euler("xz", [0.4 * frame, 0.2 * joint]).as_matrix())
            turn[:3, 3] = torch.tensor([0.1 * frame, 0.0, 0.0]) * (joint != 1)
            moving[frame, joint] = (local if parent < 0 else moving[frame, parent] @ local) @ turn
    normals = tr.TriangleMesh(vertices, ball.faces).vertex_normals()
    return save_animated_skin(path, vertices, ball.faces, weights, NAMES, PARENTS, rest, moving, TIMES, normals)


@pytest.fixture
def grown(tmp_path):
    """Return the file of a leg, its rig with bones as coefficients, some of these, and the file of the grown leg."""
    source = leg(tmp_path / "leg.glb")
    rig = tr.ArticulatedShape.from_gltf(source, dtype=torch.float64).with_bone_coefficients()
    change = {"size": 0.1, "girth": -0.1, "length of thigh": 0.3, "radius of shin": 0.2}
    coefficients = torch.tensor([change.get(name, 0.0) for name in rig.coefficient_names], dtype=torch.float64)
    path = rig.with_coefficients(coefficients).to_gltf(tmp_path / "grown.glb", source)
    return source, rig, coefficients, path


def test_read_back_it_is_the_same_rig_in_any_pose(grown):
    _, rig, coefficients, path = grown
    back = tr.ArticulatedShape.from_gltf(path, dtype=torch.float64)
    poses = 0.5 * torch.randn(3, rig.num_dofs, generator=torch.Generator().manual_seed(0)).double()
    torch.testing.assert_close(back.vertices(poses), rig.vertices(poses, coefficients), atol=1e-6, rtol=0)
    torch.testing.assert_close(back.surface.weights, rig.surface.weights, atol=1e-7, rtol=0)


def test_clips_turn_as_before_and_slide_as_the_bones_are_long(grown):
    before, after = Player(grown[0]), Player(grown[3])
    # Hips to thigh grow by the size; from thigh to knee, too, by the thigh's own length. What carries the root grows as
    # the distances of the joints from it: 0.05 and 0.5 to 0.055 and 0.685.
    factors = {1: 1.1, 2: 1.1 + 0.3}
    bones = [factor * length for factor, length in zip(factors.values(), (0.05, 0.45), strict=True)]
    size = (bones[0] + sum(bones)) / (0.05 + 0.5)
    for key in (None, *TIMES.tolist()):
        old, new = before.joints(key), after.joints(key)
        np.testing.assert_allclose(new[:, :3, :3], old[:, :3, :3], atol=1e-6)
        np.testing.assert_allclose(new[0, :3, 3], size * old[0, :3, 3], atol=1e-6)
        for joint, factor in factors.items():
            bone = [joints[joint, :3, 3] - joints[joint - 1, :3, 3] for joints in (old, new)]
            np.testing.assert_allclose(bone[1], factor * bone[0], atol=1e-6)
    moved = after.joints(2.0) - after.joints()
    assert np.abs(moved[:, :3, 3]).max() > 0.1


def test_normals_are_those_of_the_new_surface(grown):
    rig = load_rig(grown[3])
    wanted = tr.TriangleMesh(rig.vertices, rig.faces).vertex_normals()
    assert float((rig.normals * wanted).sum(-1).min()) > 0.9999
    stale = load_rig(grown[0]).normals
    assert float((stale * wanted).sum(-1).min()) < 0.996


def hand_made(folder):
    """Write a .gltf with its buffer and a picture beside it: interleaved vertices, clips that share their numbers."""
    scene = Scene()
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [3, 0, 0], [3, 1, 0]], "f4")
    joints = np.array([[0, 0, 0, 0], [0, 0, 0, 0], [1, 0, 0, 0], [2, 0, 0, 0], [2, 0, 0, 0]], "u2")
    shares = np.tile(np.array([1, 0, 0, 0], "f4"), (5, 1))
    faces, changes = np.array([[0, 1, 2], [1, 3, 4]]), {"JOINTS_0": joints, "WEIGHTS_0": shares}
    rows = np.concatenate([vertices, np.tile(np.array([0, 0, 1], "f4"), (5, 1))], axis=1)
    view = scene.append("bufferViews", {"buffer": 0, "byteLength": rows.nbytes, "byteStride": 24})
    scene.blob = rows.tobytes()
    primitive = scene.primitive(vertices, faces, weights=vertices[:, 0], POSITION=None, **changes)
    for name, offset in (("POSITION", 0), ("NORMAL", 12)):
        entries = {"bufferView": view, "byteOffset": offset, "componentType": 5126, "count": 5, "type": "VEC3"}
        primitive["attributes"][name] = scene.append("accessors", entries)
    scene.add(np.zeros(40, "u1"))
    # Between the first and second joint is a node, the third has a matrix, and a prop moves like the second.
    scene.node(root=True, name="mesh", mesh=scene.mesh(primitive), skin=0)
    scene.node(root=True, name="root", children=[2, 5], translation=[0, 0, 0])
    scene.node(name="between", children=[3], translation=[0.25, 0, 0])
    scene.node(name="middle", children=[4], translation=[0.75, 0, 0])
    scene.node(name="end", matrix=shift(2, 0, 0).T.reshape(-1).tolist())
    scene.node(name="prop", translation=[5, 0, 0])
    scene.skin([1, 3, 4], [shift(0, 0, 0), shift(-1, 0, 0), shift(-3, 0, 0)])
    spline = [[9, 0, 0], [2, 0, 0], [8, 0, 0], [7, 0, 0], [2, 1, 0], [6, 0, 0]]
    scene.clip([0, 1], {(3, "translation"): [[1, 0, 0], [1, 0, 2]], (4, "translation"): spline})
    clip = scene.json["animations"][0]
    clip["samplers"][1]["interpolation"] = "CUBICSPLINE"
    clip["samplers"].append(dict(clip["samplers"][0]))
    clip["channels"] += [{"sampler": s, "target": {"node": n, "path": "translation"}} for s, n in ((0, 5), (2, 1))]
    scene.json["images"] = [{"uri": "skin.png"}, {"uri": "lost.png"}]
    put(folder, "skin.png", b"\x89PNG picture")
    put(folder, "leg.bin", scene.blob)
    return put(folder, "leg.gltf", scene.json | {"buffers": [{"byteLength": len(scene.blob), "uri": "leg.bin"}]})


def opened(path):
    content = path.read_bytes()
    length = struct.unpack_from("<I", content, 12)[0]
    assert struct.unpack_from("<I", content, 8)[0] == len(content)
    return json.loads(content[20 : 20 + length]), content[28 + length :]


def test_what_files_may_share_and_keep_elsewhere(tmp_path):
    source = hand_made(tmp_path)
    vertices = load_rig(source).vertices * 2.0
    positions = {"root": (0, 0, 0), "middle": (3.0, 0, 0), "end": (7.0, 0, 0)}
    positions = {name: torch.tensor(value, dtype=torch.float64) for name, value in positions.items()}
    path = save_refitted_rig(tmp_path / "new.glb", source, vertices, positions)
    tree, blob = opened(path)
    tracks = {node: values for (node, _), (_, values) in Player(path).tracks().items()}
    nodes = tree["nodes"]
    assert [nodes[n]["translation"][0] for n in (2, 3, 5)] == [0.75, 2.25, 5]
    assert nodes[4]["matrix"][12:15] == [4.0, 0.0, 0.0]
    keys = np.array([[1, 0, 0], [1, 0, 2.0]])
    size = (3 + 7) / (1 + 3)
    np.testing.assert_allclose(tracks[3], 3 * keys)
    np.testing.assert_allclose(tracks[5], keys)  # the prop is no bone
    np.testing.assert_allclose(tracks[1], size * keys)
    np.testing.assert_allclose(tracks[4][:, 0], 2 * np.array([9, 2, 8, 7, 2, 6.0]))
    back = load_rig(path)
    torch.testing.assert_close(back.vertices, vertices)
    torch.testing.assert_close(back.joint_transforms[:, 0, 3], torch.tensor([0.0, 3, 7], dtype=torch.float64))
    torch.testing.assert_close(back.rest_transforms, back.joint_transforms)
    assert tree["images"][1] == {"uri": "lost.png"}
    view = tree["bufferViews"][tree["images"][0]["bufferView"]]
    assert blob[view["byteOffset"] :][: view["byteLength"]] == b"\x89PNG picture"
    # The interleaved vertices and the idle view are gone.
    assert sum(view["byteLength"] for view in tree["bufferViews"]) < len((tmp_path / "leg.bin").read_bytes()) + 100
    assert len(tree["buffers"]) == 1


def test_joints_side_by_side_go_where_the_bind_pose_has_them(tmp_path):
    ball = unit_sphere(2, dtype=torch.float64)
    places = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    places[:, 0, 3] = torch.tensor([0.5, 1.5])
    weights = torch.sigmoid(10 * ball.vertices[:, :1]) * torch.tensor([1.0, -1.0]) + torch.tensor([0.0, 1.0])
    source = save_animated_skin(
        tmp_path / "flat.glb", ball.vertices, ball.faces, weights, ["a", "b"], [-1, -1], places, places[None],
        torch.zeros(1),
    )  # fmt: skip
    rig = tr.ArticulatedShape.from_gltf(source, parents={"b": "a"}, dtype=torch.float64).with_bone_coefficients()
    coefficients = torch.tensor([0.0, 0.0, 0.5, 0.0, 0.0, 0.0], dtype=torch.float64)
    assert rig.coefficient_names[2] == "length of a"
    path = rig.with_coefficients(coefficients).to_gltf(tmp_path / "grown.glb", source)
    back, joints = load_rig(path), Player(path).joints()
    assert float(back.joint_transforms[1, 0, 3] - back.joint_transforms[0, 0, 3]) == pytest.approx(1.5)
    assert joints[1, 0, 3] - joints[0, 0, 3] == pytest.approx(1.5)


def test_what_is_not_the_rig_of_a_file(grown, tmp_path):
    source, rig, coefficients, _ = grown
    person = rig.with_coefficients(coefficients)
    frames = person.frame_transforms(torch.zeros_like(person.rest))[:, :3, 3]
    tree = person.kinematics.tree
    positions = {name: frames[tree.index(name)] + 0.0 for name in NAMES}
    positions["shin"] += torch.tensor([0.1, 0.0, 0.0])
    other, target, gone = hand_made(tmp_path), tmp_path / "a.glb", tmp_path / "absent.glb"
    words = "the bone to joint 'shin' has another direction"
    refused(
        (lambda: person.to_gltf(tmp_path / "leg.gltf", source), r"path must end in .glb"),
        (lambda: person.to_gltf(target, other), "has 5 vertices and 3 joints"),
        (lambda: save_refitted_rig(target, source, person.surface.vertices, positions), words),
        error=tr.errors.InputError,
    )
    refused((lambda: person.to_gltf(target, gone), "absent"), error=FileNotFoundError)
    assert not (tmp_path / "a.glb").exists()
