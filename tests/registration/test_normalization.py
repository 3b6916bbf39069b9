import torch

from torchreg.geometry.range_scan import RangeScan
from torchreg.geometry.rigid import transform_points
from torchreg.registration.normalization import Normalization

F64 = torch.float64


def cloud():
    return 3 * torch.randn(200, 3, generator=torch.Generator().manual_seed(0), dtype=F64) + 5


def motions(count):
    generator = torch.Generator().manual_seed(1)
    transforms = torch.eye(4, dtype=F64).repeat(count, 1, 1)
    transforms[:, :3, :3] = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator, dtype=F64))[0]
    transforms[:, :3, 3] = torch.randn(count, 3, generator=generator, dtype=F64)
    return transforms


def test_size_follows_the_unit_and_not_the_turn():
    points, motion = cloud(), motions(1)[0]
    normalization = Normalization.from_points(points)
    turned = Normalization.from_points(7 * transform_points(motion, points))
    assert abs(turned.scale - 7 * normalization.scale) < 1e-12 * turned.scale
    torch.testing.assert_close(turned.center, 7 * transform_points(motion, normalization.center[None])[0])
    assert bool(normalization.normalize(points).mean(0).abs().max() < 1e-12)


def test_points_and_scans_come_back():
    points = cloud().float()
    normalization = Normalization.from_points(points)
    torch.testing.assert_close(normalization.denormalize(normalization.normalize(points), points), points)
    scan = RangeScan(points, normals=torch.nn.functional.normalize(points, dim=-1))
    torch.testing.assert_close(normalization.normalize_scan(scan).points, normalization.normalize(points))


def test_motions_mean_the_same_in_both_coordinates():
    points, transforms = cloud(), motions(4)
    normalization = Normalization.from_points(points)
    there = normalization.denormalize(transform_points(transforms, normalization.normalize(points)), points)
    torch.testing.assert_close(transform_points(normalization.denormalize_motions(transforms), points), there)
