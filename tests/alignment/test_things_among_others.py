"""A thing among other things: windows of the data, poses by matches in them, and data that a candidate misses."""

import copy
import warnings
from dataclasses import replace

import pytest
import torch

import torchreg as tr
from experiments.made_up.bodies import quadruped
from tests.alignment import made
from tests.alignment.made import generator
from torchreg.alignment.evidence.coverage import missing_data
from torchreg.alignment.fit.problem import centered_problem
from torchreg.alignment.search.windows import DataWindows
from torchreg.datasets.hand import make_hand_cloud, surface_skin
from torchreg.geometry.rotation import so3_exp


@pytest.fixture(scope="module")
def beast():
    """A skinned animal that no network knows, with a seam of joints from head to tail."""
    body = quadruped(spacing=0.04)
    return tr.ArticulatedShape.from_skinned_mesh(
        body.mesh.vertices.float(), body.mesh.faces, body.weights.float(), body.joints.float(), list(body.parents)
    ).requires_grad_(False)


def cloud_of(shape, pose, seed, **options):
    return make_hand_cloud(
        shape, pose, num_points=700, noise=0.004, outlier_ratio=0.0, skin=surface_skin(shape),
        generator=generator(seed), **options,
    ).points  # fmt: skip


def problem_of(shape, clouds, valid=None):
    valid = torch.ones_like(clouds[..., 0], dtype=torch.bool) if valid is None else valid
    rest = shape.rest_pose().expand(len(clouds), -1)
    skin = tr.sample_skin(shape, 200)
    return centered_problem(skin, clouds, valid, rest, torch.zeros(len(clouds), 3), prior_std=None, pose_atol=0.0)


def test_data_that_fit_in_one_window_are_one_and_things_apart_are_several(plain_hand):
    one = cloud_of(plain_hand, plain_hand.rest_pose(), 0)
    both = torch.stack([torch.cat([one, one + torch.tensor([0.5, 0.0, 0.0])]), torch.cat([one, one])])
    valid = torch.ones_like(both[..., 0], dtype=torch.bool)
    valid[1, -20:] = False
    windows = DataWindows.of(problem_of(plain_hand, both, valid))
    assert windows.row.tolist() == [0, 0, 1]
    assert sorted(window.nonzero()[0].item() for window in windows.problem.valid[:2]) == [0, len(one)]
    assert windows.problem.valid.sum(-1).tolist() == [len(one), len(one), 2 * len(one) - 20]
    assert windows.best(torch.tensor([3.0, 1.0, 2.0])).tolist() == [1, 2]


def test_pictures_tell_themselves_what_is_there(links_skin, links_pose, picture):
    """Crops are no further cut, and free space speaks for what has no data."""
    data = torch.cat([picture.points, picture.points + torch.tensor([3.0, 0.0, 0.0]).to(picture.points)])[None]
    for space, count in ((picture.free_space, 1), (None, 2)):
        problem = made.problem_of(links_skin, data, links_pose[None], free_space=space)
        assert len(DataWindows.of(problem).row) == count
        away = problem.with_data(data[:, :40], torch.ones_like(data[:, :40, 0], dtype=torch.bool))
        assert (float(missing_data(away, links_pose[None])) == 0) == (count == 1)


def test_what_a_pose_covers_misses_no_data_and_holes_count_by_their_area(plain_hand):
    """Beside the area of the hole: fingers that have no data would have as many as the rest, by their area."""
    pose = plain_hand.rest_pose()
    data = make_hand_cloud(
        plain_hand, pose, num_points=3000, noise=0.0, outlier_ratio=0.0, camera=torch.tensor([0.0, 0.5, 0.0])
    ).points
    cut = data[:, 2] < data[:, 2].quantile(0.6)
    clouds, valid = data.expand(2, -1, -1), torch.stack([torch.ones_like(cut), cut])
    missing = missing_data(problem_of(plain_hand, clouds, valid), pose.expand(2, -1))
    assert float(missing[0]) < 0.02 * len(data)
    # Surely, not most probably.
    assert 0.25 * float((~cut).sum()) < float(missing[1]) < 1.3 * float((~cut).sum())


@pytest.mark.parametrize("apart", [0.5, 1.3])
def test_a_rig_is_found_beside_something_else(beast, plain_hand, apart):
    pose = beast.rest_pose()
    pose[:3], pose[3:6] = torch.tensor([0.3, -0.2, 2.0]), torch.tensor([0.4, 1.9, -0.5])
    pose[6:] += 0.15 * torch.randn(beast.num_dofs - 6, generator=generator(4))
    pose, size = beast.clamp(pose), float((beast.surface.vertices.amax(0) - beast.surface.vertices.amin(0)).norm())
    own = cloud_of(beast, pose, 1)
    # A hand as large as the animal.
    other = cloud_of(plain_hand, plain_hand.rest_pose(), 2)
    other = (other - other.mean(0)) @ so3_exp(torch.tensor([0.3, 0.2, 1.0])).mT * size / 0.25
    data = torch.cat([own, other + own.mean(0) + torch.tensor([apart * size + 0.5, 0.0, 0.0])])
    found = tr.find_pose(beast, data)
    skin = surface_skin(beast)
    off = (skin(found.best) - skin(pose)).norm(dim=-1).mean()
    assert float(off) < 0.03 * size


def test_searches_leave_the_random_state_alone_and_repeat(beast):
    pose = beast.rest_pose()
    data = cloud_of(beast, pose, 3)
    config = replace(tr.FindPoseConfig(), num_placed=2, num_searched=1)
    before = torch.random.get_rng_state()
    first, second = (tr.find_pose(beast, data, config=config).best for _ in range(2))
    assert torch.equal(torch.random.get_rng_state(), before)
    assert torch.equal(first, second)


@pytest.mark.parametrize("data", [torch.zeros(1, 3), torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]).repeat(50, 1)])
def test_data_at_a_place_or_two_are_no_error(beast, data):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", tr.errors.DegenerateDataWarning)
        found = tr.find_pose(beast, data)
    assert bool(found.poses.isfinite().all())
    assert float(found.confidence) < 0.05


def test_a_batch_of_clouds_with_padding_is_a_loop_in_either_precision(beast):
    config = replace(tr.FindPoseConfig(), num_placed=2, num_searched=1)
    cloud = cloud_of(beast, beast.rest_pose(), 5)[:300]
    both, mask = torch.stack([cloud, cloud + 1.0]), torch.ones(2, 300, dtype=torch.bool)
    mask[1, 250:] = False
    batch = tr.find_pose(beast, both, mask=mask, config=config).best
    alone = torch.stack(
        [tr.find_pose(beast, data[told], config=config).best for data, told in zip(both, mask, strict=True)]
    )
    torch.testing.assert_close(batch, alone, rtol=0, atol=1e-4)
    double = tr.find_pose(copy.deepcopy(beast).double(), both.double(), mask=mask, config=config).best
    assert double.dtype == torch.float64
    off = surface_skin(beast)(double.float()) - surface_skin(beast)(batch)
    assert float(off.norm(dim=-1).mean()) < 0.02


def test_starts_from_which_nothing_is_found_are_searched_for_unless_they_are_meant(plain_hand):
    """Alone as in a batch; what is held, or never searched, stays with its start."""
    pose = plain_hand.clamp(plain_hand.rest_pose() + 0.1 * torch.randn(27, generator=generator(3)))
    points = cloud_of(plain_hand, pose, 0)
    wrong = pose + torch.tensor([0.3, 0.0, 0.1, 0.0, 2.5, 1.0] + [0.0] * 21)
    both = tr.align(plain_hand, torch.stack([points, points]), torch.stack([pose, wrong]))
    alone = tr.align(plain_hand, points, wrong)
    assert both.statuses == (alone.status,) * 2 == (tr.Status.CONVERGED,) * 2
    truth = plain_hand.keypoints(pose)
    assert float((both.keypoints - truth).norm(dim=-1).max()) < 0.01
    torch.testing.assert_close(both.pose[1], alone.pose, atol=1e-4, rtol=0)
    assert both.doubt[1] == alone.doubt
    assert bool(both.rivals.isnan().all())
    assert len(alone.rivals) == 0
    never = tr.align(plain_hand, points, wrong, config=tr.AlignConfig(search="never"))
    held = tr.align(plain_hand, points, wrong, locked="base")
    assert never.statuses != (tr.Status.CONVERGED,) != held.statuses
    torch.testing.assert_close(held.pose[:6], wrong[:6])
