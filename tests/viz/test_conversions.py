"""Conversions hold the same points, triangles and colors; missing libraries are named with their extra."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import torchreg as tr
from tests.tables import refused
from torchreg.viz import bone_colors

to_open3d, to_pyvista, to_trimesh = tr.to_open3d, tr.to_pyvista, tr.to_trimesh
BALL = tr.TriangleMesh(torch.eye(4, 3), torch.tensor([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]))


class PolyData:
    def __init__(self, points, faces=None, lines=None):
        self.points, self.faces, self.lines = points, faces, lines
        self.point_data, self.cell_data = {}, {}


class Geometry:
    def __init__(self, points, cells=None):
        self.points, self.cells = points, cells


@pytest.fixture
def stand_ins(monkeypatch):
    """Put stand-ins in the place of the large libraries, which the tests do not install."""
    kinds = {name: type(name, (Geometry,), {}) for name in ("TriangleMesh", "PointCloud", "LineSet")}
    vectors = dict.fromkeys(("Vector3dVector", "Vector3iVector", "Vector2iVector"), np.asarray)
    open3d = SimpleNamespace(geometry=SimpleNamespace(**kinds), utility=SimpleNamespace(**vectors))
    monkeypatch.setitem(sys.modules, "open3d", open3d)
    monkeypatch.setitem(sys.modules, "pyvista", SimpleNamespace(PolyData=PolyData))


def test_meshes_and_scans(stand_ins):
    mesh = to_trimesh(BALL)
    np.testing.assert_allclose(mesh.vertices, BALL.vertices)
    np.testing.assert_array_equal(mesh.faces, BALL.faces)
    scan = tr.RangeScan(BALL.vertices, BALL.faces)
    other = to_open3d(scan)
    assert type(other).__name__ == "TriangleMesh"
    np.testing.assert_allclose(other.vertex_normals, scan.normals)
    data = to_pyvista(scan)
    np.testing.assert_array_equal(data.faces.reshape(-1, 4), np.c_[np.full(len(BALL.faces), 3), BALL.faces])
    np.testing.assert_allclose(data.point_data["normals"], scan.normals)


def test_points_and_their_colors(stand_ins):
    cloud = tr.PointCloud(BALL.vertices, colors=BALL.vertices.abs().clamp(0, 1))
    assert to_trimesh(cloud).colors.shape == (len(cloud), 4)
    np.testing.assert_allclose(to_open3d(cloud).colors, cloud.colors, atol=1e-6)
    np.testing.assert_array_equal(to_pyvista(cloud).point_data["rgb"], (255 * cloud.colors).round())
    np.testing.assert_allclose(to_trimesh(BALL.vertices).vertices, BALL.vertices)
    np.testing.assert_allclose(to_pyvista(BALL.vertices.numpy()).points, BALL.vertices)


def test_results(stand_ins, alignment, registration, sequence):
    np.testing.assert_allclose(to_trimesh(alignment).vertices, alignment.registered, atol=1e-6)
    moved = to_trimesh(registration)
    np.testing.assert_allclose(moved.vertices, registration.deformed)
    paint = registration.weights @ bone_colors.bone_palette(3).double()
    np.testing.assert_allclose(moved.visual.vertex_colors[:, :3], 255 * paint, atol=0.6)
    np.testing.assert_allclose(to_open3d(sequence, 1).points, sequence.deformed[1])
    np.testing.assert_allclose(to_open3d(sequence, 1).vertex_colors, paint, atol=1e-6)


def test_curves(stand_ins, spine):
    path = to_trimesh(spine, 2)
    assert len(path.entities) == 3 * 7
    assert path.length == pytest.approx(3.03, abs=0.1)
    lines = to_open3d(spine)
    assert lines.cells.shape == (21, 2)
    np.testing.assert_allclose(lines.colors[0], bone_colors.bone_palette(3)[0], atol=0.003)
    data = to_pyvista(spine.model.skeleton(1.0))
    assert data.lines.reshape(-1, 3)[:, 0].tolist() == [2] * 21
    assert data.cell_data["rgb"].shape == (21, 3)
    tree = tr.Skeleton(torch.eye(3), torch.tensor([[0, 1], [1, 2]]), torch.ones(3))
    assert to_trimesh(tree).length == pytest.approx(2 * 2**0.5)


def test_what_does_not_fit_is_refused(monkeypatch, sequence, spine):
    refused(
        (lambda: to_trimesh(sequence, 2), "frame must be from 0 to 1, got 2"),
        (lambda: to_trimesh(spine, -1), "frame must be from 0 to 2"), error=tr.errors.InputError,
    )  # fmt: skip
    refused((lambda: to_trimesh("mesh.ply"), "got str"), error=tr.errors.InputTypeError)
    for name, convert in (("open3d", to_open3d), ("pyvista", to_pyvista)):
        monkeypatch.setitem(sys.modules, name, None)
        words = rf"pip install 'torchreg-articulated\[{name}\]'"
        refused((lambda convert=convert: convert(BALL), words), error=tr.errors.MissingExtraError)


@pytest.mark.parametrize(("name", "convert"), [("open3d", to_open3d), ("pyvista", to_pyvista)])
def test_the_libraries_themselves_take_it_all(name, convert, registration, spine, alignment):
    pytest.importorskip(name, reason=f"{name} is not installed")
    for value in (BALL, tr.RangeScan(BALL.vertices, BALL.faces), registration, spine, alignment):
        convert(value)
