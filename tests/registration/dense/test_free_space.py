import math

import pytest
import torch

from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.rigid import se3_exp, transform_points
from torchreg.registration.dense.free_space import FreeSpace

F64 = torch.float64
EYE = torch.tensor([0.0, 0.0, -8.0], dtype=F64)
MOST_CUT = 0.125


def half_ball(count=3000):
    """Return points and normals of the side of a unit ball that the camera sees, spread evenly, in no order."""
    number = torch.arange(count, dtype=F64) + 0.5
    height = 1 - 2 * number / count
    angle = math.pi * (1 + math.sqrt(5)) * number
    around = (1 - height.square()).sqrt()
    ball = torch.stack([around * angle.cos(), around * angle.sin(), height], dim=1)
    # A ray meets the ball where its normal looks towards the camera.
    return ball[((ball - EYE) * ball).sum(-1) < 0]


@pytest.fixture(scope="module")
def ball():
    return half_ball()


@pytest.fixture(scope="module")
def space(ball):
    return FreeSpace.of(ball, ball, EYE, MOST_CUT)


def test_what_is_beyond_the_outline_is_taken_straight_back(space):
    angle = torch.linspace(0, 2 * math.pi, 50, dtype=F64)
    outward = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], dim=1)
    for radius, depth in ((1.3, 0.0), (1.6, 0.0), (1.5, 2.0)):
        points = radius * outward + torch.tensor([0.0, 0.0, depth], dtype=F64)
        distance, back, trust = space.beyond(points, 0.1)
        # The cone of rays that touch the ball is as wide as this at that depth.
        outline = (depth + 8) / math.sqrt(8**2 - 1)
        torch.testing.assert_close(distance, torch.full_like(distance, radius - outline), atol=0.04, rtol=0)
        assert float((back * -outward).sum(-1).min()) > 0.95
        torch.testing.assert_close(trust, torch.ones_like(trust))


def test_what_is_seen_or_hidden_may_be_there(space, ball):
    for points in (ball, 0.5 * ball, ball * ball.new_tensor([1, 1, -1]), ball - ball.new_tensor([0, 0, 0.5])):
        distance, _, trust = space.beyond(points, 0.15)
        assert float(distance.max()) == float(trust.max()) == 0


def test_margins_forgive(space):
    point = torch.tensor([[1.3, 0.0, 0.0]], dtype=F64)
    assert float(space.beyond(point, 0.2)[0]) > 0.2
    assert float(space.beyond(point, 0.4)[0]) == 0


def test_a_scan_that_ends_across_what_faces_the_camera_says_nothing(ball):
    line = torch.linspace(-1, 1, 40, dtype=F64)
    wall = torch.nn.functional.pad(torch.cartesian_prod(line, line), (0, 1))
    facing = torch.tensor([0.0, 0.0, -1.0], dtype=F64).expand_as(wall)
    assert float(FreeSpace.of(wall, facing, EYE, MOST_CUT).trust.max()) == 0
    # Even if told that nothing is missing, only edges beside which the surface turns away are trusted.
    assert float(FreeSpace.of(wall, facing, EYE, 1.1).trust.max()) == 0
    half = ball[ball[:, 0] > 0]
    assert float(FreeSpace.of(half, half, EYE, MOST_CUT).trust.max()) == 0
    far = torch.tensor([[-0.5, 0.0, 0.0], [1.5, 0.0, 0.0]], dtype=F64)
    assert FreeSpace.of(half, half, EYE, 1.1).beyond(far, 0.1)[2].tolist() == [0, 1]


def test_motion_scale_and_order_change_nothing(space, ball):
    generator = torch.Generator().manual_seed(0)
    points = 2 * torch.randn(60, 3, generator=generator, dtype=F64)
    distance, back, trust = space.beyond(points, 0.1)
    motion = se3_exp(torch.tensor([0.3, 2.0, -1.0, 0.5, 1.0, 2.0], dtype=F64))
    order = torch.randperm(len(ball), generator=generator)
    surface, eye, moved = (7 * transform_points(motion, values) for values in (ball[order], EYE[None], points))
    other = FreeSpace.of(surface, ball[order] @ motion[:3, :3].mT, eye[0], MOST_CUT)
    found = other.beyond(moved, 0.7)
    torch.testing.assert_close(found[0], 7 * distance)
    torch.testing.assert_close(found[1], back @ motion[:3, :3].mT)
    torch.testing.assert_close(found[2], trust)


def draws(count, seed=0):
    """Return points around the ball, and unit vectors."""
    generator = torch.Generator().manual_seed(seed)
    points, normals = torch.randn(2, count, 3, generator=generator, dtype=F64)
    return 1.5 * points, torch.nn.functional.normalize(normals, dim=-1)


def test_what_a_ball_hides_is_not_in_view(space):
    points, _ = draws(4000)
    reach = (points - EYE).norm(dim=-1)
    rays = (points - EYE) / reach.unsqueeze(1)
    # A ray meets the ball where the quadratic says, if it is not too far off.
    along = -(rays * EYE).sum(-1)
    off = EYE.square().sum() - along.square()
    meets = along - (1 - off).clamp(min=0).sqrt()
    hidden = (off < 1) & (reach - meets > 0.3)
    clear = ((off.sqrt() - 1).abs() > 0.15) & ((reach - meets - 0.3).abs() > 0.1)
    assert 0.05 < float(hidden[clear].double().mean()) < 0.95
    assert torch.equal(space.in_view(points, -rays, 0.3)[clear], ~hidden[clear])


def test_only_what_faces_the_camera_is_in_view(space):
    points, normals = draws(1000)
    points[:, 2] = -2
    facing = ((EYE - points) * normals).sum(-1) / (EYE - points).norm(dim=-1)
    assert torch.equal(space.in_view(points, normals, 0.1), facing >= 0.1)


def test_a_scan_sees_itself(space, ball):
    seen = space.in_view(ball, ball, 0.1)
    # All but the outline, which is looked along.
    assert bool(seen[ball[:, 2] < -0.3].all())
    assert not bool(space.in_view(ball, -ball, 0.1).any())


def test_motion_scale_and_order_change_nothing_in_view(space, ball):
    points, normals = draws(300)
    motion = se3_exp(torch.tensor([0.3, 2.0, -1.0, 0.5, 1.0, 2.0], dtype=F64))
    turn = motion[:3, :3].mT
    order = torch.randperm(len(ball), generator=torch.Generator().manual_seed(1))
    surface, eye, moved = (7 * transform_points(motion, values) for values in (ball[order], EYE[None], points))
    other = FreeSpace.of(surface, ball[order] @ turn, eye[0], MOST_CUT)
    found = space.in_view(points, normals, 0.2)
    assert 0.05 < float(found.double().mean()) < 0.95
    assert torch.equal(other.in_view(moved, normals @ turn, 1.4), found)


def test_few_points_say_nothing(ball):
    for count in (1, 5, 16):
        few = FreeSpace.of(ball[:count], ball[:count], EYE, MOST_CUT)
        assert float(few.beyond(3 * ball[:20], 0.1)[2].max()) == 0
    # Nor do many at one place.
    same = ball[:1].expand(50, 3)
    assert float(FreeSpace.of(same, same, EYE, MOST_CUT).beyond(3 * ball[:20], 0.1)[2].max()) == 0
    assert float(FreeSpace.of(same, same, same[0], MOST_CUT).beyond(3 * ball[:20], 0.1)[2].max()) == 0
    # They hide no more than themselves: all that faces the camera may be seen.
    for few in (ball[:1], ball[:5], same):
        assert bool(FreeSpace.of(few, few, EYE, MOST_CUT).in_view(ball[-100:], ball[-100:], 0.1).all())


def test_bad_input_is_named(ball):
    with pytest.raises(InputError, match="points must have shape"):
        FreeSpace.of(ball[0], ball, EYE, MOST_CUT)
    with pytest.raises(InputError, match="normals must have shape"):
        FreeSpace.of(ball, ball[1:], EYE, MOST_CUT)
    with pytest.raises(InputError, match="viewpoint must have shape"):
        FreeSpace.of(ball, ball, EYE[:2], MOST_CUT)
    with pytest.raises(InputError, match="most_cut must be"):
        FreeSpace.of(ball, ball, EYE, 0.0)
    with pytest.raises(InputTypeError, match=r"normals is torch.float32"):
        FreeSpace.of(ball, ball.float(), EYE, MOST_CUT)


def test_bad_questions_are_named(space, ball):
    with pytest.raises(InputError, match="points must have shape"):
        space.in_view(ball[0], ball[0], 0.1)
    with pytest.raises(InputError, match="normals must have shape"):
        space.in_view(ball, ball[1:], 0.1)
    with pytest.raises(InputError, match="behind must be positive"):
        space.in_view(ball, ball, 0.0)
    with pytest.raises(InputTypeError, match=r"normals is torch.float32"):
        space.in_view(ball, ball.float(), 0.1)
    with pytest.raises(InputTypeError, match=r"points is torch.float32"):
        space.in_view(ball.float(), ball.float(), 0.1)
