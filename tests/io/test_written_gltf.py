"""Animated glTF: a viewer's own evaluation of skins, parts and morph targets gives the frames."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import torchreg as tr
from tests.gltf_player import Player
from tests.tables import refused, refusing
from torchreg.geometry.mesh import unit_sphere
from torchreg.io.gltf_file.morph import save_vertex_animation
from torchreg.io.gltf_write import save_animated_parts, save_animated_skin

InputError = tr.errors.InputError
PARENTS = [2, -1, 1, 1]
NAMES = ["tip", "root", "middle", "other"]


def random_rigid(rng, *batch):
    matrices = np.tile(np.eye(4), (*batch, 1, 1))
    count = int(np.prod(batch))
    matrices[..., :3, :3] = Rotation.random(count, random_state=rng).as_matrix().reshape(*batch, 3, 3)
    matrices[..., :3, 3] = rng.normal(size=(*batch, 3))
    return matrices


def scene(seed=0, joints=4, frames=6, spread=4):
    """Arguments of save_animated_skin, as arrays; every vertex follows ``spread`` joints."""
    rng = np.random.default_rng(seed)
    vertices = rng.normal(size=(30, 3))
    weights = np.zeros((30, joints))
    for row in weights:
        row[rng.permutation(joints)[:spread]] = rng.uniform(0.05, 1, size=min(spread, joints))
    return {
        "vertices": vertices,
        "faces": np.stack([rng.permutation(30)[:3] for _ in range(20)]),
        "weights": weights / weights.sum(1, keepdims=True),
        "joint_names": NAMES if joints == 4 else [f"joint{i}" for i in range(joints)],
        "parents": PARENTS if joints == 4 else [-1, *range(joints - 1)],
        "rest_transforms": random_rigid(rng, joints),
        "joint_transforms": random_rigid(rng, frames, joints),
        "times": np.arange(frames) / 30,
    }


def save(path, arguments):
    return save_animated_skin(
        path, **{k: torch.as_tensor(v) if isinstance(v, np.ndarray) else v for k, v in arguments.items()}
    )


def blend(arguments, frame):
    """Linear blend skinning from its definition, one vertex and joint at a time."""
    posed = np.zeros((len(arguments["vertices"]), 3))
    for j in range(arguments["weights"].shape[1]):
        move = arguments["joint_transforms"][frame, j] @ np.linalg.inv(arguments["rest_transforms"][j])
        posed += arguments["weights"][:, j : j + 1] * (arguments["vertices"] @ move[:3, :3].T + move[:3, 3])
    return posed


@pytest.mark.parametrize(("joints", "spread"), [(1, 1), (4, 4), (9, 4), (9, 7), (300, 8)])
def test_file_plays_like_blend_skinning(tmp_path, joints, spread):
    arguments = scene(joints, joints, spread=spread)
    if joints == 300:  # a long chain of meter-long steps would lose digits to float32
        arguments["rest_transforms"][:, :3, 3] *= 0.01
        arguments["joint_transforms"][..., :3, 3] *= 0.01
        arguments["parents"] = [-1] + [0] * 299
    player = Player(save(tmp_path / "a.glb", arguments))
    np.testing.assert_allclose(player.skinned(None), arguments["vertices"], atol=1e-5)
    for frame, time in enumerate(arguments["times"]):
        np.testing.assert_allclose(player.skinned(float(np.float32(time))), blend(arguments, frame), atol=1e-5)


def test_nodes_follow_the_given_hierarchy(tmp_path):
    arguments = scene()
    player = Player(save(tmp_path / "a.glb", arguments))
    gltf = player.gltf
    assert [gltf.nodes[j].name for j in gltf.skins[0].joints] == NAMES
    for index, parent in enumerate(PARENTS):
        above = [n.name for n in gltf.nodes if gltf.skins[0].joints[index] in n.children]
        assert above == [NAMES[parent] if parent >= 0 else "armature"]
    joints = player.joints(float(np.float32(arguments["times"][3])))
    np.testing.assert_allclose(joints, arguments["joint_transforms"][3], atol=2e-6)


def test_quaternions_take_the_short_way_through_full_turns(tmp_path):
    arguments = scene(joints=1, frames=80, spread=1)
    angles = np.linspace(0, 6 * np.pi, 80)
    arguments["joint_transforms"][:, 0, :3, :3] = Rotation.from_rotvec(np.outer(angles, [0.6, 0, 0.8])).as_matrix()
    player = Player(save(tmp_path / "a.glb", arguments))
    rotations = player.accessor(player.gltf.animations[0].samplers[1].output).astype(float)
    assert (rotations[1:] * rotations[:-1]).sum(1).min() > 0.9
    np.testing.assert_allclose(np.linalg.norm(rotations, axis=1), 1, atol=1e-6)


def test_accessors_are_aligned_and_bounded(tmp_path):
    arguments = scene(joints=9, spread=6)
    arguments |= {"normals": np.r_[np.zeros((1, 3)), np.ones((29, 3))], "colors": np.full((30, 3), 0.25)}
    player = Player(save(tmp_path / "a.glb", arguments))
    gltf = player.gltf
    assert all(view.byteOffset % 4 == 0 for view in gltf.bufferViews)
    assert (tmp_path / "a.glb").stat().st_size % 4 == 0
    position, stored = gltf.accessors[gltf.meshes[0].primitives[0].attributes.POSITION], player.attribute("POSITION")
    assert (position.min, position.max) == (stored.min(0).tolist(), stored.max(0).tolist())
    time = gltf.accessors[gltf.animations[0].samplers[0].input]
    assert (time.min, time.max) == ([0.0], [float(np.float32(5 / 30))])
    weights = np.c_[player.attribute("WEIGHTS_0"), player.attribute("WEIGHTS_1")].astype(float)
    np.testing.assert_allclose(weights.sum(1), 1, atol=2e-7)
    assert (np.c_[player.attribute("JOINTS_0"), player.attribute("JOINTS_1")][weights == 0] == 0).all()
    assert player.attribute("NORMAL")[0].tolist() == [0, 0, 1]
    np.testing.assert_allclose(np.linalg.norm(player.attribute("NORMAL"), axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(player.attribute("COLOR_0"), np.tile([0.25, 0.25, 0.25, 1], (30, 1)))


def test_small_fifth_weights_are_dropped(tmp_path):
    arguments = scene(joints=9, spread=4)
    arguments["weights"] = arguments["weights"] + 5e-5
    player = Player(save(tmp_path / "a.glb", arguments))
    assert player.attribute("JOINTS_1") is None
    np.testing.assert_allclose(player.attribute("WEIGHTS_0").sum(1), 1, atol=2e-7)


def test_large_indices_get_four_bytes(tmp_path):
    arguments = scene(joints=1, frames=1, spread=1)
    count = 65536
    arguments |= {"vertices": np.zeros((count, 3)), "weights": np.ones((count, 1)), "faces": np.array([[0, 1, 65535]])}
    player = Player(save(tmp_path / "a.glb", arguments))
    assert player.accessor(player.gltf.meshes[0].primitives[0].indices)[:, 0].tolist() == [0, 1, 65535]


def test_parts_move_as_nodes(tmp_path):
    rng = np.random.default_rng(3)
    transforms = random_rigid(rng, 5, 3)
    meshes = [unit_sphere(1), None, unit_sphere(0, dtype=torch.float64)]
    times = torch.arange(5) * 0.5
    path = save_animated_parts(
        tmp_path / "p.glb", meshes, torch.from_numpy(transforms), times, ["a", "b", "c"], torch.eye(3)
    )
    player = Player(path)
    assert [node.name for node in player.gltf.nodes] == ["a", "b", "c"]
    assert [node.mesh for node in player.gltf.nodes] == [0, None, 1]
    for frame in range(5):
        np.testing.assert_allclose(np.stack(player.world(frame * 0.5)), transforms[frame], atol=1e-6)
    np.testing.assert_allclose(player.attribute("POSITION", 1), meshes[2].vertices, atol=1e-7)
    assert player.gltf.materials[1].pbrMetallicRoughness.baseColorFactor == [0, 0, 1, 1]
    unnamed = save_animated_parts(tmp_path / "q.glb", meshes, torch.from_numpy(transforms), times)
    assert [node.name for node in Player(unnamed).gltf.nodes] == ["part_0", "part_1", "part_2"]


def test_parts_move_with_their_parents(tmp_path):
    rng = np.random.default_rng(4)
    transforms = random_rigid(rng, 3, 3)
    ball = unit_sphere(1)
    path = save_animated_parts(
        tmp_path / "p.glb", [ball] * 3, torch.from_numpy(transforms), torch.arange(3), list("abc"), None,
        part_normals=[ball.vertices, None, None], parents=[2, 0, -1], up=(0.0, 0.0, 1.0),
    )  # fmt: skip
    player = Player(path)
    turn = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    for frame in range(3):
        np.testing.assert_allclose(np.stack(player.world(frame))[:3], turn @ transforms[frame], atol=1e-6)
    np.testing.assert_allclose(player.attribute("NORMAL"), ball.vertices, atol=1e-6)
    assert player.attribute("NORMAL", 1) is None


MIRROR = np.tile(np.diag([1.0, 1.0, -1.0, 1.0]), (4, 1, 1))
NONRIGID = np.tile(np.diag([1.0, 1.0, 1.1, 1.0]), (4, 1, 1))


test_bad_skins = refusing(lambda folder, change: save(folder / "a.glb", scene() | change), InputError, leaves=0)(
    ({"vertices": np.zeros((30, 2))}, r"vertices must have shape \(V, 3\)"),
    ({"vertices": np.full((30, 3), np.nan)}, "vertices must be finite"),
    ({"faces": np.full((1, 3), 30)}, "faces must hold indices from 0 to 29, got 30 to 30"),
    ({"faces": np.zeros((0, 3), int)}, "at least one triangle"),
    ({"weights": np.zeros((30, 4))}, "30 zero row"),
    ({"weights": -np.ones((30, 4))}, "not be negative"),
    ({"weights": np.ones((30, 3))}, r"weights must have shape \(30, 4\)"),
    ({"joint_names": ["a", "b", "a", "c"]}, "occur more than once: a"),
    ({"joint_names": []}, "at least one name"),
    ({"parents": [-1, 0, 1]}, r"one index per joint \(4\), got 3"),
    ({"parents": [-1, 0, 1, 4]}, "parents of joint 'other' must be -1 to 3, got 4"),
    ({"parents": [-1, 2, 1, 0]}, "cycle: root, middle"),
    ({"rest_transforms": NONRIGID}, "rest_transforms must hold rigid motions"),
    ({"rest_transforms": MIRROR}, "rest_transforms must hold rigid motions"),
    ({"joint_transforms": np.zeros((5, 4, 4, 4))}, r"joint_transforms must have shape \(6, 4, 4, 4\)"),
    ({"times": np.zeros(6)}, "strictly increasing"),
    ({"times": np.arange(6) - 1.0}, "not negative"),
    ({"times": np.zeros(0)}, "must not be empty"),
    ({"colors": np.full((30, 3), 255.0)}, r"colors must lie in \[0, 1\]"),
    ({"colors": np.zeros((29, 3))}, r"colors must have shape \(30, 3\)"),
    ({"normals": np.zeros((29, 3))}, r"normals must have shape \(30, 3\)"),
)


def test_bad_paths_types_and_parts(tmp_path):
    def parts(mesh, *names):
        count = max(len(names), 1)
        return save_animated_parts(
            tmp_path / "a.glb", [mesh], torch.eye(4).expand(1, count, 4, 4), torch.zeros(1), names or None
        )

    empty = tr.TriangleMesh(torch.zeros(3, 3), torch.zeros(0, 3, dtype=torch.int64))
    refused(
        (lambda: save(tmp_path / "a.gltf", scene()), r"must end in \.glb"),
        (lambda: save(tmp_path / "no" / "a.glb", scene()), "existing folder"),
        (lambda: parts(None, "a", "b"), r"one mesh per part name \(2\), got 1"),
        (lambda: parts(empty), r"part_meshes\[0\]\.faces"),
        error=InputError,
    )
    floats = scene() | {"faces": np.zeros((1, 3))}
    refused((lambda: save(tmp_path / "a.glb", floats), "faces must hold integers"), error=tr.errors.InputTypeError)


def test_four_weights_are_enough_where_they_are_asked_for(tmp_path):
    arguments = scene(joints=9, spread=6)
    player = Player(save(tmp_path / "a.glb", arguments | {"most_weights": 4}))
    assert player.attribute("JOINTS_1") is None
    kept = np.where(arguments["weights"] >= np.sort(arguments["weights"], axis=1)[:, -4:-3], arguments["weights"], 0)
    expected = blend(arguments | {"weights": kept / kept.sum(1, keepdims=True)}, 2)
    np.testing.assert_allclose(player.skinned(arguments["times"][2]), expected, atol=1e-5)
    odd = arguments | {"most_weights": 5}
    refused((lambda: save(tmp_path / "b.glb", odd), "most_weights must be 4, 8 or None, got 5"), error=InputError)


BALL = unit_sphere(1)
TIMES = torch.tensor([0.0, 0.5, 2.0])


FRAMES = BALL.vertices + 0.3 * torch.randn(3, *BALL.vertices.shape, generator=torch.Generator().manual_seed(0))
MOVING = {"frames": FRAMES, "faces": BALL.faces, "times": TIMES}


def test_frames_are_met_and_lines_lead_between_them(tmp_path):
    player = Player(save_vertex_animation(tmp_path / "a.glb", FRAMES, BALL.faces, TIMES))
    for time, frame in zip(TIMES, FRAMES, strict=True):
        np.testing.assert_allclose(player.morphed(float(time)), frame, atol=1e-6)
        np.testing.assert_allclose(np.linalg.norm(player.morphed(float(time), "NORMAL"), axis=-1), 1, atol=1e-5)
    np.testing.assert_allclose(player.morphed(1.25), (FRAMES[1] + FRAMES[2]) / 2, atol=1e-6)


def test_colors_and_the_first_frame_are_read_back(tmp_path):
    colors = torch.rand(len(BALL.vertices), 3, generator=torch.Generator().manual_seed(1))
    cloud = tr.load_points(save_vertex_animation(tmp_path / "a.glb", FRAMES, BALL.faces, TIMES, colors))
    np.testing.assert_allclose(cloud.points, FRAMES[0], atol=1e-6)
    np.testing.assert_allclose(cloud.colors, colors, atol=1e-6)


test_bad_frames = refusing(
    lambda folder, change: save_vertex_animation(**(MOVING | change | {"path": folder / change.get("path", "a.glb")})),
    InputError,
)(
    ({"path": "a.gltf"}, r"end in \.glb"),
    ({"frames": torch.zeros(1, 42, 3)}, "two at least, got 1"),
    ({"frames": torch.zeros(42, 3)}, "frames must have shape"),
    ({"times": TIMES[:2]}, r"one per frame \(3\), got 2"),
    ({"times": TIMES.flip(0)}, "strictly increasing"),
    ({"faces": BALL.faces + 40}, "indices from 0 to 41"),
)


@pytest.mark.parametrize("up", [(0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1), (1, 0, 0), (-1, 0, 0)])
def test_what_is_upright_becomes_gltfs_y(tmp_path, up):
    points = torch.tensor([[0.0, 0.0, 0.0], [0.1, 0.05, 0.0], [0.0, 0.1, 0.1]]) + torch.tensor(up).float()
    frames = torch.eye(4).expand(1, 1, 4, 4)
    save_animated_skin(
        tmp_path / "a.glb", points, torch.tensor([[0, 1, 2]]), torch.ones(3, 1), ["root"], [-1], frames[0], frames,
        torch.zeros(1), up=up,
    )  # fmt: skip
    found = tr.load_points(tmp_path / "a.glb").points
    torch.testing.assert_close(found[:, 1], points @ torch.tensor(up).float(), atol=1e-6, rtol=0)
    volumes = (torch.linalg.det(value.double()) for value in (found, points))  # turned, not mirrored
    assert next(volumes) == pytest.approx(float(next(volumes)), abs=1e-6)
    torch.testing.assert_close(found.norm(dim=-1), points.norm(dim=-1), atol=1e-6, rtol=0)
