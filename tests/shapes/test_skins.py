"""Skins: eq. 3 against a literal loop, analytic Jacobians, sharpness, and sampled model points."""

import numpy as np
import pytest
import torch

import torchreg as tr
from tests.shapes.kinds import D, around, at, compare, perturbed, poses_of, seeded
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.shapes.primitives import Primitive

# torch builds its forward-mode rules with torch.jit.script, and warns about it.
JACFWD = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")


@pytest.fixture
def pose(hand):
    return poses_of(hand, 1, seed=2)[0]


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
        two.append({p, r})
    return np.array(found), two


@torch.no_grad()
@pytest.mark.parametrize("sharpness", [0.5, 2.0, 10.0])
def test_the_bending_skin_is_equation_3(hand, pose, sharpness):
    reference = poses_of(hand, 1, seed=1)[0]
    points = around(hand, reference, 80)
    # Far from all parts the literal fields underflow.
    points = points[hand.distance(points, reference) < 300 * hand.nu / sharpness]
    expected, two = eq3(hand, points, reference, pose, sharpness)
    skin = tr.BendingSkin(hand, points, reference, sharpness)
    np.testing.assert_allclose(skin(pose).numpy(), expected, atol=1e-12)
    np.testing.assert_allclose(skin(reference).numpy(), points.numpy(), atol=1e-12)
    assert all(set(row.nonzero().flatten().tolist()) <= pair for row, pair in zip(skin.weights, two, strict=True))
    assert skin.sharpness == sharpness
    assert len(skin) == len(points) > 20
    assert torch.equal(tr.BendingSkin(hand, points).reference_pose, hand.rest_pose())


def test_far_points_and_lonely_parts_get_sound_weights(hand):
    far = torch.tensor([[50.0, 0.0, 0.0], [0.0, 0.0, 0.0]], dtype=D)
    compare([tr.BendingSkin(hand, far, sharpness=10.0).weights.sum(-1)], [torch.ones(2, dtype=D)])
    tree = KinematicTree((Joint("only", -1, at()),))
    alone = tr.ArticulatedShape(tree, ["only"], [Primitive("capsule", (1.0, 1.0), at())], dtype=D)
    assert tr.BendingSkin(alone, far).weights.tolist() == [[1.0], [1.0]]


@JACFWD
@pytest.mark.parametrize("rotation", [0.0, 1.0])
def test_jacobians_equal_forward_mode_and_differences_through_the_retraction(hand, rotation):
    pose = poses_of(hand, 1, seed=4, turn=rotation)[0]
    skin = tr.BendingSkin(hand, around(hand, hand.rest_pose(), 30))
    jacobian = torch.func.jacfwd(skin)(pose)
    compare(skin.jacobian(pose), (skin(pose), jacobian), atol=1e-10)
    batch = torch.stack([pose, hand.rest_pose()]).unsqueeze(0)
    points, jacobians = skin.jacobian(batch)
    compare((points, jacobians[0, 0]), (skin(batch), jacobian), atol=1e-10)
    steps = 1e-6 * torch.eye(27, dtype=D)
    ahead, behind = (skin(hand.retract(pose.expand_as(steps), sign * steps)) for sign in (1, -1))
    compare([skin.jacobian(pose, chart="tangent")[1]], [((ahead - behind) / 2e-6).permute(1, 2, 0)], atol=1e-8)


@torch.no_grad()
def test_normals_turn_with_their_parts(hand, pose):
    normals = torch.nn.functional.normalize(seeded(10, 3, seed=1), dim=-1)
    weights = torch.zeros(10, 16)
    weights[:, 5] = 1.0
    skin = tr.LinearBlendSkin(hand, around(hand, hand.rest_pose(), 10), weights, hand.rest_pose(), normals=normals)
    turn = (hand.part_transforms(pose)[5] @ torch.linalg.inv(hand.part_transforms(hand.rest_pose())[5]))[:3, :3]
    compare([skin.posed_normals(pose)], [normals @ turn.mT], atol=1e-7)
    assert skin.posed_normals(pose.expand(2, 27)).shape == (2, 10, 3)


@torch.no_grad()
def test_states_make_fresh_skins_the_same_and_dtypes_reach_the_shape(hand, pose):
    normals, faces = torch.eye(3, dtype=D).repeat(4, 1), torch.tensor([[0, 1, 2]], dtype=torch.int32)
    points = around(hand, hand.rest_pose(), 12)
    skin = tr.BendingSkin(hand, points, pose, 4.0, normals=normals, faces=faces)
    assert {"points", "weights", "basis", "reference_pose"} <= set(skin.state_dict())
    fresh = tr.BendingSkin(tr.Hand(dtype=D), torch.zeros(12, 3), normals=-normals, faces=0 * faces)
    fresh.load_state_dict(skin.state_dict())
    other = poses_of(hand, 1)[0]
    assert torch.equal(fresh(other), skin(other))
    assert torch.equal(fresh.posed_normals(other), skin.posed_normals(other))
    assert torch.equal(fresh.faces, faces.long())
    assert fresh.to(torch.float32)(torch.zeros(27)).dtype == torch.float32


def test_skins_of_shapes_that_learn_follow_them(hand, pose):
    shape, reference = tr.Hand(dtype=D).requires_grad_(True), poses_of(hand, 1, seed=1)[0]
    points = around(hand, reference, 6)
    skin = tr.BendingSkin(shape, points, reference, normals=torch.eye(3).repeat(2, 1))
    assert skin.follows_shape
    compare([skin(pose)], [tr.BendingSkin(hand, points, reference)(pose)])
    perturbed(shape)
    with torch.no_grad():
        frozen = skin.frozen()
        for other in (tr.BendingSkin(shape, points, reference, normals=skin.normals), frozen):
            assert not other.follows_shape
            compare((skin(pose), skin.posed_normals(pose)), (other(pose), other.posed_normals(pose)))
            compare(skin.jacobian(pose), other.jacobian(pose))
        shape.log_nu.add_(0.1)
        assert not torch.allclose(skin(pose), frozen(pose))
    for _ in range(2):
        skin(pose).square().sum().backward()
    assert all(float(value.grad.abs().max()) > 0 for value in shape.parameters())


@pytest.mark.parametrize("follows", [False, True])
def test_gradients_of_a_skin_in_the_pose_and_in_the_parameters_of_the_shape(hand, pose, follows):
    shape = tr.Hand(dtype=D).requires_grad_(follows)
    skin = tr.BendingSkin(shape, around(hand, hand.rest_pose(), 3), poses_of(hand, 1, seed=1)[0])
    names = [f"shape.{name}" for name, _ in shape.named_parameters()]

    def posed(pose, *values):
        return torch.func.functional_call(skin, dict(zip(names, values, strict=True)), (pose,))

    values = (pose, *(value.detach().clone() for value in shape.parameters()))
    assert torch.autograd.gradcheck(posed, tuple(value.requires_grad_() for value in values))


def test_the_sharpness_of_a_skin_is_that_of_its_shape_unless_another_is_given(hand, pose):
    points, sharp = around(hand, hand.rest_pose(), 20), tr.Hand(sharpness=7.0, dtype=D)
    assert tr.BendingSkin(sharp, points).sharpness == sharp.sharpness == 7.0
    assert torch.equal(tr.BendingSkin(sharp, points)(pose), tr.BendingSkin(hand, points, sharpness=7.0)(pose))
    assert torch.equal(tr.BendingSkin(sharp, points, sharpness=2.0)(pose), tr.BendingSkin(hand, points)(pose))


@torch.no_grad()
def test_sampled_points_cover_the_surface_evenly(plain_hand):
    skin = tr.sample_skin(plain_hand, 300)
    assert isinstance(skin, tr.BendingSkin)
    assert len(skin) == 300
    assert float(plain_hand.distance(skin.points, plain_hand.rest_pose()).abs().max()) < 1e-3
    gaps = torch.cdist(skin.points, skin.points).fill_diagonal_(torch.inf).amin(-1)
    assert float(gaps.min()) > 0.3 * float(gaps.mean())
    outside = plain_hand.distance(skin.points + 0.001 * skin.normals, plain_hand.rest_pose())
    assert float((outside > 0).float().mean()) > 0.98


@torch.no_grad()
def test_sampled_points_of_a_surface_follow_its_weights():
    corners = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]) * 0.1
    faces = torch.tensor([[0, 1, 3], [0, 3, 2]])
    weights = torch.tensor([[1.0, 0], [1, 0], [0, 1], [0, 1]])
    joints = torch.tensor([[0.05, 0.0, 0.0], [0.05, 0.05, 0.0]])
    shape = tr.ArticulatedShape.from_skinned_mesh(corners, faces, weights, joints, [-1, 0], dtype=D)
    skin = tr.sample_skin(shape, 20)
    torch.testing.assert_close(skin.weights, torch.stack([1 - 10 * skin.points[:, 1], 10 * skin.points[:, 1]], dim=-1))
    assert bool((skin.normals[:, 2] == 1).all())
    assert not isinstance(skin, tr.BendingSkin)
    assert torch.equal(tr.sample_skin(shape, 20).points, skin.points)
    assert not torch.equal(tr.sample_skin(shape, 20, seed=1).points, skin.points)
