"""Files play in a viewer's own evaluation what shapes, registered bones, spines and scenes of skinned meshes give."""

import numpy as np
import pytest
import torch
import trimesh

import torchreg as tr
from tests.tables import each_row
from torchreg.viz import gltf, scan_gltf, spine_gltf, tracking
from torchreg.viz import scene as sc

SHAPE, SCAN, SPINE, SCENE = (
    gltf.save_shape_animation, scan_gltf.save_grid_animation, spine_gltf.save_spine_animation, gltf.gltf_of_scene,
)  # fmt: skip


def test_the_file_plays_what_the_skin_gives_and_reads_back_as_a_shape(tools, plain_hand, coarse, bend, tmp_path):
    viewer = tools.play(SHAPE(tmp_path / "a.glb", plain_hand, bend, fps=10, skin=coarse))
    np.testing.assert_allclose(viewer.seconds(), np.arange(5) / 10, rtol=1e-6)
    assert viewer.joint_names() == list(plain_hand.part_names)
    for frame in (0, 3):
        np.testing.assert_allclose(viewer.vertices(frame), coarse(bend[frame]), atol=1e-5)
    again = tr.ArticulatedShape.from_gltf(tmp_path / "a.glb")
    assert set(again.part_names) <= set(plain_hand.part_names)
    torch.testing.assert_close(again.surface.vertices.float(), coarse.points, atol=1e-5, rtol=0)


def test_a_track_begins_where_the_shape_was_found(tools, plain_hand, coarse, track, tmp_path):
    times = torch.tensor([-3.0, -2.95, -2.9])
    late = type(track)(**{**vars(track), "times": times})
    viewer = tools.play(tracking.save_track_gltf(tmp_path / "a.glb", plain_hand, late, skin=coarse))
    np.testing.assert_allclose(viewer.seconds(), [0.05, 0.1], atol=1e-6)
    np.testing.assert_allclose(viewer.vertices(0), coarse(track.poses[1]), atol=1e-5)


def test_the_surface_of_a_rig_is_its_own(person, tmp_path):
    again = tr.ArticulatedShape.from_gltf(SHAPE(tmp_path / "a.glb", person, person.rest_pose().expand(2, -1)))
    assert len(again.surface.faces) == len(person.surface.faces)


ARM = """<robot name="arm"><material name="red"><color rgba="1 0 0 1"/></material>
<link name="upper"><visual><origin xyz="0 0 .2"/><geometry><box size=".05 .08 .4"/></geometry>
<material name="red"/></visual></link>
<link name="fore"><visual><origin xyz="0 0 .15"/><geometry><cylinder radius=".03" length=".3"/>
</geometry></visual></link>
<joint name="elbow" type="revolute"><parent link="upper"/><child link="fore"/><origin xyz="0 0 .4"/>
<axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint></robot>"""


def test_links_of_a_robot_are_nodes_in_their_colors(tmp_path):
    (tmp_path / "arm.urdf").write_text(ARM, encoding="utf-8")
    arm = tr.ArticulatedShape.from_urdf(tmp_path / "arm.urdf", free_base=False)
    poses = torch.stack([arm.pose_from_dict({"elbow": angle}) for angle in (0.7, -0.4)])
    # An independent reader, which shows the first frame.
    scene = trimesh.load_scene(SHAPE(tmp_path / "arm.glb", arm, poses, up=(0.0, 0.0, 1.0)))
    assert set(scene.graph.nodes_geometry) == {"upper", "fore"}
    expected = arm.file_skin()(poses[0]).detach()[:, [0, 2, 1]] * torch.tensor([1.0, 1.0, -1.0])
    np.testing.assert_allclose(scene.bounds, torch.stack((expected.amin(0), expected.amax(0))), atol=1e-5)
    colors = {name: mesh.visual.material.baseColorFactor for name, mesh in scene.geometry.items()}
    assert colors["upper"].tolist() == [255, 0, 0, 255]
    assert colors["fore"][0] != 255
    assert len(scene.geometry["upper"].vertices) == 24  # a box, with the normals of its sides


@each_row(
    ("tree", torch.float32, 1e-3), ("flat", torch.float64, 1e3), ("tree", torch.float64, 1.0),
    ("flat", torch.float32, 1.0),
)  # fmt: skip
def test_both_poses_are_those_of_the_model(tools, tmp_path, hierarchy, dtype, scale):
    model, points, faces = tools.bones_scene(bones=4, scale=scale, dtype=dtype)
    written = SCAN(tmp_path / "scan.glb", model, points, faces, hierarchy=hierarchy)
    viewer, size = tools.play(written.path), float((points.amax(0) - points.amin(0)).norm())
    np.testing.assert_allclose(viewer.vertices(0), points, atol=1e-5 * size)
    np.testing.assert_allclose(viewer.vertices(1), model(points).detach(), atol=1e-5 * size)
    assert written.residual < 1e-5 * size
    assert (max(written.parents) >= 0) == (hierarchy == "tree")
    assert viewer.joint_names() == [f"bone_{number}" for number in range(4)]


def test_many_poses_are_played_at_their_times(tools, tmp_path):
    model, points, faces = tools.bones_scene()
    poses = tools.motion(torch.randn(4, 6, 6, generator=torch.Generator().manual_seed(1)))
    times = torch.tensor([0.0, 0.1, 0.5, 2.0])
    viewer = tools.play(SCAN(tmp_path / "a.glb", model, points, faces, poses, times, most_weights=8).path)
    np.testing.assert_allclose(viewer.seconds(), times)
    for frame in range(4):
        np.testing.assert_allclose(viewer.vertices(frame), model(points, poses[frame]).detach(), atol=1e-4)
    several = tr.GridLBS(model.grid, model.weights, poses)
    own = tools.play(SCAN(tmp_path / "b.glb", several, points, faces, most_weights=8).path)
    np.testing.assert_allclose(own.vertices(0), points, atol=1e-5)
    np.testing.assert_allclose(own.vertices(3), viewer.vertices(2), atol=1e-5)


@pytest.mark.parametrize(("up", "axis", "sign"), [((0, 0, 1), 2, 1), ((0, -1, 0), 1, -1), ((1, 0, 0), 0, 1)])
def test_the_upright_axis_is_y_in_the_file(tools, tmp_path, up, axis, sign):
    model, points, faces = tools.bones_scene(bones=3)
    viewer = tools.play(SCAN(tmp_path / "a.glb", model, points, faces, up=up).path)
    for frame, expected in enumerate((points, model(points).detach())):
        shown = viewer.vertices(frame)
        np.testing.assert_allclose(shown[:, 1], sign * expected[:, axis], atol=1e-5)
        np.testing.assert_allclose(np.linalg.norm(shown, axis=1), expected.norm(dim=-1), atol=1e-5)


def test_the_residual_is_the_error_of_dropped_weights_and_of_the_linear_blend(tools, tmp_path):
    cases = {(9, 4): {"smooth": True}, (9, 8): {"smooth": True}, (6, 4): {"blend": "dual_quaternion"}}
    residuals = []
    for (bones, most), settings in cases.items():
        model, points, faces = tools.bones_scene(bones=bones, **settings)
        written = SCAN(tmp_path / "a.glb", model, points, faces, most_weights=most)
        off = np.linalg.norm(tools.play(written.path).vertices(1) - model(points).detach().numpy(), axis=1).max()
        assert written.residual == pytest.approx(off, abs=1e-5)
        residuals.append(off)
    assert 0 < residuals[1] < residuals[0]
    assert residuals[2] > 1e-3


def test_colors_and_normals_are_the_callers(tools, tmp_path):
    model, points, faces = tools.bones_scene()
    red, up = (torch.tensor(row).expand(len(points), 3) for row in ([1.0, 0, 0], [0.0, 0, 2.0]))
    viewer = tools.play(SCAN(tmp_path / "a.glb", model, points, faces, colors=red, normals=up).path)
    np.testing.assert_allclose(viewer.attribute("COLOR_0")[:, :3], red)
    np.testing.assert_allclose(viewer.attribute("NORMAL"), up / 2)


def test_joints_of_spines_lie_on_the_curves_in_every_frame(tools, spine, tmp_path):
    viewer = tools.play(SPINE(tmp_path / "a.glb", spine.model, num_joints=8, fps=10.0))
    animation = viewer.gltf.animations[0]
    moves = [channel for channel in animation.channels if channel.target.path == "translation"]
    places = np.stack([viewer.accessor(animation.samplers[channel.sampler].output) for channel in moves], 1)
    np.testing.assert_allclose(places, spine.curves.flatten(1, 2), atol=1e-6)
    np.testing.assert_allclose(viewer.seconds(), [0.0, 0.1, 0.2], atol=1e-6)
    assert viewer.gltf.nodes[moves[0].target.node].name == "limb_0_0"
    assert viewer.gltf.materials[0].alphaMode == "OPAQUE"


def test_the_surface_of_a_spine_is_translucent_and_hangs_on_the_limb_around_it(tools, spine, tmp_path):
    ball, ends = tools.ball(1), spine.curves[0, :, 1]
    vertices = torch.cat([0.1 * ball.vertices + end for end in ends])
    mesh = tr.TriangleMesh(vertices, torch.cat([ball.faces + k * ball.num_vertices for k in range(3)]))
    viewer = tools.play(SPINE(tmp_path / "a.glb", spine.model, mesh, num_joints=5))
    assert viewer.gltf.materials[0].alphaMode == "BLEND"
    names, count = viewer.joint_names(), len(vertices)
    joints, weights = viewer.attribute("JOINTS_0")[-count:], viewer.attribute("WEIGHTS_0")[-count:]
    own = [names[joint].split("_")[1] for joint in joints.ravel()]
    share = (np.array(own).reshape(joints.shape) == np.repeat(list("012"), ball.num_vertices)[:, None]) * weights
    assert share.sum(1).min() > 0.95


def test_a_scene_is_written_in_the_frames_in_which_its_joints_were_found(tools, tmp_path):
    ball, still = tools.ball(1), torch.eye(4)
    moving = torch.stack([still * torch.nan, tools.motion([0.3, 0, 0, 0, 0.5, 0]).float(), still])[:, None]
    joints = sc.Joints(["base"], [-1], still[None], moving)
    layers = [
        sc.SkinnedMesh(
            name=name, vertices=ball.vertices + shift, faces=ball.faces, weights=torch.ones(42, 1), paint=paint,
            opacity=opacity, joints=joints, visible=shift < 5,
        )
        for name, shift, paint, opacity in (
            ("one", 0.0, (1.0, 0.0, 0.0), 1.0), ("two", 3.0, ball.vertices.abs(), 0.5), ("hidden", 9.0, (0.0,) * 3, 1),
        )
    ]  # fmt: skip
    scene = sc.Scene(
        "balls", (*layers, sc.MovingMesh("plain", ball.vertices, ball.faces)), torch.tensor([5.0, 5.5, 7.0])
    )
    viewer = tools.play(SCENE(tmp_path / "a.glb", scene))
    np.testing.assert_allclose(viewer.seconds(), [0.5, 2.0])
    for frame in range(2):
        shown = torch.cat([layer.points(frame + 1) for layer in layers[:2]])
        np.testing.assert_allclose(viewer.vertices(frame), shown, atol=1e-5)
    colors = viewer.attribute("COLOR_0")
    np.testing.assert_allclose(colors[:42], [[1, 0, 0, 1]] * 42)
    np.testing.assert_allclose(colors[42:], np.c_[ball.vertices.abs(), np.full(42, 0.5)], atol=1e-6)


PLAIN = sc.Scene("a", (sc.MovingMesh("plain", torch.eye(3), torch.arange(3)[None]),))


@each_row(
    (SHAPE, {"times": torch.arange(2.0)}, r"times must have shape \(3\), got \(2,\)"),
    (SHAPE, {"poses": torch.zeros(27)}, r"poses must have shape \(T, 27\)"),
    (SHAPE, {"poses": torch.full((3, 27), torch.nan)}, "the shape was never found"),
    (SHAPE, {"path": "a.gif"}, r"path must end in \.glb"),
    (SHAPE, {"fps": -1.0}, "fps must be positive"),
    (SHAPE, {"skin": None}, "skin must have faces"),
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
    (SCENE, {"scene": PLAIN}, "joints move, but has plain"),
)
def test_bad_arguments_are_refused(tools, plain_hand, plain_hand_skin, coarse, spine, tmp_path, save, change, message):
    usual = {
        SHAPE: {"shape": plain_hand, "poses": plain_hand.rest_pose().expand(3, -1), "skin": coarse},
        SCAN: dict(zip(("model", "points", "faces"), tools.bones_scene(), strict=True)),
        SPINE: {"spine": spine.model},
        SCENE: {},
    }
    if "skin" in change:
        change = {"skin": plain_hand_skin}
    arguments = {"path": "a.glb"} | usual[save] | change
    with pytest.raises(tr.errors.InputError, match=message):
        save(**(arguments | {"path": tmp_path / arguments["path"]}))
