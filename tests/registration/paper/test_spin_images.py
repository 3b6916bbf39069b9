"""Spin images by a plain loop, and how alike two of them are by the definitions."""

import math

import pytest
import torch

import torchreg as tr
from tests.geometry.draws import directions, rand, seeded
from torchreg.geometry.rigid import se3_exp, transform_points
from torchreg.registration.paper.spin_images import image_similarity, spin_images


def cloud(count=200):
    return rand(count, 3), directions(count)


def plain_images(points, normals, scan, scan_normals, bin_size, size, angle, interpolate):
    """Johnson's definition, one number at a time."""
    images = torch.zeros(len(points), size, size, dtype=points.dtype)
    for image, p, n in zip(images, points, normals, strict=True):
        for x, m in zip(scan, scan_normals, strict=True):
            beta = float(n @ (x - p))
            alpha = math.sqrt(max(0.0, float((x - p) @ (x - p)) - beta**2))
            row, column = size / 2 - beta / bin_size, alpha / bin_size
            if math.acos(max(-1.0, min(1.0, float(n @ m)))) >= angle or not (0 < row < size and column < size):
                continue
            if not interpolate:
                image[int(row), int(column)] += 1
                continue
            i, j = math.floor(row - 0.5), math.floor(column - 0.5)
            a, b = row - 0.5 - i, column - 0.5 - j
            for line, share in ((i, 1 - a), (i + 1, a)):
                for place, part in ((j, 1 - b), (j + 1, b)):
                    if 0 <= line < size and place < size:
                        image[line, max(place, 0)] += share * part
    return images


@pytest.mark.parametrize("interpolate", [True, False])
@pytest.mark.parametrize(("size", "angle"), [(15, math.pi / 2), (5, math.radians(40)), (7, math.pi)])
def test_images_are_those_of_a_plain_loop(interpolate, size, angle):
    points, normals = cloud(60)
    options = {"bin_size": 0.09, "image_size": size, "support_angle": angle, "interpolate": interpolate}
    images = spin_images(points[:8], normals[:8], points, normals, **options)
    expected = plain_images(points[:8], normals[:8], points, normals, 0.09, size, angle, interpolate)
    torch.testing.assert_close(images, expected)
    assert float(images.sum()) > 10


def test_motions_units_order_and_chunks_change_nothing(monkeypatch):
    points, normals = cloud()
    images = spin_images(points, normals, points, normals, bin_size=0.05)
    motion = se3_exp(torch.tensor([3.0, -2, 5, 1, 2, -0.5], dtype=torch.float64))
    moved, turned = transform_points(motion, points), normals @ motion[:3, :3].mT
    torch.testing.assert_close(spin_images(moved, turned, moved, turned, bin_size=0.05), images)
    torch.testing.assert_close(spin_images(1e3 * points, normals, 1e3 * points, normals, bin_size=50.0), images)
    order = torch.randperm(len(points), generator=seeded(2))
    monkeypatch.setattr("torchreg.registration.paper.spin_images._CHUNK_ENTRIES", 700)
    mixed = spin_images(points[order], normals[order], points, normals, bin_size=0.05)
    torch.testing.assert_close(mixed, images[order])
    far, single_normals = (points + 64).float(), normals.float()
    single = spin_images(far, single_normals, far, single_normals, bin_size=0.1)
    assert single.dtype == torch.float32
    expected = spin_images(points, normals, points, normals, bin_size=0.1)
    torch.testing.assert_close(single.double(), expected, atol=0.01, rtol=0)


def test_weights_count_points_and_missing_normals_count_all():
    points, normals = cloud(50)

    def images(*scan, **options):
        return spin_images(points, normals, *scan, bin_size=0.1, **options)

    doubled = images(points.repeat(2, 1), normals.repeat(2, 1))
    torch.testing.assert_close(images(points, normals, weights=torch.full((50,), 2.0)), doubled)
    torch.testing.assert_close(images(points), images(points, normals, support_angle=math.pi))


@pytest.mark.parametrize("similarity", ["correlation", "overlap", "l2", "distance"])
def test_an_image_is_most_like_itself(similarity):
    points, normals = cloud(80)
    images = spin_images(points, normals, points, normals, bin_size=0.05)
    scores = image_similarity(images, images, similarity)
    assert torch.equal(scores.argmax(1), torch.arange(80))


def test_similarities_by_their_definitions():
    first, second = rand(2, 5, 4, 4)
    first = torch.where(first < 0.3, 0.0, first)
    names = ("correlation", "overlap", "l2", "distance")
    correlation, alike, apart, plain = (image_similarity(first, second, name) for name in names)
    for i, a in enumerate(first.flatten(1)):
        for j, b in enumerate(second.flatten(1)):
            both = (a != 0) & (b != 0)
            r = torch.corrcoef(torch.stack([a[both], b[both]]))[0, 1]
            torch.testing.assert_close(correlation[i, j], torch.corrcoef(torch.stack([a, b]))[0, 1])
            torch.testing.assert_close(apart[i, j], -(a / a.norm() - b / b.norm()).norm())
            torch.testing.assert_close(plain[i, j], -(a - b).norm())
            torch.testing.assert_close(alike[i, j], r.sign() * torch.atanh(r) ** 2 - 3 / (both.sum() - 3))


def test_empty_images_are_like_nothing():
    full, empty = rand(3, 4, 4), torch.zeros(2, 4, 4).double()
    assert float(image_similarity(empty, full).abs().max()) == 0
    assert bool((image_similarity(empty, full, "overlap") == -math.inf).all())
    torch.testing.assert_close(image_similarity(empty, full, "l2"), torch.full((2, 3), -math.sqrt(2.0)).double())
    assert bool(image_similarity(torch.ones(1, 4, 4).double(), full, "overlap").isfinite().all())


ROW = torch.eye(3, dtype=torch.float64)


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"normals": ROW[:2]}, "InputError", "normals must have shape"),
        ({"scan_normals": ROW[:2]}, "InputError", "scan_normals must have shape"),
        ({"scan_points": ROW * math.nan}, "InputError", "scan_points must be finite"),
        ({"scan_points": ROW.float()}, "InputTypeError", r"scan_points is torch\.float32"),
        ({"bin_size": 0.0}, "InputError", "bin_size"),
        ({"support_angle": 0.0}, "InputError", "support_angle"),
        ({"image_size": 0}, "InputError", "image_size"),
        ({"weights": torch.ones(2)}, "InputError", "weights must have shape"),
    ],
)
def test_bad_arguments_are_named(change, error, words):
    given = {"points": ROW, "normals": ROW, "scan_points": ROW, "scan_normals": ROW, "bin_size": 0.1}
    with pytest.raises(getattr(tr.errors, error), match=words):
        spin_images(**given | change)
    with pytest.raises(tr.errors.InputError, match="similarity must be one of"):
        image_similarity(ROW, ROW, "cosine")
    with pytest.raises(tr.errors.InputError, match="target must have shape"):
        image_similarity(ROW, ROW[:, :2])
