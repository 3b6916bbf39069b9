"""What loaders return, every system takes: clouds, scans, meshes, frames."""

import pytest
import torch

import torchreg as tr
from tests.bodies import QUICK
from torchreg.geometry.loaded import as_mesh, as_points, as_scan
from torchreg.io.points import save_points


@pytest.fixture
def loaded(tmp_path, arm):
    mesh = arm.surface_mesh(spacing=0.03)
    path = tmp_path / "arm.ply"
    save_points(path, mesh.vertices, faces=mesh.faces)
    return tr.load_points(path), tr.load_mesh(path), tr.load_scan(path), tr.load_frames(path)[0]


def test_points_scans_and_meshes_of_what_was_loaded(loaded):
    cloud, mesh, scan, points = loaded
    for value in loaded:
        assert torch.equal(as_points(value), points)
    for value in (cloud, mesh, scan):
        assert torch.equal(as_scan(value, "source").points, points)
        assert torch.equal(as_mesh(value, "mesh").faces, mesh.faces)
    with pytest.raises(tr.errors.InputTypeError, match=r"source must be a RangeScan, got Tensor; .* load a file"):
        as_scan(points, "source")
    with pytest.raises(tr.errors.InputTypeError, match="mesh must be a TriangleMesh, got Tensor; load a file with"):
        as_mesh(points, "mesh")
    with pytest.raises(tr.errors.InputTypeError, match="got the points of a RangeScan alone; mesh them first"):
        as_mesh(tr.RangeScan(points), "mesh")


def test_systems_take_them(loaded, arm):
    cloud, mesh, scan, points = loaded
    start = arm.rest_pose()
    wanted = tr.align(arm, points, start).pose
    for value in (cloud, mesh, scan):
        assert torch.equal(tr.align(arm, value, start).pose, wanted)
    tracked = tr.Tracker(arm, start).run([cloud, mesh])
    assert tracked.poses.shape == (2, arm.num_dofs)
    assert torch.equal(tr.skeletonize(cloud).nodes, tr.skeletonize(mesh).nodes)
    assert torch.equal(tr.register(cloud, mesh, 2, 8, QUICK).deformed, tr.register(scan, scan, 2, 8, QUICK).deformed)
