"""Distances to the exact meshes of rigid links."""

import math

import pytest
import torch

import torchreg as tr
from tests.shapes.kinds import D, at
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.shapes import link_surface
from torchreg.shapes.primitives import Primitive
from torchreg.shapes.spec import RigSurface

SIZE = torch.tensor([0.3, 0.1, 0.08], dtype=D)
# The second box hangs on the end of the first and turns about z.
HINGE, MIDDLE = at(0.18), torch.tensor([0.16, 0.0, 0.0], dtype=D)


def box():
    corners = torch.cartesian_prod(*torch.tensor([-0.5, 0.5], dtype=D).expand(3, 2)) * SIZE
    sides = torch.tensor([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    return corners, sides[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)


def two_boxes(drop=0, turned_in=False):
    """Return an arm of two boxes, their meshes in the pose of all zeros; faces dropped of the second one."""
    vertices, faces = box()
    second = faces[drop:].flip(-1) if turned_in else faces[drop:]
    weights = torch.nn.functional.one_hot(torch.arange(2).repeat_interleave(8), 2).float()
    both = torch.cat([vertices, vertices + HINGE[:3, 3] + MIDDLE])
    surface = RigSurface(both, torch.cat([faces, second + 8]), weights, is_rigid=True)
    tree = KinematicTree((Joint("base", -1, at()), Joint("elbow", 0, HINGE, "revolute")))
    solids = [Primitive("ellipsoid", (0.15, 0.05, 0.04), at())] * 2
    return tr.ArticulatedShape(tree, ["base", "elbow"], solids, surface=surface, dtype=D)


@pytest.fixture(scope="module")
def arm():
    return two_boxes()


POSE = torch.tensor([0.2, -0.1, 0.4, 0.5, -1.0, 0.3, 0.9], dtype=D)


def box_distances(shape, points, pose):
    """Return the exact signed distances (2, N) to the two boxes."""
    found = []
    for frame, middle in zip(shape.part_transforms(pose), (torch.zeros(3), MIDDLE), strict=True):
        local = (points - frame[:3, 3]) @ frame[:3, :3] - middle
        beyond = local.abs() - SIZE / 2
        found.append(beyond.clamp_min(0).norm(dim=-1) + beyond.amax(-1).clamp_max(0))
    return torch.stack(found)


def around(shape, pose, count=400, reach=0.06):
    """Return points (N, 3) around the posed boxes, inside and outside."""
    generator = torch.Generator().manual_seed(0)
    local = (torch.rand(count, 3, generator=generator, dtype=D) - 0.5) * (SIZE + 2 * reach)
    frames = shape.part_transforms(pose)
    first, second = local[: count // 2], local[count // 2 :] + MIDDLE
    return torch.cat([x @ T[:3, :3].mT + T[:3, 3] for x, T in zip((first, second), frames, strict=True)])


def test_distances_are_those_to_the_nearer_box(arm):
    points = around(arm, POSE)
    exact = box_distances(arm, points, POSE)
    nearest = exact.gather(0, exact.abs().argmin(0, keepdim=True))[0]
    surface = link_surface.LinkSurface(arm)
    # A plane is taken to go on for two spacings beyond an edge.
    torch.testing.assert_close(surface.distance(points, POSE), nearest, rtol=0, atol=2 * surface.meshes.spacing)
    near = nearest.abs() < 0.02
    off = (surface.distance(points, POSE) - nearest)[near].abs()
    assert float(off.quantile(0.9)) < 1e-4


def test_jacobian_matches_differences(arm):
    points = around(arm, POSE, 80)
    surface = link_surface.LinkSurface(arm)
    distance, jacobian = surface.distance_jacobian(points, POSE)
    torch.testing.assert_close(distance, surface.distance(points, POSE))
    steps = 1e-7 * torch.eye(7, dtype=D)
    ahead, behind = (surface.distance(points, arm.retract(POSE.expand(7, 7), s * steps)) for s in (1, -1))
    found = ((ahead - behind) / 2e-7).mT
    # Where a step changes the nearest sample, the difference means nothing.
    same = (found - jacobian).abs().amax(-1) < 1e-5
    assert float(same.double().mean()) > 0.9


def test_meshes_turned_inside_out_are_turned_back_and_open_ones_have_no_inside(arm):
    inside = POSE[:3].unsqueeze(0)
    points = torch.cat([inside, around(arm, POSE, 60)])
    turned = link_surface.LinkSurface(two_boxes(turned_in=True)).distance(points, POSE)
    torch.testing.assert_close(turned, link_surface.LinkSurface(arm).distance(points, POSE), rtol=0, atol=1e-3)
    surface = link_surface.LinkSurface(two_boxes(drop=2))
    assert [link.is_closed for link in surface.meshes.links] == [True, False]
    frame = arm.part_transforms(POSE)[1]
    in_second = (frame[:3, :3] @ MIDDLE + frame[:3, 3]).unsqueeze(0)
    assert float(surface.distance(in_second, POSE)) == pytest.approx(0.04, abs=1e-3)
    assert float(surface.distance(inside, POSE)) == pytest.approx(-0.04, abs=1e-3)


def test_meshes_are_made_once_for_a_shape_and_its_surface(arm):
    assert link_surface.link_meshes(arm) is link_surface.link_meshes(arm)
    other = two_boxes()
    before = link_surface.link_meshes(other)
    other.surface = two_boxes(drop=2).surface
    assert link_surface.link_meshes(other) is not before
    area = 4 * float(SIZE[0] * SIZE[1] + SIZE[1] * SIZE[2] + SIZE[2] * SIZE[0])
    assert link_surface.link_meshes(arm).spacing == pytest.approx(math.sqrt(area / 60_000))


def test_shapes_that_blend_or_have_no_mesh_have_no_rigid_links(arm):
    assert link_surface.has_rigid_links(arm)
    assert not link_surface.has_rigid_links(tr.Hand())
    blended = arm.surface.weights.clone()
    blended[0] = 0.5
    prop = RigSurface(arm.surface.vertices, arm.surface.faces, arm.surface.weights)
    skin = RigSurface(arm.surface.vertices, arm.surface.faces, blended)
    for surface, is_rigid in ((prop, True), (skin, False)):
        other = two_boxes()
        other.surface = surface
        assert link_surface.has_rigid_links(other) is is_rigid
