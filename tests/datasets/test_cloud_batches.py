"""Made-up clouds in batches: points of the shape as a camera observes them, and points of other objects."""

from dataclasses import replace

import pytest
import torch

import torchreg as tr
from torchreg.datasets import cloud_batches
from torchreg.datasets.cloud_clutter import Clutter

SIZE = 0.26
BARE = {
    "noise": (1e-6, 1e-6), "outliers": 0.0, "whole": 0.0, "hole": 0.0, "thinned": 0.0, "stretch": 0.0, "forearm": 0.0,
    "neighbor": 0.0,
}  # fmt: skip


@pytest.fixture(scope="module")
def skin(plain_hand):
    return tr.sample_skin(plain_hand, 1500)


@pytest.fixture
def drawn(plain_hand, skin, monkeypatch):
    """A function that draws clouds which vary in what is named only."""

    def draw(**changes):
        variety = replace(cloud_batches._VARIETY, **(BARE | changes))
        monkeypatch.setattr(cloud_batches, "_VARIETY", variety)
        generator = torch.Generator().manual_seed(2)
        poses = cloud_batches.random_poses(plain_hand, 8, generator)
        return cloud_batches.random_clouds(skin, SIZE, poses, 300, generator, in_scenes="scene" in changes)

    return draw


def test_bare_clouds_are_points_of_the_posed_skin(skin, drawn):
    batch = drawn()
    assert batch.mask.all()
    assert (batch.index >= 0).all()
    there = skin(batch.poses).gather(1, batch.index.unsqueeze(-1).expand(-1, -1, 3))
    torch.testing.assert_close(batch.points, there, atol=1e-5, rtol=0)


def test_a_forearm_is_no_part_of_the_hand_and_leads_away_from_it(plain_hand, drawn):
    batch = drawn(forearm=1.0)
    arm = batch.index < 0
    assert arm.double().mean() > 0.1
    base, middle = batch.poses[:, :3], plain_hand.keypoints(batch.poses).mean(1)
    away = torch.nn.functional.normalize(base - middle, dim=-1)
    along = ((batch.points - base.unsqueeze(1)) * away.unsqueeze(1)).sum(-1)
    widest = (cloud_batches._VARIETY.forearm_radius[1] + cloud_batches._VARIETY.forearm_growth * 1.5) * SIZE
    assert along[arm].mean() > 0.05 * SIZE
    assert (along[arm] > -widest - 0.5 * SIZE).all()
    assert along[~arm].mean() < 0


def test_a_second_object_is_part_of_the_cloud(drawn):
    assert ((drawn(neighbor=1.0).index < 0).double().mean(1) > 0.02).all()


def test_objects_differ_from_the_shape_by_a_share_of_its_size(skin, drawn):
    batch = drawn(stretch=0.06)
    there = skin(batch.poses).gather(1, batch.index.clamp_min(0).unsqueeze(-1).expand(-1, -1, 3))
    off = (batch.points - there).norm(dim=-1)[batch.mask].mean()
    reach = (there - batch.poses[:, None, :3]).norm(dim=-1)[batch.mask].mean()
    # A stretch along axes at random moves a point by its distance from the base times the deviation.
    assert 0.5 * 0.06 < off / reach < 2 * 0.06


def test_windows_of_scenes_hold_things_that_are_no_part_of_the_shape_and_some_do_not_show_it(drawn):
    there = drawn(scene=1.0, absent=0.0, plane=1.0, window=(0.4, 0.4), window_off=0.0)
    assert there.is_shown.all()
    assert ((there.index < 0) & there.mask).any(1).all()
    spread = there.points - there.points.mean(1, keepdim=True)
    assert (spread.norm(dim=-1)[there.mask] < 0.8 * SIZE + 1e-4).all()
    absent = drawn(scene=1.0, absent=1.0)
    assert not absent.is_shown.any()
    assert (absent.mask.sum(1) > 50).all()


def test_clutter_is_planes_behind_the_middle_and_things_of_some_size():
    clutter = Clutter(torch.Generator().manual_seed(1), torch.zeros(()), SIZE)
    middle = torch.tensor([[0.0, 0.0, 0.1], [0.2, 0.0, 0.0]])
    points, normals = clutter.plane(middle)
    local = points - points.mean(1, keepdim=True)
    assert (torch.linalg.svdvals(local)[:, 2] < 1e-4).all()
    assert (((middle.unsqueeze(1) - points) * normals).sum(-1) > 0.04 * SIZE).all()
    assert (normals[..., 2] < 0).all()
    points, normals = clutter.near(middle)
    center = points.mean(1, keepdim=True)
    assert ((points - center) * normals).sum(-1).mean() > 0.02 * SIZE
    assert ((points - center).norm(dim=-1) < 0.8 * SIZE).all()
    torch.testing.assert_close(normals.norm(dim=-1), torch.ones(2, normals.shape[1]))
