"""Range scans: normals and boundary against trimesh and known shapes, subsets, motions, depth images, bad input."""

import math

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from torchreg.geometry.graphs import connected_components
from torchreg.geometry.mesh import TriangleMesh, unit_sphere
from torchreg.geometry.range_scan import RangeScan
from torchreg.geometry.rigid import rigid_matrix
from torchreg.geometry.rotation import so3_exp
from torchreg.geometry.scan_clusters import clustered_scan
from torchreg.geometry.visibility import aim, rasterize


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def sheet(height=12, width=15, dtype=torch.float64):
    """A bent grid of points, and its triangles, counter-clockwise from above."""
    row, column = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    x, y = column.reshape(-1).to(dtype), row.reshape(-1).to(dtype)
    points = torch.stack((x, y, -0.02 * ((x - 7) ** 2 + (y - 5) ** 2)), dim=-1)
    a = (row * width + column)[:-1, :-1].reshape(-1)
    b, c, d = a + 1, a + width, a + width + 1
    return points, torch.cat((torch.stack((a, b, d), -1), torch.stack((a, d, c), -1)))


def rim(height=12, width=15):
    mask = torch.zeros(height, width, dtype=torch.bool)
    mask[0], mask[-1], mask[:, 0], mask[:, -1] = True, True, True, True
    return mask.reshape(-1)


def as_trimesh(points, faces):
    return trimesh.Trimesh(points.numpy(), faces.numpy(), process=False)


def check_same(scan, other, tolerance=1e-9):
    torch.testing.assert_close(scan.points, other.points, atol=tolerance, rtol=0)
    torch.testing.assert_close(scan.normals, other.normals, atol=1e-6, rtol=0)
    assert torch.equal(scan.boundary, other.boundary)
    assert scan.spacing == pytest.approx(other.spacing, rel=1e-6)
    assert scan.diagonal == pytest.approx(other.diagonal, rel=1e-6)


def test_normals_and_boundary_of_faces_are_those_of_trimesh():
    points, faces = sheet()
    keep = torch.rand(len(faces), generator=seeded()) > 0.1
    mesh = as_trimesh(points, faces[keep])
    scan = RangeScan(points, faces[keep])
    used = np.unique(mesh.faces)
    np.testing.assert_allclose(scan.normals[used], mesh.vertex_normals[used], atol=1e-6)
    single = mesh.edges_sorted[trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)]
    wanted = np.isin(np.arange(len(points)), single) | ~np.isin(np.arange(len(points)), used)
    np.testing.assert_array_equal(scan.boundary, wanted)
    np.testing.assert_allclose(scan.diagonal, np.linalg.norm(np.ptp(points.numpy(), axis=0)))
    near = cKDTree(points.numpy()).query(points.numpy(), 2)[0][:, 1]
    assert scan.spacing == pytest.approx(np.median(near))
    assert scan.faces.dtype == torch.int64


def test_points_alone_find_nearly_what_faces_say():
    points, faces = sheet()
    scan, bare = RangeScan(points, faces), RangeScan(points)
    assert torch.equal(scan.boundary, rim())
    assert torch.equal(bare.boundary, rim())
    assert float((scan.normals * bare.normals).sum(-1).min()) > 0.97
    assert bare.faces is None
    assert bare.spacing == scan.spacing


def test_a_hole_and_its_rim_without_faces():
    points = torch.rand(4000, 3, generator=seeded()) * torch.tensor([2.0, 2.0, 0.0])
    radius = (points[:, :2] - 1).norm(dim=-1)
    scan = RangeScan(points[radius > 0.3])
    from_hole = radius[radius > 0.3] - 0.3
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


def test_a_viewpoint_turns_what_winding_and_bulge_say():
    points, faces = sheet()
    below = torch.tensor([7.0, 5.0, -50.0])
    for shape in (faces, None):
        scan = RangeScan(points, shape, viewpoint=below)
        assert float(scan.normals[:, 2].max()) < -0.5
        assert scan.viewpoint.dtype == torch.float64
        assert scan.viewpoint.tolist() == below.tolist()
    assert RangeScan(points).viewpoint is None


def test_triangles_that_share_places_but_no_indices_are_one_surface():
    points, faces = sheet()
    scan = RangeScan(points, faces)
    soup = RangeScan(points[faces].reshape(-1, 3), torch.arange(3 * len(faces)).reshape(-1, 3))
    torch.testing.assert_close(soup.normals, scan.normals[faces].reshape(-1, 3))
    assert torch.equal(soup.boundary, scan.boundary[faces].reshape(-1))
    assert soup.spacing == pytest.approx(scan.spacing)


def test_degenerate_doubled_and_turned_faces_change_nothing():
    points, faces = sheet()
    scan = RangeScan(points, faces)
    bad = torch.cat((faces, faces[:9], faces[20:24].flip(-1), torch.tensor([[4, 4, 9], [7, 7, 7]])))
    check_same(RangeScan(points, bad), scan)
    turned = faces.clone()
    turned[::5] = turned[::5].flip(-1)
    check_same(RangeScan(points, turned), scan)


def test_faces_of_no_use_count_as_none():
    points, _ = sheet()
    bare = RangeScan(points)
    for faces in (torch.zeros(0, 3), [], None):
        scan = RangeScan(points, torch.as_tensor(faces).long().reshape(0, 3) if faces is not None else None)
        assert scan.faces is None
        check_same(scan, bare)
    flat = RangeScan(points, torch.tensor([[0, 0, 1]]))
    torch.testing.assert_close(flat.normals, bare.normals, atol=1e-3, rtol=0)
    assert bool(flat.boundary.all())


@settings(max_examples=10, deadline=None)
@given(
    turn=st.lists(st.floats(-3, 3), min_size=3, max_size=3),
    scale=st.sampled_from([1e-3, 1.0, 1e3]),
    with_faces=st.booleans(),
    seed=st.integers(0, 99),
)
def test_a_moved_scan_is_the_scan_of_moved_points(turn, scale, with_faces, seed):
    points, faces = sheet()
    shake = 0.1 * torch.rand(points.shape, generator=seeded(seed), dtype=torch.float64)
    scan = RangeScan(points + shake, faces if with_faces else None, viewpoint=torch.tensor([0.0, 0, 90]))
    rotation = so3_exp(torch.tensor(turn, dtype=torch.float64))
    motion = rigid_matrix(scale * rotation, torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64))
    moved = scan.transformed(motion)
    eye = scale * (rotation @ scan.viewpoint) + motion[:3, 3]
    torch.testing.assert_close(moved.viewpoint, eye)
    check_same(moved, RangeScan(moved.points, moved.faces, viewpoint=eye), 1e-9 * scale)
    torch.testing.assert_close(moved.points, scale * scan.points @ rotation.mT + motion[:3, 3])


def test_order_does_not_matter():
    points, faces = sheet()
    # Of neighbors exactly as far as each other any may be found.
    points = points + 0.01 * torch.rand(points.shape, generator=seeded(1), dtype=torch.float64)
    order = torch.randperm(len(points), generator=seeded())
    for shape in (faces, None):
        scan = RangeScan(points, shape)
        shuffled = RangeScan(points[order], None if shape is None else order.argsort()[shape])
        torch.testing.assert_close(shuffled.normals, scan.normals[order])
        assert torch.equal(shuffled.boundary, scan.boundary[order])


def test_subsample_by_count_or_spacing():
    scan = RangeScan(*sheet())
    few = scan.uniform_subsample(40)
    assert len(few.unique()) == 40
    apart = torch.cdist(scan.points[few], scan.points[few]).fill_diagonal_(torch.inf)
    assert float(apart.min()) > 1.4
    wide = scan.uniform_subsample(spacing=3.0)
    assert float(torch.cdist(scan.points[wide], scan.points[wide]).fill_diagonal_(torch.inf).min()) > 3.0
    assert torch.equal(scan.uniform_subsample(10**6), torch.arange(180))
    other = scan.uniform_subsample(40, generator=seeded(3))
    assert not torch.equal(other, few)
    assert torch.equal(other, scan.uniform_subsample(40, generator=seeded(3)))


def test_subset_keeps_normals_and_the_faces_among_the_points():
    points, faces = sheet()
    scan = RangeScan(points, faces, viewpoint=torch.tensor([0.0, 0, 9]))
    left = points[:, 0] < 6.5
    part = scan.subset(left)
    check_same(scan.subset(left.nonzero()[:, 0]), part)
    torch.testing.assert_close(part.normals, scan.normals[left])
    assert torch.equal(part.boundary, scan.boundary[left])
    assert torch.equal(part.viewpoint, scan.viewpoint)
    assert part.diagonal == pytest.approx(RangeScan(points[left]).diagonal)
    inside = left[faces].all(dim=-1)
    assert torch.equal(part.points[part.faces], points[faces[inside]])
    check_same(
        RangeScan(points, faces).subset(torch.ones(180, dtype=torch.bool), mark_cut=True), RangeScan(points, faces)
    )
    cut = scan.subset(left, mark_cut=True)
    assert torch.equal(cut.boundary, RangeScan(cut.points, cut.faces).boundary)
    bare = RangeScan(points).subset(left, mark_cut=True)
    assert torch.equal(bare.boundary, cut.boundary)
    few = scan.subset(scan.uniform_subsample(20))
    assert few.faces is None
    assert few.spacing > 1.5 * scan.spacing


def test_dtypes():
    points, faces = sheet()
    scan = RangeScan(points, faces, viewpoint=torch.tensor([0.0, 0, 9]))
    single = scan.to(torch.float32)
    assert {single.points.dtype, single.normals.dtype, single.viewpoint.dtype} == {torch.float32}
    assert single.boundary.dtype == torch.bool
    check_same(single.to(torch.float64), scan, 1e-5)
    check_same(RangeScan(points.float(), faces.int()), single, 1e-6)
    assert RangeScan(points.numpy(), faces.numpy()).points.dtype == torch.float64
    assert RangeScan(points.tolist()).points.dtype == torch.get_default_dtype()


def rendered(camera):
    """The depth image of an ellipsoid before a wall, its camera, and the surface."""
    sphere = unit_sphere(4, dtype=torch.float64)
    mesh = TriangleMesh(sphere.vertices * torch.tensor([1.0, 0.6, 0.8]), sphere.faces)
    view = aim(mesh.vertices, torch.tensor(camera), size=160)
    depth = rasterize(mesh, view).depth
    focal = 1 / view.pitch
    center = -view.corner / view.pitch - 0.5
    world = rigid_matrix(view.rotation.mT, view.position)
    return torch.where(depth.isfinite(), depth, 12.0), (focal, focal, float(center[0]), float(center[1])), world


@pytest.mark.parametrize("camera", [(0.0, 0.0, -6.0), (4.0, -3.0, 2.0)])
def test_a_rendered_depth_image_gives_the_surface_back(camera):
    depth, intrinsics, world = rendered(camera)
    scan = RangeScan.from_depth(depth, intrinsics, world)
    torch.testing.assert_close(scan.viewpoint, world[:3, 3])
    local = (scan.points - world[:3, 3]) @ world[:3, :3]
    body = local[:, 2] < 11
    # On the ellipsoid, but for its facets.
    level = (scan.points / torch.tensor([1.0, 0.6, 0.8])).norm(dim=-1)
    assert float((level[body] - 1).abs().max()) < 0.01
    assert bool((body[scan.faces].all(-1) | ~body[scan.faces].any(-1)).all())
    assert float(body.double().mean()) > 0.5
    toward = torch.nn.functional.normalize(world[:3, 3] - scan.points, dim=-1)
    assert float((scan.normals * toward).sum(-1).min()) > 0
    right = torch.nn.functional.normalize(scan.points / torch.tensor([1.0, 0.6, 0.8]) ** 2, dim=-1)
    inner = body & ~scan.boundary
    assert float((scan.normals * right).sum(-1)[inner].min()) > 0.9
    assert bool(scan.boundary[body].any())
    assert float(scan.boundary[body].double().mean()) < 0.06


def test_depth_without_a_pose_and_in_integers():
    scan = RangeScan.from_depth(np.full((6, 8), 1000, dtype=np.int32), (500.0, 500.0, 3.5, 2.5))
    assert len(scan) == 48
    assert scan.spacing == pytest.approx(2.0)
    torch.testing.assert_close(scan.normals, torch.tensor([[0.0, 0, -1]]).expand(48, 3))
    assert scan.viewpoint.tolist() == [0, 0, 0]
    assert int(scan.boundary.sum()) == 24


def test_the_smallest_scans():
    triangle = RangeScan(torch.eye(3), torch.tensor([[0, 1, 2]]))
    torch.testing.assert_close(triangle.normals, torch.full((3, 3), 3**-0.5))
    assert bool(triangle.boundary.all())
    assert bool(RangeScan(torch.eye(3)).boundary.all())
    line = RangeScan(torch.arange(30.0).reshape(10, 3))
    assert bool(line.boundary.all())
    torch.testing.assert_close(line.normals.norm(dim=-1), torch.ones(10))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_on_a_graphics_card():
    points, faces = sheet()
    for shape in (faces, None):
        scan = RangeScan(points.cuda(), None if shape is None else shape.cuda())
        check_same(scan.to("cpu"), RangeScan(points, shape))
        assert scan.uniform_subsample(20).is_cuda
        assert scan.subset(scan.boundary, mark_cut=True).normals.is_cuda
    assert RangeScan.from_depth(torch.ones(5, 5).cuda(), (5.0, 5.0, 2.0, 2.0)).boundary.is_cuda


def test_even_samples_that_were_asked_for_before_are_the_same_and_cannot_be_spoilt():
    scan = RangeScan(torch.rand(300, 3, generator=torch.Generator().manual_seed(3)))
    first = scan.uniform_subsample(50)
    expected = first.clone()
    first.zero_()
    assert torch.equal(scan.uniform_subsample(50), expected)
    assert torch.equal(expected, RangeScan(scan.points).uniform_subsample(50))


@pytest.mark.parametrize("first", [0, 3])
def test_the_first_point_beside_a_cut_is_on_the_boundary_too(first):
    """Of a fan around point 0, one triangle is cut away: both of its points that are left end at the cut."""
    turns = torch.arange(6) * math.pi / 3
    ring = torch.stack([turns.cos(), turns.sin(), 0.1 * turns.sin()], dim=-1)
    points = torch.cat([torch.zeros(1, 3), ring])
    order = torch.arange(7).roll(-first)
    place = order.argsort()
    faces = place[torch.tensor([[0, 1 + k, 1 + (k + 1) % 6] for k in range(6)])]
    scan = RangeScan(points[order], faces).replaced(boundary=torch.zeros(7, dtype=torch.bool))
    left = torch.ones(7, dtype=torch.bool)
    left[place[4]] = False
    cut = scan.subset(left, mark_cut=True)
    kept = order[left]
    assert {int(number) for number in kept[cut.boundary]} >= {0, 3, 5}
    assert not bool(cut.boundary[(kept == 1).nonzero()[0, 0]])


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
