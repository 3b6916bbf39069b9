"""The forward pass of shapes: its points, its gradients, its state, and what each parameter moves."""

import copy
import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchreg.alignment.em_loss import EMLoss
from torchreg.errors import InputError
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.rigid import rigid_matrix
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.hand import Hand
from torchreg.shapes.material_points import ShapeOutput
from torchreg.shapes.primitives import Primitive
from torchreg.shapes.skin import BendingSkin

D = torch.float64
NAMES = ["log_length_scales", "log_radius_scales", "log_nu", "log_sharpness"]


@pytest.fixture(scope="module")
def hand():
    return Hand(dtype=D)


def random_poses(shape, count=2, seed=0, turn=1.0):
    generator = torch.Generator().manual_seed(seed)
    limits = shape.lower[6:].clamp_min(-1), shape.upper[6:].clamp_max(1)
    joints = limits[0] + (limits[1] - limits[0]) * torch.rand(count, shape.num_dofs - 6, generator=generator).to(D)
    base = torch.tensor([0.1] * 3 + [turn] * 3, dtype=D) * torch.randn(count, 6, generator=generator).to(D)
    return torch.cat([base, joints], dim=-1).to(shape.rest)


def at(x=0.0, y=0.0, z=0.0):
    return rigid_matrix(torch.eye(3, dtype=D), torch.tensor([x, y, z], dtype=D))


def rod(**options):
    """Two links on a hinge, with solids that lie oblique to them."""
    turn = torch.from_numpy(Rotation.from_rotvec([0.4, -0.2, 0.3]).as_matrix())
    tree = KinematicTree((Joint("a", -1, at()), Joint("b", 0, at(z=0.1), "revolute", (1.0, 0.0, 0.0), -1.0, 1.0)))
    solids = [
        Primitive("capsule", (0.05, 0.02), at(z=0.05)),
        Primitive("ellipsoid", (0.02, 0.015, 0.05), rigid_matrix(turn, torch.tensor([0.0, 0.0, 0.05], dtype=D))),
    ]
    return ArticulatedShape(tree, ["a", "b"], solids, nu=0.004, dtype=D, **options)


def blocks():
    """A box on a cone, and another box that hides inside of it."""
    tree = KinematicTree((Joint("a", -1, at()), Joint("b", 0, at(z=0.1), "revolute", (1.0, 0.0, 0.0), -1.0, 1.0),
                          Joint("c", 1, at(), "revolute", (0.0, 1.0, 0.0), -1.0, 1.0)))  # fmt: skip
    solids = [
        Primitive("cone", (0.05, 0.05, 0.02), at(z=0.05)),
        Primitive("superquadric", (0.04, 0.02, 0.06, 0.3, 0.3), at(z=0.05)),
        Primitive("superquadric", (0.01, 0.01, 0.02, 0.3, 0.3), at(z=0.05)),
    ]
    return ArticulatedShape(tree, ["a", "b", "c"], solids, nu=0.004, dtype=D)


def perturbed(shape, seed=0, spread=0.1):
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for value in shape.parameters():
            value.add_(spread * torch.randn(value.shape, generator=generator).to(value))
    return shape


def test_a_forward_pass_is_points_keypoints_and_transforms(hand):
    poses = random_poses(hand, 6).unflatten(0, (2, 3))
    found = hand(poses)
    assert isinstance(found, ShapeOutput)
    assert found.points.shape == (2, 3, len(hand.surface_points), 3)
    assert torch.equal(found.keypoints, hand.keypoints(poses))
    assert torch.equal(found.transforms, hand.part_transforms(poses))
    torch.testing.assert_close(found.points[1, 2], hand(poses[1, 2]).points, atol=1e-12, rtol=0)
    assert hand.faces is None
    with pytest.raises(InputError, match=r"pose must have shape \(\.\.\., 27\), got \(9,\)"):
        hand(torch.zeros(9, dtype=D))


@pytest.mark.parametrize(
    "make", [lambda: Hand(dtype=D), lambda: Hand("left", scale=0.6, nu=0.002, dtype=D), rod, blocks]
)
def test_points_cover_the_fused_surface_evenly_and_stay_on_it(make):
    shape = make()
    rest = shape(shape.rest_pose()).points
    assert float(shape.distance(rest, shape.rest_pose()).abs().max()) < 1e-2 * shape.nu
    mesh = shape.surface_mesh(spacing=shape.nu)
    gaps = torch.cdist(rest, rest).fill_diagonal_(torch.inf).amin(-1)
    # Everything on the surface is nearer to a point than twice their usual spacing.
    assert float(torch.cdist(mesh.vertices, rest).amin(-1).max()) < 2 * float(gaps.mean())
    assert float(gaps.min()) > 0.3 * float(gaps.mean())
    poses = random_poses(shape, 8)
    distance = shape.distance(shape(poses).points, poses).abs()
    assert float(distance.quantile(0.9)) < 1e-2 * shape.nu


def test_at_rest_points_follow_the_bending_skin_before_the_newton_step(hand):
    """Bent, they are the skin's points, moved along the gradient of the distance until it is zero to first order."""
    poses = random_poses(hand, 3)
    posed = BendingSkin(hand, hand.surface_points.points)(poses)
    posed.requires_grad_()
    distance = hand.distance(posed, poses)
    (gradient,) = torch.autograd.grad(distance.sum(), posed)
    expected = posed - gradient * (distance / gradient.square().sum(-1)).unsqueeze(-1)
    off = (hand(poses).points - expected).norm(dim=-1)
    # Points whose surroundings another finger enters are told from that finger here, not in the oracle.
    assert float((off < 1e-9).double().mean()) > 0.9


def test_parameters_are_frozen_until_they_are_told_to_learn():
    hand = Hand()
    assert [name for name, _ in hand.named_parameters()] == NAMES
    assert not any(value.requires_grad for value in hand.parameters())
    assert hand.keypoints(hand.rest_pose()).numpy().shape == (21, 3)
    assert isinstance(hand(hand.rest_pose()).points.numpy(), np.ndarray)
    hand.requires_grad_(True)
    hand(hand.rest_pose() + 0.2).points.square().sum().backward()
    assert all(float(value.grad.abs().max()) > 0 for value in hand.parameters())


def test_nu_and_sharpness_are_what_their_logarithms_say():
    shape = Hand(nu=0.0037, sharpness=3.3)
    assert (shape.nu, shape.sharpness) == (0.0037, 3.3)
    assert float(shape.log_nu.exp()) == pytest.approx(0.0037)
    with torch.no_grad():
        shape.log_nu.fill_(math.log(0.005))
        shape.log_sharpness.add_(math.log(2.0))
    assert shape.nu == pytest.approx(0.005, rel=1e-6)
    assert shape.sharpness == pytest.approx(6.6, rel=1e-6)
    points = 0.05 * torch.randn(50, 3, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(
        shape.distance(points, shape.rest_pose()), Hand(nu=0.005).distance(points, shape.rest_pose())
    )


def call(shape, pose, *values):
    return torch.func.functional_call(shape, dict(zip(NAMES, values, strict=True)), (pose,))


@pytest.mark.parametrize("make", [rod, lambda: Hand(dtype=D)])
def test_gradients_in_the_pose_and_all_parameters(make):
    shape = perturbed(make())
    for name in ("points", "weights", "partners"):
        shape.surface_points.register_buffer(name, getattr(shape.surface_points, name)[::40])
    inputs = (random_poses(shape, 1), *(value.detach().clone() for value in shape.parameters()))
    inputs = tuple(value.requires_grad_() for value in inputs)
    assert torch.autograd.gradcheck(lambda *values: tuple(call(shape, *values)), inputs, atol=1e-6, fast_mode=True)


def test_the_em_loss_moves_all_parameters():
    truth, hand = perturbed(Hand(), 3), Hand().requires_grad_(True)
    poses = random_poses(hand, 2)
    loss = EMLoss(0.004)
    energy = loss(hand(poses).points, truth(poses).points).sum()
    energy.backward()
    with torch.no_grad():
        for value in hand.parameters():
            assert float(value.grad.abs().max()) > 0
            value.sub_(1e-3 * value.grad / value.grad.norm())
        assert float(loss(hand(poses).points, truth(poses).points).sum()) < float(energy)


def test_the_surface_grows_with_the_scales():
    """All scales and nu at once are a change of units."""
    shape, larger = rod(), rod()
    with torch.no_grad():
        for value in (larger.log_length_scales, larger.log_radius_scales, larger.log_nu):
            value.add_(math.log(1.3))
    pose = random_poses(shape, 4)
    grown = torch.cat([1.3 * pose[:, :3], pose[:, 3:]], dim=-1)
    for found, expected in zip(larger(grown)[:2], shape(pose)[:2], strict=True):
        torch.testing.assert_close(found, 1.3 * expected, atol=1e-9, rtol=0)
    thick = rod()
    with torch.no_grad():
        thick.log_radius_scales[1] = 0.3
    points, own = thick(shape.rest_pose()).points, thick.surface_points.weights[:, 1] == 1
    assert float(thick.distance(points, shape.rest_pose()).abs().max()) < 0.1 * shape.nu
    tip = own & (points[:, 2] > 0.15)
    assert float((points - shape(shape.rest_pose()).points)[tip].norm(dim=-1).mean()) > 0.002


@pytest.mark.parametrize("make", [lambda: Hand(nu=0.004), lambda: rod(free_base=False)])
def test_the_state_makes_a_fresh_shape_the_same(make):
    shape, fresh = perturbed(make()), make()
    fresh.load_state_dict(shape.state_dict())
    poses = random_poses(shape, 3)
    for found, expected in zip(fresh(poses), shape(poses), strict=True):
        assert torch.equal(found, expected)


def test_moving_a_shape_moves_all_of_it():
    hand = perturbed(Hand())
    poses = random_poses(hand, 2)
    double = copy.deepcopy(hand).double()
    assert {value.dtype for value in double.state_dict().values()} == {D}
    for found, expected in zip(double(poses.double()), hand(poses), strict=True):
        assert found.dtype == D
        torch.testing.assert_close(found.float(), expected, atol=1e-5, rtol=0)
    device = "cuda" if torch.cuda.is_available() else "meta"
    moved = copy.deepcopy(hand).to(device)
    assert {value.device.type for value in (*moved.parameters(), *moved.buffers())} == {device}
    assert {value.device.type for value in moved(poses.to(device))} == {device}


def square():
    """A folded square of two faces, each on a part of its own; its vertices are blended along the fold."""
    vertices = torch.tensor([[-0.1, 0, 0], [-0.1, 0.1, 0], [0, 0, 0], [0, 0.1, 0], [0.1, 0, 0], [0.1, 0.1, 0]], dtype=D)
    faces = torch.tensor([[0, 2, 1], [1, 2, 3], [2, 4, 3], [3, 4, 5]])
    weights = torch.tensor([[1, 0], [1, 0], [0.5, 0.5], [0.5, 0.5], [0, 1], [0, 1]], dtype=D)
    joints = torch.tensor([[-0.1, 0.05, 0], [0.0, 0.05, 0]], dtype=D)
    return ArticulatedShape.from_skinned_mesh(vertices, faces, weights, joints, [-1, 0], dtype=D)


def test_points_of_a_rig_are_its_vertices_in_their_order():
    shape = square()
    pose = shape.rest_pose()
    assert torch.equal(shape(pose).points, shape.surface.vertices)
    assert torch.equal(shape.faces, shape.surface.faces)
    poses = random_poses(shape, 3)
    torch.testing.assert_close(shape(poses).points, shape.file_skin()(poses), atol=1e-14, rtol=0)
    shape.requires_grad_(True)
    shape(poses).points.square().sum().backward()
    assert float(shape.log_radius_scales.grad.abs().max()) > 0
    assert shape.log_nu.grad is None


@pytest.fixture
def robot(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(
        """<robot name="arm">
          <link name="base"><visual><geometry><box size="0.2 0.1 0.1"/></geometry></visual></link>
          <link name="arm"><visual><origin xyz="0 0 0.15"/>
            <geometry><cylinder radius="0.03" length="0.3"/></geometry></visual></link>
          <joint name="hinge" type="revolute"><parent link="base"/><child link="arm"/><origin xyz="0 0 0.05"/>
            <axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
        </robot>""",
        encoding="utf-8",
    )
    return ArticulatedShape.from_urdf(path, dtype=D)


def test_points_of_a_robot_are_samples_of_its_links(robot):
    poses = random_poses(robot, 2)
    found = robot(poses)
    assert found.points.shape == (2, 500, 3)
    assert robot.faces is None
    owners = robot.surface_points.weights.argmax(-1)
    # Every point is on a face of the box, or on the cylinder of 24 facets, in the coordinates of its link.
    local = torch.linalg.inv(found.transforms)[:, owners] @ torch.nn.functional.pad(
        found.points, (0, 1), value=1.0
    ).unsqueeze(-1)
    box = local[:, owners == 0, :3, 0].abs() - torch.tensor([0.1, 0.05, 0.05], dtype=D)
    assert float(box.amax(-1).abs().max()) < 1e-9
    arm = local[:, owners == 1, :3, 0]
    radial = arm[..., :2].norm(dim=-1) - 0.03
    end = (arm[..., 2] - 0.15).abs() - 0.15
    assert float(torch.maximum(radial, end).abs().max()) < 0.03 * (1 - math.cos(math.pi / 24)) + 1e-9
    mesh = TriangleMesh(robot.surface.vertices, robot.surface.faces)
    share = float(mesh.face_areas()[robot.surface.weights[mesh.faces[:, 0], 0] == 1].sum() / mesh.face_areas().sum())
    assert float((owners == 0).double().mean()) == pytest.approx(share, abs=0.1)
