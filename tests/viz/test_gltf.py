"""Files play in a viewer's own evaluation what shapes, registered bones, spines and scenes of skinned meshes give."""

import numpy as np
import pygltflib
import pytest
import torch
import trimesh

from torchreg.datasets.hand import hand_motion, surface_skin
from torchreg.errors import InputError
from torchreg.geometry.mesh import unit_sphere
from torchreg.geometry.rigid import se3_exp
from torchreg.io.gltf import load_rig
from torchreg.registration.bones.grid_lbs import GridLBS
from torchreg.registration.bones.sparse_grid import SparseGrid
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.spines.spine import Spine
from torchreg.viz.gltf import gltf_of_scene, save_shape_animation
from torchreg.viz.scan_gltf import save_grid_animation
from torchreg.viz.scene import Joints, MovingMesh, Scene, SkinnedMesh
from torchreg.viz.spine_gltf import save_spine_animation


@pytest.fixture(scope="module")
def skin(hand):
    return surface_skin(hand, spacing=0.01)


def test_the_file_plays_what_the_skin_gives(gltf_viewer, hand, skin, tmp_path):
    poses = hand_motion(hand, "bend", 5)
    viewer = gltf_viewer(save_shape_animation(tmp_path / "a.glb", hand, poses, fps=10, skin=skin))
    seconds = viewer.read(viewer.gltf.animations[0].samplers[0].input)[:, 0]
    np.testing.assert_allclose(seconds, np.arange(5) / 10, rtol=1e-6)
    names = [viewer.gltf.nodes[node].name for node in viewer.gltf.skins[0].joints]
    assert names == list(hand.part_names)
    for frame in (0, 3):
        np.testing.assert_allclose(viewer.vertices(frame), skin(poses[frame]).detach().numpy(), atol=1e-5)


def test_the_file_reads_back_as_a_shape(hand, skin, tmp_path):
    times = torch.tensor([0.0, 0.3, 1.0])
    path = save_shape_animation(tmp_path / "a.glb", hand, hand_motion(hand, "rotate", 3), times, skin=skin)
    again = ArticulatedShape.from_gltf(path)
    assert set(again.part_names) <= set(hand.part_names)
    assert again.surface is not None
    torch.testing.assert_close(again.surface.vertices.float(), skin.points, atol=1e-5, rtol=0)


def test_the_surface_is_made_when_no_skin_is_given(tmp_path):
    box = torch.tensor([[x, y, z] for x in (0.0, 0.1) for y in (0.0, 0.1) for z in (0.0, 0.2, 0.4)])
    weights = torch.zeros(12, 2)
    weights[torch.arange(12), (box[:, 2] > 0.3).long()] = 1.0
    faces = torch.tensor([[0, 1, 3], [1, 2, 4], [6, 7, 9], [7, 8, 10]])
    shape = ArticulatedShape.from_skinned_mesh(box, faces, weights, box[[0, 1]], [-1, 0])
    poses = shape.rest_pose().expand(2, -1)
    assert save_shape_animation(tmp_path / "a.glb", shape, poses).stat().st_size > 500


ARM = """<robot name="arm"><material name="red"><color rgba="1 0 0 1"/></material>
<link name="upper"><visual><origin xyz="0 0 .2"/><geometry><box size=".05 .08 .4"/></geometry>
<material name="red"/></visual></link>
<link name="fore"><visual><origin xyz="0 0 .15"/><geometry><cylinder radius=".03" length=".3"/>
</geometry></visual></link>
<joint name="elbow" type="revolute"><parent link="upper"/><child link="fore"/><origin xyz="0 0 .4"/>
<axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint></robot>"""


def test_links_of_a_robot_are_nodes_in_their_colors(tmp_path):
    (tmp_path / "arm.urdf").write_text(ARM, encoding="utf-8")
    arm = ArticulatedShape.from_urdf(tmp_path / "arm.urdf", free_base=False)
    poses = torch.stack([arm.pose_from_dict({"elbow": angle}) for angle in (0.7, -0.4)])
    path = save_shape_animation(tmp_path / "arm.glb", arm, poses, up=(0.0, 0.0, 1.0))
    scene = trimesh.load_scene(path)  # an independent reader, which shows the first frame
    assert set(scene.graph.nodes_geometry) == {"upper", "fore"}
    expected = arm.file_skin()(poses[0]).detach()[:, [0, 2, 1]] * torch.tensor([1.0, 1.0, -1.0])
    np.testing.assert_allclose(scene.bounds, torch.stack((expected.amin(0), expected.amax(0))), atol=1e-5)
    colors = {name: mesh.visual.material.baseColorFactor for name, mesh in scene.geometry.items()}
    assert colors["upper"].tolist() == [255, 0, 0, 255]
    assert colors["fore"][0] != 255
    assert len(scene.geometry["upper"].vertices) == 24  # a box, with the normals of its sides


def bones_scene(bones=6, blend="linear", smooth=False, scale=1.0, dtype=torch.float64):
    mesh = unit_sphere(2)
    points = scale * (mesh.vertices.double() * torch.tensor([3.0, 1.0, 0.8]))
    grid = SparseGrid.from_points(points, 12)
    seeds = points[:: len(points) // bones][:bones]
    far = torch.cdist(grid.cell_centers(), seeds)
    motions = se3_exp(0.5 * torch.randn(bones, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64))
    motions[:, :3, 3] *= scale
    model = GridLBS.from_labels(grid, far.argmin(1), bones, motions, blend=blend)
    if smooth:
        soft = torch.softmax(-4 * torch.cdist(grid.corner_points(), seeds) / scale, dim=-1)
        model = GridLBS(grid, soft, motions, blend=blend)
    return model.to(dtype), points.to(dtype), mesh.faces


@pytest.mark.parametrize(
    ("hierarchy", "dtype", "scale"),
    [
        ("tree", torch.float32, 1e-3),
        ("flat", torch.float64, 1e3),
        ("tree", torch.float64, 1.0),
        ("flat", torch.float32, 1.0),
    ],
)
def test_both_poses_are_those_of_the_model(gltf_viewer, tmp_path, hierarchy, dtype, scale):
    model, points, faces = bones_scene(bones=4, scale=scale, dtype=dtype)
    written = save_grid_animation(tmp_path / "scan.glb", model, points, faces, hierarchy=hierarchy)
    assert written.path == tmp_path / "scan.glb"
    viewer = gltf_viewer(written.path)
    size = float((points.amax(0) - points.amin(0)).norm())
    np.testing.assert_allclose(viewer.vertices(0), points.numpy(), atol=1e-5 * size)
    np.testing.assert_allclose(viewer.vertices(1), model(points).detach().numpy(), atol=1e-5 * size)
    assert written.residual < 1e-5 * size
    assert (max(written.parents) >= 0) == (hierarchy == "tree")
    names = [viewer.gltf.nodes[node].name for node in viewer.gltf.skins[0].joints]
    assert names == [f"bone_{number}" for number in range(4)]


def test_many_poses_are_played_at_their_times(gltf_viewer, tmp_path):
    model, points, faces = bones_scene()
    generator = torch.Generator().manual_seed(1)
    poses = se3_exp(torch.randn(4, 6, 6, generator=generator, dtype=torch.float64))
    times = torch.tensor([0.0, 0.1, 0.5, 2.0])
    path = save_grid_animation(tmp_path / "a.glb", model, points, faces, poses, times, most_weights=8).path
    viewer = gltf_viewer(path)
    seconds = viewer.read(viewer.gltf.animations[0].samplers[0].input)[:, 0]
    np.testing.assert_allclose(seconds, times.numpy())
    for frame in range(4):
        np.testing.assert_allclose(viewer.vertices(frame), model(points, poses[frame]).detach().numpy(), atol=1e-4)
    several = GridLBS(model.grid, model.weights, poses)
    own = gltf_viewer(save_grid_animation(tmp_path / "b.glb", several, points, faces, most_weights=8).path)
    np.testing.assert_allclose(own.vertices(0), points.numpy(), atol=1e-5)
    np.testing.assert_allclose(own.vertices(3), viewer.vertices(2), atol=1e-5)


@pytest.mark.parametrize(("up", "y"), [((0, 0, 1), (2, 1)), ((0, -1, 0), (1, -1)), ((1, 0, 0), (0, 1))])
def test_what_is_upright_is_y_in_the_file(gltf_viewer, tmp_path, up, y):
    model, points, faces = bones_scene(bones=3)
    viewer = gltf_viewer(save_grid_animation(tmp_path / "a.glb", model, points, faces, up=up).path)
    axis, sign = y
    for frame, expected in enumerate((points, model(points).detach())):
        shown = viewer.vertices(frame)
        np.testing.assert_allclose(shown[:, 1], sign * expected[:, axis].numpy(), atol=1e-5)
        np.testing.assert_allclose(np.linalg.norm(shown, axis=1), expected.norm(dim=-1).numpy(), atol=1e-5)


def test_the_residual_is_what_dropped_weights_cost(gltf_viewer, tmp_path):
    model, points, faces = bones_scene(bones=9, smooth=True)
    truth = model(points).detach().numpy()
    residuals = {}
    for most in (4, 8):
        written = save_grid_animation(tmp_path / f"{most}.glb", model, points, faces, most_weights=most)
        off = np.linalg.norm(gltf_viewer(written.path).vertices(1) - truth, axis=1).max()
        assert written.residual == pytest.approx(off, abs=1e-5)
        residuals[most] = written.residual
    assert 0 < residuals[8] < residuals[4]


def test_the_residual_of_dual_quaternions_is_that_of_the_linear_blend(gltf_viewer, tmp_path):
    model, points, faces = bones_scene(blend="dual_quaternion")
    written = save_grid_animation(tmp_path / "a.glb", model, points, faces)
    off = np.linalg.norm(gltf_viewer(written.path).vertices(1) - model(points).detach().numpy(), axis=1).max()
    assert written.residual == pytest.approx(off, abs=1e-5)
    assert off > 1e-3


def test_colors_and_normals_are_the_callers(gltf_viewer, tmp_path):
    model, points, faces = bones_scene()
    red = torch.tensor([1.0, 0, 0]).expand(len(points), 3)
    up = torch.tensor([0.0, 0, 2.0]).expand(len(points), 3)
    viewer = gltf_viewer(save_grid_animation(tmp_path / "a.glb", model, points, faces, colors=red, normals=up).path)
    attributes = viewer.gltf.meshes[0].primitives[0].attributes
    np.testing.assert_allclose(viewer.read(attributes.COLOR_0)[:, :3], red.numpy())
    np.testing.assert_allclose(viewer.read(attributes.NORMAL), up.numpy() / 2)


GRAPH = torch.tensor([[0, 3], [1, 3], [2, 3]])


@pytest.fixture
def tripod():
    ends = torch.tensor([[1.0, 0, 0], [-1, 0.5, 0], [0, 0, 1]], dtype=torch.float64)
    share = torch.linspace(0, 1, 9, dtype=torch.float64)[:, None]
    rest = ends[:, None] * (1 - share)
    lifted = rest + 0.4 * (1 - share) * torch.tensor([0.0, 1.0, 0.0])
    radii = torch.full((3, 3, 9), 0.1)
    return Spine(torch.stack((rest, 0.5 * (rest + lifted), lifted)), GRAPH, radii)


def test_the_joints_lie_on_the_curves_in_every_frame(gltf_viewer, tripod, tmp_path):
    viewer = gltf_viewer(save_spine_animation(tmp_path / "a.glb", tripod, num_joints=5, fps=10.0))
    animation = viewer.gltf.animations[0]
    moves = [channel for channel in animation.channels if channel.target.path == "translation"]
    assert len(moves) == 15
    places = np.stack([viewer.read(animation.samplers[channel.sampler].output) for channel in moves], 1)
    right = tripod(tripod.times).detach()[:, :, ::2].flatten(1, 2).numpy()
    np.testing.assert_allclose(places, right, atol=1e-6)
    times = viewer.read(animation.samplers[0].input)[:, 0]
    np.testing.assert_allclose(times, [0.0, 0.1, 0.2], atol=1e-6)
    assert viewer.gltf.nodes[moves[0].target.node].name == "limb_0_0"


def test_the_surface_hangs_on_the_limb_around_it(tripod, tmp_path):
    ball = unit_sphere(1)
    mesh = type(ball)(torch.cat([0.1 * ball.vertices + end for end in tripod(0.0).detach()[:, 1].float()]),
                      torch.cat([ball.faces + k * ball.num_vertices for k in range(3)]))  # fmt: skip
    rig = load_rig(save_spine_animation(tmp_path / "a.glb", tripod, mesh, num_joints=5))
    own = rig.weights[-mesh.num_vertices :].reshape(3, ball.num_vertices, 3, 5)
    for limb in range(3):
        assert own[limb, :, limb].sum(-1).min() > 0.95
    assert rig.vertices.shape[0] == mesh.num_vertices + 3 * 9 * 8


def test_only_a_surface_makes_it_translucent(tripod, tmp_path):
    gltf = pygltflib.GLTF2().load(str(save_spine_animation(tmp_path / "a.glb", tripod)))
    assert gltf.materials[0].alphaMode == "OPAQUE"
    gltf = pygltflib.GLTF2().load(str(save_spine_animation(tmp_path / "b.glb", tripod, unit_sphere(1))))
    assert gltf.materials[0].alphaMode == "BLEND"


def test_a_scene_is_written_in_the_frames_in_which_its_joints_were_found(gltf_viewer, tmp_path):
    ball, still = unit_sphere(1), torch.eye(4)
    moving = torch.stack([still * torch.nan, se3_exp(torch.tensor([0.3, 0, 0, 0, 0.5, 0])), still])[:, None]
    layers = [
        SkinnedMesh(
            name=name, vertices=ball.vertices + shift, faces=ball.faces, weights=torch.ones(42, 1), paint=paint,
            opacity=opacity, joints=Joints(["base"], [-1], still[None], moving), visible=shift < 5,
        )
        for name, shift, paint, opacity in (
            ("one", 0.0, (1.0, 0.0, 0.0), 1.0), ("two", 3.0, ball.vertices.abs(), 0.5), ("hidden", 9.0, (0.0,) * 3, 1),
        )
    ]  # fmt: skip
    scene = Scene("balls", (*layers, MovingMesh("plain", ball.vertices, ball.faces)), torch.tensor([5.0, 5.5, 7.0]))
    viewer = gltf_viewer(gltf_of_scene(tmp_path / "a.glb", scene))
    np.testing.assert_allclose(viewer.read(viewer.gltf.animations[0].samplers[0].input)[:, 0], [0.5, 2.0])
    for frame in range(2):
        shown = torch.cat([layer.points(frame + 1) for layer in layers[:2]])
        np.testing.assert_allclose(viewer.vertices(frame), shown, atol=1e-5)
    colors = viewer.read(viewer.gltf.meshes[0].primitives[0].attributes.COLOR_0)
    np.testing.assert_allclose(colors[:42], [[1, 0, 0, 1]] * 42)
    np.testing.assert_allclose(colors[42:], np.c_[ball.vertices.abs(), np.full(42, 0.5)], atol=1e-6)


SHAPE, SCAN, SPINE, SCENE = save_shape_animation, save_grid_animation, save_spine_animation, gltf_of_scene


@pytest.mark.parametrize(
    ("save", "change", "message"),
    [
        (SHAPE, {"times": torch.arange(2.0)}, r"times must have shape \(3\), got \(2,\)"),
        (SHAPE, {"poses": torch.zeros(27)}, r"poses must have shape \(T, 27\)"),
        (SHAPE, {"poses": torch.full((3, 27), torch.nan)}, "the shape was never found"),
        (SHAPE, {"path": "a.gif"}, r"path must end in \.glb"),
        (SHAPE, {"fps": -1.0}, "fps must be positive"),
        (SHAPE, {"bare": True}, "skin must have faces"),
        (SCAN, {"hierarchy": "ring"}, "hierarchy must be one of"),
        (SCAN, {"most_weights": 5}, "most_weights must be 4 or 8"),
        (SCAN, {"points": torch.zeros(0, 3)}, "points must hold at least 1"),
        (SCAN, {"poses": torch.eye(4)}, "poses must have shape"),
        (SCAN, {"poses": torch.zeros(0, 6, 4, 4)}, "poses must hold at least one"),
        (SCAN, {"poses": 2 * torch.eye(4).repeat(1, 6, 1, 1)}, "poses must hold rigid motions"),
        (SCAN, {"times": torch.zeros(3)}, "times must have shape"),
        (SCAN, {"path": "a.gltf"}, r"path must end in \.glb"),
        (SPINE, {"path": "a.gltf"}, r"must end in \.glb"),
        (SPINE, {"frame": 3}, "frame must be from 0 to 2"),
        (SPINE, {"num_joints": 1}, "num_joints must be at least 2"),
        (
            SCENE,
            {"scene": Scene("a", (MovingMesh("plain", torch.eye(3), torch.arange(3)[None]),))},
            "joints move, but has plain",
        ),
    ],
)
def test_what_does_not_fit_is_refused(hand, skin, tripod, tmp_path, save, change, message):
    model, points, faces = bones_scene()
    usual = {
        SHAPE: {"shape": hand, "poses": hand.rest_pose().expand(3, -1), "skin": skin},
        SCAN: {"model": model, "points": points, "faces": faces},
        SPINE: {"spine": tripod},
        SCENE: {},
    }
    if change.get("bare"):
        change = {"skin": LinearBlendSkin(hand, skin.points, skin.weights, hand.rest_pose())}
    arguments = {"path": "a.glb"} | usual[save] | change
    with pytest.raises(InputError, match=message):
        save(**(arguments | {"path": tmp_path / arguments["path"]}))
