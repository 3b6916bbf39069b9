"""Parts of a chain of known links: one each, no more where the skin blends, whatever its place, turn and size."""

import pytest
import torch

from torchreg.geometry.rigid import transform_points
from torchreg.geometry.rotation import so3_exp
from torchreg.registration.rigging.parts import moving_parts

JOINTS, WIDTH, COST = (1.0, 2.0), 0.15, 0.005


@pytest.fixture(scope="module")
def chain():
    """Return the points of a tube of three links, its edges, the points in four frames, and the weights of links."""
    along, around = torch.arange(0, 3.001, 0.05, dtype=torch.float64), torch.arange(12) * (2 * torch.pi / 12)
    ring = 0.15 * torch.stack((around.cos(), around.sin()), -1).double()
    points = torch.cat((along[:, None, None].expand(-1, 12, 1), ring.expand(len(along), 12, 2)), -1).reshape(-1, 3)
    # An even grid has ties, which rounding decides.
    points += 0.008 * torch.rand(points.shape, generator=torch.Generator().manual_seed(1), dtype=points.dtype)
    number = torch.arange(len(points)).reshape(len(along), 12)
    edges = torch.cat((
        torch.stack((number[:-1], number[1:]), -1).reshape(-1, 2),
        torch.stack((number, number.roll(-1, 1)), -1).reshape(-1, 2),
    ))  # fmt: skip
    first, second = (torch.sigmoid((points[:, 0] - joint) / (WIDTH / 4)) for joint in JOINTS)
    weights = torch.stack((1 - first, first * (1 - second), first * second), -1)
    angles = torch.tensor([[0.0, 0.0], [0.6, 0.0], [0.3, 0.7], [-0.2, 0.9]], dtype=torch.float64)
    moved = []
    for each in angles:
        motion, placed = torch.eye(4, dtype=torch.float64), [points]
        for joint, angle in zip(JOINTS, each, strict=True):
            turn = torch.eye(4, dtype=torch.float64)
            turn[:3, :3] = so3_exp(angle * torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
            pivot = torch.tensor([joint, 0.0, 0.0], dtype=torch.float64)
            turn[:3, 3] = pivot - turn[:3, :3] @ pivot
            motion = motion @ turn
            placed.append(transform_points(motion, points))
        moved.append((weights.mT[..., None] * torch.stack(placed)).sum(0))
    return points, edges, torch.stack(moved), weights


def found(points, edges, moved, most=20, cost=COST):
    return moving_parts(points, edges, moved, torch.ones(moved.shape[:2]).double(), most=most, cost=cost)


def test_each_link_is_one_part_though_the_skin_blends(chain):
    points, edges, moved, weights = chain
    part, motions = found(points, edges, moved)
    assert motions.shape == (4, 3, 4, 4)
    assert part.unique().tolist() == [0, 1, 2]
    sure = weights.amax(1) > 0.99
    owner = weights.argmax(1)
    for link in range(3):
        assert len(part[sure & (owner == link)].unique()) == 1
    torch.testing.assert_close(
        transform_points(motions, points[sure])[torch.arange(4)[:, None], part[sure], torch.arange(int(sure.sum()))],
        moved[:, sure], atol=0.02, rtol=0,
    )  # fmt: skip


def test_parts_do_not_depend_on_place_turn_and_size(chain):
    points, edges, moved, _ = chain
    turn = so3_exp(torch.tensor([0.4, -0.8, 0.3], dtype=torch.float64))
    part, _ = found(points, edges, moved)
    again, _ = found(5 * points @ turn.mT + 3, edges, 5 * moved @ turn.mT + 3, cost=5 * COST)
    assert torch.equal(part, again)


def test_noise_makes_no_parts_and_few_may_be_asked_for(chain):
    points, edges, moved, _ = chain
    generator = torch.Generator().manual_seed(3)
    noisy = moved + 0.01 * torch.randn(moved.shape, generator=generator, dtype=moved.dtype)
    assert found(points, edges, noisy)[1].shape[1] == 3
    assert found(points, edges, moved, most=2)[1].shape[1] == 2
    assert found(points, edges, points.expand(4, -1, -1))[1].shape[1] == 1
