"""Labels of a motion: poses frame from frame, a search where that fails, parts of the points."""

import pytest
import torch

from torchreg.alignment.find_pose import FindPoseConfig
from torchreg.alignment.pose_initializer import PoseInitializer, PoseInitializerConfig
from torchreg.alignment.pseudo_labels import label_frames
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.primitives import Primitive
from torchreg.shapes.skin import sample_skin

QUICK = FindPoseConfig(num_candidates=8, num_placed=2, num_searched=1, search_rounds=1)


def offset(*place):
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor(place, dtype=torch.float64)
    return pose


@pytest.fixture(scope="module")
def layer():
    tree = KinematicTree((
        Joint("body", -1, offset(0.0, 0.0, 0.0)),
        Joint("finger", 0, offset(0.03, 0.0, 0.05), "revolute", (1.0, 0.0, 0.0), -0.5, 1.2),
    ))  # fmt: skip
    solids = [
        Primitive("ellipsoid", (0.05, 0.03, 0.06), offset(0, 0, 0)),
        Primitive("ellipsoid", (0.012, 0.015, 0.04), offset(0, 0, 0.04)),
    ]
    shape = ArticulatedShape(tree, ["body", "finger"], solids, nu=0.004).requires_grad_(False)
    return PoseInitializer(shape, PoseInitializerConfig(find_pose=QUICK), model_points=sample_skin(shape, 80))


@pytest.fixture(scope="module")
def motion(layer):
    poses = torch.zeros(3, 7)
    poses[:, 0] = torch.tensor([0.3, 0.303, 0.9])  # the last one jumps
    poses[:, 6] = torch.tensor([0.2, 0.25, 0.8])
    return poses, sample_skin(layer.shape, 120, seed=4)(poses)


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
