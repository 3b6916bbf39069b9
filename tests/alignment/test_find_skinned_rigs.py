"""Finding skinned rigs without a start: any rotation, batches, motions."""

import math

import pytest
import torch

from torchreg.alignment.find_pose import FindPoseConfig, find_pose
from torchreg.geometry.rotation import so3_exp

QUICK = FindPoseConfig(num_placed=5, num_searched=2, num_model_points=200)


def generator(seed):
    return torch.Generator().manual_seed(seed)


@pytest.fixture(scope="module")
def people(person):
    """Poses of two skinned people, lying and standing, and clouds of all sides."""
    poses = person.rest_pose().repeat(2, 1)
    poses[:, 6:] = math.radians(15) * torch.randn(2, person.num_dofs - 6, generator=generator(1))
    poses[:, 3:6] = torch.tensor([[1.6, -0.4, 0.8], [0.1, 0.2, -2.0]])
    poses[:, :3] = torch.tensor([0.4, -0.3, 1.0])
    points = person.vertices(poses)
    chosen = torch.randint(points.shape[1], (500,), generator=generator(2))
    return poses, points[:, chosen] + 0.003 * torch.randn(2, 500, 3, generator=generator(3))


@pytest.fixture(scope="module")
def found_people(person, people):
    return find_pose(person, people[1], config=QUICK)


def test_skinned_rigs_in_any_rotation_are_found(person, people, found_people):
    size = (person.vertices(person.rest_pose()).amax(0) - person.vertices(person.rest_pose()).amin(0)).norm()
    error = (person.vertices(found_people.poses[:, 0]) - person.vertices(people[0])).norm(dim=-1).mean(-1)
    assert (error < 0.02 * size).all()


def test_a_skinned_rig_alone_is_found_as_in_a_batch(person, people, found_people):
    alone = find_pose(person, people[1][1], config=QUICK)
    torch.testing.assert_close(
        person.vertices(alone.poses[0]), person.vertices(found_people.poses[1, 0]), rtol=0, atol=1e-3
    )


def test_skinned_rigs_turn_with_their_data(person, people, found_people):
    turn = so3_exp(torch.tensor([0.7, -1.1, 0.4]))
    shift = torch.tensor([0.2, 1.0, -0.5])
    moved = find_pose(person, people[1][0] @ turn.T + shift, config=QUICK)
    wanted = person.vertices(found_people.poses[0, 0]) @ turn.T + shift
    torch.testing.assert_close(person.vertices(moved.poses[0]), wanted, rtol=0, atol=0.01)
