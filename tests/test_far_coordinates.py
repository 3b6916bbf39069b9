"""Coordinates far from the origin, as in maps: files keep their digits, results know their origin."""

import json

import pytest
import torch

import torchreg as tr
from tests.bodies import QUICK, bent_tube, finger
from torchreg.geometry.far_origin import far_origin
from torchreg.geometry.mesh import unit_sphere
from torchreg.io.points import load_points, save_points
from torchreg.storage import load_pose

MAP = torch.tensor([500213.25, 5400788.5, 312.75], dtype=torch.float64)
SPHERE = unit_sphere(2, dtype=torch.float64)


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


def test_shapes_in_single_precision_keep_the_digits_of_data_far_away():
    shape = finger()
    start, points = shape.rest_pose(), tr.sample_skin(shape, 150)(shape.rest_pose()).detach().double()
    far_start, steps = torch.cat([start[:3] + MAP, start[3:]]), []
    near = tr.align(shape, points, start)
    far = tr.align(shape, points + MAP, far_start, on_step=steps.append)
    tracked = tr.Tracker(shape, far_start).run([points + MAP])
    assert near.origin is None
    assert torch.equal(far.origin, far_origin(points + MAP))
    assert torch.equal(tracked.origin, far.origin)
    for poses in (far.pose, tracked.poses[0], tr.find_pose(shape, points + MAP, num_starts=1).best):
        assert poses.dtype == torch.float64
        torch.testing.assert_close(poses[:3] - MAP, near.pose[:3].double(), atol=2e-3, rtol=0)
    torch.testing.assert_close(far.registered - MAP, near.registered.double(), atol=4e-3, rtol=0)
    torch.testing.assert_close(far.local(start).pose[:3] + far.origin, far.pose[:3], atol=1e-4, rtol=0)
    assert float((steps[-1].pose[..., :3] - MAP).abs().max()) < 1


def test_results_far_away_know_their_origin(arm, tmp_path):
    mesh = arm.surface_mesh(spacing=0.02)
    scans = [tr.RangeScan(points + MAP, faces) for points, faces in (bent_tube(bend, 13, 5) for bend in (0.0, 0.4))]
    pair = tr.register(*scans, 2, 8, QUICK)
    spine = tr.extract_spine([tr.TriangleMesh(mesh.vertices + MAP, mesh.faces)])
    pair.save(tmp_path / "r.safetensors")
    for result, field in ((pair, "deformed"), (tr.load(tmp_path / "r.safetensors"), "deformed"), (spine, "curves")):
        moved = getattr(result.local(), field) + result.origin
        torch.testing.assert_close(moved, getattr(result, field), atol=1e-6, rtol=0)


@pytest.mark.parametrize(("unit", "factor", "name"), [(1000, "0.001", "millimeters"), (100, "0.01", "centimeters")])
def test_data_in_other_units_are_named_with_the_factor(arm, unit, factor, name):
    with pytest.warns(tr.errors.UnitsWarning, match=f"If they are in {name}, load them with scale={factor}"):
        tr.align(arm, arm.surface_mesh().vertices * unit, arm.rest_pose(), config=tr.AlignConfig(search="never"))


def test_a_pose_far_away_is_read_in_the_precision_that_it_needs(plain_hand, tmp_path):
    (tmp_path / "p.json").write_text(json.dumps({"base_x": 5400000.3}))
    (tmp_path / "q.json").write_text(json.dumps({"base_x": 0.3}))
    assert float(load_pose(tmp_path / "p.json", plain_hand)[0]) == 5400000.3
    assert load_pose(tmp_path / "q.json", plain_hand).dtype == torch.float32
    (tmp_path / "r.csv").write_text("frame,base_x,base_y,status\n0,1,2,converged\n1,3,,lost\n")
    assert load_pose(tmp_path / "r.csv", plain_hand)[:2].tolist() == [1, 2]
