"""Made-up people: what their poses are, and that clouds are points of them."""

from dataclasses import replace

import pytest
import torch

from tests.people import body_like_anny
from torchreg.datasets import cloud_batches, people_batches, people_poses
from torchreg.geometry.rotation import so3_exp


@pytest.fixture(scope="module")
def body():
    return body_like_anny()


def joints_of(body, states):
    """Return the joints' places (B, 3) by name, in people's own frames: mean coefficients, unturned."""
    poses = states[:, : body.num_dofs].clone()
    poses[:, :6] = 0
    return dict(zip(body.part_names, body.keypoints(poses).unbind(1), strict=True))


def with_habits(monkeypatch, arms=None, legs=None):
    still = replace(people_poses._TRUNK, every=(0, 0), spine=(0, 0, 0), head=(0, 0, 0), bent=0.0)
    monkeypatch.setattr(people_poses, "_TRUNK", still)
    for name, habits, chosen in (("_ARMS", people_poses._ARMS, arms), ("_LEGS", people_poses._LEGS, legs)):
        shares = [
            replace(habit, share=float(chosen is None or number == chosen)) for number, habit in enumerate(habits)
        ]
        monkeypatch.setattr(people_poses, name, tuple(shares))


def test_who_sits_has_knees_before_the_hips_and_feet_below_them(body, monkeypatch):
    with_habits(monkeypatch, legs=2)
    joints = joints_of(body, people_poses.people_states(body, 40, torch.Generator().manual_seed(1)))
    for side in (".L", ".R"):
        hip, knee, foot = (joints[name + side] for name in ("upperleg01", "lowerleg01", "foot"))
        assert bool((knee[:, 1] < hip[:, 1] - 0.2).all())
        assert bool((foot[:, 2] < knee[:, 2]).all())


def test_arms_are_raised_and_crossed_on_both_sides_alike(body, monkeypatch):
    with_habits(monkeypatch, arms=2)
    joints = joints_of(body, people_poses.people_states(body, 40, torch.Generator().manual_seed(2)))
    for side in (".L", ".R"):
        assert float((joints["lowerarm01" + side][:, 2] > joints["upperarm01" + side][:, 2]).double().mean()) > 0.9
    with_habits(monkeypatch, arms=3)
    joints = joints_of(body, people_poses.people_states(body, 40, torch.Generator().manual_seed(3)))
    left, right = joints["wrist.L"], joints["wrist.R"]
    assert float((left[:, 1] < 0).double().mean()) > 0.9, "crossed before the trunk"
    assert float((left[:, 0] < joints["upperarm01.L"][:, 0]).double().mean()) > 0.9
    assert float((right[:, 0] > joints["upperarm01.R"][:, 0]).double().mean()) > 0.9


def test_angles_of_a_turn_give_the_turn_back():
    vectors = torch.randn(50, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    turns = so3_exp(vectors)
    angles, axes = people_poses._angles_of(turns), torch.eye(3, dtype=torch.float64)
    x, y, z = (so3_exp(angles[:, k, None] * axes[k]) for k in range(3))
    torch.testing.assert_close(x @ y @ z, turns)


def test_a_bare_whole_cloud_is_of_the_posed_surface_and_the_marks_are_its_vertices(body, monkeypatch):
    bare = {"clothed": 0.0, "held": 0.0, "whole": 1.0, "cut": 0.0, "samples": 400}
    monkeypatch.setattr(people_batches, "_VARIETY", replace(people_batches._VARIETY, **bare))
    exact = {"noise": (1e-7, 1e-7), "outliers": 0.0, "hole": 0.0, "thinned": 0.0}
    monkeypatch.setattr(cloud_batches, "_VARIETY", replace(cloud_batches._VARIETY, **exact))
    marks = torch.arange(0, 200, 10)
    people = people_batches.PeopleBatches(body, marks)
    batch = people.clouds(6, 300, torch.Generator().manual_seed(5), 1.9)
    assert batch.mask.all()
    assert (batch.index >= 0).all()
    for row in range(6):
        vertices = body.vertices(batch.poses[row, : body.num_dofs], batch.poses[row, body.num_dofs :])
        offset = vertices[people.index].mean(0)
        torch.testing.assert_close(
            batch.points[row], vertices[people.index][batch.index[row]] - offset, atol=1e-4, rtol=0
        )
        torch.testing.assert_close(batch.marks[row], vertices[marks] - offset, atol=1e-4, rtol=0)


def test_clothes_lie_outside_the_skin_and_a_camera_sees_one_side(body, monkeypatch):
    variety = replace(people_batches._VARIETY, clothed=1.0, held=0.0, whole=0.0, cut=0.0, samples=400)
    monkeypatch.setattr(people_batches, "_VARIETY", variety)
    people = people_batches.PeopleBatches(body, torch.arange(8))
    draw = people_batches.CloudDraw(torch.Generator().manual_seed(6), people.rest.expand(20, -1, -1), 1.9, 0.0)
    cloth = people._cloth(draw)
    assert bool((cloth >= 0).all())
    bare = torch.tensor([name.startswith(("wrist", "foot")) for name in body.part_names])
    part = body.file_surface().weights[people.index].argmax(-1)
    assert float(cloth[:, bare[part]].max()) == 0
    assert 0.01 < float(cloth[:, ~bare[part]].mean()) < 0.06
    views = people_batches._cameras(draw, 50)
    torch.testing.assert_close(views @ views.mT, torch.eye(3).expand(50, -1, -1), atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.linalg.det(views), torch.ones(50))
    seen = people.clouds(20, 400, torch.Generator().manual_seed(7), 1.9)
    assert float(seen.mask.double().mean()) < 0.8, "some of the surface is hidden"
