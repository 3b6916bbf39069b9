"""Rigs with other bones: bind pose, skin and clips as an evaluation of the files by hand has them, and bad input."""

import json
import struct

import numpy as np
import pygltflib
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchreg.errors import InputError
from torchreg.geometry.mesh import TriangleMesh, unit_sphere
from torchreg.io.gltf import load_rig
from torchreg.io.gltf_refit import save_refitted_rig
from torchreg.io.gltf_write import save_animated_skin
from torchreg.shapes.articulated import ArticulatedShape

NAMES, PARENTS, TIMES = ["hips", "thigh", "shin"], [-1, 0, 1], torch.tensor([0.0, 0.5, 2.0])
KINDS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}


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
    normals = TriangleMesh(vertices, ball.faces).vertex_normals()
    return save_animated_skin(path, vertices, ball.faces, weights, NAMES, PARENTS, rest, moving, TIMES, normals)


class File:
    """A file as the specification says, by numpy and scipy."""

    def __init__(self, path):
        self.gltf = pygltflib.GLTF2().load(str(path))
        self.blob = self.gltf.binary_blob()

    def read(self, index):
        accessor = self.gltf.accessors[index]
        view, width = self.gltf.bufferViews[accessor.bufferView], KINDS[accessor.type]
        assert accessor.componentType == 5126
        assert not view.byteStride
        start = view.byteOffset + (accessor.byteOffset or 0)
        return np.frombuffer(self.blob, "<f4", accessor.count * width, start).reshape(-1, width).astype(float)

    def joints(self, key=None):
        """Return the joints (J, 4, 4) at rest, or at a key of the clip."""
        translation = {n: np.array(node.translation or [0, 0, 0.0]) for n, node in enumerate(self.gltf.nodes)}
        rotation = {n: np.array(node.rotation or [0, 0, 0, 1.0]) for n, node in enumerate(self.gltf.nodes)}
        for channel in self.gltf.animations[0].channels if key is not None else ():
            tracks = {"translation": translation, "rotation": rotation}[channel.target.path]
            tracks[channel.target.node] = self.read(self.gltf.animations[0].samplers[channel.sampler].output)[key]
        found = {}

        def place(number, above):
            local = np.eye(4)
            local[:3, :3], local[:3, 3] = Rotation.from_quat(rotation[number]).as_matrix(), translation[number]
            found[number] = above @ local
            for child in self.gltf.nodes[number].children or []:
                place(child, found[number])

        for root in self.gltf.scenes[0].nodes:
            place(root, np.eye(4))
        return np.stack([found[number] for number in self.gltf.skins[0].joints])


@pytest.fixture
def grown(tmp_path):
    """Return the file of a leg, its rig with bones as coefficients, some of these, and the file of the grown leg."""
    source = leg(tmp_path / "leg.glb")
    rig = ArticulatedShape.from_gltf(source, dtype=torch.float64).with_bone_coefficients()
    change = {"size": 0.1, "girth": -0.1, "length of thigh": 0.3, "radius of shin": 0.2}
    coefficients = torch.tensor([change.get(name, 0.0) for name in rig.coefficient_names], dtype=torch.float64)
    path = rig.with_coefficients(coefficients).to_gltf(tmp_path / "grown.glb", source)
    return source, rig, coefficients, path


def test_read_back_it_is_the_same_rig_in_any_pose(grown):
    _, rig, coefficients, path = grown
    back = ArticulatedShape.from_gltf(path, dtype=torch.float64)
    poses = 0.5 * torch.randn(3, rig.num_dofs, generator=torch.Generator().manual_seed(0)).double()
    torch.testing.assert_close(back.vertices(poses), rig.vertices(poses, coefficients), atol=1e-6, rtol=0)
    torch.testing.assert_close(back.surface.weights, rig.surface.weights, atol=1e-7, rtol=0)


def test_clips_turn_as_before_and_slide_as_the_bones_are_long(grown):
    before, after = File(grown[0]), File(grown[3])
    # Hips to thigh grow by the size; from thigh to knee, too, by the thigh's own length. What carries the root grows as
    # the distances of the joints from it: 0.05 and 0.5 to 0.055 and 0.685.
    factors = {1: 1.1, 2: 1.1 + 0.3}
    bones = [factor * length for factor, length in zip(factors.values(), (0.05, 0.45), strict=True)]
    size = (bones[0] + sum(bones)) / (0.05 + 0.5)
    for key in (None, 0, 1, 2):
        old, new = before.joints(key), after.joints(key)
        np.testing.assert_allclose(new[:, :3, :3], old[:, :3, :3], atol=1e-6)
        np.testing.assert_allclose(new[0, :3, 3], size * old[0, :3, 3], atol=1e-6)
        for joint, factor in factors.items():
            bone = [joints[joint, :3, 3] - joints[joint - 1, :3, 3] for joints in (old, new)]
            np.testing.assert_allclose(bone[1], factor * bone[0], atol=1e-6)
    moved = after.joints(2) - after.joints()
    assert np.abs(moved[:, :3, 3]).max() > 0.1


def test_normals_are_those_of_the_new_surface(grown):
    rig = load_rig(grown[3])
    wanted = TriangleMesh(rig.vertices, rig.faces).vertex_normals()
    assert float((rig.normals * wanted).sum(-1).min()) > 0.9999
    stale = load_rig(grown[0]).normals
    assert float((stale * wanted).sum(-1).min()) < 0.996


def hand_made(path, *, shared_picture=True):
    """Write a .gltf with its buffer and a picture beside it: interleaved vertices, clips that share their numbers."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [3, 0, 0], [3, 1, 0]], "<f4")
    rows = np.concatenate([vertices, np.tile(np.array([0, 0, 1], "<f4"), (5, 1))], axis=1)
    joints = np.array([[0, 0, 0, 0], [0, 0, 0, 0], [1, 0, 0, 0], [2, 0, 0, 0], [2, 0, 0, 0]], "<u2")
    inverse = np.tile(np.eye(4, dtype="<f4"), (3, 1, 1))
    inverse[1, 3, 0], inverse[2, 3, 0] = -1, -3  # column by column
    keys = np.array([[1, 0, 0], [1, 0, 2]], "<f4")
    spline = np.array([[9, 0, 0], [2, 0, 0], [8, 0, 0], [7, 0, 0], [2, 1, 0], [6, 0, 0]], "<f4")
    blocks = [
        (rows, 24), (joints, 0), (np.tile(np.array([1, 0, 0, 0], "<f4"), (5, 1)), 0), (inverse, 0), (keys, 0),
        (spline, 0), (np.array([0, 1], "<f4"), 0), (np.array([0, 1, 2, 1, 3, 4], "<u2"), 0),
        (np.zeros(40, "u1"), 0),
    ]  # fmt: skip
    blob, views = b"", []
    for block, stride in blocks:
        views.append({"buffer": 0, "byteOffset": len(blob), "byteLength": block.nbytes})
        views[-1] |= {"byteStride": stride} if stride else {}
        blob += block.tobytes() + bytes(-block.nbytes % 4)
    layout = [
        (0, 0, 5126, 5, "VEC3"), (0, 12, 5126, 5, "VEC3"), (1, 0, 5123, 5, "VEC4"), (2, 0, 5126, 5, "VEC4"),
        (3, 0, 5126, 3, "MAT4"), (4, 0, 5126, 2, "VEC3"), (5, 0, 5126, 6, "VEC3"), (6, 0, 5126, 2, "SCALAR"),
        (7, 0, 5123, 6, "SCALAR"),
    ]  # fmt: skip
    accessors = [
        dict(zip(("bufferView", "byteOffset", "componentType", "count", "type"), row, strict=True)) for row in layout
    ]
    # Between the first and second joint is a node, the third has a matrix, and a prop moves like the second.
    nodes = [
        {"name": "mesh", "mesh": 0, "skin": 0},
        {"name": "root", "children": [2, 5], "translation": [0, 0, 0]},
        {"name": "between", "children": [3], "translation": [0.25, 0, 0]},
        {"name": "middle", "children": [4], "translation": [0.75, 0, 0]},
        {"name": "end", "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 2, 0, 0, 1]},
        {"name": "prop", "translation": [5, 0, 0]},
    ]
    channels = [(0, 3), (0, 5), (1, 4), (2, 1)]
    document = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0, 1]}], "nodes": nodes, "accessors": accessors,
        "bufferViews": views, "buffers": [{"byteLength": len(blob), "uri": "leg.bin"}],
        "images": [{"uri": "skin.png"}, {"uri": "lost.png"}],
        "skins": [{"joints": [1, 3, 4], "inverseBindMatrices": 4}],
        "meshes": [{"primitives": [
            {"attributes": {"POSITION": 0, "NORMAL": 1, "JOINTS_0": 2, "WEIGHTS_0": 3}, "indices": 8}
        ]}],
        "animations": [{
            "samplers": [
                {"input": 7, "output": 5}, {"input": 7, "output": 6, "interpolation": "CUBICSPLINE"},
                {"input": 7, "output": 5},
            ],
            "channels": [{"sampler": s, "target": {"node": n, "path": "translation"}} for s, n in channels],
        }],
    }  # fmt: skip
    (path / "leg.bin").write_bytes(blob)
    (path / "skin.png").write_bytes(b"\x89PNG picture")
    (path / "leg.gltf").write_text(json.dumps(document))
    return path / "leg.gltf"


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
    file = File(path)
    nodes = tree["nodes"]
    assert [nodes[n]["translation"][0] for n in (2, 3, 5)] == [0.75, 2.25, 5]
    assert nodes[4]["matrix"][12:15] == [4.0, 0.0, 0.0]
    clip = tree["animations"][0]
    tracks = {
        channel["target"]["node"]: file.read(clip["samplers"][channel["sampler"]]["output"])
        for channel in clip["channels"]
    }
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
    rig = ArticulatedShape.from_gltf(source, parents={"b": "a"}, dtype=torch.float64).with_bone_coefficients()
    coefficients = torch.tensor([0.0, 0.0, 0.5, 0.0, 0.0, 0.0], dtype=torch.float64)
    assert rig.coefficient_names[2] == "length of a"
    path = rig.with_coefficients(coefficients).to_gltf(tmp_path / "grown.glb", source)
    back, joints = load_rig(path), File(path).joints()
    assert float(back.joint_transforms[1, 0, 3] - back.joint_transforms[0, 0, 3]) == pytest.approx(1.5)
    assert joints[1, 0, 3] - joints[0, 0, 3] == pytest.approx(1.5)


def test_what_is_not_the_rig_of_a_file(grown, tmp_path):
    source, rig, coefficients, _ = grown
    person = rig.with_coefficients(coefficients)
    with pytest.raises(InputError, match=r"path must end in .glb"):
        person.to_gltf(tmp_path / "leg.gltf", source)
    with pytest.raises(FileNotFoundError):
        person.to_gltf(tmp_path / "a.glb", tmp_path / "absent.glb")
    with pytest.raises(InputError, match="has 5 vertices and 3 joints"):
        person.to_gltf(tmp_path / "a.glb", hand_made(tmp_path))
    frames = person.frame_transforms(torch.zeros_like(person.rest))[:, :3, 3]
    tree = person.kinematics.tree
    positions = {name: frames[tree.index(name)] + 0.0 for name in NAMES}
    positions["shin"] += torch.tensor([0.1, 0.0, 0.0])
    with pytest.raises(InputError, match="the bone to joint 'shin' has another direction"):
        save_refitted_rig(tmp_path / "a.glb", source, person.surface.vertices, positions)
    assert not (tmp_path / "a.glb").exists()
