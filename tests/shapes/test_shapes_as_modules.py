"""The forward pass of shapes: where its points lie, and what each parameter moves."""

import math

import numpy as np
import pytest
import torch

import torchreg as tr
from tests.shapes.kinds import D, at, compare, poses_of, rod
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.shapes.primitives import Primitive


def blocks():
    """A box on a cone, and another box that hides inside of it."""
    tree = KinematicTree((Joint("a", -1, at()), Joint("b", 0, at(z=0.1), "revolute", (1.0, 0.0, 0.0), -1.0, 1.0),
                          Joint("c", 1, at(), "revolute", (0.0, 1.0, 0.0), -1.0, 1.0)))  # fmt: skip
    solids = [
        Primitive("cone", (0.05, 0.05, 0.02), at(z=0.05)),
        Primitive("superquadric", (0.04, 0.02, 0.06, 0.3, 0.3), at(z=0.05)),
        Primitive("superquadric", (0.01, 0.01, 0.02, 0.3, 0.3), at(z=0.05)),
    ]
    return tr.ArticulatedShape(tree, ["a", "b", "c"], solids, nu=0.004, dtype=D)


@torch.no_grad()
@pytest.mark.parametrize("name", ["hand", "left hand", "rod", "blocks"])
def test_points_cover_the_fused_surface_evenly_and_stay_on_it(shapes, name):
    shape = shapes.get(name) or blocks()
    output = shape(shape.rest_pose())
    assert isinstance(output, tr.ShapeOutput)
    assert shape.faces is None
    rest = output.points
    assert float(shape.distance(rest, shape.rest_pose()).abs().max()) < 1e-2 * shape.nu
    mesh = shape.surface_mesh(spacing=shape.nu)
    gaps = torch.cdist(rest, rest).fill_diagonal_(torch.inf).amin(-1)
    # Everything on the surface is nearer to a point than twice their usual spacing.
    assert float(torch.cdist(mesh.vertices, rest).amin(-1).max()) < 2 * float(gaps.mean())
    assert float(gaps.min()) > 0.3 * float(gaps.mean())
    poses = poses_of(shape, 8)
    assert float(shape.distance(shape(poses).points, poses).abs().quantile(0.9)) < 1e-2 * shape.nu


def test_at_rest_points_follow_the_bending_skin_before_the_newton_step(hand):
    """Bent, they are the skin's points, moved along the gradient of the distance until it is zero to first order."""
    poses = poses_of(hand)
    posed = tr.BendingSkin(hand, hand.surface_points.points)(poses).requires_grad_()
    distance = hand.distance(posed, poses)
    (gradient,) = torch.autograd.grad(distance.sum(), posed)
    expected = posed - gradient * (distance / gradient.square().sum(-1)).unsqueeze(-1)
    off = (hand(poses).points - expected).norm(dim=-1)
    # Points whose surroundings another finger enters keep their own finger's surface, which the oracle does not.
    assert float((off < 1e-9).double().mean()) > 0.9


def test_parameters_are_frozen_until_gradients_are_asked_for():
    hand = tr.Hand()
    assert not any(value.requires_grad for value in hand.parameters())
    assert isinstance(hand(hand.rest_pose()).points.numpy(), np.ndarray)
    hand.requires_grad_(True)
    hand(hand.rest_pose() + 0.2).points.square().sum().backward()
    assert all(float(value.grad.abs().max()) > 0 for value in hand.parameters())


@torch.no_grad()
def test_nu_and_sharpness_are_what_their_logarithms_say():
    shape = tr.Hand(nu=0.0037, sharpness=3.3)
    assert (shape.nu, shape.sharpness) == (0.0037, 3.3)
    assert float(shape.log_nu.exp()) == pytest.approx(0.0037)
    shape.log_nu.fill_(math.log(0.005))
    shape.log_sharpness.add_(math.log(2.0))
    assert (shape.nu, shape.sharpness) == pytest.approx((0.005, 6.6), rel=1e-6)
    points, rest = shape.surface_points.points + 0.01, shape.rest_pose()
    torch.testing.assert_close(shape.distance(points, rest), tr.Hand(nu=0.005).distance(points, rest))


@torch.no_grad()
def test_the_surface_grows_with_the_scales(shapes):
    """All scales and nu at once are a change of units."""
    shape, larger, thick = shapes["rod"], rod(), rod()
    for value in (larger.log_length_scales, larger.log_radius_scales, larger.log_nu):
        value.add_(math.log(1.3))
    pose = poses_of(shape, 4)
    grown = torch.cat([1.3 * pose[:, :3], pose[:, 3:]], dim=-1)
    compare(larger(grown)[:2], (1.3 * part for part in shape(pose)[:2]), atol=1e-9)
    thick.log_radius_scales[1] = 0.3
    points, own = thick(shape.rest_pose()).points, thick.surface_points.weights[:, 1] == 1
    assert float(thick.distance(points, shape.rest_pose()).abs().max()) < 0.1 * shape.nu
    tip = own & (points[:, 2] > 0.15)
    assert float((points - shape(shape.rest_pose()).points)[tip].norm(dim=-1).mean()) > 0.002


def test_points_of_a_rig_are_its_vertices_in_their_order(shapes):
    shape = shapes["tube"]
    assert torch.equal(shape(shape.rest_pose()).points, shape.surface.vertices)
    assert torch.equal(shape.faces, shape.surface.faces)
    poses = poses_of(shape)
    compare([shape(poses).points], [shape.file_skin()(poses)], atol=1e-14)


@torch.no_grad()
def test_points_of_a_robot_are_samples_of_its_links(shapes):
    shape = shapes["robot"]
    poses = poses_of(shape, 2)
    found = shape(poses)
    assert found.points.shape == (2, 500, 3)
    assert shape.faces is None
    owners = shape.surface_points.weights.argmax(-1)
    # Every point is on a face of the box, or on the cylinder of 24 facets, in the coordinates of its link.
    homogeneous = torch.nn.functional.pad(found.points, (0, 1), value=1.0).unsqueeze(-1)
    local = (torch.linalg.inv(found.transforms)[:, owners] @ homogeneous)[..., :3, 0]
    box = local[:, owners == 0].abs() - torch.tensor([0.15, 0.1, 0.05], dtype=D)
    assert float(box.amax(-1).abs().max()) < 1e-9
    mast = local[:, owners == 1]
    outside = torch.maximum(mast[..., :2].norm(dim=-1) - 0.04, (mast[..., 2] - 0.2).abs() - 0.2)
    assert float(outside.abs().max()) < 0.04 * (1 - math.cos(math.pi / 24)) + 1e-9
    mesh = tr.TriangleMesh(shape.surface.vertices, shape.surface.faces)
    share = float(mesh.face_areas()[shape.surface.weights[mesh.faces[:, 0], 0] == 1].sum() / mesh.face_areas().sum())
    assert float((owners == 0).double().mean()) == pytest.approx(share, abs=0.1)
