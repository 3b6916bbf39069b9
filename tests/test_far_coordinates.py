"""Coordinates far from the origin, as in maps: every system finds there what it finds near the origin."""

import json

import numpy as np
import pytest
import torch

import torchreg as tr
from torchreg.alignment.pose_initializer import PoseInitializer
from torchreg.alignment.pseudo_labels import label_frames
from torchreg.errors import UnitsWarning
from torchreg.geometry.far_origin import far_origin
from torchreg.geometry.mesh import TriangleMesh, sample_surface, unit_sphere
from torchreg.io.points import load_points, save_points

MAP = torch.tensor([500213.25, 5400788.5, 312.75], dtype=torch.float64)
SPHERE = unit_sphere(2, dtype=torch.float64)


@pytest.fixture(scope="module")
def body():
    """A body with an arm on one hinge, in single precision, whose base moves."""
    return tr.Hand().requires_grad_(False)


def test_only_double_precision_far_away_has_an_origin():
    points = SPHERE.vertices
    assert far_origin(points) is None
    assert far_origin(points + 100) is None
    assert far_origin((points + MAP).float()) is None
    assert torch.equal(far_origin(points + MAP), torch.tensor([500213.0, 5400788.0, 313.0], dtype=torch.float64))
    strays = torch.cat([points + MAP, torch.zeros(3, 3)])
    assert far_origin(strays) is not None
    assert far_origin(torch.full((4, 3), 5e6, dtype=torch.float64)) is None


@pytest.mark.parametrize("ending", ["ply", "xyz", "csv", "npz", "pcd"])
@pytest.mark.parametrize("scale", [1.0, 0.001])
def test_files_are_read_in_the_precision_that_they_need(tmp_path, ending, scale):
    path = tmp_path / f"a.{ending}"
    save_points(path, SPHERE.vertices + MAP)
    cloud = load_points(path, scale=scale)
    assert cloud.points.dtype == torch.float64
    torch.testing.assert_close(cloud.points, (SPHERE.vertices + MAP) * scale, rtol=0, atol=1e-9)
    save_points(path, SPHERE.vertices)
    assert load_points(path, scale=scale).points.dtype == torch.float32


def test_scans_and_frames_keep_their_digits(tmp_path):
    for number in range(3):
        save_points(tmp_path / f"f{number}.ply", SPHERE.vertices + MAP + 0.1 * number)
    means = [cloud.mean(0) for cloud in tr.load_frames(tmp_path)]
    torch.testing.assert_close(means[1] - means[0], torch.full((3,), 0.1).double(), atol=1e-6, rtol=0)
    near, far = tr.RangeScan(SPHERE.vertices), tr.load_scan(tmp_path / "f0.ply")
    torch.testing.assert_close(far.points - MAP, near.points, atol=1e-8, rtol=0)
    # Which neighbors a normal comes from may change where several are equally near.
    torch.testing.assert_close(far.normals, near.normals, atol=5e-3, rtol=0)
    assert far.spacing == pytest.approx(near.spacing, rel=1e-6)


@pytest.fixture(scope="module")
def hand_cloud(body):
    generator = torch.Generator().manual_seed(0)
    pose = body.rest_pose().double()
    pose[3:6] = torch.tensor([0.3, -0.2, 0.1])
    mesh = body.surface_mesh()
    points = sample_surface(mesh, 400, generator)[0].double()
    turn = torch.linalg.matrix_exp(torch.tensor([[0, -0.1, -0.2], [0.1, 0, -0.3], [0.2, 0.3, 0]], dtype=torch.float64))
    return points @ turn.T, turn


def test_aligning_and_searching_far_away(body, hand_cloud):
    points, _ = hand_cloud
    start = body.rest_pose()
    near = tr.align(body, points, start)
    far_start = torch.cat([start[:3].double() + MAP, start[3:].double()])
    seen = []
    far = tr.align(body, points + MAP, far_start, on_step=seen.append)
    assert near.origin is None
    assert far.pose.dtype == torch.float64
    torch.testing.assert_close(far.pose[:3] - MAP, near.pose[:3].double(), atol=2e-3, rtol=0)
    torch.testing.assert_close(far.registered - MAP, near.registered.double(), atol=4e-3, rtol=0)
    torch.testing.assert_close(far.local(start).pose[:3].double() + far.origin, far.pose[:3], atol=1e-4, rtol=0)
    assert float((seen[-1].pose[..., :3] - MAP).abs().max()) < 1
    found = tr.find_pose(body, points + MAP, num_starts=1).best
    torch.testing.assert_close(found[:3] - MAP, near.pose[:3].double(), atol=0.02, rtol=0)


def test_aligning_without_a_start_searches(body, hand_cloud):
    points, _ = hand_cloud
    half = torch.diag(torch.tensor([-1.0, 1, -1])).double()
    result = tr.align(body, points @ half + torch.tensor([1.0, 2, 3]), None)
    assert result.status.usable
    assert float(result.inliers.double().mean()) > 0.9
    rest = tr.align(body, points @ half + torch.tensor([1.0, 2, 3]), body.rest_pose())
    assert float(result.cost) <= float(rest.cost) + 1


def test_tracking_and_labeling_far_away(body, hand_cloud):
    points, _ = hand_cloud
    start = tr.align(body, points, body.rest_pose()).pose
    frames = [points + 0.004 * number for number in range(2)]
    near = tr.Tracker(body, start).run(frames)
    far_start = torch.cat([start[:3].double() + MAP, start[3:].double()])
    tracker = tr.Tracker(body, far_start)
    far = tracker.run([frame + MAP for frame in frames])
    assert torch.equal(far.origin, far_origin(frames[0] + MAP))
    torch.testing.assert_close(far.poses[:, :3] - MAP, near.poses[:, :3].double(), atol=3e-3, rtol=0)
    torch.testing.assert_close(far.keypoints - MAP, near.keypoints.double(), atol=5e-3, rtol=0)
    label = next(iter(label_frames(PoseInitializer(body), [points + MAP], start=far_start)))
    torch.testing.assert_close(label.points, points + MAP, atol=1e-5, rtol=0)
    torch.testing.assert_close(label.pose[:3] - MAP, near.poses[0, :3].double(), atol=5e-3, rtol=0)


def bent_tube(bend):
    """The upper side of a tube that bends in its middle."""
    along, around = np.meshgrid(np.linspace(0, 1.2, 25), np.linspace(0.2, np.pi - 0.2, 9), indexing="ij")
    angle = bend * np.clip((along - 0.6) / 0.1, 0, 1)
    steps = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], -1) * 0.05
    middle = np.cumsum(steps, 0) - steps
    radius = 0.12 * (1 + 0.25 * np.sin(6 * along))
    side = np.stack([np.cos(angle), 0 * angle, -np.sin(angle)], -1) * np.cos(around)[..., None]
    points = middle + radius[..., None] * (side + np.array([0, 0.7, 0]) * np.sin(around)[..., None])
    index = np.arange(25 * 9).reshape(25, 9)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return torch.from_numpy(points.reshape(-1, 3)), torch.from_numpy(faces)


def test_registering_far_away(tmp_path):
    (source, faces), (target, _) = bent_tube(0.0), bent_tube(0.4)
    near = tr.register(tr.RangeScan(source, faces), tr.RangeScan(target, faces), 3, 20)
    far = tr.register(tr.RangeScan(source + MAP, faces), tr.RangeScan(target + MAP, faces), 3, 20)
    torch.testing.assert_close(far.deformed - MAP, near.deformed, atol=5e-3, rtol=0)
    torch.testing.assert_close(far.model(far.points), far.deformed, atol=1e-6, rtol=0)
    torch.testing.assert_close(far.local().deformed + far.origin, far.deformed, atol=1e-8, rtol=0)
    far.save(tmp_path / "r.safetensors")
    again = tr.load(tmp_path / "r.safetensors")
    assert torch.equal(again.origin, far.origin)
    assert torch.equal(again.deformed, far.deformed)


def test_scans_in_other_units_are_told():
    (source, faces), (target, _) = bent_tube(0.0), bent_tube(0.4)
    with pytest.warns(
        UnitsWarning, match=r"target is 10\d\d times as large as source.* load target with a scale of 0\.001"
    ):
        tr.register(tr.RangeScan(source, faces), tr.RangeScan(1000 * target, faces), 3, 20)


@pytest.mark.parametrize(("unit", "factor", "name"), [(1000, "0.001", "millimeters"), (100, "0.01", "centimeters")])
def test_data_in_other_units_are_told_with_the_factor(body, hand_cloud, unit, factor, name):
    with pytest.warns(UnitsWarning, match=f"If they are in {name}, load them with scale={factor}"):
        tr.align(body, hand_cloud[0] * unit, body.rest_pose(), config=tr.AlignConfig(search="never"))


def test_spines_far_away():
    mesh = TriangleMesh(*bent_closed_tube())
    near = tr.skeletonize(mesh)
    far = tr.skeletonize(TriangleMesh(mesh.vertices + MAP, mesh.faces))
    torch.testing.assert_close(far.nodes - MAP, near.nodes, atol=1e-6, rtol=0)
    meshes = [TriangleMesh(mesh.vertices + 0.01 * k, mesh.faces) for k in range(2)]
    first = tr.extract_spine(meshes, workers=1)
    moved = tr.extract_spine([TriangleMesh(m.vertices + MAP, m.faces) for m in meshes], workers=1)
    torch.testing.assert_close(moved.curves - MAP, first.curves, atol=1e-6, rtol=0)
    torch.testing.assert_close(moved.model(moved.times), moved.curves, atol=1e-6, rtol=0)
    torch.testing.assert_close(moved.local().curves, first.curves - (moved.origin - MAP), atol=1e-6, rtol=0)


def bent_closed_tube():
    points, faces = bent_tube(0.4)
    below = points * torch.tensor([1.0, -1, 1])
    # The upper side and its mirror image, sewn along both sides and closed at the ends.
    index = torch.arange(25 * 9).reshape(25, 9)
    count = len(points)
    strips = []
    for side in (0, 8):
        a, d = index[:-1, side], index[1:, side]
        strips += [torch.stack([a, d, a + count], -1), torch.stack([d, d + count, a + count], -1)]
    for end in (0, 24):
        a, b = index[end, :-1], index[end, 1:]
        strips += [torch.stack([a, b, a + count], -1), torch.stack([b, b + count, a + count], -1)]
    return torch.cat([points, below]), torch.cat([faces, faces.flip(1) + count, *strips])


def test_a_pose_far_away_is_read_in_the_precision_that_it_needs(body, tmp_path):
    from torchreg.storage import load_pose

    (tmp_path / "p.json").write_text(json.dumps({"base_x": 5400000.3}))
    (tmp_path / "q.json").write_text(json.dumps({"base_x": 0.3}))
    assert float(load_pose(tmp_path / "p.json", body)[0]) == 5400000.3
    assert load_pose(tmp_path / "q.json", body).dtype == torch.float32
    (tmp_path / "r.csv").write_text("frame,base_x,base_y,status\n0,1,2,converged\n1,3,,lost\n")
    assert load_pose(tmp_path / "r.csv", body)[:2].tolist() == [1, 2]
