"""Skinned glTF: surfaces as viewers show them, and rigs of which a piece is bad."""

import json
import struct

import numpy as np
import pytest
import torch

from torchreg.errors import FileWarning, FormatError, InputError, ModelError
from torchreg.io.gltf import load_rig
from torchreg.io.points import load_mesh, load_points
from torchreg.shapes.articulated import ArticulatedShape

KINDS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
TURN = [0, 0, -np.sqrt(0.5), np.sqrt(0.5)]  # a quarter turn about z, clockwise


def bar(height=2.0, thick=0.3, rings=9, unit=1.0):
    """A square bar along y: vertices, triangles, and how much each vertex belongs to the upper half."""
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


class Scene:
    """A binary glTF under construction."""

    def __init__(self):
        self.json = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": []}]}
        self.blob = b""

    def append(self, collection, item):
        self.json.setdefault(collection, []).append(item)
        return len(self.json[collection]) - 1

    def add(self, values, normalized=False):
        values = np.asarray(values)
        row = values.itemsize * (1 if values.ndim == 1 else values.shape[1])
        stride = row if values.ndim == 1 else -(-row // 4) * 4
        packed = np.zeros((len(values), stride), "u1")
        packed[:, :row] = np.frombuffer(np.ascontiguousarray(values).tobytes(), "u1").reshape(len(values), row)
        self.blob += b"\0" * (-len(self.blob) % 4)
        view = {"buffer": 0, "byteOffset": len(self.blob), "byteLength": packed.size}
        self.blob += packed.tobytes()
        return self.append("accessors", {
            "bufferView": self.append("bufferViews", view | ({"byteStride": stride} if stride != row else {})),
            "componentType": KINDS[values.dtype.str[1:]], "count": len(values), "normalized": normalized,
            "type": TYPES[1 if values.ndim == 1 else values.shape[1]],
        })  # fmt: skip

    def primitive(self, vertices=VERTICES, faces=FACES, weights=UPPER, **changes):
        joints = np.tile(np.array([0, 1, 0, 0], "u1"), (len(vertices), 1))
        shares = np.stack([1 - weights, weights, 0 * weights, 0 * weights], 1).astype("f4")
        values = {"POSITION": vertices.astype("f4"), "JOINTS_0": joints, "WEIGHTS_0": shares} | changes
        attributes = {
            name: self.add(*v) if isinstance(v, tuple) else self.add(v) for name, v in values.items() if v is not None
        }
        return {"attributes": attributes, "indices": self.add(faces.reshape(-1).astype("u2"))}

    def node(self, root=False, **entries):
        number = self.append("nodes", entries)
        if root:
            self.json["scenes"][0]["nodes"].append(number)
        return number

    def skin(self, joints, inverse_binds, **entries):
        stored = np.swapaxes(np.asarray(inverse_binds, "f4"), 1, 2).reshape(-1, 16)
        return self.append("skins", {"joints": joints, "inverseBindMatrices": self.add(stored), **entries})

    def rig(self, primitives=None, tip=None, inverse=None, above=None, **root):
        """Add a root, a tip a metre above it and the bar that they move; return the tip."""
        number = self.node(name="tip", **{"translation": [0, 1, 0], **(tip or {})})
        base = self.node(root=above is None, name="root", children=[number], **root)
        skin = self.skin([base, number], [shift(0, 0, 0), shift(0, -1, 0)] if inverse is None else inverse)
        mesh = self.append("meshes", {"primitives": primitives or [self.primitive()]})
        body = self.node(root=above is None, name="body", mesh=mesh, skin=skin)
        if above is not None:
            self.node(root=True, children=[base, body], **above)
        return number

    def save(self, path):
        self.json["buffers"] = [{"byteLength": len(self.blob)}]
        head = json.dumps(self.json).encode()
        head += b" " * (-len(head) % 4)
        body = self.blob + b"\0" * (-len(self.blob) % 4)
        chunks = struct.pack("<I4s", len(head), b"JSON") + head + struct.pack("<I4s", len(body), b"BIN\0") + body
        path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
        return path


@pytest.fixture
def scene():
    return Scene()


def corners(path, **options):
    points = load_points(path, dtype=torch.float64, **options).points
    return np.stack([points.amin(0), points.amax(0)]).round(4)


STRAIGHT = [[-0.15, 0, -0.15], [0.15, 2, 0.15]]
BENT = [[-0.15, 0, -0.15], [1, 1.15, 0.15]]


def test_the_pose_of_the_nodes_bends_the_skin(tmp_path, scene):
    scene.rig(tip={"rotation": TURN})
    path = scene.save(tmp_path / "a.glb")
    np.testing.assert_allclose(corners(path), BENT)
    # The same vertex by vertex: the upper half turns about the joint.
    wanted = VERTICES.copy()
    upper = UPPER > 0
    wanted[upper] = np.stack([VERTICES[upper, 1] - 1, 1 - VERTICES[upper, 0], VERTICES[upper, 2]], 1)
    np.testing.assert_allclose(load_points(path).points, wanted, atol=1e-6)


def test_transforms_above_the_skeleton_count_and_those_of_the_mesh_do_not(tmp_path, scene):
    vertices = bar(unit=100.0)[0]
    inverse = [shift(0, 0, 0), shift(0, -100, 0)]
    scene.rig(
        [scene.primitive(vertices)], tip={"translation": [0, 100, 0]}, inverse=inverse, above={"scale": [0.01] * 3}
    )
    scene.json["nodes"][2]["translation"] = [9, 9, 9]
    np.testing.assert_allclose(corners(scene.save(tmp_path / "a.glb")), STRAIGHT)


def test_quantized_positions_are_put_right_by_the_inverse_bind_matrices(tmp_path, scene):
    packed = np.round((VERTICES - [0, 1, 0]) * 32767).astype("i2")
    back = shift(0, 1, 0)
    scene.rig([scene.primitive(POSITION=(packed, True))], inverse=[back, shift(0, -1, 0) @ back])
    np.testing.assert_allclose(corners(scene.save(tmp_path / "a.glb")), STRAIGHT, atol=1e-4)


def test_skins_props_and_instances_stand_side_by_side(tmp_path, scene):
    scene.rig(tip={"rotation": TURN})
    scene.rig(translation=[5, 0, 0])
    prop = scene.append("meshes", {"primitives": [scene.primitive(JOINTS_0=None, WEIGHTS_0=None)]})
    places = scene.add(np.array([[0, 0, 1], [0, 0, 2]], "f4"))
    sizes = scene.add(np.array([[1, 1, 1], [2, 1, 1]], "f4"))
    instances = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": places, "SCALE": sizes}}}
    scene.node(root=True, mesh=prop, translation=[10, 0, 0], extensions=instances)
    points = load_points(scene.save(tmp_path / "a.glb")).points.reshape(4, -1, 3)
    wanted = np.array([BENT, STRAIGHT, STRAIGHT, [[-0.3, 0, -0.15], [0.3, 2, 0.15]]])
    wanted += np.array([[0, 0, 0], [5, 0, 0], [10, 0, 1], [10, 0, 2]])[:, None]
    np.testing.assert_allclose(np.stack([points.amin(1), points.amax(1)], 1), wanted, atol=1e-6)


def test_morph_targets_stand_at_their_weights(tmp_path, scene):
    primitive = scene.primitive(JOINTS_0=None, WEIGHTS_0=None)
    primitive["targets"] = [{"POSITION": scene.add(np.full((36, 3), value, "f4"))} for value in (1.0, 10.0)]
    mesh = scene.append("meshes", {"primitives": [primitive], "weights": [0.5, 0.0]})
    scene.node(root=True, mesh=mesh)
    scene.node(root=True, mesh=mesh, weights=[0.0, 1.0])
    points = load_points(scene.save(tmp_path / "a.glb")).points.reshape(2, -1, 3)
    np.testing.assert_allclose(points, np.stack([VERTICES + 0.5, VERTICES + 10]), atol=1e-6)


@pytest.mark.parametrize("kind", ["LINEAR", "STEP", "CUBICSPLINE"])
def test_moments_of_an_animation(tmp_path, scene, kind):
    tip = scene.rig()
    keys = np.array([[0, 0, 0, 1], TURN], "f4")
    keys = (
        np.concatenate([np.zeros_like(keys), keys, np.zeros_like(keys)], 1).reshape(-1, 4) if kind[0] == "C" else keys
    )
    sampler = {"input": scene.add(np.array([0, 2], "f4")), "output": scene.add(keys), "interpolation": kind}
    channel = {"sampler": 0, "target": {"node": tip, "path": "rotation"}}
    scene.append("animations", {"samplers": [sampler], "channels": [channel]})
    path = scene.save(tmp_path / "a.glb")
    np.testing.assert_allclose(corners(path), STRAIGHT)
    for moment in ({"time": 0.0}, {"frame": 0}, {"time": -3.0}):
        np.testing.assert_allclose(corners(path, **moment), STRAIGHT)
    for moment in ({"time": 2.0}, {"frame": 1}, {"frame": -1}, {"time": 99.0}):
        np.testing.assert_allclose(corners(path, **moment), BENT)
    half = corners(path, time=1.0)
    if kind == "STEP":
        np.testing.assert_allclose(half, STRAIGHT)
    else:  # by symmetry an eighth of a turn
        angle = np.pi / 4
        np.testing.assert_allclose(half[1, 0], np.sin(angle) + 0.15 * np.cos(angle), atol=1e-3)
    with pytest.raises(InputError, match="frame must be below 2, the number of keyframes; got 2"):
        load_points(path, frame=2)
    with pytest.raises(InputError, match="give one of them"):
        load_points(path, frame=1, time=1.0)


def test_moments_of_what_does_not_move_are_refused(tmp_path, scene):
    scene.rig()
    with pytest.raises(FormatError, match=r"a\.glb: holds no animation"):
        load_points(scene.save(tmp_path / "a.glb"), time=1.0)
    (tmp_path / "a.xyz").write_text("0 0 0\n")
    with pytest.raises(InputError, match="time choose a moment of an animation, which XYZ"):
        load_points(tmp_path / "a.xyz", time=1.0)


def test_mirrored_skins_keep_their_outside(tmp_path, scene):
    scene.rig(above={"scale": [-1, 1, 1]})
    mesh = load_mesh(scene.save(tmp_path / "a.glb"), dtype=torch.float64)
    plain = Scene()
    plain.rig()
    other = load_mesh(plain.save(tmp_path / "b.glb"), dtype=torch.float64)
    torch.testing.assert_close(mesh.face_normals() * torch.tensor([-1.0, 1, 1]), other.face_normals())


def test_vertices_without_weight_follow_their_neighbors(tmp_path, scene):
    weights = np.stack([1 - UPPER, UPPER, 0 * UPPER, 0 * UPPER], 1).astype("f4")
    weights[[5, 33]] = 0
    weights[6] = np.nan
    scene.rig([scene.primitive(WEIGHTS_0=weights)])
    path = scene.save(tmp_path / "a.glb")
    with pytest.warns(FileWarning, match=r"a\.glb: 3 of 36 vertices have no skin weight and follow the nearest"):
        rig = load_rig(path)
    np.testing.assert_allclose(rig.weights[:, 1], UPPER)
    np.testing.assert_allclose(corners(path), STRAIGHT)  # as viewers do, after the first joint


def test_primitives_without_positions_or_skin_are_left_out(tmp_path, scene):
    whole = scene.primitive()
    nothing = {"attributes": {}, "indices": whole["indices"]}
    scene.rig([whole, nothing, scene.primitive(JOINTS_0=None, WEIGHTS_0=None)])
    with pytest.warns(FileWarning, match="2 primitives are left out: primitive 1 of mesh 0 has no positions; prim"):
        rig = load_rig(scene.save(tmp_path / "a.glb"))
    assert (len(rig.vertices), len(rig.faces)) == (36, 64)
    empty = Scene()
    empty.rig([nothing])
    with pytest.raises(ModelError, match=r"b\.glb: the skinned mesh has no triangles that a skin moves: primitive 0"):
        load_rig(empty.save(tmp_path / "b.glb"))


@pytest.mark.parametrize("matrix", [np.eye(4), np.zeros((4, 4))])
def test_joints_that_move_nothing_stand_where_their_nodes_do(tmp_path, scene, matrix):
    scene.rig()
    end = scene.node(name="end", translation=[0, 1, 0])
    scene.json["nodes"][0]["children"] = [end]
    scene.json["skins"][0] = {"joints": [1, 0, end]}
    stored = np.stack([shift(0, 0, 0), shift(0, -1, 0), matrix]).swapaxes(1, 2).reshape(-1, 16)
    scene.json["skins"][0]["inverseBindMatrices"] = scene.add(stored.astype("f4"))
    with pytest.warns(FileWarning, match="1 joints that move nothing have no bind pose .*: end"):
        rig = load_rig(scene.save(tmp_path / "a.glb"))
    assert rig.joint_transforms[:, :3, 3].tolist() == [[0, 0, 0], [0, 1, 0], [0, 2, 0]]


def test_several_trees_of_joints_hang_on_the_largest(tmp_path, scene):
    tip = scene.node(name="tip", translation=[0, 1, 0])
    lower = scene.node(root=True, name="lower")
    upper = scene.node(root=True, name="upper", translation=[0, 1, 0])
    scene.json["nodes"][lower]["children"] = [tip]
    skin = scene.skin([upper, lower, tip], [shift(0, -1, 0), np.eye(4), shift(0, -1, 0)])
    joints = np.tile(np.array([1, 0, 2, 0], "u1"), (36, 1))
    mesh = scene.append("meshes", {"primitives": [scene.primitive(JOINTS_0=joints)]})
    scene.node(root=True, mesh=mesh, skin=skin)
    with pytest.warns(FileWarning, match=r"a\.glb: the skeleton has 2 roots: 'upper' hang on 'lower'"):
        shape = ArticulatedShape.from_gltf(scene.save(tmp_path / "a.glb"))
    assert set(shape.part_names) == {"lower", "upper"}
    assert [name for name in shape.dof_names if name.startswith("upper")] == ["upper_x", "upper_y", "upper_z"]


def test_flat_hierarchies_are_still_refused(tmp_path, scene):
    joints = [scene.node(root=True, name=f"j{k}", translation=[0, 0.5 * k, 0]) for k in range(4)]
    skin = scene.skin(joints, [shift(0, -0.5 * k, 0) for k in range(4)])
    mesh = scene.append("meshes", {"primitives": [scene.primitive()]})
    scene.node(root=True, mesh=mesh, skin=skin)
    with pytest.raises(ModelError, match=r"a\.glb: the skeleton has 4 roots .* name each joint's parent with parents="):
        ArticulatedShape.from_gltf(scene.save(tmp_path / "a.glb"))


def test_one_skin_of_several_is_chosen(tmp_path, scene):
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
        assert ArticulatedShape.from_gltf(path, skin=skin).keypoints(torch.zeros(9))[0, 0] == place
