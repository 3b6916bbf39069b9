"""Labels of a motion: poses frame from frame, a search where that fails, parts of the points."""

import pytest
import torch

import torchreg as tr
from tests.alignment.made import finger
from torchreg.alignment.pseudo_labels import label_frames

QUICK = tr.FindPoseConfig(num_candidates=8, num_placed=2, num_searched=1, search_rounds=1)


@pytest.fixture(scope="module")
def layer():
    shape = finger(dtype=torch.float32)
    return tr.PoseInitializer(shape, tr.PoseInitializerConfig(find_pose=QUICK), model_points=tr.sample_skin(shape, 80))


@pytest.fixture(scope="module")
def motion(layer):
    poses = torch.zeros(3, 7)
    poses[:, 0] = torch.tensor([0.3, 0.303, 0.9])  # the last one jumps
    poses[:, 6] = torch.tensor([0.2, 0.25, 0.8])
    return poses, tr.sample_skin(layer.shape, 120, seed=4)(poses)


def test_frames_follow_one_another_and_are_searched_after_a_jump(layer, motion):
    poses, frames = motion
    labels = list(label_frames(layer, frames, start=poses[0]))
    assert len(labels) == 3
    for label, pose in zip(labels[:2], poses, strict=False):
        torch.testing.assert_close(label.pose, pose, atol=0.02, rtol=0)
    for label in labels:
        assert label.confidence > 0.5
        near = layer.shape.distance(label.points, label.pose).abs() < 0.003
        assert near.float().mean() > 0.95
    nearest = layer.shape.part_distances(frames[0], poses[0]).argmin(-1)
    assert (labels[0].parts == nearest).float().mean() > 0.95


def test_points_off_the_surface_have_no_part(layer, motion):
    poses, frames = motion
    cloud = torch.cat([frames[0], torch.tensor([[0.3, 0.3, 0.0]])])
    (label,) = label_frames(layer, [cloud], start=poses[0])
    assert label.parts[-1] == -1
    assert (label.parts[:-1] >= 0).float().mean() > 0.95
