"""Range scans from files: what the file holds is kept, the rest computed, and damage is named."""

import pytest
import torch
import trimesh

from torchreg.errors import FormatError, InputError
from torchreg.geometry.mesh import unit_sphere
from torchreg.geometry.range_scan import RangeScan
from torchreg.io.points import save_points
from torchreg.io.scans import load_scan

SPHERE = unit_sphere(2, dtype=torch.float64)


@pytest.mark.parametrize("ending", ["ply", "npz", "obj", "stl", "glb"])
def test_faces_are_kept(tmp_path, ending):
    path = tmp_path / f"scan.{ending}"
    if ending in ("ply", "npz"):
        save_points(path, SPHERE.vertices, faces=SPHERE.faces)
    else:
        trimesh.Trimesh(SPHERE.vertices.numpy(), SPHERE.faces.numpy(), process=False).export(path)
    scan = load_scan(path)
    assert scan.points.dtype == torch.float32
    torch.testing.assert_close(scan.points[scan.faces], SPHERE.vertices.float()[SPHERE.faces])
    assert float((scan.normals * scan.points).sum(-1).min()) > 0.99
    assert not bool(scan.boundary.any())


@pytest.mark.parametrize("ending", ["ply", "npz", "pcd", "xyz"])
def test_normals_are_kept(tmp_path, ending):
    path = tmp_path / f"scan.{ending}"
    normals = torch.nn.functional.normalize(SPHERE.vertices + torch.tensor([0.0, 0.0, 3.0]), dim=-1)
    save_points(path, SPHERE.vertices, normals)
    scan = load_scan(str(path), dtype=torch.float64)
    torch.testing.assert_close(scan.normals, normals)
    assert scan.faces is None


@pytest.mark.parametrize("ending", ["ply", "npz", "pcd", "xyz", "txt"])
def test_bare_points_become_a_scan(tmp_path, ending):
    path = tmp_path / f"scan.{ending}"
    save_points(path, SPHERE.vertices)
    scan = load_scan(path, dtype=torch.float64)
    torch.testing.assert_close(scan.normals, RangeScan(SPHERE.vertices).normals)
    inside = load_scan(path, viewpoint=[0.0, 0.0, 0.0])
    assert float((inside.normals * inside.points).sum(-1).max()) < -0.9


def test_rows_without_a_measurement_are_dropped_where_asked(tmp_path):
    path = tmp_path / "scan.xyz"
    path.write_text("0 0 0\nnan nan nan\n1 0 0\n0 1 0\n1 1 0\n")
    assert len(load_scan(path, nan_policy="omit")) == 4
    with pytest.raises(FormatError, match="1 of 5 points are not finite"):
        load_scan(path)


@pytest.mark.parametrize("text", ["0 0 0\n1 0 0\n", "1 2 3\n" * 9])
def test_too_few_places_name_the_file(tmp_path, text):
    path = tmp_path / "tiny.xyz"
    path.write_text(text)
    with pytest.raises(FormatError, match=r"tiny.xyz: a scan needs points at 3 places or more, it holds \d points"):
        load_scan(path)


def test_what_is_not_there_and_no_viewpoint(tmp_path):
    with pytest.raises(FileNotFoundError):
        load_scan(tmp_path / "absent.ply")
    path = tmp_path / "scan.ply"
    save_points(path, SPHERE.vertices)
    with pytest.raises(InputError, match="viewpoint must be finite"):
        load_scan(path, viewpoint=[0.0, float("nan"), 0.0])
