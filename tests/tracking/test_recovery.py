"""Recovery: what is tried when a fit is in doubt or lost, in which order, and how often."""

from dataclasses import replace
from itertools import pairwise

import pytest
import torch

import torchreg.tracking.recovery as recovery
from torchreg.alignment.results import PoseStarts
from torchreg.datasets.hand import hand_motion
from torchreg.tracking.evidence import is_lost
from torchreg.tracking.recovery import Recovery, rested, waited

HINGE = 6


@pytest.fixture
def tracking(arm_tracking):
    with torch.no_grad():
        yield arm_tracking


@pytest.fixture
def searches(monkeypatch, tracking):
    """Replace the search everywhere by one that answers at once, and keep what it was asked."""
    asked = []

    def find(shape, data, **options):
        asked.append((len(data), options["config"].seed))
        far = tracking.pose.clone()
        far[:3] += 0.5
        return PoseStarts(
            torch.stack([far, tracking.pose]), torch.tensor([10.0, 12.0]), torch.tensor(0.5, dtype=torch.float64)
        )

    monkeypatch.setattr(recovery, "find_pose", find)
    return asked


def attempt(tracking, state, level="full", cloud=None):
    """Return what a recovery makes of a frame after descent from a state's prediction, and what descent led to."""
    fitter, frame = tracking.fitter(recovery=level), tracking.frame(tracking.cloud if cloud is None else cloud)
    view = fitter.view_ahead(state, frame)
    fit = None if view is None else fitter.descend(view, state, frame.gap)
    return *Recovery(fitter)(state, frame, view, fit), fit


def bent(pose, angle):
    pose = pose.clone()
    pose[HINGE] += angle
    return pose


def test_a_flipped_base_is_among_the_starts(plain_hand, plain_hand_skin):
    truths = hand_motion(plain_hand, "bending_palm", 2, seed=1)
    flipped = recovery.flipped(plain_hand_skin, truths[0])
    points = plain_hand_skin(truths[0])
    center = points.mean(0)
    for pose in flipped:
        turned = plain_hand_skin(pose)
        torch.testing.assert_close(turned.mean(0), center, atol=1e-5, rtol=0)
        assert (turned - points).norm(dim=-1).max() > 0.02
    # Half turns: done twice, nothing happened.
    again = torch.stack([plain_hand_skin(pose) for pose in recovery.flipped(plain_hand_skin, flipped[2])])
    assert (again - points).norm(dim=-1).amax(-1).min() < 1e-4


def test_attempts_that_fail_become_rare(tracking):
    state, attempts = tracking.state(), []
    for number in range(120):
        if state.cool_down == 0:
            attempts.append(number)
            state = rested(state, False)
        else:
            state = waited(state)
    gaps = [later - earlier for earlier, later in pairwise(attempts)]
    assert gaps == [1, 3, 5, 9, 17, 33, 33]
    state = rested(state, True)
    assert (state.cool_down, state.failed_searches) == (0, 0)
    assert waited(state).cool_down == 0


def test_a_limb_that_was_missed_is_placed_anew(tracking):
    state = tracking.state(pose=bent(tracking.pose, -1.2), failed_searches=1)
    fit, after, descended = attempt(tracking, state)
    assert (descended.world - tracking.pose)[HINGE].abs() > 0.2
    assert fit.how in ("surface", "starts")
    torch.testing.assert_close(fit.world, tracking.pose, atol=0.01, rtol=0)
    assert fit.explained > descended.explained + 4
    # Nothing that data show goes so far in a frame: the doubt remains.
    assert (after.cool_down, after.failed_searches) == (2, 2)


def test_nothing_is_tried_where_it_may_not_or_was_tried_lately(tracking, searches):
    for level, changes in (("none", {}), ("full", {"cool_down": 2})):
        state = tracking.state(pose=bent(tracking.pose, -0.3), **changes)
        fit, after, descended = attempt(tracking, state, level)
        assert fit is descended
        assert after == waited(state)
    assert searches == []


def test_what_is_long_lost_is_sought_everywhere_and_taken_where_it_is_nearest(tracking, searches):
    away = tracking.pose.clone()
    away[0] -= 5
    for lost, level, found in ((2, "full", False), (3, "starts", False), (3, "full", True)):
        fit, after, descended = attempt(tracking, tracking.state(pose=away, lost=lost), level)
        assert descended is None
        assert (fit is not None) == found
        assert (after.failed_searches == 0) == found
    assert fit.how == "found"
    torch.testing.assert_close(fit.world, tracking.pose, atol=5e-3, rtol=0)
    assert searches == [(300, 0)]


def test_first_frames_take_the_best_of_what_is_found(tracking, searches):
    fitter = tracking.fitter()
    state, frame = tracking.state(num_inliers=0.0, ratio_in_reach=0.0), tracking.frame(torch.cat([tracking.cloud] * 11))
    assert Recovery(fitter).everywhere(state, frame) is None
    # The best is half a metre away, where no data are; no more data are searched than tell anything.
    assert searches == [(3000, seed) for seed in range(4)]


def test_what_lies_beside_its_data_is_sought_again_until_a_pose_explains_them(tracking, monkeypatch):
    """The first search leads to the arm half a radian off, the second to the truth, and there is no third."""
    poses, asked = [bent(tracking.pose, 0.9), tracking.pose, tracking.pose], []

    def find(shape, data, **options):
        asked.append(options["config"])
        return PoseStarts(poses[len(asked) - 1][None], torch.tensor([10.0]), torch.tensor(0.1, dtype=torch.float64))

    monkeypatch.setattr(recovery, "find_pose", find)
    state = tracking.state(num_inliers=0.0, ratio_in_reach=0.0, residual=0.0)
    monkeypatch.setattr(recovery, "is_vague", lambda state, fit: len(asked) < 2)
    fit = Recovery(tracking.fitter()).everywhere(state, tracking.frame())
    assert [config.seed for config in asked] == [0, 1]
    assert asked[1].num_candidates == 2 * asked[0].num_candidates
    torch.testing.assert_close(fit.world, tracking.pose, atol=5e-3, rtol=0)


def test_noise_is_no_shape_and_a_hidden_one_is_not_sought(tracking, searches):
    low, high = tracking.cloud.amin(0), tracking.cloud.amax(0)
    noise = low + (high - low) * torch.rand(300, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    state = tracking.state(lost=3, cool_down=0)
    fit, after, _ = attempt(tracking, state, cloud=noise[:40])
    assert fit is None or is_lost(state, fit)
    assert searches == []
    assert after.failed_searches == 0
    fit, after, _ = attempt(tracking, state, cloud=noise)
    assert fit is None or is_lost(state, fit)
    assert len(searches) == 1
    assert after == replace(state, failed_searches=1)


def test_no_attempt_takes_the_trunk_farther_than_it_gets(tracking):
    state, frame, fitter = tracking.state(), tracking.frame(tracking.cloud), tracking.fitter()
    recover = Recovery(fitter)
    view = fitter.view_ahead(state, frame)
    fit = fitter.fit(view, state, "surface", view.problem.prior.mean)
    for dof, step, far in (
        (0, 0.3 * fitter.size, False),
        (0, 0.5 * fitter.size, True),
        (3, 1.0, False),
        (3, 2.0, True),
    ):
        moved = fit.pose.clone()
        moved[0, dof] += step
        gone = replace(fit, pose=moved)
        assert recover._leaps(state, frame, gone) == far
        # What was lost for a while may be anywhere, and a search everywhere takes nothing from the prediction.
        assert not recover._leaps(replace(state, lost=3), frame, gone)
        assert not recover._leaps(state, frame, replace(gone, how="found"))
