"""Placing limbs on data: fingers, chains, arms on a spine, jaws, slides and balls are found; limits and priors hold."""

import math
from dataclasses import replace

import pytest
import torch

from torchreg.alignment import limb_search
from torchreg.alignment.limb_search import Effort, LimbSearch, distinct_first, take_rows
from torchreg.alignment.problem import centered_problem
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.primitives import Primitive
from torchreg.shapes.skin import sample_skin

THOROUGH = Effort(
    num_data=400, width=0.05, beam=80, configurations=30, refine_widths=(0.04, 0.03, 0.025), score_width=0.02,
    combinations=6, exchanged=2,
)  # fmt: skip
COARSE = Effort(
    num_data=150,
    width=0.05,
    beam=80,
    configurations=30,
    refine_widths=(),
    score_width=0.05,
    combinations=3,
    exchanged=0,
)
TIPS = [4, 8, 12, 16, 20]


def offset(*place):
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor(place, dtype=torch.float64)
    return pose


def rod(length, radius=0.03):
    """A capsule from the frame's origin along its z."""
    return Primitive("capsule", (length / 2, radius), offset(0, 0, length / 2))


def block(*radii):
    return Primitive("ellipsoid", radii, offset(0, 0, 0))


def shape_of(joints, frames, solids, **options):
    shape = ArticulatedShape(KinematicTree(tuple(joints)), frames, solids, **({"nu": 0.008} | options))
    return shape.requires_grad_(False)


def problem_of(skin, data, mean, valid=None, std=0.4):
    """Return a problem whose coordinates are those of the data."""
    valid = torch.ones(data.shape[:2], dtype=torch.bool) if valid is None else valid
    origin = torch.zeros(len(data), 3)
    return centered_problem(skin, data, valid, mean, origin, prior_std=std, pose_atol=0.0)


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def joint_errors(found, truths):
    return (found[:, 0, 6:] - truths[:, 6:]).abs().amax(-1)


# Hands


@pytest.fixture(scope="module")
def hand_limbs(plain_hand):
    return LimbSearch(plain_hand)


@pytest.fixture(scope="module")
def truths(plain_hand):
    """Two hands, turned, every finger bent by its own share of its range."""
    poses = plain_hand.rest_pose().repeat(2, 1)
    shares = 0.6 * torch.rand(2, 21, generator=generator(3))
    poses[:, 6:] = shares * plain_hand.upper[6:].clamp_min(0)
    poses[:, :6] = torch.tensor([[0.0, 0.02, 0.01, 0.3, -0.4, 0.2], [0.01, 0.0, -0.02, -1.4, 0.5, 0.9]])
    return poses


@pytest.fixture(scope="module")
def stretched(truths):
    """The true places of the palm, all fingers stretched."""
    return torch.cat([truths[:, :6], torch.zeros(2, 21)], dim=-1)


@pytest.fixture(scope="module")
def hands(plain_hand_skin, truths, stretched):
    return problem_of(plain_hand_skin, plain_hand_skin(truths), stretched)


@pytest.fixture(scope="module")
def placed(hand_limbs, hands, stretched):
    return hand_limbs(hands, stretched, THOROUGH, generator())


def tip_errors(hand, poses, truths):
    return (hand.keypoints(poses) - hand.keypoints(truths))[..., TIPS, :].norm(dim=-1)


def test_fingers_are_found_on_a_true_palm(plain_hand, placed, truths, stretched):
    assert placed.shape == (2, 6, 27)
    assert float(tip_errors(plain_hand, stretched, truths).mean()) > 0.025
    found = tip_errors(plain_hand, placed[:, 0], truths)
    assert float(found.mean()) < 0.004
    assert float(found.max()) < 0.012


def test_the_trunk_stays_and_all_is_within_the_limits(plain_hand, placed, stretched):
    torch.testing.assert_close(placed[..., :6], stretched[:, None, :6].expand(2, 6, 6), rtol=0, atol=0)
    assert bool(((placed >= plain_hand.lower) & (placed <= plain_hand.upper)).all())


def test_the_best_combination_explains_most(plain_hand, hands, placed):
    """Counted here with a hard threshold, on the surface of the whole hand."""
    explained = plain_hand.distance(hands.data.unsqueeze(1), placed).abs() < 0.004
    counts = explained.sum(-1)
    assert bool((counts[:, 0] >= 0.95 * counts.amax(-1)).all())
    assert bool((counts[:, 0] > 360).all())


def test_outliers_are_no_fingers(plain_hand, hand_limbs, hands, truths, stretched):
    clutter = 0.3 * torch.rand(2, 100, 3, generator=generator(1)) - 0.15 + hands.data.mean(1, keepdim=True)
    cluttered = replace(hands, data=torch.cat([hands.data, clutter], dim=1), valid=torch.ones(2, 500, dtype=torch.bool))
    found = tip_errors(plain_hand, hand_limbs(cluttered, stretched, THOROUGH, generator())[:, 0], truths)
    assert float(found.mean()) < 0.005


def test_a_few_data_and_no_polish_place_fingers_roughly(plain_hand, hand_limbs, hands, truths, stretched):
    found = hand_limbs(hands, stretched, COARSE, generator())
    assert found.shape == (2, 3, 27)
    assert float(tip_errors(plain_hand, found[:, 0], truths).mean()) < 0.015
    assert bool(((found >= plain_hand.lower) & (found <= plain_hand.upper)).all())


def test_a_narrow_beam_finds_some_fingers(plain_hand, hand_limbs, hands, truths, stretched):
    """Narrower than the samples of a finger's first joint, each of which would survive else."""
    found = hand_limbs(hands, stretched, replace(THOROUGH, beam=8, configurations=4), generator())
    before, after = (tip_errors(plain_hand, poses, truths) for poses in (stretched, found[:, 0]))
    assert float(after.mean()) < 0.6 * float(before.mean())
    assert float(after.median()) < 0.01
    assert bool(((found >= plain_hand.lower) & (found <= plain_hand.upper)).all())


def test_a_hidden_finger_stays_near_the_mean_of_the_prior(plain_hand, hand_limbs, hands, truths):
    little = [dof for dof, name in enumerate(plain_hand.dof_names) if name.startswith("little")]
    others = sorted(set(range(6, 27)) - set(little))
    start = truths.clone()
    start[:, little] = torch.tensor([0.0, 0.3, 0.3, 0.3])
    start[:, others] = 0.1
    mean = start.clone()
    hidden = plain_hand.part_distances(hands.data, truths).argmin(-1) >= 13
    assert int(hidden.sum(-1).min()) > 12
    one_sided = problem_of(hands.skin, hands.data, mean, ~hidden)
    found = hand_limbs(one_sided, start, THOROUGH, generator())[:, 0]
    assert float((found - start)[:, little].abs().max()) < 0.4
    assert float(tip_errors(plain_hand, found, truths)[:, :4].mean()) < 0.004


def test_what_came_is_kept_where_it_fits(plain_hand, hand_limbs, hands, truths):
    """The true joints lie between the samples; coming along, they win, also without a polish."""
    found = hand_limbs(hands, truths, replace(COARSE, num_data=400, score_width=0.02), generator())
    assert float(tip_errors(plain_hand, found[:, 0], truths).max()) < 0.012


def test_a_batch_is_a_loop(hand_limbs, hands, stretched, placed):
    """All data are drawn, so that the draws do not differ."""
    for row in range(2):
        index = torch.tensor([row])
        single = hand_limbs(hands.rows(index), stretched[index], THOROUGH, generator(row))
        torch.testing.assert_close(single[0, 0], placed[row, 0], rtol=0, atol=2e-3)


def test_a_large_batch_is_searched_in_parts(hand_limbs, hands, stretched, placed, monkeypatch):
    monkeypatch.setattr(limb_search, "_PLACEMENT", replace(limb_search._PLACEMENT, cpu_entries=1))
    parts = hand_limbs(hands, stretched, THOROUGH, generator())
    assert parts.shape == placed.shape
    torch.testing.assert_close(parts[:, 0], placed[:, 0], rtol=0, atol=2e-3)


def test_data_that_do_not_count_change_nothing(hand_limbs, hands, stretched, placed):
    """Padding where fingers might be, as dense as fingers."""
    padded = replace(
        hands,
        data=torch.cat([hands.data, hands.skin(stretched)[:, :100]], dim=1),
        valid=torch.arange(500).expand(2, 500) < 400,
    )
    found = hand_limbs(padded, stretched, replace(THOROUGH, num_data=500), generator())
    torch.testing.assert_close(found[:, 0], placed[:, 0], rtol=0, atol=2e-3)


def test_the_generator_decides_and_the_global_state_does_not(hand_limbs, hands, stretched):
    few = replace(COARSE, num_data=60)
    first = hand_limbs(hands, stretched, few, generator(5))
    torch.manual_seed(11)
    state = torch.get_rng_state()
    again = hand_limbs(hands, stretched, few, generator(5))
    torch.testing.assert_close(first, again, rtol=0, atol=0)
    assert bool((torch.get_rng_state() == state).all())
    assert not torch.equal(first, hand_limbs(hands, stretched, few, generator(6)))


# Other shapes


def hinge(axis=(1.0, 0.0, 0.0), reach=1.8):
    return "revolute", axis, -reach, reach


def found_joints(shape, values, effort=THOROUGH, std=None, start=None):
    """Return the joints found from zeros on exact data of the given joints (B, d), and the errors (B,)."""
    skin = sample_skin(shape, 300)
    truths = shape.rest_pose().repeat(len(values), 1)
    truths[:, 6:] = torch.tensor(values)
    starts = shape.rest_pose().repeat(len(values), 1)
    if start is not None:
        starts[:, 6:] = torch.tensor(start)
    problem = problem_of(skin, skin(truths), starts, std=std)
    found = LimbSearch(shape)(problem, starts, effort, generator())
    assert bool(((found >= shape.lower) & (found <= shape.upper)).all())
    return found, joint_errors(found, truths)


def test_a_chain_is_followed_to_its_end():
    """A plate, and four links bent in turn about x and about y."""
    joints = [Joint("plate", -1, offset(0, 0, 0))]
    for number in range(4):
        axis = (1.0, 0.0, 0.0) if number % 2 else (0.0, 1.0, 0.0)
        joints.append(Joint(f"link{number}", number, offset(0, 0, 0.2 if number else 0.05), *hinge(axis)))
    solids = [block(0.15, 0.1, 0.05), *[rod(0.2)] * 4]
    shape = shape_of(joints, [joint.name for joint in joints], solids)
    _, errors = found_joints(shape, [[0.9, -1.1, 0.7, 0.4], [-0.5, 0.6, 1.2, -0.8]])
    assert float(errors.max()) < 0.1


def test_limbs_on_limbs_are_found():
    """Two arms with elbows on a spine that bends."""
    names = ["pelvis", "chest", "left", "left_elbow", "right", "right_elbow"]
    joints = [
        Joint("pelvis", -1, offset(0, 0, 0)),
        Joint("chest", 0, offset(0, 0, 0.1), *hinge((0.0, 1.0, 0.0))),
        Joint("left", 1, offset(0.1, 0, 0.4), *hinge()),
        Joint("left_elbow", 2, offset(0, 0, 0.3), *hinge()),
        Joint("right", 1, offset(-0.1, 0, 0.4), *hinge()),
        Joint("right_elbow", 4, offset(0, 0, 0.3), *hinge()),
    ]
    solids = [block(0.15, 0.1, 0.08), rod(0.4, 0.06), *[rod(0.3), rod(0.25)] * 2]
    shape = shape_of(joints, names, solids, nu=0.015)
    assert [limb.level for limb in LimbSearch(shape).limbs] == [0, 1, 1]
    _, errors = found_joints(shape, [[0.6, 1.2, 0.9, -1.0, -0.7], [-0.4, -1.4, 0.5, 0.8, 1.1]])
    assert float(errors.max()) < 0.12


@pytest.mark.parametrize("effort", [THOROUGH, COARSE])
def test_jaws_that_follow_one_another_are_found(effort):
    """The first jaw carries a hinged tip; the second mimics the first, and so moves although it is no limb's."""
    joints = [
        Joint("palm", -1, offset(0, 0, 0)),
        Joint("jaw", 0, offset(0.06, 0, 0.05), *hinge((0.0, 1.0, 0.0), 1.2)),
        Joint("tip", 1, offset(0, 0, 0.15), *hinge((0.0, 1.0, 0.0), 1.2)),
        Joint("other", 0, offset(-0.06, 0, 0.05), "revolute", (0.0, 1.0, 0.0), mimic=(1, -1.0, 0.0)),
    ]
    shape = shape_of(joints, ["palm", "jaw", "tip", "other"], [block(0.1, 0.06, 0.05), *[rod(0.15, 0.02)] * 3])
    _, errors = found_joints(shape, [[0.7, -0.9], [-0.2, 0.8]], effort)
    assert float(errors.max()) < (0.1 if effort is THOROUGH else 0.35)


def test_a_gripper_is_found_on_an_arm_and_its_jaws_close_as_one():
    """Both jaws slide, one follows: the data of both count for the one degree of freedom."""
    names = ["base", "arm", "jaw", "other", "pad"]
    joints = [
        Joint("base", -1, offset(0, 0, 0)),
        Joint("arm", 0, offset(0, 0, 0.1), *hinge()),
        Joint("jaw", 1, offset(0.02, 0, 0.4), "prismatic", (1.0, 0.0, 0.0), 0.0, 0.15),
        Joint("other", 1, offset(-0.02, 0, 0.4), "prismatic", (1.0, 0.0, 0.0), mimic=(2, -1.0, 0.0)),
        Joint("pad", 3, offset(0, 0, 0.15), "revolute", (1.0, 0.0, 0.0), mimic=(1, 0.5, 0.0)),
    ]
    solids = [block(0.15, 0.1, 0.08), rod(0.35, 0.05), rod(0.15, 0.015), rod(0.1, 0.015), block(0.02, 0.03, 0.04)]
    shape = shape_of(joints, names, solids, nu=0.01)
    search = LimbSearch(shape)
    assert [limb.parts for limb in search.limbs] == [[1], [2]]
    # The pad follows the arm, the jaw that carries it follows the other jaw; both are moved by the first jaw's limb.
    assert [search.parts[limb] for limb in search.limbs] == [[1], [2, 3, 4]]
    found, _ = found_joints(shape, [[0.7, 0.11], [-0.5, 0.03]])
    torch.testing.assert_close(found[:, 0, 6:], torch.tensor([[0.7, 0.11], [-0.5, 0.03]]), rtol=0, atol=0.03)


def test_fingers_whose_last_joint_follows_are_found():
    """Hinges in a row, the last of which mimics the one before it: a body without a degree of freedom of its own."""
    joints = [Joint("palm", -1, offset(0, 0, 0))]
    for side, x in enumerate((-0.08, 0.08)):
        first = len(joints)
        joints += [
            Joint(f"lower{side}", 0, offset(x, 0, 0.05), *hinge(reach=1.5)),
            Joint(f"middle{side}", first, offset(0, 0, 0.15), *hinge(reach=1.5)),
            Joint(
                f"tip{side}", first + 1, offset(0, 0, 0.12), "revolute", (1.0, 0.0, 0.0), mimic=(first + 1, 0.7, 0.1)
            ),
        ]
    solids = [block(0.14, 0.06, 0.05), *[rod(0.15, 0.025), rod(0.12, 0.02), rod(0.1, 0.02)] * 2]
    shape = shape_of(joints, [joint.name for joint in joints], solids)
    assert shape.num_dofs == 10
    _, errors = found_joints(shape, [[0.9, 0.7, -0.5, -0.9], [0.2, -0.6, 1.1, 0.4]])
    assert float(errors.max()) < 0.1


def test_slides_are_found():
    joints = [
        Joint("mast", -1, offset(0, 0, 0)),
        Joint("carriage", 0, offset(0.1, 0, -0.3), "prismatic", (0.0, 0.0, 1.0), 0.0, 0.6),
        Joint("arm", 1, offset(0.08, 0, 0), *hinge((0.0, 1.0, 0.0))),
    ]
    shape = shape_of(joints, ["mast", "carriage", "arm"], [block(0.06, 0.06, 0.5), block(0.1, 0.08, 0.06), rod(0.3)])
    found, _ = found_joints(shape, [[0.47, 1.1], [0.08, -0.3]])
    torch.testing.assert_close(found[:, 0, 6:], torch.tensor([[0.47, 1.1], [0.08, -0.3]]), rtol=0, atol=0.05)


def arm_with_a_ball():
    """A shoulder that is a ball without limits, and an elbow."""
    joints = [
        Joint("body", -1, offset(0, 0, 0)),
        Joint("x", 0, offset(0, 0, 0.1), "revolute", (1.0, 0.0, 0.0)),
        Joint("y", 1, offset(0, 0, 0), "revolute", (0.0, 1.0, 0.0)),
        Joint("z", 2, offset(0, 0, 0), "revolute", (0.0, 0.0, 1.0)),
        Joint("elbow", 3, offset(0, 0, 0.3), "revolute", (1.0, 0.0, 0.0), 0.0, 2.4),
    ]
    return shape_of(joints, ["body", "z", "elbow"], [block(0.15, 0.1, 0.1), rod(0.3), rod(0.25)])


def test_balls_are_found():
    """By the places of the parts: three angles may say the same turn in two ways."""
    shape = arm_with_a_ball()
    truth = shape.rest_pose().repeat(2, 1)
    truth[:, 6:] = torch.tensor([[0.8, -0.6, 0.5, 1.4], [-0.9, 0.4, -0.3, 0.9]])
    found, _ = found_joints(shape, truth[:, 6:].tolist(), std=1.0)
    end = torch.tensor([0.0, 0.0, 0.25, 1.0])
    places = [(shape.part_transforms(pose)[:, 1:] @ end)[..., :3] for pose in (found[:, 0], truth)]
    assert float((places[0] - places[1]).norm(dim=-1).max()) < 0.03


def test_samples_cover_every_joint_evenly_and_few_are_taken_of_many():
    search = LimbSearch(arm_with_a_ball())
    ball, elbow = (search.samples[body] for body in search.limbs[0].bodies)
    assert ball.shape[1] == 3
    assert len(ball) <= 64
    assert bool((ball.abs() <= 1.2 + 1e-6).all())
    # Every half of every axis is sampled about equally often.
    assert float(((ball > 0).float().mean(0) - 0.5).abs().max()) < 0.1
    gaps = elbow[:, 0].sort().values.diff()
    torch.testing.assert_close(gaps, gaps[:1].expand_as(gaps))
    assert float(gaps[0]) <= math.radians(17)
    torch.testing.assert_close(elbow.amin(), 2.4 - elbow.amax())
    again = LimbSearch(arm_with_a_ball())
    torch.testing.assert_close(again.samples[again.limbs[0].bodies[0]], ball, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("limits", "span"),
    [
        ((), (-math.pi, math.pi)),
        ((0.5,), (0.5, 0.5 + 2 * math.pi)),
        ((-math.inf, 1.0), (1.0 - 2 * math.pi, 1.0)),
        ((-0.2, 0.3), (-0.2, 0.3)),
        ((0.4, 0.4), (0.4, 0.4)),
    ],
)
def test_joints_are_tried_over_their_range_or_one_turn(limits, span):
    joints = [Joint("body", -1, offset(0, 0, 0)), Joint("arm", 0, offset(0, 0, 0.1), "revolute", (1.0, 0, 0), *limits)]
    search = LimbSearch(shape_of(joints, ["body", "arm"], [rod(0.1)] * 2))
    values = search.samples[search.limbs[0].bodies[0]][:, 0]
    assert bool(((values >= span[0] - 1e-5) & (values <= span[1] + 1e-5)).all())
    assert float(values.mean()) == pytest.approx(sum(span) / 2, abs=1e-4)
    step = (span[1] - span[0]) / len(values)
    assert float(values.min()) == pytest.approx(span[0] + step / 2, abs=1e-4)
    assert step <= math.radians(17)


def test_joints_that_turn_freely_are_found_all_around():
    """Far joints too, of which a wide beam can try a part of the samples only."""
    joints = [Joint("plate", -1, offset(0, 0, 0))]
    joints += [
        Joint(f"link{number}", number, offset(0, 0.05, 0.05 if number == 0 else 0.2), "revolute", (0.0, 1.0, 0.0))
        for number in range(3)
    ]
    shape = shape_of(joints, [joint.name for joint in joints], [block(0.15, 0.1, 0.05), *[rod(0.2, 0.02)] * 3])
    wide = replace(THOROUGH, beam=123)
    values = [[2.9, 1.0, 2.6], [-2.8, -1.2, -2.5]]
    _, errors = found_joints(shape, values, wide)
    assert float(errors.max()) < 0.1


def test_a_shape_without_joints_is_left_as_it_is():
    shape = shape_of([Joint("stone", -1, offset(0, 0, 0))], ["stone"], [block(0.1, 0.05, 0.03)])
    search = LimbSearch(shape)
    poses = torch.randn(3, 6, generator=generator())
    problem = problem_of(sample_skin(shape, 50), torch.randn(3, 20, 3, generator=generator()), poses)
    assert search.limbs == []
    torch.testing.assert_close(search(problem, poses, THOROUGH, generator()), poses.unsqueeze(1), rtol=0, atol=0)


def test_an_arm_without_a_trunk_is_found():
    """The first part already moves: the base itself carries no solid."""
    joints = [
        Joint("world", -1, offset(0, 0, 0)),
        Joint("upper", 0, offset(0, 0, 0.1), *hinge()),
        Joint("fore", 1, offset(0, 0, 0.3), *hinge((0.0, 1.0, 0.0))),
    ]
    shape = shape_of(joints, ["upper", "fore"], [rod(0.3, 0.04), rod(0.25)])
    _, errors = found_joints(shape, [[0.9, -1.2]])
    assert float(errors.max()) < 0.1


# Parts


def test_rows_are_taken_from_tables_of_any_width():
    table = torch.randn(2, 5, 4, 3, generator=generator())
    index = torch.tensor([[4, 0, 0], [1, 2, 3]])
    expected = torch.stack([table[0, [4, 0, 0]], table[1, [1, 2, 3]]])
    torch.testing.assert_close(take_rows(table, index), expected)
    torch.testing.assert_close(take_rows(table[..., 0, 0], index), expected[..., 0, 0])


def test_what_is_close_to_something_better_comes_last():
    values = torch.tensor([[0.0, 0.1, 0.15, 1.0, 0.25, 1.05]])
    close = (values.unsqueeze(2) - values.unsqueeze(1)).abs() < 0.2
    # 0.25 is close to 0.1 and 0.15 only, which are not kept themselves.
    assert distinct_first(close).tolist() == [[0, 3, 4, 1, 2, 5]]
    assert distinct_first(torch.eye(4, dtype=torch.bool).unsqueeze(0)).tolist() == [[0, 1, 2, 3]]
    assert distinct_first(torch.ones(1, 3, 3, dtype=torch.bool)).tolist() == [[0, 1, 2]]
