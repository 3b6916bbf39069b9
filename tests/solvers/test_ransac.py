"""Rigid motions from mostly wrong matches: truth under outliers, several motions, groups, scores, refusals."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.geometry.draws import D, rand, randn, seeded
from torchreg.geometry.rigid import invert_rigid, se3_exp, transform_points
from torchreg.solvers import ransac as module
from torchreg.solvers.ransac import ransac_rigid

THRESHOLD = 0.01


def matched(seed, shares=(0.1,), count=200, noise=0.002, batch=()):
    """Source, target, their normals, and the motions behind the first shares of the rows; the rest is random."""
    generator = seeded(seed)

    def normal(*shape):
        return torch.randn(*batch, *shape, generator=generator, dtype=D)

    source, target = 0.1 * normal(count, 3), 0.3 * normal(count, 3)
    normals = [torch.nn.functional.normalize(normal(count, 3), dim=-1) for _ in range(2)]
    motions, start = [], 0
    for share in shares:
        motion = se3_exp(normal(6) * torch.tensor([0.2, 0.2, 0.2, 1.0, 1.0, 1.0]))
        rows = slice(start, start + round(share * count))
        target[..., rows, :] = transform_points(motion, source[..., rows, :]) + noise * normal(rows.stop - start, 3)
        turned = normals[0][..., rows, :] @ motion[..., :3, :3].mT + 0.1 * normal(rows.stop - start, 3)
        normals[1][..., rows, :] = torch.nn.functional.normalize(turned, dim=-1)
        motions.append(motion)
        start = rows.stop
    return source, target, {"source_normals": normals[0], "target_normals": normals[1]}, motions


def error(transform, motion, source):
    """Mean distance of the points from their true positions."""
    return (transform_points(transform, source) - transform_points(motion, source)).norm(dim=-1).mean(-1)


def found(source, target, **options):
    return ransac_rigid(source, target, threshold=THRESHOLD, **options)


@pytest.mark.parametrize("share", [0.2, 0.1])
@pytest.mark.parametrize("with_normals", [False, True])
def test_the_motion_is_found_under_80_and_90_percent_of_outliers(share, with_normals):
    source, target, normals, (motion,) = matched(0, (share,), batch=(25,))
    result, right = found(source, target, **(normals if with_normals else {})), round(share * 200)
    assert (error(result.transforms[:, 0], motion, source) < 0.004).all()
    assert (result.inliers[:, 0, :right].double().mean(-1) > 0.9).all()
    assert (result.inliers[:, 0, right:].sum(-1) <= 3).all()


def test_several_motions_come_out_best_first():
    source, target, normals, motions = matched(2, (0.25, 0.15, 0.1), batch=(8,))
    for given_normals in ({}, normals):
        result = found(source, target, **given_normals)
        for place, motion in enumerate(motions):
            assert (error(result.transforms[:, place], motion, source) < 0.004).all()
        assert (result.scores.diff(dim=-1) <= 0).all()
        assert (result.counts[:, :3] >= torch.tensor([45, 27, 17])).all()
        assert (result.counts[:, 3] < result.counts[:, 2] / 2).all()


def test_scores_counts_and_inliers_follow_their_definitions():
    source, target, normals, _ = matched(4, (0.2,))
    weights = rand(200)
    result = found(source, target, weights=weights, max_angle=0.4, **normals)
    for place, motion in enumerate(result.transforms):
        distance = (transform_points(motion, source) - target).norm(dim=-1)
        angle = torch.acos(((normals["source_normals"] @ motion[:3, :3].T) * normals["target_normals"]).sum(-1))
        within = (distance < THRESHOLD) & (angle < 0.4)
        assert torch.equal(result.inliers[place], within)
        assert int(result.counts[place]) == int(within.sum())
        torch.testing.assert_close(result.scores[place], (weights * (1 - (distance / THRESHOLD) ** 2))[within].sum())


@given(st.integers(0, 1000), st.booleans())
@settings(max_examples=15, deadline=None)
def test_motions_are_rigid_and_distinct(seed, with_normals):
    source, target, normals, _ = matched(seed, (0.3, 0.2), count=60, noise=0.004)
    result = found(source, target, num_trials=80, **(normals if with_normals else {}))
    rotation = result.transforms[:, :3, :3]
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3, dtype=D).expand(4, 3, 3), atol=1e-9, rtol=0)
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(4, dtype=D))
    moved = transform_points(result.transforms[result.counts > 0], source)
    apart = (moved[:, None] - moved).square().sum(-1).mean(-1).sqrt()
    assert bool((apart + torch.eye(len(moved)) >= 3 * THRESHOLD * (1 - 1e-9)).all())


def test_a_generator_decides_all_and_global_randomness_is_left_alone():
    source, target, _, _ = matched(5, (0.05,), count=60)
    state = torch.random.get_rng_state()
    generators = (seeded(0), seeded(0), None, seeded(1))
    runs = [found(source, target, num_trials=20, generator=generator).transforms for generator in generators]
    assert torch.equal(runs[0], runs[1])
    assert torch.equal(runs[0], runs[2])
    assert not torch.equal(runs[0], runs[3])
    assert torch.equal(torch.random.get_rng_state(), state)


@pytest.mark.parametrize("with_normals", [False, True])
def test_groups_padded_into_a_batch_equal_each_group_alone(with_normals):
    sizes, tables = [40, 75, 60], {}
    groups = [matched(seed, (0.3,), count=size) for seed, size in enumerate(sizes)]
    groups = [{"source": s, "target": t, **(normals if with_normals else {})} for s, t, normals, _ in groups]
    for name in groups[0]:
        padded = [
            torch.nn.functional.pad(group[name], (0, 0, 0, 75 - len(group[name])), value=torch.nan) for group in groups
        ]
        tables[name] = torch.stack(padded)
    batch = found(**tables, mask=torch.arange(75) < torch.tensor(sizes)[:, None], num_trials=100)
    for row, group in enumerate(groups):
        alone = found(**group, num_trials=100)
        torch.testing.assert_close(batch.transforms[row], alone.transforms, atol=1e-8, rtol=0)
        assert torch.equal(batch.inliers[row, :, : sizes[row]], alone.inliers)
        assert not batch.inliers[row, :, sizes[row] :].any()


def test_chunks_change_nothing(monkeypatch):
    source, target, _, _ = matched(7, (0.2,), count=50, batch=(3,))
    whole = found(source, target, num_trials=70)
    monkeypatch.setattr(module, "BUDGET", replace(module.BUDGET, table_entries=3 * 50 * 16))
    parts = found(source, target, num_trials=70)
    torch.testing.assert_close(parts.transforms, whole.transforms)
    assert torch.equal(parts.inliers, whole.inliers)


def test_moving_source_and_target_moves_the_motions_along():
    source, target, normals, _ = matched(8, (0.3, 0.2))
    first, second = se3_exp(randn(2, 6))
    plain = found(source, target, num_hypotheses=2, **normals)
    turned = {
        "source_normals": normals["source_normals"] @ first[:3, :3].T,
        "target_normals": normals["target_normals"] @ second[:3, :3].T,
    }
    moved = found(transform_points(first, source), transform_points(second, target), num_hypotheses=2, **turned)
    torch.testing.assert_close(moved.transforms, second @ plain.transforms @ invert_rigid(first), atol=1e-7, rtol=0)


def test_weights_choose_between_motions_and_weight_zero_is_no_inlier():
    source, target, _, (first, second) = matched(11, (0.3, 0.3))
    rows = torch.arange(200)
    for light, motion in ((rows < 60, second), ((rows >= 60) & (rows < 120), first)):
        result = found(source, target, weights=torch.where(light, 0.1, 1.0).to(D))
        assert error(result.transforms[0], motion, source) < 0.004
    assert not found(source, target, weights=(rows >= 60).to(D)).inliers[:, :60].any()


def test_normals_that_contradict_leave_nothing():
    source, target, normals, _ = matched(12, (1.0,))
    normals["target_normals"] = -normals["target_normals"]
    assert int(found(source, target, **normals).counts[0]) < 20
    assert int(found(source, target).counts[0]) == 200


@pytest.mark.parametrize("kind", ["one", "two", "line", "same", "masked", "weightless"])
def test_too_little_gives_the_identity_and_no_inliers(kind):
    line = torch.linspace(0, 1, 30, dtype=D)[:, None] * torch.tensor([[1.0, 2.0, 3.0]])
    full = torch.linalg.cross(line.sin(), line)
    source = {"one": line[:1], "two": line[:2], "line": line, "same": 0 * line + 1}.get(kind, full)
    mask, weights = (
        torch.full((len(source),), kind != "masked"),
        torch.full((len(source),), float(kind != "weightless")),
    )
    result = found(source, source, mask=mask, weights=weights, num_trials=40)
    assert (result.counts.tolist(), result.scores.tolist()) == ([0] * 4, [0] * 4)
    assert not result.inliers.any()
    assert torch.equal(result.transforms, torch.eye(4, dtype=D).expand(4, 4, 4))


def test_more_hypotheses_than_trials_are_filled_up():
    source, target, _, _ = matched(14, (0.5,))
    result = found(source, target, num_trials=2, num_hypotheses=5)
    assert result.transforms.shape == (5, 4, 4)
    assert result.counts[2:].tolist() == [0, 0, 0]
    assert torch.equal(result.transforms[4], torch.eye(4, dtype=D))
