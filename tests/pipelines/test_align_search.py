"""The search around a start: what a limb is, when a search is wanted, what candidates are, and what it finds."""

from dataclasses import replace

import pytest
import torch

from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.geometry.rigid import rigid_matrix
from torchreg.models.articulated import ArticulatedShape
from torchreg.models.hand import Hand
from torchreg.models.primitives import Primitive
from torchreg.models.skin import BendingSkin
from torchreg.models.surface import FusedSurface
from torchreg.pipelines import align_search
from torchreg.pipelines.align_objectives import PosePrior
from torchreg.pipelines.align_search import _scatter, coarse_skin, explore, limb_dofs, needs_search
from torchreg.pipelines.align_stages import AlignProblem


def make_problem(skin, data, mean):
    shape = skin.shape
    return AlignProblem(
        skin=skin,
        surface=FusedSurface(shape),
        data=data,
        valid=torch.ones(data.shape[:2], dtype=torch.bool),
        size=float((skin.points.amax(0) - skin.points.amin(0)).norm()),
        lower=shape.lower,
        upper=shape.upper,
        prior=PosePrior(mean, torch.cat([torch.zeros(6), torch.full((shape.num_dofs - 6,), 8.0)])),
        pose_atol=1e-3,
    )


@pytest.fixture(scope="module")
def truths(plain_hand):
    poses = plain_hand.rest_pose().repeat(2, 1)
    flexion = torch.tensor([name.endswith("flexion") for name in plain_hand.dof_names])
    poses[0, flexion], poses[1, flexion] = 0.15, 0.35
    poses[1, 3:6] = torch.tensor([0.3, -0.2, 0.5])
    return poses


@pytest.fixture(scope="module")
def problem(plain_hand_skin, truths):
    """Two hands in two poses; the data are exact, and centered as in an alignment."""
    data = plain_hand_skin(truths)
    mean = data.mean(1)
    poses = torch.cat([truths[:, :3] - mean, truths[:, 3:]], dim=-1)
    return make_problem(plain_hand_skin, data - mean.unsqueeze(1), poses)


@pytest.fixture(scope="module")
def exact(problem):
    """The true poses in the coordinates of the problem."""
    return problem.prior.mean


def finger(shape, name):
    return [index for index, dof in enumerate(shape.dof_names) if dof.startswith(name)]


def test_the_limbs_of_a_hand_are_its_fingers(plain_hand):
    found = [limb.tolist() for limb in limb_dofs(plain_hand)]
    assert found == [finger(plain_hand, name) for name in ("thumb", "index", "middle", "ring", "little")]


def offset(*place):
    return rigid_matrix(torch.eye(3, dtype=torch.float64), torch.tensor(place, dtype=torch.float64))


def test_limbs_follow_mimic_joints_and_leave_out_stiff_and_single_chains():
    """Two jaws on a forearm that hangs on a base: one moves the other, a third thing is rigid."""
    hinge = ("revolute", (1.0, 0.0, 0.0), -1.0, 1.0)
    tree = KinematicTree((
        Joint("base", -1, offset(0, 0, 0)),
        Joint("forearm", 0, offset(0, 0, 0.1), *hinge),
        Joint("jaw", 1, offset(0.02, 0, 0.1), *hinge),
        Joint("other_jaw", 1, offset(-0.02, 0, 0.1), *hinge, mimic=(2, -1.0, 0.0)),
        Joint("camera", 1, offset(0, 0.03, 0.1)),
        Joint("finger", 2, offset(0, 0, 0.1), *hinge),
    ))  # fmt: skip
    names = ["base", "forearm", "jaw", "other_jaw", "camera", "finger"]
    shape = ArticulatedShape(tree, names, [Primitive("capsule", (0.04, 0.01), offset(0, 0, 0.05))] * 6)
    assert shape.dof_names[6:] == ("forearm", "jaw", "finger")
    assert [limb.tolist() for limb in limb_dofs(shape)] == [[7, 8], [7]]
    chain = ArticulatedShape(
        KinematicTree(tree.joints[:3]), names[:3], [Primitive("capsule", (0.04, 0.01), offset(0, 0, 0))] * 3
    )
    assert limb_dofs(chain) == []


def test_a_descent_that_stayed_near_and_explains_all_is_trusted(problem, exact):
    near = exact.clone()
    near[:, 6:] += 0.03
    assert needs_search(problem, near, exact).tolist() == [False, False]


def test_a_descent_that_went_far_is_not_trusted(problem, exact):
    start = exact.clone()
    start[0, 6:] += 0.5
    assert needs_search(problem, start, exact).tolist() == [True, False]
    start = exact.clone()
    start[1, 3] += 0.5
    assert needs_search(problem, start, exact).tolist() == [False, True]


def test_a_finger_left_off_the_surface_is_noticed(problem, exact, plain_hand):
    """Also when half of the data are padding; and thin clutter is no limb."""
    missed = exact.clone()
    missed[0, finger(plain_hand, "index")[1]] += 1.2
    assert needs_search(problem, missed, missed).tolist() == [True, False]
    generator = torch.Generator().manual_seed(0)
    clutter = 0.4 * torch.rand(2, 400, 3, generator=generator) - 0.2
    cluttered = replace(problem, data=torch.cat([problem.data, clutter], dim=1), valid=problem.valid.repeat(1, 2))
    assert needs_search(cluttered, exact, exact).tolist() == [False, False]
    padded = replace(cluttered, data=cluttered.data.clone(), valid=cluttered.valid.clone())
    padded.data[:, 400:], padded.valid[:, 400:] = problem.data, False
    padded.data[:, 400:] += 0.02
    assert needs_search(padded, exact, exact).tolist() == [False, False]
    assert needs_search(padded, missed, missed).tolist() == [True, False]


def test_large_clouds_are_thinned_before_clusters_are_sought(problem, exact, plain_hand):
    many = problem.data.repeat(1, 7, 1)
    many = many + 5e-4 * torch.randn(many.shape, generator=torch.Generator().manual_seed(1))
    large = replace(problem, data=many, valid=problem.valid.repeat(1, 7))
    missed = exact.clone()
    missed[1, finger(plain_hand, "ring")[1]] += 1.0
    assert needs_search(large, missed, missed).tolist() == [False, True]


def test_a_cloud_without_inliers_is_searched_without_failing(problem, exact):
    lost = replace(problem, data=problem.data + 5.0)
    assert needs_search(lost, exact, exact).shape == (2,)


def test_candidates_stay_within_limits_and_the_first_is_the_center(problem, exact, plain_hand):
    limbs = limb_dofs(plain_hand)
    generator = torch.Generator().manual_seed(2)
    for number in (0, 1, 5):
        found = _scatter(problem, exact, limbs, 40, number, generator)
        assert found.shape == (2, 40, 27)
        torch.testing.assert_close(found[:, 0], exact, rtol=0, atol=1e-6)
        assert bool((found >= plain_hand.lower).all())
        assert bool((found <= plain_hand.upper).all())
        # Every degree of freedom is tried.
        assert float((found[:, 1:] - exact.unsqueeze(1)).abs().amax(1).min()) > 1e-3


def test_candidates_of_shapes_without_limits_stay_near(problem):
    """Joints that turn freely are scattered by a fraction of a radian, fresh limbs by little more than one."""
    turn = ("revolute", (1.0, 0.0, 0.0))
    tree = KinematicTree((
        Joint("body", -1, offset(0, 0, 0)),
        Joint("left", 0, offset(0.05, 0, 0), *turn),
        Joint("right", 0, offset(-0.05, 0, 0), *turn),
    ))  # fmt: skip
    shape = ArticulatedShape(tree, ["body", "left", "right"], [Primitive("capsule", (0.04, 0.01), offset(0, 0, 0))] * 3)
    points = 0.05 * torch.randn(30, 3, generator=torch.Generator().manual_seed(0))
    center = torch.zeros(2, 8)
    alike = make_problem(BendingSkin(shape, points), problem.data, center)
    found = _scatter(alike, center, limb_dofs(shape), 200, 0, torch.Generator().manual_seed(3))
    assert bool(torch.isfinite(found).all())
    assert 0.5 < float(found[..., 6:].abs().max()) < 3.0


def test_coarse_skins_cover_the_fine_ones(plain_hand_skin, truths):
    coarse = coarse_skin(plain_hand_skin)
    assert len(coarse) < len(plain_hand_skin)
    torch.testing.assert_close(coarse(plain_hand_skin.reference_pose), coarse.points)
    fine, few = plain_hand_skin(truths[1]), coarse(truths[1])
    gaps = torch.cdist(fine, few).amin(-1)
    assert float(gaps.max()) < 0.025
    assert float(torch.cdist(few, fine).amin(-1).max()) < 1e-4
    assert len(coarse_skin(coarse)) == len(coarse)


def misled(exact, shape):
    """Return starts with a finger each that a descent would not find: folded flat against its truth, and neighbors."""
    start = exact.clone()
    start[0, finger(shape, "index")[1:]] += torch.tensor([1.2, 0.9, 0.5])
    start[1, finger(shape, "little")[1:]] += torch.tensor([0.9, 0.9, 0.5])
    return torch.minimum(start, shape.upper)


@pytest.fixture(scope="module")
def explored(problem, exact, plain_hand):
    start = misled(exact, plain_hand)
    coarse = replace(problem, skin=coarse_skin(problem.skin), prior=replace(problem.prior, mean=start))
    generator = torch.Generator().manual_seed(4)
    return start, coarse, explore(coarse, start, start, candidates=16, rounds=2, generator=generator)


def test_a_lost_finger_is_found(problem, exact, plain_hand, explored):
    start, _, found = explored
    before, after = ((plain_hand.keypoints(each) - plain_hand.keypoints(exact)).norm(dim=-1) for each in (start, found))
    assert float(before.amax(-1).min()) > 0.05
    assert float(after.amax(-1).max()) < 0.015
    assert bool((found >= plain_hand.lower).all() & (found <= plain_hand.upper).all())


def test_a_search_is_the_same_for_the_same_seed_and_leaves_the_global_state_alone(explored):
    start, coarse, found = explored
    torch.manual_seed(77)
    state = torch.get_rng_state()
    again = explore(coarse, start, start, candidates=16, rounds=2, generator=torch.Generator().manual_seed(4))
    torch.testing.assert_close(again, found, rtol=0, atol=0)
    assert bool((torch.get_rng_state() == state).all())


def test_a_search_that_improves_nothing_ends_and_returns_the_descent(problem, exact, monkeypatch):
    rounds = []
    refine = align_search._refine

    def counted(*arguments):
        rounds.append(1)
        return refine(*arguments)

    monkeypatch.setattr(align_search, "_refine", counted)
    coarse = replace(problem, skin=coarse_skin(problem.skin))
    generator = torch.Generator().manual_seed(5)
    found = explore(coarse, exact, exact, candidates=3, rounds=4, generator=generator)
    assert len(rounds) == 1
    off = (problem.skin.shape.keypoints(found) - problem.skin.shape.keypoints(exact)).norm(dim=-1)
    assert float(off.max()) < 0.008


def test_large_batches_are_searched_in_parts(problem, exact, monkeypatch):
    sizes = []

    def spied(part, start, descended, candidates, rounds, generator):
        sizes.append(len(start))
        return descended + 1

    monkeypatch.setattr(align_search, "_explore", spied)
    monkeypatch.setattr(align_search, "_CHUNK_ENTRIES", 1)
    generator = torch.Generator().manual_seed(6)
    found = explore(problem, exact, exact, candidates=2, rounds=1, generator=generator)
    assert sizes == [1, 1]
    torch.testing.assert_close(found, exact + 1)


def test_hands_of_both_sides_have_the_same_limbs(plain_hand):
    left = limb_dofs(Hand("left"))
    assert [limb.tolist() for limb in left] == [limb.tolist() for limb in limb_dofs(plain_hand)]
