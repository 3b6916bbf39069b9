"""Aligning: known poses come back, symmetries hold, every option does what it says, bad data are told by the status."""

import math
from dataclasses import replace

import pytest
import torch

from torchreg.alignment.align import align
from torchreg.alignment.config import AlignConfig
from torchreg.alignment.sigma_schedule import SigmaSchedule
from torchreg.datasets.hand import make_hand_cloud
from torchreg.errors import DegenerateDataWarning
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.geometry.rigid import rigid_matrix
from torchreg.geometry.rotation import so3_exp
from torchreg.result import Status
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.hand import Hand
from torchreg.shapes.primitives import Primitive
from torchreg.shapes.skin import BendingSkin, sample_skin

# Without a search an alignment is one descent: fast, and the same whatever else is in the batch.
DESCENT = AlignConfig(search="never")


@pytest.fixture(scope="module")
def truth(plain_hand):
    """A hand half a metre away, turned, its fingers bent a little."""
    pose = plain_hand.rest_pose()
    pose[:6] = torch.tensor([0.05, -0.1, 0.5, 1.2, -0.4, 0.6])
    for index, name in enumerate(plain_hand.dof_names[6:], 6):
        pose[index] = 0.25 + 0.02 * (index % 5) if name.endswith("flexion") else 0.05
    return pose


@pytest.fixture(scope="module")
def start(truth):
    """Ten degrees off in every joint, alternating; 8 mm and 8 degrees off in the base."""
    pose = truth.clone()
    pose[6:] += math.radians(10) * (1 - 2.0 * (torch.arange(21) % 2))
    pose[:6] += torch.tensor([0.005, -0.005, 0.003, 0.1, 0.05, -0.08])
    return pose


def cloud(hand, surface, pose, seed=0, **options):
    options = {"num_points": 400, "noise": 0.001, "outlier_ratio": 0.0} | options
    return make_hand_cloud(hand, pose, skin=surface, generator=torch.Generator().manual_seed(seed), **options)


@pytest.fixture(scope="module")
def clean(plain_hand, plain_hand_surface, truth):
    """The whole surface, 1 mm noise."""
    return cloud(plain_hand, plain_hand_surface, truth).points


@pytest.fixture(scope="module")
def found(plain_hand, plain_hand_skin, clean, start):
    """One descent, and the records it called back with."""
    records = []
    result = align(plain_hand, clean, start, model_points=plain_hand_skin, config=DESCENT, on_step=records.append)
    return result, records


def offsets(hand, pose, truth):
    """Return the distances of the keypoints from their true places."""
    return (hand.keypoints(pose) - hand.keypoints(truth)).norm(dim=-1)


# Known poses come back


def test_the_whole_surface_gives_the_pose(plain_hand, found, start, truth):
    result, _ = found
    assert float(offsets(plain_hand, start, truth).mean()) > 0.006
    assert float(offsets(plain_hand, result.pose, truth).mean()) < 0.001
    assert float(offsets(plain_hand, result.pose, truth).max()) < 0.003
    torch.testing.assert_close(result.keypoints, plain_hand.keypoints(result.pose), rtol=0, atol=1e-6)
    assert bool(((result.pose >= plain_hand.lower) & (result.pose <= plain_hand.upper)).all())


def test_one_side_with_outliers_gives_the_pose_and_the_inliers(
    plain_hand, plain_hand_surface, plain_hand_skin, start, truth
):
    """What a camera sees, and 40 % outliers: the fit tells inliers from outliers."""
    measured = cloud(
        plain_hand, plain_hand_surface, truth, camera=torch.zeros(3), noise=0.0015, outlier_ratio=0.4, seed=2
    )
    result = align(plain_hand, measured.points, start, model_points=plain_hand_skin)
    seen = torch.bincount(measured.part_labels[measured.inliers], minlength=16)[list(plain_hand.fingertip_parts)] >= 8
    tips = offsets(plain_hand, result.pose, truth)[4::4]
    assert int(seen.sum()) >= 3
    assert float(tips[seen].mean()) < 0.003
    right = (result.inliers & measured.inliers).sum()
    assert float(right / measured.inliers.sum()) >= 0.95
    # Some of the uniform clutter lies within the threshold of the true surface; no method can tell it.
    beside = plain_hand.distance(measured.points, truth).abs() > 0.006
    assert int((result.inliers & ~measured.inliers & beside).sum()) <= 0.05 * int(result.inliers.sum())


def test_fields_of_the_result_fit_each_other(plain_hand, plain_hand_skin, clean, found):
    result, _ = found
    assert result.status in (Status.CONVERGED, Status.MAX_STEPS)
    assert result.registered.shape == (400, 3)
    torch.testing.assert_close(result.registered, plain_hand_skin(result.pose), rtol=0, atol=1e-5)
    exact = plain_hand.distance(clean, result.pose)
    torch.testing.assert_close(result.distances, exact, rtol=0, atol=2e-6)
    assert bool(((exact.abs() < 0.004) <= result.inliers).all())
    assert float(result.inliers.float().mean()) > 0.95
    assert bool(((result.posterior > 0) & (result.posterior < 1)).all())
    assert result.sigma.shape == result.cost.shape == ()
    assert not result.pose.requires_grad


def test_double_precision_stays_double_precision(plain_hand_skin, clean, start, truth):
    hand = Hand(dtype=torch.float64).requires_grad_(False)
    skin = BendingSkin(hand, plain_hand_skin.points)
    result = align(hand, clean.double(), start.double(), model_points=skin, config=DESCENT)
    for name in ("pose", "registered", "keypoints", "distances", "posterior", "sigma", "cost"):
        assert getattr(result, name).dtype == torch.float64
    assert float(offsets(hand, result.pose, truth.double()).mean()) < 0.001
    # Data of another precision are taken in the shape's.
    assert align(hand, clean, start, model_points=skin, config=replace(DESCENT, em_steps=1)).pose.dtype == torch.float64


# Symmetries


def assert_same_fit(hand, result, other, atol=3e-4):
    torch.testing.assert_close(result.keypoints, other.keypoints, rtol=0, atol=atol)


def test_a_batch_is_a_loop(plain_hand, plain_hand_surface, plain_hand_skin, start, truth):
    """Three clouds of different sizes, padded with a mask; one of them without the first stage's many outliers."""
    poses = truth.repeat(3, 1)
    poses[1, 6:] += 0.1
    poses[2, 3] += 1.0
    clouds = [cloud(plain_hand, plain_hand_surface, pose, 5, num_points=300 + 50 * i) for i, pose in enumerate(poses)]
    starts = poses + (start - truth)
    data = torch.full((3, 400, 3), torch.nan)
    mask = torch.zeros(3, 400, dtype=torch.bool)
    for row, each in enumerate(clouds):
        data[row, : len(each.points)], mask[row, : len(each.points)] = each.points, True
    batch = align(plain_hand, data, starts, mask=mask, model_points=plain_hand_skin, config=DESCENT)
    assert batch.pose.shape == (3, 27)
    assert batch.registered.shape == (3, 400, 3)
    assert len(batch.status) == 3
    for row, each in enumerate(clouds):
        single = align(plain_hand, each.points, starts[row], model_points=plain_hand_skin, config=DESCENT)
        torch.testing.assert_close(batch.keypoints[row], single.keypoints, rtol=0, atol=3e-4)
        torch.testing.assert_close(batch.inliers[row, : len(each.points)], single.inliers)
    torch.testing.assert_close(batch.distances.isnan(), ~mask)
    assert not bool(batch.inliers[~mask].any())
    assert float(batch.posterior[~mask].abs().max()) == 0.0


def test_one_start_serves_a_whole_batch(plain_hand, plain_hand_skin, clean, start):
    quick = replace(DESCENT, em_steps=1, surface_steps=1)
    both = torch.stack([clean, clean.flip(0)])
    shared = align(plain_hand, both, start, model_points=plain_hand_skin, config=quick)
    each = align(plain_hand, both, start.repeat(2, 1), model_points=plain_hand_skin, config=quick)
    torch.testing.assert_close(shared.pose, each.pose)
    rows = align(plain_hand, both, start.unsqueeze(0), model_points=plain_hand_skin, config=quick)
    torch.testing.assert_close(rows.pose, each.pose)


def test_moving_data_and_start_moves_the_answer(plain_hand, plain_hand_skin, clean, start, found):
    step = torch.zeros(27)
    step[3:6] = torch.tensor([2.0, -1.0, 1.5])
    turn, shift = so3_exp(step[3:6]), torch.tensor([0.3, -0.2, 0.4])
    moved = start.clone()
    moved[3:6] = plain_hand.retract(start, step)[3:6]
    moved[:3] = turn @ start[:3] + shift
    result = align(plain_hand, clean @ turn.mT + shift, moved, model_points=plain_hand_skin, config=DESCENT)
    torch.testing.assert_close(result.keypoints, found[0].keypoints @ turn.mT + shift, rtol=0, atol=3e-4)


def test_the_order_of_the_data_does_not_matter(plain_hand, plain_hand_skin, clean, start, found):
    order = torch.randperm(400, generator=torch.Generator().manual_seed(1))
    result = align(plain_hand, clean[order], start, model_points=plain_hand_skin, config=DESCENT)
    assert_same_fit(plain_hand, result, found[0])
    torch.testing.assert_close(result.inliers, found[0].inliers[order])


def test_masking_points_is_removing_them(plain_hand, plain_hand_skin, clean, start):
    mask = torch.rand(400, generator=torch.Generator().manual_seed(2)) < 0.7
    spoiled = torch.where(mask.unsqueeze(-1), clean, 7.0)
    masked = align(plain_hand, spoiled, start, mask=mask, model_points=plain_hand_skin, config=DESCENT)
    removed = align(plain_hand, clean[mask], start, model_points=plain_hand_skin, config=DESCENT)
    assert_same_fit(plain_hand, masked, removed)
    torch.testing.assert_close(masked.distances[mask], removed.distances, rtol=0, atol=3e-4)
    assert bool(masked.distances[~mask].isnan().all())


def test_data_a_kilometre_away_lose_only_their_own_rounding(plain_hand, plain_hand_skin, clean, start, found):
    """float32 has steps of 0.06 mm there; the fit works about the mean of the data."""
    away = torch.tensor([1000.0, -1000.0, 0.0])
    moved = start.clone()
    moved[:3] += away
    result = align(plain_hand, clean + away, moved, model_points=plain_hand_skin, config=DESCENT)
    torch.testing.assert_close(result.keypoints - away, found[0].keypoints, rtol=0, atol=5e-4)


def test_several_starts_give_the_best(plain_hand, plain_hand_skin, clean, start, truth):
    lost, turned = start.clone(), start.clone()
    lost[:3] += 0.3
    turned[3:6] = plain_hand.retract(start, torch.tensor([0.0] * 3 + [0.0, 0.0, 2.5] + [0.0] * 21))[3:6]
    starts = torch.stack([lost, turned, start])
    result = align(plain_hand, clean, starts, model_points=plain_hand_skin, config=DESCENT)
    assert result.pose.shape == (27,)
    assert isinstance(result.status, Status)
    assert float(offsets(plain_hand, result.pose, truth).mean()) < 0.001
    costs = [align(plain_hand, clean, each, model_points=plain_hand_skin, config=DESCENT).cost for each in starts]
    assert min(costs) == costs[2]
    # The prior of the winner is about its own start.
    torch.testing.assert_close(result.cost, costs[2], rtol=0.02, atol=0.1)


# Records and results


def test_a_result_has_one_status_per_problem(result):
    assert result.history == ()
    assert result.statuses == (Status.CONVERGED,)
    assert replace(result, status=(Status.NO_DATA, Status.CONVERGED)).statuses == (Status.NO_DATA, Status.CONVERGED)


def test_history_is_what_was_called_back_stage_after_stage(found):
    result, records = found
    assert list(result.history) == records
    stages = [record.stage for record in records]
    assert stages == sorted(stages)
    assert set(stages) == {"em", "surface"}
    em = [record for record in records if record.stage == "em"]
    assert len(em) <= DESCENT.em_steps * 5
    steps = [record.step for record in em]
    assert steps == sorted(steps)
    assert set(steps) == set(range(5))
    for stage in ("em", "surface"):
        widths = [float(record.sigma) for record in records if record.stage == stage]
        assert widths == sorted(widths, reverse=True)
    assert float(records[-1].pose_change.max()) < 0.05
    torch.testing.assert_close(records[-1].pose[0], result.pose, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    "schedule",
    [
        SigmaSchedule.geometric(0.02, 0.005, 3),
        SigmaSchedule.linear(0.02, 0.005, 4),
        SigmaSchedule.constant(0.01, 2),
        SigmaSchedule.adaptive(0.02, 0.004, 6),
    ],
)
def test_a_schedule_is_followed(plain_hand, plain_hand_skin, clean, start, truth, schedule):
    config = replace(DESCENT, schedule=schedule, surface_steps=0)
    result = align(plain_hand, clean, start, model_points=plain_hand_skin, config=config)
    assert {record.stage for record in result.history} == {"em"}
    assert {record.num_steps for record in result.history} == {schedule.steps}
    used = [float(record.sigma) for record in result.history]
    if schedule.kind == "fixed":
        expected = sorted(set(schedule.values), reverse=True)
        assert list(dict.fromkeys(used)) == pytest.approx(expected)
    else:
        assert used[0] == pytest.approx(schedule.values[0])
        assert used[-1] < used[0]
        assert min(used) >= schedule.values[1] * (1 - 1e-6)
    assert float(result.sigma) == pytest.approx(used[-1] if schedule.kind == "fixed" else float(result.sigma))
    before, after = (float(offsets(plain_hand, pose, truth).mean()) for pose in (start, result.pose))
    assert after < 0.8 * before


@pytest.mark.parametrize("correspondence", ["em", "softassign", "closest"])
def test_other_correspondences_align_too(plain_hand, plain_hand_skin, clean, start, truth, correspondence):
    config = replace(DESCENT, correspondence=correspondence, em_steps=6, surface_steps=0)
    result = align(plain_hand, clean, start, model_points=plain_hand_skin, config=config)
    before, after = (float(offsets(plain_hand, pose, truth).mean()) for pose in (start, result.pose))
    assert after < 0.6 * before


def test_without_surface_steps_there_is_no_surface_fit(plain_hand, plain_hand_skin, clean, start, found):
    config = replace(DESCENT, surface_steps=0)
    result = align(plain_hand, clean, start, model_points=plain_hand_skin, config=config)
    assert {record.stage for record in result.history} == {"em"}
    torch.testing.assert_close(result.sigma, result.history[-1].sigma[0])
    assert float(result.distances.abs().mean()) > float(found[0].distances.abs().mean())


# Options


@pytest.mark.parametrize(
    "options",
    [
        {"outlier": "volume"},
        {"m_steps": 3, "em_steps": 2},
        {"debias": 0.0},
        {"debias": 1.0},
        {"prior_std": None},
        {"prior_std": 1.0},
        {"pose_atol": 0.0},
    ],
)
def test_every_variant_finds_the_pose(plain_hand, plain_hand_skin, clean, start, truth, options):
    config = replace(DESCENT, **options)
    result = align(plain_hand, clean, start, model_points=plain_hand_skin, config=config)
    assert float(offsets(plain_hand, result.pose, truth).mean()) < 0.0015


def test_a_tight_prior_keeps_joints_and_lets_the_base_go(plain_hand, plain_hand_skin, clean, start, truth):
    config = replace(DESCENT, prior_std=1e-4)
    result = align(plain_hand, clean, start, model_points=plain_hand_skin, config=config)
    torch.testing.assert_close(result.pose[6:], start[6:], rtol=0, atol=2e-3)
    assert float((result.pose[:3] - start[:3]).norm()) > 0.003


def test_the_inlier_threshold_is_the_one_given(plain_hand, plain_hand_skin, clean, start):
    config = replace(DESCENT, inlier_distance=0.001)
    result = align(plain_hand, clean, start, model_points=plain_hand_skin, config=config)
    torch.testing.assert_close(result.inliers, result.distances.abs() < 0.001)


def test_model_points_may_be_a_skin_points_or_nothing(plain_hand, plain_hand_surface, clean, truth, start):
    """Points are meant in the initial pose and follow the found one; without any they are sampled as configured."""
    index = torch.arange(0, len(plain_hand_surface), 12)
    points = plain_hand_surface(start)[index]
    given = align(plain_hand, clean, start, model_points=points, config=DESCENT)
    assert given.registered.shape == points.shape
    assert float((given.registered - plain_hand_surface(truth)[index]).norm(dim=-1).mean()) < 0.0015
    sampled = align(plain_hand, clean, start, config=replace(DESCENT, num_model_points=300, sharpness=3.0))
    skin = sample_skin(plain_hand, 300, sharpness=3.0)
    expected = align(plain_hand, clean, start, model_points=skin, config=DESCENT)
    torch.testing.assert_close(sampled.registered, expected.registered, rtol=0, atol=0)


def test_the_rest_pose_is_where_an_alignment_starts(plain_hand, plain_hand_surface, plain_hand_skin):
    pose = plain_hand.rest_pose()
    pose[7:] += 0.15
    pose = plain_hand.clamp(pose)
    data = cloud(plain_hand, plain_hand_surface, pose).points
    result = align(plain_hand, data, model_points=plain_hand_skin, config=DESCENT)
    assert float(offsets(plain_hand, result.pose, pose).mean()) < 0.001


def offset(*place):
    return rigid_matrix(torch.eye(3, dtype=torch.float64), torch.tensor(place, dtype=torch.float64))


@pytest.fixture(scope="module")
def lift():
    """A machine bolted to the origin: a mast, a carriage that slides up on it, a hinged arm, all of unlike sizes."""
    tree = KinematicTree((
        Joint("mast", -1, offset(0.0, 0.0, 0.0)),
        Joint("carriage", 0, offset(0.15, 0.0, 0.2), "prismatic", (0.0, 0.0, 1.0), 0.0, 0.5),
        Joint("arm", 1, offset(0.1, 0.0, 0.0), "revolute", (0.0, 1.0, 0.0), -1.5, 1.5),
    ))  # fmt: skip
    solids = [
        Primitive("superquadric", (0.06, 0.09, 0.5, 0.5, 0.5), offset(0, 0, 0.5)),
        Primitive("ellipsoid", (0.12, 0.1, 0.08), offset(0, 0, 0)),
        Primitive("cone", (0.2, 0.07, 0.04), offset(0, 0, 0.2)),
    ]
    shape = ArticulatedShape(tree, ["mast", "carriage", "arm"], solids, nu=0.01, free_base=False)
    return shape.requires_grad_(False)


@pytest.mark.parametrize("search", ["never", "auto", "always"])
def test_a_bolted_machine_with_a_slide_finds_its_joints(lift, search):
    truth, start = lift.rest_pose(), lift.rest_pose()
    truth[6:], start[6:] = torch.tensor([0.31, 0.5]), torch.tensor([0.25, 0.3])
    skin = sample_skin(lift, 400, seed=3)
    generator = torch.Generator().manual_seed(0)
    data = skin(truth) + 0.003 * torch.randn(400, 3, generator=generator)
    config = AlignConfig(search=search, num_candidates=8)
    result = align(lift, data, start, model_points=sample_skin(lift, 300), config=config)
    assert bool((result.pose[:6] == 0).all())
    assert result.pose[6:].tolist() == pytest.approx([0.31, 0.5], abs=0.02)
    assert float(result.inliers.float().mean()) > 0.9
    batch = align(lift, data.repeat(2, 1, 1), start, model_points=skin, config=config)
    assert bool((batch.pose[:, :6] == 0).all())
    torch.testing.assert_close(batch.pose[0], batch.pose[1], rtol=0, atol=2e-3)


# Search


@pytest.fixture(scope="module")
def misled(plain_hand, truth):
    """A start whose index finger is closed, so that a descent takes it for another place."""
    pose = truth.clone()
    index = [number for number, name in enumerate(plain_hand.dof_names) if name.startswith("index")]
    pose[index[1:]] = torch.tensor([1.5, 1.4, 1.0])
    return pose


def test_a_search_finds_what_a_descent_does_not(plain_hand, plain_hand_skin, clean, misled, truth):
    tips = {}
    for search in ("never", "auto", "always"):
        result = align(plain_hand, clean, misled, model_points=plain_hand_skin, config=AlignConfig(search=search))
        tips[search] = float(offsets(plain_hand, result.pose, truth)[8])
        assert float((result.history[-1].pose[0, :3] - result.pose[:3]).norm()) < 0.02
        assert [record.stage for record in result.history][-1] == "surface"
    assert tips["auto"] < 0.003
    assert tips["always"] < 0.003
    assert tips["never"] > 0.01


def test_a_search_is_left_out_where_the_descent_can_be_trusted(plain_hand, plain_hand_skin, clean, truth):
    start = truth.clone()
    start[6:] += 0.03
    counts = {
        search: len(align(plain_hand, clean, start, model_points=plain_hand_skin, config=replace(
            DESCENT, search=search, num_candidates=4, search_rounds=1)).history)
        for search in ("never", "auto", "always")
    }  # fmt: skip
    assert counts["never"] == counts["auto"] < counts["always"]


def test_only_the_problems_that_need_it_are_searched(plain_hand, plain_hand_skin, clean, truth, misled):
    near = truth.clone()
    near[6:] += 0.03
    starts, data = torch.stack([near, misled]), clean.repeat(2, 1, 1)
    apart = torch.tensor([0.0, 0.7, 0.0])
    starts[1, :3] += apart
    data[1] += apart
    result = align(plain_hand, data, starts, model_points=plain_hand_skin)
    # The records of the search are about the second problem alone.
    assert result.history[-1].pose.shape == (1, 27)
    assert float((result.history[-1].pose[0, :3] - result.pose[1, :3]).norm()) < 0.02
    plain = align(plain_hand, data, starts, model_points=plain_hand_skin, config=DESCENT)
    torch.testing.assert_close(result.pose[0], plain.pose[0], rtol=0, atol=0)
    moved = truth.clone()
    moved[:3] += apart
    assert float(offsets(plain_hand, result.pose[1], moved)[8]) < 0.003
    assert float(result.cost[1]) <= float(plain.cost[1])


def test_a_search_depends_on_its_seed_only(plain_hand, plain_hand_skin, clean, misled):
    config = AlignConfig(search="always", num_candidates=6, search_rounds=1, seed=3)
    torch.manual_seed(5)
    state = torch.get_rng_state()
    first = align(plain_hand, clean, misled, model_points=plain_hand_skin, config=config)
    assert bool((torch.get_rng_state() == state).all())
    torch.manual_seed(6)
    second = align(plain_hand, clean, misled, model_points=plain_hand_skin, config=config)
    torch.testing.assert_close(first.pose, second.pose, rtol=0, atol=0)
    other = align(plain_hand, clean, misled, model_points=plain_hand_skin, config=replace(config, seed=4))
    assert not torch.equal(first.pose, other.pose)


# Bad data


@pytest.mark.parametrize("search", ["never", "auto"])
@pytest.mark.parametrize("count", [1, 2])
def test_one_point_is_too_few_to_mean_anything(plain_hand, plain_hand_skin, truth, clean, count, search):
    config = AlignConfig(search=search, num_candidates=4, search_rounds=1)
    result = align(plain_hand, clean[:count], truth, model_points=plain_hand_skin, config=config)
    assert result.status is Status.FEW_INLIERS
    assert bool(torch.isfinite(result.pose).all())
    assert result.distances.shape == (count,)


def test_all_outliers_are_told_by_the_status(plain_hand, plain_hand_skin, truth):
    generator = torch.Generator().manual_seed(0)
    clutter = truth[:3] + torch.tensor([0.0, 0.0, 0.5]) + torch.rand(300, 3, generator=generator)
    config = AlignConfig(num_candidates=4, search_rounds=1)
    result = align(plain_hand, clutter, truth, model_points=plain_hand_skin, config=config)
    assert result.status is Status.FEW_INLIERS
    assert bool(torch.isfinite(result.pose).all())


def test_a_cloud_of_a_batch_may_be_empty(plain_hand, plain_hand_skin, clean, start, found):
    mask = torch.ones(2, 400, dtype=torch.bool)
    mask[1] = False
    result = align(plain_hand, clean.repeat(2, 1, 1), start, mask=mask, model_points=plain_hand_skin, config=DESCENT)
    assert result.status[1] is Status.NO_DATA
    assert result.status[0] is not Status.NO_DATA
    torch.testing.assert_close(result.keypoints[0], found[0].keypoints, rtol=0, atol=3e-4)
    assert bool(torch.isfinite(result.pose).all())
    searched = align(
        plain_hand, clean.repeat(2, 1, 1), start, mask=mask, model_points=plain_hand_skin,
        config=AlignConfig(search="always", num_candidates=3, search_rounds=1),
    )  # fmt: skip
    assert searched.status[1] is Status.NO_DATA
    assert bool(torch.isfinite(searched.pose).all())


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_non_finite_data_may_be_left_out(plain_hand, plain_hand_skin, clean, start, bad):
    spoiled = clean.clone()
    spoiled[::40, 1] = bad
    config = replace(DESCENT, nan_policy="omit")
    result = align(plain_hand, spoiled, start, model_points=plain_hand_skin, config=config)
    kept = torch.isfinite(spoiled).all(-1)
    removed = align(plain_hand, clean[kept], start, model_points=plain_hand_skin, config=DESCENT)
    assert_same_fit(plain_hand, result, removed)
    assert bool(result.distances[~kept].isnan().all())
    assert not bool(result.inliers[~kept].any())


def test_duplicated_points_change_little(plain_hand, plain_hand_skin, clean, start, truth):
    result = align(plain_hand, clean.repeat(3, 1), start, model_points=plain_hand_skin, config=DESCENT)
    assert float(offsets(plain_hand, result.pose, truth).mean()) < 0.001
    with pytest.warns(DegenerateDataWarning, match="the data lie at one place"):
        same = align(plain_hand, clean[:1].repeat(50, 1), start, model_points=plain_hand_skin)
    assert bool(torch.isfinite(same.pose).all())


def test_a_start_beyond_the_limits_is_moved_inside(plain_hand, plain_hand_skin, clean, truth):
    wild = truth.clone()
    wild[8] = 40.0
    wild[9] = -40.0
    wild[3:6] = truth[3:6] * (1 - 2 * math.pi / float(truth[3:6].norm()))
    inside = truth.clone()
    inside[8], inside[9] = plain_hand.upper[8], plain_hand.lower[9]
    quick = replace(DESCENT, prior_std=None)
    results = [align(plain_hand, clean, pose, model_points=plain_hand_skin, config=quick) for pose in (wild, inside)]
    assert_same_fit(plain_hand, *results, atol=1e-3)
    assert bool(((results[0].pose >= plain_hand.lower) & (results[0].pose <= plain_hand.upper)).all())


def test_clouds_are_not_changed(plain_hand, plain_hand_skin, clean, start):
    data, pose = clean.clone(), start.clone()
    align(plain_hand, data, pose, model_points=plain_hand_skin, config=replace(DESCENT, em_steps=1))
    assert torch.equal(data, clean)
    assert torch.equal(pose, start)
