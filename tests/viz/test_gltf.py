import numpy as np
import pytest
import torch
import trimesh

from torchreg.datasets.hand import hand_motion, surface_skin
from torchreg.errors import InputError
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.hand import Hand
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.viz.gltf import save_shape_animation


@pytest.fixture(scope="module")
def hand():
    return Hand()


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


def test_save_shape_animation_refuses(hand, skin, tmp_path):
    poses = hand.rest_pose().expand(3, -1)
    with pytest.raises(InputError, match=r"times must have shape \(3\), got \(2,\)"):
        save_shape_animation(tmp_path / "a.glb", hand, poses, torch.arange(2.0), skin=skin)
    with pytest.raises(InputError, match=r"poses must have shape \(T, 27\)"):
        save_shape_animation(tmp_path / "a.glb", hand, poses[0], skin=skin)
    with pytest.raises(InputError, match=r"path must end in \.glb"):
        save_shape_animation(tmp_path / "a.gif", hand, poses, skin=skin)
    with pytest.raises(InputError, match="fps must be positive"):
        save_shape_animation(tmp_path / "a.glb", hand, poses, fps=-1.0, skin=skin)
    bare = LinearBlendSkin(hand, skin.points, skin.weights, hand.rest_pose())
    with pytest.raises(InputError, match="skin must have faces"):
        save_shape_animation(tmp_path / "a.glb", hand, poses, skin=bare)
