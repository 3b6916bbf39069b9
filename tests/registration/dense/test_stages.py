from dataclasses import replace

import numpy as np
import pytest
import torch

from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.datasets.scan_sequences import walking_figure
from torchreg.geometry.range_scan import RangeScan
from torchreg.geometry.rigid import se3_exp
from torchreg.registration.dense.config import (
    ChoiceConfig,
    EMConfig,
    ScanAlignConfig,
)
from torchreg.registration.dense.oriented_samples import OrientedSamples
from torchreg.registration.dense.problem import describe
from torchreg.registration.dense.stages import (
    Reporter,
    agree,
    embedded,
    follow_regions,
    judge,
    leaps,
    loses_limb,
    mismatch,
    overlaps,
    refine,
    used_samples,
)

CONFIG = ScanAlignConfig(num_samples=400, num_target_samples=800, num_nodes=30)


@pytest.fixture(scope="module")
def pair():
    return walking_figure(3, scanner=DepthScanner(num_points=1500)).pair(0, 1)


@pytest.fixture(scope="module")
def problem(pair):
    return describe(pair.source, pair.target, CONFIG)


@pytest.fixture
def reporter():
    records = []
    return Reporter("some", 2.0, records.append), records


def misses(pair, problem, transforms):
    truth = problem.unit.normalize(pair.truth[problem.samples])
    return (problem.graph(transforms) - truth).norm(dim=-1)


def test_steps_come_nearer_and_report(pair, problem, reporter):
    rest = problem.graph.rest()
    moved = refine(problem, rest, EMConfig(num_steps=3, final_steps=1), reporter[0])
    assert float(misses(pair, problem, moved).mean()) < float(misses(pair, problem, rest).mean())
    assert len(reporter[1]) == 4
    widths = [record.width for record in reporter[1]]
    assert widths == sorted(widths, reverse=True)
    assert (widths[0], widths[-1]) == pytest.approx((2 * 0.025, 2 * 0.006))
    assert all(record.hypothesis == "some" and record.stage == "refine" for record in reporter[1])


def test_small_sigmas_use_more_samples(problem):
    config = EMConfig(density=0.1, least_samples=50)
    assert len(used_samples(problem, problem.graph.rest(), 0.1, config)) == 50
    assert len(used_samples(problem, problem.graph.rest(), 0.02, config)) == 250
    assert len(used_samples(problem, problem.graph.rest(), 0.001, config)) == 400


def test_a_near_start_begins_with_a_smaller_sigma(problem, reporter):
    refine(problem, problem.graph.rest(), EMConfig(num_steps=2, final_steps=1), reporter[0], 0.01)
    assert [record.width for record in reporter[1]] == pytest.approx([0.02, 0.012, 0.012])


def test_refinement_can_be_taken_in_parts(problem, reporter):
    config, rest = EMConfig(num_steps=4, final_steps=1), problem.graph.rest()
    whole = refine(problem, rest, config, reporter[0], 0.02)
    records = reporter[1].copy()
    begun = refine(problem, rest, config, reporter[0], 0.02, slice(2))
    assert torch.equal(refine(problem, begun, config, reporter[0], 0.02, slice(2, None)), whole)
    assert reporter[1][len(records) :] == records


def test_samples_without_a_match_stay_about_where_they_are_expected(problem, reporter):
    rest = problem.graph.rest()
    shift = torch.tensor([0.02, -0.01, 0.03], dtype=torch.float64)
    waiting = replace(problem, expected=problem.graph(rest) + shift)
    # Nothing is matched by a sigma so small; when all is matched, next to nothing holds it.
    alone = EMConfig(num_steps=4, final_steps=0, sigma=(1e-4, 1e-4), beyond=0)
    held = refine(waiting, rest, alone, reporter[0])
    torch.testing.assert_close(problem.graph(held), waiting.expected, rtol=0, atol=1e-3)
    free = problem.graph(refine(waiting, rest, replace(alone, expected=0.0), reporter[0]))
    assert float((free - problem.graph(rest)).norm(dim=-1).median()) < 0.1 * float(shift.norm())
    matched = EMConfig(num_steps=3, final_steps=1)
    plain, aware = (problem.graph(refine(each, rest, matched, reporter[0])) for each in (problem, waiting))
    assert float((plain - aware).norm(dim=-1).median()) < 0.1 * float(shift.norm())


def test_wide_regions_are_strained_less_where_samples_follow(problem, reporter):
    rest, config = problem.graph.rest(), EMConfig(num_steps=4, final_steps=0)
    half = torch.full_like(problem.graph.points[:, 0], 0.5)
    strains = [
        problem.regions.strain(
            problem.graph(refine(problem, rest, replace(config, regions=weight), reporter[0], follow=half))
        )
        for weight in (0.0, 0.05, 0.5)
    ]
    assert strains[0] > 1.1 * strains[1] > 1.1**2 * strains[2]
    # At the last sigma they count no more.
    last = EMConfig(num_steps=1, final_steps=3)
    begun = refine(problem, rest, last, reporter[0], steps=slice(1), follow=half)
    ends = [
        refine(problem, begun, replace(last, regions=each), reporter[0], steps=slice(1, None), follow=half)
        for each in (0, 0.1)
    ]
    assert torch.equal(*ends)


def test_who_follows_nothing_is_refined_as_ever(problem, reporter):
    rest, config = problem.graph.rest(), EMConfig(num_steps=2, final_steps=1)
    nobody = torch.zeros_like(problem.graph.points[:, 0])
    plain, following = (refine(problem, rest, config, reporter[0], follow=each) for each in (None, nobody))
    torch.testing.assert_close(problem.graph(following), problem.graph(plain))


def test_followers_are_not_drawn_along_the_surface(reporter):
    """Of a plane that went down and sideways, which its features alone tell, followers go down alone."""
    flat = torch.rand(600, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    flat[:, 2] = 0
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(600, 3)
    scan = RangeScan(flat, normals=up)
    problem = describe(scan, scan, CONFIG)
    features = torch.randn(len(problem.source), 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    source, shift = replace(problem.source, features=features), torch.tensor([0.01, 0.0, -0.01], dtype=torch.float64)
    gone = replace(problem, source=source, target=replace(source, points=source.points + shift), free=None)
    rest, config = problem.graph.rest(), EMConfig(num_steps=6, final_steps=0, regions=0.0, slide=(1.0, 1.0))
    for follow, expected in ((0.0, shift), (1.0, shift * torch.tensor([0.0, 0.0, 1.0]))):
        everyone = torch.full_like(problem.graph.points[:, 0], follow)
        moved = problem.graph(refine(gone, rest, config, reporter[0], follow=everyone))
        went = (moved - problem.graph(rest)).median(0).values
        torch.testing.assert_close(went, expected, rtol=0, atol=1e-3)


def test_cloth_does_not_follow_its_folds(reporter):
    """A tube that stands still, but for the features of its lower half, which wander around it."""
    generator = torch.Generator().manual_seed(0)
    angle, height = torch.rand(2, 1500, generator=generator, dtype=torch.float64) * torch.tensor([[2 * np.pi], [1.0]])
    around = torch.stack((angle.cos(), angle.sin(), torch.zeros_like(angle)), dim=1)
    points = 0.25 * around + height.unsqueeze(1) * torch.tensor([0.0, 0.0, 1.0])
    scan = RangeScan(points, normals=around)
    problem = describe(scan, scan, CONFIG)

    def pattern(places, turned):
        x, y, z = problem.unit.denormalize(places, points).unbind(-1)
        phase = 3 * (torch.atan2(y, x) - turned * (z < 0.5))
        return torch.stack((phase.cos(), phase.sin()), dim=1)

    source = replace(problem.source, features=pattern(problem.source.points, 0.0))
    target = replace(problem.target, features=pattern(problem.target.points, 0.4))
    worn = replace(problem, source=source, target=target, free=None)
    rest, config = problem.graph.rest(), EMConfig(near_sigma=0.04).slower()
    follow = follow_regions(worn, rest, config, ChoiceConfig())
    drawn, held = (
        (worn.graph(refine(worn, rest, config, reporter[0], 0.04, follow=each)) - worn.graph(rest)).norm(dim=-1)
        for each in (None, follow)
    )
    below = problem.unit.denormalize(worn.graph.points, points)[:, 2] < 0.4
    assert float(follow[below].mean()) > 0.9
    assert float(drawn[below].median()) > 0.02
    assert float(held[below].median()) < 0.002


def test_samples_follow_where_all_around_is_unlike(problem):
    rest, choice, config = problem.graph.rest(), ChoiceConfig(), EMConfig(surrounding=10, unlike=(0.5, 1.5))
    moved, target = problem.moved(rest), problem.target
    # By one nearest neighbor at a time.
    away = torch.cdist(embedded(moved, choice), embedded(target, choice))
    nearest = away.argmin(1)
    unlike = (moved.features - target.features[nearest]).square().sum(-1).clamp(max=2)
    unlike[away.amin(1) >= choice.cap] = 2
    expected = [
        (float(np.sort(unlike[(problem.graph.points - point).norm(dim=-1).argsort()[:10]].numpy())[4]) - 0.5) / 1.0
        for point in problem.graph.points
    ]
    found = follow_regions(problem, rest, config, choice)
    torch.testing.assert_close(found, torch.tensor(expected, dtype=torch.float64).clamp(0, 1))
    assert 0 < float(found.mean()) < 1
    # Who is where he was is like himself.
    alike = replace(problem, target=moved)
    assert float(follow_regions(alike, rest, config, choice).max()) == 0
    # Whose target is gone follows, however few there are.
    gone = replace(problem, target=replace(target, points=target.points + 10))
    everyone = follow_regions(gone, rest, replace(config, surrounding=10**6), choice)
    torch.testing.assert_close(everyone, torch.ones_like(everyone))


def test_strain_costs_as_much_as_it_weighs(problem):
    bent = problem.graph.rest()
    bent[::2, :3, 3] += 0.03
    strain = problem.regions.strain(problem.graph(bent))
    assert strain > 0.01
    plain, dear = (judge(problem, "", bent, ChoiceConfig(strain=weight)) for weight in (0.0, 3.0))
    assert dear.strain == pytest.approx(3 * strain)
    assert dear.energy - plain.energy == pytest.approx(dear.strain)
    assert replace(dear, energy=0, strain=0) == replace(plain, energy=0)


def test_leaps_cost_their_distance_up_to_a_cap(problem):
    config, rest = ChoiceConfig(leap=2.0, leap_cap=0.1), problem.graph.rest()
    places = problem.graph(rest)
    assert float(leaps(problem, places, config).max()) == 0
    for distance, cost in ((0.0, 0.0), (0.05, 0.5), (0.1, 2.0), (7.0, 2.0)):
        away = replace(problem, expected=places + distance * torch.tensor([0.6, 0.0, -0.8]))
        torch.testing.assert_close(leaps(away, places, config), torch.full_like(places[:, 0], cost))
        assert judge(away, "", rest, config).leap == pytest.approx(cost)


@pytest.fixture(scope="module")
def plates():
    """Two plates in one scan, 0.1 apart, about half as wide: a problem, and which of its nodes are on the second."""
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(1200, 3, generator=generator, dtype=torch.float64) * torch.tensor([0.5, 0.5, 0.0])
    points[600:, 0] += 0.6
    scan = RangeScan(points, normals=torch.tensor([[0.0, 0.0, 1.0]]).double().expand_as(points))
    problem = describe(scan, scan, CONFIG)
    return problem, points[problem.nodes, 0] > 0.55


def laid(problem, second, height=0.0, turn=0.0):
    """Return motions that lay the second plate on the first, above it, turned about an edge of its own."""
    motions, size = problem.graph.rest(), problem.unit.scale
    there = torch.tensor([-0.6 / size, 0.0, height], dtype=torch.float64)
    middle = problem.graph.centers[second].mean(0)
    turned = se3_exp(torch.tensor([0.0, 0, 0, turn, 0, 0], dtype=torch.float64))
    turned[:3, 3] = middle - turned[:3, :3] @ middle + there
    motions[second] = turned
    return motions


def test_limbs_in_one_place_overlap(plates):
    problem, second = plates
    config, total = ChoiceConfig(), len(problem.far)
    assert torch.equal(problem.far, problem.far.mT)
    assert not problem.far.diagonal().any()
    assert overlaps(problem, problem.moved(problem.graph.rest()), config).count_nonzero() == 0
    found = overlaps(problem, problem.moved(laid(problem, second)), config)
    # By hand, pair by pair: points alone, as all face one way.
    places = problem.graph(laid(problem, second))[:total]
    first = problem.graph.points[:total, 0] < problem.graph.points[:, 0].mean()
    away = torch.full((total,), torch.inf, dtype=torch.float64)
    for one in range(total):
        for other in (first != first[one]).nonzero()[:, 0].tolist():
            away[one] = min(away[one], float((places[one] - places[other]).norm()))
    torch.testing.assert_close(found, 1 - (away / config.overlap_cap).clamp(max=1).square())
    assert float(found.mean()) > 0.2
    # Not if one lies above the other, or faces the other way.
    for apart in (laid(problem, second, 1.01 * config.overlap_cap), laid(problem, second, 0.0, torch.pi)):
        assert overlaps(problem, problem.moved(apart), config).count_nonzero() == 0


def test_overlaps_cost_as_much_as_they_weigh_and_lose_a_limb(plates):
    problem, second = plates
    both = laid(problem, second)
    share = float(overlaps(problem, problem.moved(both), ChoiceConfig()).mean())
    plain, dear = (judge(problem, "", both, ChoiceConfig(overlap=weight)) for weight in (0.0, 3.0))
    assert dear.overlap == pytest.approx(3 * share)
    assert dear.energy - plain.energy == pytest.approx(dear.overlap)
    # Everything lies on the target: that half of it is bare tells nothing, it may be new.
    assert loses_limb(problem, both, ChoiceConfig())
    assert not loses_limb(problem, both, ChoiceConfig(lost_share=1.1 * share))


def test_better_hypotheses_are_judged_better(problem, reporter):
    rest = problem.graph.rest()
    moved = refine(problem, rest, EMConfig(num_steps=3, final_steps=1), reporter[0])
    config = ChoiceConfig()
    still, better = judge(problem, "still", rest, config), judge(problem, "better", moved, config)
    assert better.energy < still.energy
    assert still.bend == 0
    assert still.strain == pytest.approx(0, abs=1e-12)
    assert still.energy == pytest.approx(still.forward + still.seen + still.backward + still.unlike)
    far = rest.clone()
    far[:, :3, 3] += 10
    lost = judge(problem, "lost", far, config)
    assert (lost.forward, lost.backward) == (1, 1)
    # Where nothing lies on the target, features are as unlike as they usually are.
    assert lost.unlike == pytest.approx(0.4 * config.unlike)


def test_likeness_counts_where_surfaces_meet(problem):
    config, target = ChoiceConfig(), problem.target
    assert all(float(cost.max()) == 0 for cost in mismatch(problem, target, config))
    other = OrientedSamples(target.points, target.normals, target.features + 10, target.boundary)
    *_, unlike = mismatch(problem, other, config)
    torch.testing.assert_close(unlike, torch.full_like(unlike, 2 * config.unlike))
    away = OrientedSamples(target.points + 10, target.normals, target.features, target.boundary)
    apart, _, unlike = mismatch(problem, away, config)
    assert float(apart.min()) == 1
    torch.testing.assert_close(unlike, torch.full_like(apart, 0.4 * config.unlike))


def test_what_the_camera_should_have_seen_costs_its_distance(problem):
    config, moved = ChoiceConfig(seen=3.0, cap=0.05), problem.moved(problem.graph.rest())
    apart = torch.cdist(embedded(moved, config), embedded(problem.target, config)).amin(1)
    in_view = problem.free.in_view(moved.points, moved.normals, config.behind)
    _, seen, _ = mismatch(problem, moved, config)
    # Nothing up to a quarter of the cap, all from the whole cap on.
    expected = 3 * ((apart - 0.0125) / 0.0375).clamp(0, 1)
    torch.testing.assert_close(seen, expected * in_view)
    assert 0 < float(seen.mean()) < 0.9 * float(expected.mean())
    # Nearer to the camera all that faces it would have been seen, and is not there; behind the target it may be.
    forward = problem.free.picture.rotation[2]
    for shift, least, most in ((-1.0, 0.9, 1.0), (1.0, 0.0, 0.2)):
        away = replace(problem.target, points=problem.target.points + shift * forward)
        cost = mismatch(problem, away, replace(config, behind=0.01))[1]
        assert 3 * least <= float(cost.mean()) <= 3 * most


def test_where_no_camera_is_known_nothing_is_seen(problem):
    config, rest = ChoiceConfig(), problem.graph.rest()
    seen = judge(problem, "", rest, config)
    assert seen.seen > 0
    for blind in (
        judge(replace(problem, free=None), "", rest, config),
        judge(problem, "", rest, replace(config, seen=0.0)),
    ):
        assert blind.seen == 0
        assert blind.energy == pytest.approx(seen.energy - seen.seen)


def test_a_limb_is_lost_where_samples_of_both_scans_are_left_over(problem):
    rest, config = problem.graph.rest(), ChoiceConfig(cap=0.02)
    here = replace(problem, target=problem.source)
    assert not loses_limb(here, rest, config)
    # The target hides the left tenth of what is moved: there is nothing of its own left over.
    left = here.target.points[:, 0] < here.target.points[:, 0].quantile(0.1)
    values = {
        name: getattr(here.target, name)[~left] for name in ("points", "normals", "features", "boundary", "cut_off")
    }
    assert not loses_limb(replace(here, target=OrientedSamples(**values)), rest, config)
    shift = torch.where(left.unsqueeze(1), torch.tensor([0.0, 0.0, 0.3]), torch.zeros(3)).double()
    elsewhere = replace(here.target, points=here.target.points + shift)
    assert loses_limb(replace(here, target=elsewhere), rest, config)
    assert not loses_limb(replace(here, target=elsewhere), rest, replace(config, lost_share=0.2))


def test_hypotheses_agree_where_nearly_all_samples_do(problem):
    rest, config = problem.graph.rest(), ChoiceConfig()
    whole = se3_exp(torch.tensor([0.003, 0, 0, 0, 0, 0], dtype=torch.float64)).expand_as(rest)
    assert agree(problem, rest, whole, config)
    one = rest.clone()
    one[3, 0, 3] += 0.05
    assert not agree(problem, rest, one, ChoiceConfig(same_share=1.0))
    assert not agree(problem, rest, 3 * whole - 2 * rest, config)


def test_samples_are_taken_back_from_where_the_camera_saw_nothing(problem, reporter):
    aside = problem.free.picture.rotation[0]
    start = problem.graph.rest()
    start[:, :3, 3] += 0.1 * aside

    def apart(transforms):
        distance, _, trust = problem.free.beyond(problem.graph(transforms), 0.02)
        return float((distance * trust).mean())

    def refined(beyond):
        # A sigma so small that next to nothing is matched.
        config = EMConfig(num_steps=4, final_steps=0, sigma=(1e-4, 1e-4), beyond=beyond)
        return refine(problem, start, config, reporter[0])

    assert apart(start) > 0.003
    assert apart(refined(1.0)) < 0.2 * apart(start)
    assert apart(refined(0.0)) > 0.8 * apart(start)
