"""Poses from skeletons: a hand's chains fitted to limbs that are known exactly, with and without a forearm."""

import pytest
import torch

import torchreg as tr
from tests.alignment.made import TIPS, off, problem_of
from torchreg.geometry.skeleton import build_skeleton


def bent_pose(hand, seed):
    generator = torch.Generator().manual_seed(seed)
    pose = hand.rest_pose()
    pose[6:] = 0.5 * torch.rand(hand.num_dofs - 6, generator=generator) * hand.upper[6:].clamp_min(0)
    pose[:3] = torch.tensor([0.1, -0.2, 0.5])
    pose[3:6] = torch.randn(3, generator=generator)
    return hand.clamp(pose)


def hand_skeleton(hand, pose, *, forearm=True):
    """The fingers' bones, joined in the middle of the palm, and a limb towards the forearm."""
    points = hand.keypoints(pose)
    wrist, fingers = points[0], points[1:].reshape(5, 4, 3).flip(1)
    middle = 0.5 * (wrist + fingers[1:, -1].mean(0))
    order = [3, 0, 4, 1, 2]
    curves = [torch.cat((fingers[k], middle[None])) for k in order]
    if forearm:
        curves.insert(2, torch.stack((wrist + (wrist - middle), wrist, middle)))
    limbs = [(curve, torch.full((len(curve),), 0.01), torch.eye(3).expand(len(curve), 3, 3)) for curve in curves]
    return build_skeleton(limbs, [(k, 99) for k in range(len(limbs))])


@pytest.mark.parametrize(("seed", "kind"), [(0, "with forearm"), (1, "without"), (4, "of the surface")])
def test_the_pose_is_found_from_the_limbs_alone(plain_hand, plain_hand_skin, plain_hand_surface, seed, kind):
    pose = bent_pose(plain_hand, seed)
    surface = tr.TriangleMesh(plain_hand_surface(pose), plain_hand_surface.faces)
    if kind == "of the surface":
        source = tr.SpineLimbs.of_surface(surface, count=1)
        assert len(source.skeleton.tips) == 6
    else:
        source = tr.SpineLimbs(hand_skeleton(plain_hand, pose, forearm=kind == "with forearm"))
    starts = tr.find_pose(plain_hand, surface.vertices[::7], sources=[source], model_points=plain_hand_skin)
    assert float(off(plain_hand, starts.best, pose)[TIPS].mean()) < 0.003


def test_a_batch_of_clouds_shares_the_skeleton(plain_hand, plain_hand_skin, plain_hand_surface):
    pose = bent_pose(plain_hand, 1)
    cloud = plain_hand_surface(pose)[::7]
    origin = torch.stack([cloud.mean(0), cloud[200:].mean(0) + 0.1])
    source = tr.SpineLimbs(hand_skeleton(plain_hand, pose), count=1)
    rest = plain_hand.rest_pose().repeat(2, 1)
    problem = problem_of(plain_hand_skin, cloud[:400].expand(2, -1, -1), rest, origin=origin)
    poses = source(problem, torch.Generator())
    assert poses.shape == (2, 1, plain_hand.num_dofs)
    for row, middle in zip(poses[:, 0], origin, strict=True):
        tips = plain_hand.keypoints(row)[TIPS] + middle
        assert float((tips - plain_hand.keypoints(pose)[TIPS]).norm(dim=-1).mean()) < 0.01
