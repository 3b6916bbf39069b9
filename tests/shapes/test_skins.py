"""Skins: eq. 3 against a literal loop, analytic Jacobians, sharpness, and sampled model points."""

import math

import numpy as np
import pytest
import torch

from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.hand import Hand
from torchreg.shapes.primitives import Primitive
from torchreg.shapes.skin import BendingSkin, LinearBlendSkin, bending_weights, sample_skin

# torch builds its forward-mode rules with torch.jit.script, and warns about it.
JACFWD = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")


@pytest.fixture(scope="module")
def hand():
    return Hand(dtype=torch.float64)


def random_pose(hand, seed, rotation=1.0):
    generator = torch.Generator().manual_seed(seed)
    pose = torch.randn(27, dtype=torch.float64, generator=generator) * torch.tensor(
        [0.1] * 3 + [rotation] * 3 + [0] * 21
    )
    pose[6:] = hand.lower[6:] + (hand.upper[6:] - hand.lower[6:]) * torch.rand(21, generator=generator).double()
    return pose


def near_surface(hand, pose, count=80, seed=0):
    generator = torch.Generator().manual_seed(seed)
    points = hand.keypoints(pose).detach()
    chosen = points[torch.randint(21, (count,), generator=generator)]
    return chosen + 0.008 * torch.randn(count, 3, dtype=torch.float64, generator=generator)


@torch.no_grad()
def eq3(hand, points, reference, pose, sharpness):
    """Equation 3 literally: fields in the reference pose, two rigid motions, their weighted mean."""
    fields = np.exp(-hand.part_distances(points, reference).numpy() / hand.nu)
    motions = hand.part_transforms(pose).numpy() @ np.linalg.inv(hand.part_transforms(reference).numpy())
    parents = [-1] + [0 if part % 3 == 1 else part - 1 for part in range(1, 16)]
    found, two = [], []
    for x, phi in zip(points.numpy(), fields, strict=True):
        p = int(phi.argmax())
        neighbors = [q for q in range(16) if parents[q] == p or parents[p] == q]
        r = max(neighbors, key=lambda q: phi[q])
        wp, wr = phi[p] ** sharpness, phi[r] ** sharpness
        ends = [motions[q, :3, :3] @ x + motions[q, :3, 3] for q in (p, r)]
        found.append((wp * ends[0] + wr * ends[1]) / (wp + wr))
        two.append((p, r))
    return np.array(found), two


@torch.no_grad()
@pytest.mark.parametrize("sharpness", [0.5, 2.0, 10.0])
def test_the_bending_skin_is_equation_3(hand, sharpness):
    reference, pose = random_pose(hand, 1), random_pose(hand, 2)
    points = near_surface(hand, reference)
    expected, two = eq3(hand, points, reference, pose, sharpness)
    skin = BendingSkin(hand, points, reference, sharpness)
    np.testing.assert_allclose(skin(pose).numpy(), expected, atol=1e-12)
    np.testing.assert_allclose(skin(reference).numpy(), points.numpy(), atol=1e-12)
    for row, pair in zip(skin.weights, two, strict=True):
        assert set(row.nonzero().flatten().tolist()) <= set(pair)
    assert skin.sharpness == sharpness
    assert len(skin) == len(points)


@torch.no_grad()
def test_a_large_sharpness_is_rigid(hand):
    reference, pose = hand.rest_pose(), random_pose(hand, 3)
    points = near_surface(hand, reference)
    owner = hand.part_distances(points, reference).argmin(-1)
    motion = (hand.part_transforms(pose) @ torch.linalg.inv(hand.part_transforms(reference)))[owner]
    rigid = (motion[:, :3, :3] @ points.unsqueeze(-1)).squeeze(-1) + motion[:, :3, 3]
    errors = [float((BendingSkin(hand, points, reference, a)(pose) - rigid).norm(dim=-1).mean()) for a in (2, 10, 1e4)]
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 1e-5


def test_the_default_reference_is_the_rest_pose(hand):
    points = near_surface(hand, hand.rest_pose(), 5)
    assert torch.equal(BendingSkin(hand, points).reference_pose, hand.rest_pose())


def test_far_points_and_lonely_parts_get_sound_weights(hand):
    far = torch.tensor([[50.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    weights = bending_weights(hand.to(torch.float64), far.double(), hand.rest_pose(), 10.0)
    torch.testing.assert_close(weights.sum(-1), torch.ones(2, dtype=torch.float64))
    tree = KinematicTree((Joint("only", -1, torch.eye(4, dtype=torch.float64)),))
    alone = ArticulatedShape(tree, ["only"], [Primitive("capsule", (1.0, 1.0), torch.eye(4))])
    assert bending_weights(alone, far, alone.rest_pose(), 2.0).tolist() == [[1.0], [1.0]]


@JACFWD
@pytest.mark.parametrize("rotation", [0.0, 1.0])
def test_the_jacobian_in_the_pose_equals_forward_mode(hand, rotation):
    pose = random_pose(hand, 4, rotation)
    skin = BendingSkin(hand, near_surface(hand, hand.rest_pose()))
    points, jacobian = skin.jacobian(pose)
    torch.testing.assert_close(points, skin(pose), atol=1e-14, rtol=0)
    torch.testing.assert_close(jacobian, torch.func.jacfwd(skin)(pose), atol=1e-10, rtol=0)
    batch = torch.stack([pose, hand.rest_pose()]).unsqueeze(0)
    points, jacobians = skin.jacobian(batch)
    assert jacobians.shape == (1, 2, 80, 3, 27)
    torch.testing.assert_close(jacobians[0, 0], jacobian, atol=1e-13, rtol=0)
    torch.testing.assert_close(points, skin(batch), atol=1e-14, rtol=0)


@torch.no_grad()
def test_the_tangent_jacobian_equals_differences_through_the_retraction(hand):
    pose, h = random_pose(hand, 5), 1e-6
    skin = BendingSkin(hand, near_surface(hand, hand.rest_pose(), 20))
    jacobian = skin.jacobian(pose, chart="tangent")[1]
    for k in range(27):
        step = torch.zeros(27, dtype=torch.float64)
        step[k] = h
        slope = (skin(hand.retract(pose, step)) - skin(hand.retract(pose, -step))) / (2 * h)
        torch.testing.assert_close(jacobian[..., k], slope, atol=1e-8, rtol=0)


def test_gradients_in_the_pose_and_the_bone_lengths(hand):
    skin = BendingSkin(hand, near_surface(hand, hand.rest_pose(), 4))

    def posed(pose, lengths):
        return torch.func.functional_call(skin, {"shape.log_length_scales": lengths}, (pose,))

    lengths = torch.linspace(-0.1, 0.1, 16, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(posed, (random_pose(hand, 6).requires_grad_(), lengths))


@torch.no_grad()
def test_normals_turn_with_their_parts(hand):
    points = near_surface(hand, hand.rest_pose(), 10)
    normals = torch.nn.functional.normalize(torch.randn(10, 3, generator=torch.Generator().manual_seed(1)), dim=-1)
    weights = torch.zeros(10, 16)
    weights[:, 5] = 1.0
    skin = LinearBlendSkin(hand, points, weights, hand.rest_pose(), normals=normals)
    pose = random_pose(hand, 7)
    turn = (hand.part_transforms(pose)[5] @ torch.linalg.inv(hand.part_transforms(hand.rest_pose())[5]))[:3, :3]
    torch.testing.assert_close(skin.posed_normals(pose), normals.double() @ turn.mT, atol=1e-7, rtol=0)
    assert skin.posed_normals(pose.expand(2, 27)).shape == (2, 10, 3)


@torch.no_grad()
def test_moving_a_skin_moves_its_shape():
    skin = BendingSkin(Hand(dtype=torch.float64), torch.zeros(2, 3), faces=torch.zeros(1, 3, dtype=torch.int32))
    assert skin.faces.dtype == torch.int64
    assert skin.to(torch.float32)(torch.zeros(27)).dtype == torch.float32


@torch.no_grad()
def test_the_state_of_a_skin_makes_a_fresh_one_the_same(hand):
    pose, normals = random_pose(hand, 1), torch.eye(3, dtype=torch.float64).repeat(4, 1)
    faces = torch.tensor([[0, 1, 2]])
    skin = BendingSkin(hand, near_surface(hand, hand.rest_pose(), 12), pose, 4.0, normals=normals, faces=faces)
    assert {"points", "weights", "basis", "reference_pose"} <= set(skin.state_dict())
    fresh = BendingSkin(Hand(dtype=torch.float64), torch.zeros(12, 3), normals=-normals, faces=0 * faces)
    fresh.load_state_dict(skin.state_dict())
    other = random_pose(hand, 2)
    assert torch.equal(fresh(other), skin(other))
    assert torch.equal(fresh.posed_normals(other), skin.posed_normals(other))
    assert torch.equal(fresh.faces, faces)


def test_skins_of_shapes_that_learn_follow_them(hand):
    shape = Hand(dtype=torch.float64).requires_grad_(True)
    points, reference, pose = near_surface(hand, hand.rest_pose(), 6), random_pose(hand, 1), random_pose(hand, 2)
    skin = BendingSkin(shape, points, reference, normals=torch.eye(3).repeat(2, 1))
    assert skin.follows_shape
    torch.testing.assert_close(skin(pose), BendingSkin(hand, points, reference)(pose))
    with torch.no_grad():
        for number, value in enumerate(shape.parameters()):
            value.add_(0.1 * torch.randn(value.shape, generator=torch.Generator().manual_seed(number)))
    with torch.no_grad():
        rebuilt = BendingSkin(shape, points, reference, normals=skin.normals)
        frozen = skin.frozen()
        for other in (rebuilt, frozen):
            assert not other.follows_shape
            torch.testing.assert_close(skin(pose), other(pose))
            torch.testing.assert_close(skin.posed_normals(pose), other.posed_normals(pose))
            torch.testing.assert_close(skin.jacobian(pose), other.jacobian(pose))
        shape.log_nu.add_(0.1)
        assert not torch.allclose(skin(pose), frozen(pose))
    for _ in range(2):
        skin(pose).square().sum().backward()
    assert all(float(value.grad.abs().max()) > 0 for value in shape.parameters())


def test_the_gradients_of_a_following_skin_are_those_of_all_parameters(hand):
    shape = Hand(dtype=torch.float64).requires_grad_(True)
    skin = BendingSkin(shape, near_surface(hand, hand.rest_pose(), 3), random_pose(hand, 1))
    names = [name for name, _ in shape.named_parameters()]

    def posed(*values):
        state = {f"shape.{name}": value for name, value in zip(names, values, strict=True)}
        return torch.func.functional_call(skin, state, (random_pose(hand, 2),))

    assert torch.autograd.gradcheck(
        posed, tuple(value.detach().clone().requires_grad_() for value in shape.parameters())
    )


def test_the_sharpness_of_a_skin_is_that_of_its_shape_unless_another_is_given(hand):
    points, pose = near_surface(hand, hand.rest_pose(), 20), random_pose(hand, 2)
    sharp = Hand(sharpness=7.0, dtype=torch.float64)
    assert BendingSkin(sharp, points).sharpness == sharp.sharpness == 7.0
    assert torch.equal(BendingSkin(sharp, points)(pose), BendingSkin(hand, points, sharpness=7.0)(pose))
    assert torch.equal(BendingSkin(sharp, points, sharpness=2.0)(pose), BendingSkin(hand, points)(pose))
    with pytest.raises(InputError, match="sharpness must be positive and finite, got -1"):
        Hand(sharpness=-1.0)


@torch.no_grad()
def test_sampled_points_cover_the_surface_evenly():
    hand = Hand()
    skin = sample_skin(hand, 300)
    assert isinstance(skin, BendingSkin)
    assert len(skin) == 300
    assert float(hand.distance(skin.points, hand.rest_pose()).abs().max()) < 1e-3
    gaps = torch.cdist(skin.points, skin.points).fill_diagonal_(torch.inf).amin(-1)
    assert float(gaps.min()) > 0.3 * float(gaps.mean())
    outside = hand.distance(skin.points + 0.001 * skin.normals, hand.rest_pose())
    assert float((outside > 0).float().mean()) > 0.98


@torch.no_grad()
def test_sampled_points_of_a_surface_follow_its_weights():
    corners = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]) * 0.1
    faces = torch.tensor([[0, 1, 3], [0, 3, 2]])
    weights = torch.tensor([[1.0, 0], [1, 0], [0, 1], [0, 1]])
    joints = torch.tensor([[0.05, 0.0, 0.0], [0.05, 0.05, 0.0]])
    shape = ArticulatedShape.from_skinned_mesh(corners, faces, weights, joints, [-1, 0], dtype=torch.float64)
    skin = sample_skin(shape, 20)
    expected = torch.stack([1 - 10 * skin.points[:, 1], 10 * skin.points[:, 1]], dim=-1)
    torch.testing.assert_close(skin.weights, expected)
    assert bool((skin.normals[:, 2] == 1).all())
    assert not isinstance(skin, BendingSkin)
    assert torch.equal(sample_skin(shape, 20).points, skin.points)
    assert not torch.equal(sample_skin(shape, 20, seed=1).points, skin.points)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"weights": torch.ones(2, 16)}, "weights must not be negative and every row must sum to one"),
        ({"weights": torch.tensor([[2.0, -1.0] + [0.0] * 14] * 2)}, "weights must not be negative"),
        ({"weights": torch.full((2, 16), math.nan)}, "weights must not be negative and every row must sum to one"),
        ({"weights": torch.ones(2, 15)}, r"weights must have shape \(2, 16\), got \(2, 15\)"),
        ({"points": torch.zeros(2, 2)}, r"points must have shape \(N, 3\)"),
        ({"points": torch.full((2, 3), math.inf)}, "points must be finite, got 6 non-finite of 6 numbers"),
        ({"reference_pose": torch.zeros(26)}, r"reference_pose must have shape \(\.\.\., 27\), got \(26,\)"),
        ({"reference_pose": torch.zeros(1, 27)}, r"reference_pose must have shape \(27\), got \(1, 27\)"),
        ({"normals": torch.zeros(3, 3)}, r"normals must have shape \(2, 3\), got \(3, 3\)"),
        ({"faces": torch.tensor([[0, 1, 2]])}, "faces must index the 2 vertices"),
    ],
)
def test_skins_that_do_not_fit_are_refused(hand, change, message):
    even = {"points": torch.zeros(2, 3), "weights": torch.full((2, 16), 1 / 16), "reference_pose": hand.rest_pose()}
    with pytest.raises(InputError, match=message):
        LinearBlendSkin(hand, **{**even, **change})


def test_bending_skins_that_do_not_fit_are_refused(hand):
    with pytest.raises(InputError, match="sharpness must be positive and finite, got 0"):
        BendingSkin(hand, torch.zeros(2, 3), sharpness=0)
    with pytest.raises(InputError, match=r"reference_pose must have shape \(27\), got \(2, 27\)"):
        BendingSkin(hand, torch.zeros(2, 3), torch.zeros(2, 27))
    with pytest.raises(InputError, match="points must hold at least 1 point"):
        BendingSkin(hand, torch.zeros(0, 3))
    with pytest.raises(InputError, match="this skin has no normals; pass normals="):
        BendingSkin(hand, torch.zeros(2, 3)).posed_normals(hand.rest_pose())


@pytest.mark.parametrize(("count", "error"), [(0, InputError), (-3, InputError), (2.5, InputTypeError)])
def test_samples_of_a_skin_are_counted(plain_hand, count, error):
    with pytest.raises(error, match="count must be"):
        sample_skin(plain_hand, count)
