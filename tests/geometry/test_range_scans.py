"""Range scans: normals and boundary against trimesh and known shapes, subsets, motions, depth images, bad input."""

import math

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from tests.geometry.draws import D, rand, seeded, sheet_faces
from torchreg.geometry.graphs import connected_components
from torchreg.geometry.mesh import TriangleMesh, unit_sphere
from torchreg.geometry.range_scan import RangeScan
from torchreg.geometry.rigid import rigid_matrix
from torchreg.geometry.rotation import so3_exp
from torchreg.geometry.scan_clusters import clustered_scan
from torchreg.geometry.visibility import aim, rasterize

ELLIPSOID = torch.tensor([1.0, 0.6, 0.8])


def sheet(height=12, width=15):
    """A bent grid of points, and its triangles, counter-clockwise from above."""
    y, x = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    points = torch.stack((x, y, -0.02 * ((x - 7) ** 2 + (y - 5) ** 2)), dim=-1)
    return points.reshape(-1, 3), sheet_faces(height, width)


def check_same(scan, other, tolerance=1e-9):
    torch.testing.assert_close(scan.points, other.points, atol=tolerance, rtol=0)
    torch.testing.assert_close(scan.normals, other.normals, atol=1e-6, rtol=0)
    assert torch.equal(scan.boundary, other.boundary)
    assert scan.spacing == pytest.approx(other.spacing, rel=1e-6)
    assert scan.diagonal == pytest.approx(other.diagonal, rel=1e-6)


def test_normals_and_boundary_of_faces_are_those_of_trimesh():
    points, faces = sheet()
    faces = faces[torch.rand(len(faces), generator=seeded()) > 0.1]
    scan, mesh = RangeScan(points, faces), trimesh.Trimesh(points.numpy(), faces.numpy(), process=False)
    used = np.unique(mesh.faces)
    np.testing.assert_allclose(scan.normals[used], mesh.vertex_normals[used], atol=1e-6)
    single = mesh.edges_sorted[trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)]
    wanted = np.isin(np.arange(len(points)), single) | ~np.isin(np.arange(len(points)), used)
    np.testing.assert_array_equal(scan.boundary, wanted)
    np.testing.assert_allclose(scan.diagonal, np.linalg.norm(np.ptp(points.numpy(), axis=0)))
    near = cKDTree(points.numpy()).query(points.numpy(), 2)[0][:, 1]
    assert scan.spacing == pytest.approx(np.median(near))


def test_points_alone_give_nearly_what_faces_give_and_a_viewpoint_turns_both():
    points, faces = sheet()
    scan, bare = RangeScan(points, faces), RangeScan(points)
    rim = (points[:, 0] % 14 == 0) | (points[:, 1] % 11 == 0)
    assert torch.equal(scan.boundary, rim)
    assert torch.equal(bare.boundary, rim)
    assert float((scan.normals * bare.normals).sum(-1).min()) > 0.97
    assert (bare.faces, bare.viewpoint, bare.spacing) == (None, None, scan.spacing)
    below = torch.tensor([7.0, 5.0, -50.0])
    for shape in (faces, None):
        turned = RangeScan(points, shape, viewpoint=below)
        torch.testing.assert_close(turned.normals, -RangeScan(points, shape).normals)
        assert torch.equal(turned.viewpoint, below.double())


def test_a_hole_and_its_rim_without_faces():
    points = torch.rand(4000, 3, generator=seeded()) * torch.tensor([2.0, 2.0, 0.0])
    radius = (points[:, :2] - 1).norm(dim=-1)
    scan, from_hole = RangeScan(points[radius > 0.3]), radius[radius > 0.3] - 0.3
    middle = (scan.points[:, :2] - 1).abs().amax(dim=-1) < 0.85
    assert float(scan.boundary[(from_hole < 0.3 * scan.spacing)].double().mean()) > 0.6
    assert float(scan.boundary[(from_hole > 4 * scan.spacing) & middle].double().mean()) < 0.01


def test_another_surface_close_behind_does_not_hide_the_rim():
    points, _ = sheet()
    behind = points * torch.tensor([1.0, 1.0, 0.0]) + torch.tensor([0.3, 0.4, -6.0])
    half = points[:, 0] < 7
    scan = RangeScan(torch.cat((points[half], behind)))
    assert bool(scan.boundary[: int(half.sum())][points[half][:, 0] == 6].all())


@pytest.mark.parametrize("with_faces", [True, False])
def test_given_normals_of_random_sign_are_oriented(with_faces):
    points, faces = sheet()
    right = RangeScan(points, faces).normals
    signs = torch.where(torch.rand(len(points), 1, generator=seeded()) < 0.5, -1.0, 1.0)
    torch.testing.assert_close(RangeScan(points, faces if with_faces else None, right * signs).normals, right)


def test_zero_normals_and_points_without_faces_are_estimated():
    points, faces = sheet()
    right = RangeScan(points, faces).normals
    some = right.clone()
    some[::7] = 0
    assert float((RangeScan(points, faces, -some).normals * right).sum(-1).max()) < -0.97
    lonely = torch.cat((points, torch.tensor([[3.4, 3.4, -0.35]], dtype=torch.float64)))
    scan = RangeScan(lonely, faces)
    assert float(scan.normals[-1] @ right[3 * 15 + 3]) > 0.97
    assert bool(scan.boundary[-1])
    none = RangeScan(points, normals=torch.zeros_like(points))
    torch.testing.assert_close(none.normals, RangeScan(points).normals, atol=1e-3, rtol=0)


def test_triangles_that_share_places_but_no_indices_are_one_surface():
    points, faces = sheet()
    scan = RangeScan(points, faces)
    soup = RangeScan(points[faces].reshape(-1, 3), torch.arange(3 * len(faces)).reshape(-1, 3))
    torch.testing.assert_close(soup.normals, scan.normals[faces].reshape(-1, 3))
    assert torch.equal(soup.boundary, scan.boundary[faces].reshape(-1))
    assert soup.spacing == pytest.approx(scan.spacing)


def test_degenerate_doubled_and_turned_faces_change_nothing():
    points, faces = sheet()
    scan, bare = RangeScan(points, faces), RangeScan(points)
    bad = torch.cat((faces, faces[:9], faces[20:24].flip(-1), torch.tensor([[4, 4, 9], [7, 7, 7]])))
    check_same(RangeScan(points, bad), scan)
    turned = faces.clone()
    turned[::5] = turned[::5].flip(-1)
    check_same(RangeScan(points.float(), turned.int()).to(D), scan, 1e-6)
    assert RangeScan(points, faces[:0]).faces is None
    check_same(RangeScan(points, faces[:0]), bare)
    flat = RangeScan(points, torch.tensor([[0, 0, 1]]))
    torch.testing.assert_close(flat.normals, bare.normals, atol=1e-3, rtol=0)
    for scan in (flat, RangeScan(torch.eye(3)), RangeScan(torch.eye(3), torch.tensor([[0, 1, 2]]))):
        assert bool(scan.boundary.all())
    torch.testing.assert_close(scan.normals, torch.full((3, 3), 3**-0.5))
    line = RangeScan(torch.arange(30.0).reshape(10, 3))
    assert bool(line.boundary.all())
    torch.testing.assert_close(line.normals.norm(dim=-1), torch.ones(10))


@settings(max_examples=10, deadline=None)
@given(
    turn=st.lists(st.floats(-3, 3), min_size=3, max_size=3),
    scale=st.sampled_from([1e-3, 1.0, 1e3]),
    with_faces=st.booleans(),
    seed=st.integers(0, 99),
)
def test_a_moved_scan_is_the_scan_of_moved_points_in_any_order(turn, scale, with_faces, seed):
    points, faces = sheet()
    shaken, order = points + 0.1 * rand(*points.shape, seed=seed), torch.randperm(len(points), generator=seeded(seed))
    scan = RangeScan(shaken, faces if with_faces else None, viewpoint=torch.tensor([0.0, 0, 90]))
    rotation = so3_exp(torch.tensor(turn, dtype=D))
    motion = rigid_matrix(scale * rotation, torch.tensor([1.0, -2.0, 3.0], dtype=D))
    moved = scan.transformed(motion)
    torch.testing.assert_close(moved.viewpoint, scale * (rotation @ scan.viewpoint) + motion[:3, 3])
    torch.testing.assert_close(moved.points, scale * scan.points @ rotation.mT + motion[:3, 3])
    direct = RangeScan(moved.points[order], order.argsort()[faces] if with_faces else None, viewpoint=moved.viewpoint)
    torch.testing.assert_close(direct.normals, moved.normals[order], atol=1e-6, rtol=0)
    assert torch.equal(direct.boundary, moved.boundary[order])
    assert (direct.spacing, direct.diagonal) == pytest.approx((moved.spacing, moved.diagonal), rel=1e-6)


def test_subsample_by_count_or_spacing():
    scan = RangeScan(*sheet())
    few, wide = scan.uniform_subsample(40), scan.uniform_subsample(spacing=3.0)
    assert len(few.unique()) == 40
    for index, least in ((few, 1.4), (wide, 3.0)):
        assert float(torch.cdist(scan.points[index], scan.points[index]).fill_diagonal_(torch.inf).min()) > least
    assert torch.equal(scan.uniform_subsample(10**6), torch.arange(180))
    other = scan.uniform_subsample(40, generator=seeded(3))
    assert not torch.equal(other, few)
    assert torch.equal(other, scan.uniform_subsample(40, generator=seeded(3)))
    # What is returned again cannot be spoilt.
    expected = few.clone()
    few.zero_()
    assert torch.equal(scan.uniform_subsample(40), expected)


def test_subset_keeps_normals_and_the_faces_among_the_points():
    points, faces = sheet()
    scan, left = RangeScan(points, faces, viewpoint=torch.tensor([0.0, 0, 9])), points[:, 0] < 6.5
    part, cut = scan.subset(left), scan.subset(left, mark_cut=True)
    check_same(scan.subset(left.nonzero()[:, 0]), part)
    torch.testing.assert_close(part.normals, scan.normals[left])
    assert torch.equal(part.boundary, scan.boundary[left])
    assert torch.equal(part.viewpoint, scan.viewpoint)
    assert part.diagonal == pytest.approx(RangeScan(points[left]).diagonal)
    assert torch.equal(part.points[part.faces], points[faces[left[faces].all(dim=-1)]])
    check_same(scan.subset(torch.ones(180, dtype=torch.bool), mark_cut=True), scan)
    assert torch.equal(cut.boundary, RangeScan(cut.points, cut.faces).boundary)
    assert torch.equal(RangeScan(points).subset(left, mark_cut=True).boundary, cut.boundary)
    few = scan.subset(scan.uniform_subsample(20))
    assert few.faces is None
    assert few.spacing > 1.5 * scan.spacing


def rendered(camera):
    """The depth image of an ellipsoid in front of a wall, its intrinsics and its camera's pose."""
    sphere = unit_sphere(4, dtype=D)
    mesh = TriangleMesh(sphere.vertices * ELLIPSOID, sphere.faces)
    view = aim(mesh.vertices, torch.tensor(camera), size=160)
    depth = rasterize(mesh, view).depth
    focal, center = 1 / view.pitch, (-view.corner / view.pitch - 0.5).tolist()
    return depth.nan_to_num(posinf=12.0), (focal, focal, *center), rigid_matrix(view.rotation.mT, view.position)


@pytest.mark.parametrize("camera", [(0.0, 0.0, -6.0), (4.0, -3.0, 2.0)])
def test_a_rendered_depth_image_gives_the_surface_back(camera):
    depth, intrinsics, world = rendered(camera)
    scan = RangeScan.from_depth(depth, intrinsics, world)
    torch.testing.assert_close(scan.viewpoint, world[:3, 3])
    body = ((scan.points - world[:3, 3]) @ world[:3, :3])[:, 2] < 11
    # On the ellipsoid, but for its facets.
    assert float(((scan.points / ELLIPSOID).norm(dim=-1)[body] - 1).abs().max()) < 0.01
    assert bool((body[scan.faces].all(-1) | ~body[scan.faces].any(-1)).all())
    assert float(body.double().mean()) > 0.5
    assert float((scan.normals * (world[:3, 3] - scan.points)).sum(-1).min()) > 0
    right = torch.nn.functional.normalize(scan.points / ELLIPSOID**2, dim=-1)
    assert float((scan.normals * right).sum(-1)[body & ~scan.boundary].min()) > 0.9
    assert 0 < float(scan.boundary[body].double().mean()) < 0.06


def test_depth_without_a_pose_and_in_integers():
    scan = RangeScan.from_depth(np.full((6, 8), 1000, dtype=np.int32), (500.0, 500.0, 3.5, 2.5))
    assert (len(scan), scan.spacing, int(scan.boundary.sum())) == (48, pytest.approx(2.0), 24)
    torch.testing.assert_close(scan.normals, torch.tensor([[0.0, 0, -1]]).expand(48, 3))
    assert scan.viewpoint.tolist() == [0, 0, 0]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_on_a_graphics_card():
    points, faces = sheet()
    for shape in (faces, None):
        scan = RangeScan(points.cuda(), None if shape is None else shape.cuda())
        check_same(scan.to("cpu"), RangeScan(points, shape))
        assert scan.uniform_subsample(20).is_cuda
        assert scan.subset(scan.boundary, mark_cut=True).normals.is_cuda
    assert RangeScan.from_depth(torch.ones(5, 5).cuda(), (5.0, 5.0, 2.0, 2.0)).boundary.is_cuda


@pytest.mark.parametrize("first", [0, 3])
def test_the_first_point_at_a_cut_is_on_the_boundary_too(first):
    """Of a fan around point 0, one triangle is cut away: both of its points that are left end at the cut."""
    turns = torch.arange(6) * math.pi / 3
    ring = torch.stack([turns.cos(), turns.sin(), 0.1 * turns.sin()], dim=-1)
    order = torch.arange(7).roll(-first)
    index = order.argsort()
    faces = index[torch.tensor([[0, 1 + k, 1 + (k + 1) % 6] for k in range(6)])]
    scan = RangeScan(torch.cat([torch.zeros(1, 3), ring])[order], faces)
    left = torch.ones(7, dtype=torch.bool)
    left[index[4]] = False
    cut = scan.replaced(boundary=torch.zeros(7, dtype=torch.bool)).subset(left, mark_cut=True)
    assert {0, 3, 5} <= set(order[left][cut.boundary].tolist()) <= {0, 2, 3, 4, 5, 6}


@pytest.mark.parametrize("with_faces", [True, False])
@pytest.mark.parametrize("cut", [True, False])
def test_few_points_stand_for_many_near_them_that_face_the_same_way(with_faces, cut):
    ball = unit_sphere(5, dtype=torch.float64)
    thin = TriangleMesh(ball.vertices * torch.tensor([1.0, 1.0, 0.02], dtype=torch.float64), ball.faces)
    scan = RangeScan(thin.vertices, thin.faces, ball.vertices)
    scan = scan.subset(thin.vertices[:, 0] < 0.5) if cut else scan
    scan = scan if with_faces else RangeScan(scan.points, None, scan.normals)
    few, index, cluster = clustered_scan(scan, 500)
    assert 250 <= len(few) <= 1000
    for name in ("points", "normals", "boundary"):
        assert torch.equal(getattr(few, name), getattr(scan, name)[index])
    assert torch.equal(cluster[index], torch.arange(len(few)))
    apart = (few.points[cluster] - scan.points).norm(dim=1)
    assert float(apart.max()) < 5 * few.spacing
    assert float((few.normals[cluster] * scan.normals).sum(1).amin()) > -0.5
    assert few.spacing > 1.5 * scan.spacing
    assert bool(few.boundary.any()) == bool(scan.boundary.any())
    if with_faces:
        assert few.faces is not None
        assert not bool((few.normals[few.faces[:, 0]] * few.normals[few.faces[:, 1]]).sum(1).lt(-0.9).any())
        piece = connected_components(torch.cat((few.faces[:, :2], few.faces[:, 1:])), len(few))
        assert float((piece == piece.mode().values).double().mean()) > 0.99
    same, every, _ = clustered_scan(scan, len(scan) // 2 + 1)
    assert same is scan
    assert torch.equal(every, torch.arange(len(scan)))
