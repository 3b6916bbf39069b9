"""Aligning: known poses come back, symmetries hold, every option does what it says, bad data show in the status."""

import math
from dataclasses import replace

import pytest
import torch

import torchreg as tr
from tests.alignment.conftest import DESCENT
from tests.alignment.made import cloud, generator, machine, off
from torchreg.geometry.rotation import so3_exp


def same_keypoints(first, second, atol=3e-4):
    torch.testing.assert_close(first.keypoints, second.keypoints, rtol=0, atol=atol)


def test_the_whole_surface_gives_the_pose_and_fields_that_agree(
    plain_hand, plain_hand_skin, clean, found, start, truth
):
    result, _ = found
    assert float(off(plain_hand, start, truth).mean()) > 0.006
    assert float(off(plain_hand, result.pose, truth).mean()) < 0.001
    assert float(off(plain_hand, result.pose, truth).max()) < 0.003
    assert bool(((result.pose >= plain_hand.lower) & (result.pose <= plain_hand.upper)).all())
    torch.testing.assert_close(result.keypoints, plain_hand.keypoints(result.pose), rtol=0, atol=1e-6)
    torch.testing.assert_close(result.registered, plain_hand_skin(result.pose), rtol=0, atol=1e-5)
    exact = plain_hand.distance(clean, result.pose)
    torch.testing.assert_close(result.distances, exact, rtol=0, atol=2e-6)
    assert bool(((exact.abs() < 0.004) <= result.inliers).all())
    assert float(result.inliers.float().mean()) > 0.95
    assert bool(((result.posterior > 0) & (result.posterior < 1)).all())
    assert result.statuses[0] in (tr.Status.CONVERGED, tr.Status.MAX_STEPS)
    assert result.sigma.shape == result.cost.shape == ()
    assert not result.pose.requires_grad


def test_one_side_with_outliers_gives_the_pose_and_the_inliers(plain_hand, plain_hand_surface, fit, start, truth):
    measured = cloud(
        plain_hand, truth, 2, skin=plain_hand_surface, camera=torch.zeros(3), noise=0.0015, outlier_ratio=0.4
    )
    result = fit(measured.points, start, config=None)
    seen = torch.bincount(measured.part_labels[measured.inliers], minlength=16)[list(plain_hand.fingertip_parts)] >= 8
    assert int(seen.sum()) >= 3
    assert float(off(plain_hand, result.pose, truth)[4::4][seen].mean()) < 0.003
    assert float((result.inliers & measured.inliers).sum() / measured.inliers.sum()) >= 0.95
    # Some of the uniform clutter lies within the threshold of the true surface; no method can exclude it.
    clutter = ~measured.inliers & (plain_hand.distance(measured.points, truth).abs() > 0.006)
    assert int((result.inliers & clutter).sum()) <= 0.05 * int(result.inliers.sum())


def test_a_batch_is_a_loop(plain_hand, plain_hand_surface, fit, start, truth):
    """Three clouds of different sizes, padded with a mask."""
    poses = truth.repeat(3, 1)
    poses[1, 6:] += 0.1
    poses[2, 3] += 1.0
    clouds = [cloud(plain_hand, pose, 5, skin=plain_hand_surface, num_points=300 + 50 * i).points
              for i, pose in enumerate(poses)]  # fmt: skip
    starts = poses + (start - truth)
    data = torch.nn.utils.rnn.pad_sequence(clouds, batch_first=True, padding_value=torch.nan)
    mask = ~data[..., 0].isnan()
    batch = fit(data, starts, mask=mask)
    assert batch.pose.shape == (3, 27)
    assert batch.registered.shape == (3, 400, 3)
    assert len(batch.status) == 3
    for row, each in enumerate(clouds):
        single = fit(each, starts[row])
        torch.testing.assert_close(batch.keypoints[row], single.keypoints, rtol=0, atol=3e-4)
        torch.testing.assert_close(batch.inliers[row, : len(each)], single.inliers)
    torch.testing.assert_close(batch.distances.isnan(), ~mask)
    assert not bool(batch.inliers[~mask].any())
    assert float(batch.posterior[~mask].abs().max()) == 0.0
    # One start serves a whole batch.
    quick = replace(DESCENT, em_steps=1, surface_steps=1)
    given, *poses = (fit(clouds[0].expand(2, -1, -1), pose, config=quick).pose
                     for pose in (starts[:1].repeat(2, 1), starts[0], starts[:1]))  # fmt: skip
    for pose in poses:
        torch.testing.assert_close(pose, given)


def test_moving_data_and_start_moves_the_answer_also_a_kilometre(plain_hand, fit, clean, start, found):
    """float32 has steps of 0.06 mm there; the fit works about the mean of the data."""
    step = torch.zeros(27)
    step[3:6] = torch.tensor([2.0, -1.0, 1.5])
    moved = plain_hand.retract(start, step)
    for turn, shift in ((so3_exp(step[3:6]), torch.tensor([0.3, -0.2, 0.4])),
                        (torch.eye(3), torch.tensor([1000.0, -1000.0, 0.0]))):  # fmt: skip
        begin = torch.cat([turn @ start[:3] + shift, (moved if shift[0] < 1 else start)[3:6], start[6:]])
        result = fit(clean @ turn.mT + shift, begin)
        torch.testing.assert_close((result.keypoints - shift) @ turn, found[0].keypoints, rtol=0, atol=5e-4)


def test_the_order_of_the_data_does_not_matter(fit, clean, start, found):
    order = torch.randperm(400, generator=generator(1))
    result = fit(clean[order], start)
    same_keypoints(result, found[0])
    torch.testing.assert_close(result.inliers, found[0].inliers[order])


@pytest.mark.parametrize("value", [7.0, math.nan, math.inf])
def test_data_that_are_masked_or_omitted_are_removed(fit, clean, start, value):
    kept = torch.rand(400, generator=generator(2)) < 0.7
    spoiled = torch.where(kept.unsqueeze(-1), clean, value)
    how = {"mask": kept} if value == 7 else {"config": replace(DESCENT, nan_policy="omit")}
    result, removed = fit(spoiled, start, **how), fit(clean[kept], start)
    same_keypoints(result, removed)
    torch.testing.assert_close(result.distances[kept], removed.distances, rtol=0, atol=3e-4)
    assert bool(result.distances[~kept].isnan().all())
    assert not bool(result.inliers[~kept].any())


def test_several_starts_give_the_best(plain_hand, fit, clean, start, found, truth):
    lost = start.clone()
    lost[:3] += 0.3
    turned = plain_hand.retract(start, torch.tensor([0.0] * 5 + [2.5] + [0.0] * 21))
    result = fit(clean, torch.stack([lost, turned, start]))
    assert result.pose.shape == (27,)
    assert isinstance(result.status, tr.Status)
    assert float(off(plain_hand, result.pose, truth).mean()) < 0.001
    costs = [fit(clean, each).cost for each in (lost, turned)]
    assert min(costs) > found[0].cost
    # The prior of the winner is about its own start.
    torch.testing.assert_close(result.cost, found[0].cost, rtol=0.02, atol=0.1)


def test_history_is_what_was_called_back_stage_after_stage(found):
    result, records = found
    assert list(result.history) == records
    assert [record.stage for record in records] == sorted(record.stage for record in records)
    em = [record for record in records if record.stage == "em"]
    assert 5 <= len(em) <= DESCENT.em_steps * 5
    assert sorted({record.step for record in em}) == list(range(5))
    for stage in ("em", "surface"):
        widths = [float(record.sigma) for record in records if record.stage == stage]
        assert widths == sorted(widths, reverse=True)
    assert float(records[-1].pose_change.max()) < 0.05
    torch.testing.assert_close(records[-1].pose[0], result.pose, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    "options",
    [
        {"outlier": "volume"}, {"m_steps": 3, "em_steps": 2}, {"debias": 0.0}, {"debias": 1.0}, {"prior_std": None},
        {"pose_atol": 0.0}, {"correspondence": "softassign"}, {"correspondence": "closest"},
    ],
)  # fmt: skip
def test_every_variant_finds_the_pose(plain_hand, fit, clean, start, truth, options):
    result = fit(clean, start, config=replace(DESCENT, **options))
    assert float(off(plain_hand, result.pose, truth).mean()) < 0.0015


def test_a_tight_prior_keeps_joints_and_lets_the_base_go(fit, clean, start):
    result = fit(clean, start, config=replace(DESCENT, prior_std=1e-4, inlier_distance=0.001))
    torch.testing.assert_close(result.pose[6:], start[6:], rtol=0, atol=2e-3)
    assert float((result.pose[:3] - start[:3]).norm()) > 0.003
    torch.testing.assert_close(result.inliers, result.distances.abs() < 0.001)


def test_model_points_may_be_a_skin_points_or_nothing(plain_hand, plain_hand_surface, fit, clean, truth, start):
    """Points are meant in the initial pose and follow the found one; without any they are sampled as configured."""
    index = torch.arange(0, len(plain_hand_surface), 12)
    given = fit(clean, start, model_points=plain_hand_surface(start)[index])
    assert float((given.registered - plain_hand_surface(truth)[index]).norm(dim=-1).mean()) < 0.0015
    sampled = fit(clean, start, model_points=None, config=replace(DESCENT, num_model_points=300, sharpness=3.0))
    expected = fit(clean, start, model_points=tr.sample_skin(plain_hand, 300, sharpness=3.0))
    torch.testing.assert_close(sampled.registered, expected.registered, rtol=0, atol=0)


def test_the_rest_pose_is_where_an_alignment_starts(plain_hand, plain_hand_surface, fit):
    pose = plain_hand.rest_pose()
    pose[7:] += 0.15
    pose = plain_hand.clamp(pose)
    result = fit(cloud(plain_hand, pose, skin=plain_hand_surface).points)
    assert float(off(plain_hand, result.pose, pose).mean()) < 0.001


@pytest.mark.parametrize("search", ["never", "auto", "always"])
def test_a_bolted_machine_with_a_slide_finds_its_joints(search):
    lift = machine(free_base=False)
    truth, start = lift.rest_pose(), lift.rest_pose()
    truth[6:], start[6:] = torch.tensor([0.31, 0.5]), torch.tensor([0.25, 0.3])
    skin = tr.sample_skin(lift, 400, seed=3)
    data = skin(truth) + 0.003 * torch.randn(400, 3, generator=generator())
    config = tr.AlignConfig(search=search, num_candidates=8)
    result = tr.align(lift, data.repeat(2, 1, 1), start, model_points=skin, config=config)
    assert bool((result.pose[:, :6] == 0).all())
    assert result.pose[0, 6:].tolist() == pytest.approx([0.31, 0.5], abs=0.02)
    assert float(result.inliers.float().mean()) > 0.9
    torch.testing.assert_close(result.pose[0], result.pose[1], rtol=0, atol=2e-3)


def test_a_search_depends_on_its_seed_only(plain_hand, fit, clean, truth):
    config = tr.AlignConfig(search="always", num_candidates=6, search_rounds=1, seed=3)
    closed, index = truth.clone(), plain_hand.dof_names.index("index_mcp_flexion")
    closed[index : index + 3] = torch.tensor([1.5, 1.4, 1.0])
    first = fit(clean, closed, config=config)
    state = torch.manual_seed(6).get_state()
    second, other = fit(clean, closed, config=config), fit(clean, closed, config=replace(config, seed=4))
    assert torch.equal(torch.get_rng_state(), state)
    torch.testing.assert_close(first.pose, second.pose, rtol=0, atol=0)
    assert not torch.equal(first.pose, other.pose)
    plain = fit(clean, truth, config=None)
    assert len(fit(clean, truth, config=config).history) > len(plain.history)
    assert float(first.cost) <= float(fit(clean, closed).cost)


def test_an_alignment_is_no_worse_than_the_start_that_was_found(plain_hand, plain_hand_skin, fit):
    """Of a hand that is edge-on an EM would draw the fingers into the palm."""
    pose = torch.cat([torch.tensor([0.0, 0.0, 0.5, 0.1, 1.5, 0.2]), 0.3 * plain_hand.upper[6:].clamp_min(0)])
    points = cloud(plain_hand, pose, 24, num_points=500, outlier_ratio=0.15, camera=torch.zeros(3)).points
    result, starts = fit(points, config=None), tr.find_pose(plain_hand, points, model_points=plain_hand_skin)
    assert result.cost <= starts.costs[0] + 1.0


@pytest.mark.parametrize("search", ["never", "auto"])
@pytest.mark.parametrize("count", [1, 2, 300])
def test_too_few_points_and_outliers_alone_show_in_the_status(fit, truth, clean, count, search):
    far = truth[:3] + torch.tensor([0.0, 0.0, 0.5]) + torch.rand(300, 3, generator=generator())
    config = tr.AlignConfig(search=search, num_candidates=4, search_rounds=1)
    result = fit(clean[:count] if count < 9 else far, truth, config=config)
    assert result.status is tr.Status.FEW_INLIERS
    assert bool(torch.isfinite(result.pose).all())
    assert result.distances.shape == (count,)


def test_a_cloud_of_a_batch_may_be_empty(fit, clean, start, found):
    mask = torch.ones(2, 400, dtype=torch.bool)
    mask[1] = False
    for config in (DESCENT, tr.AlignConfig(search="always", num_candidates=3, search_rounds=1)):
        result = fit(clean.repeat(2, 1, 1), start, mask=mask, config=config)
        assert result.status[1] is tr.Status.NO_DATA
        assert result.status[0] is not tr.Status.NO_DATA
        assert bool(torch.isfinite(result.pose).all())
        torch.testing.assert_close(result.keypoints[0], found[0].keypoints, rtol=0, atol=1e-3)


def test_duplicated_points_change_little(plain_hand, fit, clean, start, truth):
    assert float(off(plain_hand, fit(clean.repeat(3, 1), start).pose, truth).mean()) < 0.001
    with pytest.warns(tr.errors.DegenerateDataWarning, match="the data lie at one place"):
        assert bool(torch.isfinite(fit(clean[:1].repeat(50, 1), start, config=None).pose).all())


def test_a_start_beyond_the_limits_is_moved_inside(plain_hand, fit, clean, truth):
    wild, inside = truth.clone(), truth.clone()
    wild[8], wild[9] = 40.0, -40.0
    wild[3:6] = truth[3:6] * (1 - 2 * math.pi / float(truth[3:6].norm()))
    inside[8], inside[9] = plain_hand.upper[8], plain_hand.lower[9]
    results = [fit(clean, pose, config=replace(DESCENT, prior_std=None)) for pose in (wild, inside)]
    same_keypoints(*results, atol=1e-3)
    assert bool(((results[0].pose >= plain_hand.lower) & (results[0].pose <= plain_hand.upper)).all())
