"""One solid per part: mixed kinds equal single kinds, learnable sizes, and refusals."""

import math

import pytest
import torch

from torchreg.errors import ModelError
from torchreg.geometry.primitives import PRIMITIVE_KINDS
from torchreg.geometry.rigid import se3_exp
from torchreg.shapes.primitives import Primitive, PrimitiveSet

SIZES = {
    "ellipsoid": (0.2, 0.3, 0.5),
    "capsule": (0.4, 0.2),
    "cone": (0.5, 0.3, 0.1),
    "superquadric": (0.2, 0.3, 0.5, 0.6, 0.8),
}
MIXED = ("capsule", "ellipsoid", "superquadric", "cone", "ellipsoid", "capsule")


def solid(kind, seed=0):
    twist = torch.randn(6, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return Primitive(kind, SIZES[kind], se3_exp(twist))


def points(count=50):
    return torch.randn(count, len(MIXED), 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))


def unscaled(parts):
    ones = torch.ones(len(parts), dtype=torch.float64)
    return parts.scaled_sizes(ones, ones)


def test_mixed_kinds_equal_single_kinds():
    mixed = PrimitiveSet([solid(kind) for kind in MIXED])
    local = points()
    distances, gradients = mixed.distance_and_gradient(local, unscaled(mixed))
    torch.testing.assert_close(mixed(local, unscaled(mixed)), distances, atol=1e-14, rtol=0)
    assert len(mixed) == 6
    assert mixed.part_kinds == MIXED
    for part, kind in enumerate(MIXED):
        alone = PrimitiveSet([solid(kind)])
        column = local[:, part : part + 1]
        torch.testing.assert_close(alone(column, unscaled(alone))[:, 0], distances[:, part])
        one = alone.distance_and_gradient(column, unscaled(alone))[1]
        torch.testing.assert_close(one[:, 0], gradients[:, part])


def test_lengths_scale_along_z_and_radii_across():
    parts = PrimitiveSet([solid(kind) for kind in MIXED])
    length = torch.arange(2, 8, dtype=torch.float64)
    radius = torch.arange(12, 18, dtype=torch.float64)
    by_kind = dict(zip(parts.kinds, parts.scaled_sizes(length, radius), strict=True))
    expected = {
        "capsule": [[0.4 * 2, 0.2 * 12], [0.4 * 7, 0.2 * 17]],
        "ellipsoid": [[0.2 * 13, 0.3 * 13, 0.5 * 3], [0.2 * 16, 0.3 * 16, 0.5 * 6]],
        "superquadric": [[0.2 * 14, 0.3 * 14, 0.5 * 4, 0.6, 0.8]],
        "cone": [[0.5 * 5, 0.3 * 15, 0.1 * 15]],
    }
    for kind, sizes in expected.items():
        torch.testing.assert_close(by_kind[kind], torch.tensor(sizes, dtype=torch.float64))


@torch.no_grad()
@pytest.mark.parametrize("kind", PRIMITIVE_KINDS)
def test_a_ball_of_the_reach_holds_the_solid(kind):
    parts = PrimitiveSet([solid(kind)])
    reach = float(parts.reaches(unscaled(parts)))
    directions = torch.randn(500, 1, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    on_ball = reach * directions / directions.norm(dim=-1, keepdim=True)
    assert bool((parts(on_ball, unscaled(parts)) > 0).all())
    assert reach < 4 * max(SIZES[kind][:3])


def test_reaches_come_in_the_order_of_the_parts():
    mixed = PrimitiveSet([solid(kind) for kind in MIXED])
    alone = [PrimitiveSet([solid(kind)]) for kind in MIXED]
    torch.testing.assert_close(mixed.reaches(unscaled(mixed)), torch.cat([one.reaches(unscaled(one)) for one in alone]))


def test_scales_are_differentiable():
    parts = PrimitiveSet([solid(kind) for kind in MIXED])
    local = points(4)

    def distance(length, radius):
        return parts(local, parts.scaled_sizes(length, radius))

    scales = [torch.full((6,), value, dtype=torch.float64, requires_grad=True) for value in (1.1, 0.9)]
    assert torch.autograd.gradcheck(distance, scales)


def test_centers_and_sizes_are_the_state_and_move_to_other_dtypes():
    parts = PrimitiveSet([solid(kind) for kind in MIXED])
    assert list(parts.state_dict()) == ["centers", *(f"sizes.{index}" for index in range(4))]
    single = parts.to(torch.float32)
    ones = torch.ones(6)
    assert single(points().float(), single.scaled_sizes(ones, ones)).dtype == torch.float32
    assert single.rotations.dtype == torch.float32


def changed_pose(**entries):
    pose = torch.eye(4, dtype=torch.float64)
    for key, value in entries.items():
        pose[int(key[1]), int(key[2])] = value
    return pose


@pytest.mark.parametrize(
    ("primitive", "message"),
    [
        (Primitive("sphere", (1.0,), torch.eye(4)), "primitive 1 has kind 'sphere'; known: ellipsoid, capsule, cone"),
        (Primitive("capsule", (1.0,), torch.eye(4)), r"primitive 1 \(capsule\) needs sizes .*radius.*, got 1 numbers"),
        (Primitive("capsule", (1.0, 0.0), torch.eye(4)), r"primitive 1 \(capsule\) has radius = 0.0; .*positive"),
        (Primitive("capsule", (math.nan, 1.0), torch.eye(4)), "has half_length = nan"),
        (Primitive("capsule", (1.0, 1.0), torch.eye(3)), r"needs a finite \(4, 4\) pose, got shape \(3, 3\)"),
        (Primitive("capsule", (1.0, 1.0), changed_pose(m03=math.inf)), r"needs a finite \(4, 4\) pose"),
        (Primitive("capsule", (1.0, 1.0), changed_pose(m00=2.0)), "has a pose that is not a rigid motion"),
        (Primitive("capsule", (1.0, 1.0), changed_pose(m00=-1.0)), "has a pose that is not a rigid motion"),
    ],
)
def test_impossible_solids_are_refused(primitive, message):
    with pytest.raises(ModelError, match=message):
        PrimitiveSet([solid("cone"), primitive])
