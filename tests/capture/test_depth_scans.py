import json
import math

import pytest
import torch

import torchreg as tr
from experiments.made_up.depth_noise import DepthNoise
from torchreg.capture.depth import bilateral_filter, plane_normals, without_flying_pixels
from torchreg.geometry.rigid import se3_exp
from torchreg.io.calibration import save_depth_camera
from torchreg.io.images import save_depth

MOTION = se3_exp(torch.tensor([0.1, -0.2, 0.1, 0.2, -0.4, 0.1], dtype=torch.float64))
CAMERA = tr.Camera(160, 120, (150.0, 150.0, 80.0, 59.0), MOTION)
RADIUS = 0.25


def solid(kind, camera=CAMERA):
    """Exact depths (H, W), zero beside the solid, and normals (H, W, 3), of a sphere or cylinder at 0.8 m."""
    rays = camera.pixel_grid()
    rays = torch.cat(((rays - camera.intrinsics[2:]) / camera.intrinsics[:2], torch.ones_like(rays[..., :1])), -1)
    center = rays.new_tensor([0.02, 0.0, 0.8])
    keep = rays.new_tensor([1.0, 1.0, 1.0] if kind == "sphere" else [1.0, 0.0, 1.0])
    a, b = (rays**2 * keep).sum(-1), (rays * center * keep).sum(-1)
    inside = b**2 - a * ((center**2 * keep).sum() - RADIUS**2)
    depth = torch.where(inside > 0, (b - inside.clamp(min=0).sqrt()) / a, 0.0)
    return depth, (rays * depth.unsqueeze(-1) - center) * keep / RADIUS


def angles(first, second):
    return torch.rad2deg(torch.acos((first * second).sum(-1).clamp(-1, 1)))


def test_points_reproject_into_their_pixels_and_lie_on_the_sphere():
    depth, _ = solid("sphere")
    scan = tr.depth_scan(depth, CAMERA)
    pixels, _ = CAMERA.project(scan.points)
    assert (pixels - pixels.round()).abs().max() < 1e-6
    assert torch.allclose(scan.viewpoint, CAMERA.position)
    assert scan.boundary.any()
    assert scan.faces is not None


@pytest.mark.parametrize("noise", [DepthNoise.structured_light(), DepthNoise.time_of_flight()])
@pytest.mark.parametrize("kind", ["sphere", "cylinder"])
def test_normals_are_within_five_degrees_in_spite_of_noise(kind, noise):
    depth, normals = solid(kind)
    noisy = noise.measured(depth, torch.Generator().manual_seed(3))
    scan = tr.depth_scan(noisy, CAMERA, smoothing=float(noise.depth_std(torch.ones(()))))
    pixels, _ = CAMERA.project(scan.points)
    column, row = pixels.round().long().unbind(-1)
    true = normals[row, column] @ CAMERA.world_to_camera[:3, :3]
    assert len(scan) > 0.6 * (depth > 0).sum()
    assert angles(scan.normals, true).median() < 5.0


def test_lens_is_undone():
    lens = tr.Camera(160, 120, CAMERA.intrinsics, MOTION, (-0.3, 0.1, 0.0, 0.0))
    scan = tr.depth_scan(torch.full((120, 160), 1.0, dtype=torch.float64), lens)
    pixels, depth = lens.project(scan.points)
    assert (pixels - pixels.round()).abs().max() < 1e-6
    assert torch.allclose(depth, torch.ones_like(depth))


def test_flying_pixels_go_and_surfaces_stay():
    wall = torch.full((2, 20, 30), 2.0)
    wall[:, 5:15, 10:20] = 1.0
    assert torch.equal(without_flying_pixels(wall, (150.0, 150.0)), wall)
    flying = wall.clone()
    flying[0, 5:15, 10] = torch.linspace(1.2, 1.8, 10)
    clean = without_flying_pixels(flying, (150.0, 150.0))
    assert (clean[0, 5:15, 10] == 0).all()
    assert (clean == 0).sum() == 10
    # A slope of 45 degrees is a surface; one pixel alone is none.
    slope = 1 / (1 + torch.arange(30) / 150.0).expand(20, 30)
    assert torch.equal(without_flying_pixels(slope, (150.0, 150.0)), slope)
    alone = torch.zeros(5, 5)
    alone[2, 2] = 1.0
    assert not without_flying_pixels(alone, (150.0, 150.0)).any()


def test_bilateral_filter_calms_noise_but_not_edges_and_slopes():
    generator = torch.Generator().manual_seed(0)
    truth = torch.full((40, 40), 1.0)
    truth[:, 20:] = 1.5
    noisy = truth + 2e-3 * torch.randn(40, 40, generator=generator)
    smooth = bilateral_filter(noisy, 2e-3)
    assert (smooth - truth).std() < 0.5 * (noisy - truth).std()
    assert (smooth - truth).abs().max() < 0.02
    slope = (1 + 0.01 * torch.arange(40.0)).expand(40, 40)
    assert torch.allclose(bilateral_filter(slope, 2e-3), slope, atol=1e-6)
    holes = noisy.clone()
    holes[3, 3], holes[4, 4] = 0.0, torch.nan
    assert (bilateral_filter(holes, 2e-3) == 0).nonzero().tolist() == [[3, 3], [4, 4]]
    batch = torch.stack((noisy, slope))
    assert torch.equal(bilateral_filter(batch, 2e-3), torch.stack([bilateral_filter(one, 2e-3) for one in batch]))


def test_plane_normals_are_exact_on_planes():
    normal = torch.nn.functional.normalize(torch.tensor([0.5, -0.3, -1.0], dtype=torch.float64), dim=0)
    rays = CAMERA.pixel_grid()
    rays = torch.cat(((rays - CAMERA.intrinsics[2:]) / CAMERA.intrinsics[:2], torch.ones_like(rays[..., :1])), -1)
    depth = -0.8 / (rays @ normal)
    depth[50, 50] = 0.0
    found = plane_normals(depth, CAMERA.intrinsics.tolist(), 1e-3)
    assert not found[50, 50].any()
    found[50, 50] = normal
    assert torch.allclose(found, normal.expand_as(found), atol=1e-6)
    assert not plane_normals(depth[50:51, 50:52], CAMERA.intrinsics.tolist(), 1e-3).any()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"farthest": 1.0, "nearest": 2.0}, "farthest must be beyond nearest"),
        ({"depth": torch.ones(5, 160)}, r"depth must have shape \(120, 160\)"),
        ({"nearest": 2.0}, "depth must hold neighboring pixels"),
        ({"smoothing": -1.0}, "smoothing must be zero or positive"),
        ({"max_steepness": 0.0}, "max_steepness must be positive"),
    ],
)
def test_bad_input_is_named(change, words):
    with pytest.raises(tr.errors.InputError, match=words):
        tr.depth_scan(**{"depth": solid("sphere")[0], "camera": CAMERA, **change})


def test_views_from_all_sides_fuse_into_one_sphere():
    scans = []
    for angle in (0.0, 2.0, 4.0):
        place = torch.tensor([math.sin(angle), 0.0, -math.cos(angle)], dtype=torch.float64)
        camera = tr.Camera.looking_at(place, [0.0, 0.0, 0.0], focal=100.0, width=80, height=80)
        rays = camera.directions(camera.pixel_grid())
        a, b = (rays**2).sum(-1), (rays @ -place)
        inside = b**2 - a * (1 - 0.3**2)
        depth = torch.where(inside > 0, (b - inside.clamp(min=0).sqrt()) / a, 0.0)
        scans.append(tr.depth_scan(depth, camera))
    fused = tr.fuse_scans(scans)
    total = sum(len(scan) for scan in scans)
    assert len(scans[0]) < len(fused) < total
    assert (fused.points.norm(dim=-1) - 0.3).abs().max() < 2e-3
    assert angles(fused.normals, fused.points / fused.points.norm(dim=-1, keepdim=True)).median() < 2.0
    assert len(tr.fuse_scans(scans, spacing=0.05)) < len(fused)
    with pytest.raises(tr.errors.InputError, match="at least one scan"):
        tr.fuse_scans([])
    with pytest.raises(tr.errors.InputError, match="leave three points"):
        tr.fuse_scans([tr.RangeScan(torch.eye(3, dtype=torch.float64))], spacing=10.0)


def test_two_sides_of_a_sheet_stay_apart():
    grid = torch.cartesian_prod(torch.arange(10.0), torch.arange(10.0), torch.zeros(1))
    up = torch.tensor([0.0, 0.0, 1.0]).expand(100, 3)
    sides = [tr.RangeScan(grid, normals=up), tr.RangeScan(grid + torch.tensor([0.0, 0.0, 0.1]), normals=-up)]
    assert len(tr.fuse_scans(sides, spacing=0.99)) == 200


def test_files_become_scans(tmp_path):
    depth, _ = solid("sphere")
    save_depth(tmp_path / "d.png", depth, 1e-4)
    save_depth_camera(tmp_path / "k.json", CAMERA, 1e-4)
    scan = tr.load_depth_scan(tmp_path / "d.png", tmp_path / "k.json")
    exact = tr.depth_scan(depth, CAMERA)
    assert len(scan) > 0.95 * len(exact)
    pixels, _ = CAMERA.project(scan.points.double())
    assert (pixels - pixels.round()).abs().max() < 0.5
    with pytest.raises(tr.errors.FormatError, match=r"d\.png: depth must hold neighboring pixels"):
        tr.load_depth_scan(tmp_path / "d.png", tmp_path / "k.json", nearest=5.0)
    with pytest.raises(tr.errors.InputError, match="max_jump must be positive"):
        tr.load_depth_scan(tmp_path / "d.png", tmp_path / "k.json", max_jump=0.0)
    (tmp_path / "k.json").write_text(json.dumps({"width": 1, "height": 1, "fx": 1, "fy": 1, "cx": 0, "cy": 0}))
    with pytest.raises(tr.errors.FormatError, match="is 160 x 120 pixels, the camera's pictures are 1 x 1"):
        tr.load_depth_scan(tmp_path / "d.png", tmp_path / "k.json")
