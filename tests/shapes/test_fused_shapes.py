"""Shapes of solids: which parts fuse, some parts alone, sizes that are learned or held, and the meshed surface."""

import math

import numpy as np
import pytest
import torch

import torchreg as tr
from tests.shapes.kinds import D, around, at, machine, poses_of, seeded
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.shapes.primitives import Primitive

POSE = torch.tensor([0.5, -1.0, 0.25, 0.3, -0.2, 0.5, 0.4, -0.3, 0.2, 0.9], dtype=D)


@pytest.fixture
def crane():
    return machine()


def cloud(count=60, seed=0):
    return 0.6 * seeded(count, 3, seed=seed) + torch.tensor([0.6, -0.9, 1.0], dtype=D)


def without(parts):
    """The machine whose other parts are far away."""
    shape = machine()
    with torch.no_grad():
        for part in parts:
            shape.primitives.centers[part] += 1e4
    return shape


def test_names_and_neighbors(crane):
    base = ("base_x", "base_y", "base_z", "base_rx", "base_ry", "base_rz")
    assert crane.dof_names == (*base, "turn", "lift", "slide", "hook")
    assert crane.part_names == ("base", "lift", "slide", "hook", "follow")
    assert crane.part_parents == (-1, 0, 1, 2, 2)
    assert crane.is_sliding.tolist() == [True] * 3 + [False] * 5 + [True, False]
    pairs = {tuple(pair) for pair in crane.adjacency.triu(1).nonzero().tolist()}
    assert pairs == {(0, 1), (1, 2), (2, 3), (2, 4)}


def test_a_fixed_base_stays_and_the_rest_pose_is_the_limit_nearest_to_zero():
    shape = machine(free_base=False)
    assert shape.clamp(POSE)[:6].tolist() == shape.rest_pose()[:6].tolist() == [0.0] * 6
    tree = KinematicTree((Joint("a", -1, at()), Joint("b", 0, at(z=1), "revolute", (1.0, 0.0, 0.0), 0.5, 1.0)))
    shape = tr.ArticulatedShape(tree, ["a", "b"], [Primitive("ellipsoid", (1.0, 1.0, 1.0), at())] * 2)
    assert shape.rest_pose()[6:].tolist() == [0.5]


@pytest.mark.parametrize("name", ["hand", "machine"])
def test_the_fused_distance_is_equation_1_with_neighbors_only(shapes, name):
    shape = shapes[name]
    pose = poses_of(shape, 1, seed=8)[0]
    points, found = around(shape, pose, 200), []
    for row in shape.part_distances(points, pose).numpy():
        fields = np.exp(-row / shape.nu)
        near = [q for q in range(shape.num_parts) if q == fields.argmax() or shape.adjacency[fields.argmax(), q]]
        found.append(-shape.nu * np.log(fields[near].sum()))
    reached = np.isfinite(found)
    assert reached.mean() > 0.9
    np.testing.assert_allclose(shape.distance(points, pose).numpy()[reached], np.array(found)[reached], atol=1e-12)


@torch.no_grad()
def test_a_shape_of_mixed_solids_equals_shapes_of_one_kind(crane):
    points, transforms = cloud(), crane.part_transforms(POSE)
    distances = crane.part_distances(points, POSE)
    for part, solid in enumerate(crane.primitives.solids()):
        tree = KinematicTree((Joint("only", -1, transforms[part]),))
        alone = tr.ArticulatedShape(tree, ["only"], [solid], nu=0.05, dtype=D)
        # One part has nothing to fuse with.
        torch.testing.assert_close(alone.distance(points, alone.rest_pose()), distances[:, part], atol=1e-12, rtol=0)


def test_lengths_scale_along_z_and_radii_across(crane):
    length, radius = torch.arange(2, 7, dtype=D), torch.arange(12, 17, dtype=D)
    parts = crane.primitives
    by_kind = dict(zip(parts.kinds, parts.scaled_sizes(length, radius), strict=True))
    expected = {
        "cone": [[0.25 * 2, 0.3 * 12, 0.2 * 12]],
        "ellipsoid": [[0.1 * 13, 0.15 * 13, 0.35 * 3], [0.05 * 16, 0.05 * 16, 0.15 * 6]],
        "superquadric": [[0.1 * 14, 0.12 * 14, 0.2 * 4, 0.6, 0.8]],
        "capsule": [[0.1 * 5, 0.05 * 15]],
    }
    for kind, sizes in expected.items():
        torch.testing.assert_close(by_kind[kind], torch.tensor(sizes, dtype=D))


@pytest.mark.parametrize("parts", [[0], [1, 4], [4, 1, 2], [0, 1, 2, 3, 4]])
def test_some_parts_alone_equal_a_shape_whose_other_parts_are_far_away(crane, parts):
    points = seeded(40, 3, seed=3)
    expected = without(set(range(5)) - set(parts)).distance_jacobian(points, POSE)
    torch.testing.assert_close(crane.distance_jacobian(points, POSE, parts=parts), expected)
    torch.testing.assert_close(crane.distance(points, POSE, parts=parts), expected[0])


@torch.no_grad()
def test_distances_without_some_parts_equal_those_of_a_shape_where_they_are_far_away(crane):
    poses, points = torch.stack([POSE, 0.5 * POSE]), seeded(2, 40, 3, seed=3)
    left_out = [(), (0,), (4, 1), (1, 2, 3)]
    found = crane.distances_without(points, poses, [*left_out, range(5)])
    for parts, distances in zip(left_out, found, strict=False):
        torch.testing.assert_close(distances, without(parts).distance(points, poses))
    assert found.shape == (5, 2, 40)
    assert bool(torch.isposinf(found[-1]).all())


def test_placed_parts_keep_their_distances_wherever_their_joints_are(crane):
    parts, points, moved = [3, 1], seeded(7, 3, seed=4), at(1.0, -2.0, 0.5, (0.3, 1.0, -0.4))
    placed = moved @ crane.part_transforms(POSE)[parts]
    distances = crane.placed_distances(points @ moved[:3, :3].mT + moved[:3, 3], placed, parts)
    torch.testing.assert_close(distances, crane.part_distances(points, POSE)[:, parts].mT)


@torch.no_grad()
def test_longer_parts_carry_the_frames_below_them_away(crane):
    before = crane.part_transforms(POSE)
    crane.log_length_scales[1] = math.log(2.0)
    after = crane.part_transforms(POSE)
    torch.testing.assert_close(after[:2], before[:2])
    torch.testing.assert_close(after[:, :3, :3], before[:, :3, :3])
    # "slide" sits 0.6 up "lift"; what it slides by is no part of the length.
    shift = 0.6 * before[1, :3, 2]
    torch.testing.assert_close(after[2:, :3, 3] - before[2:, :3, 3], shift.expand(3, 3))


def test_held_sizes_change_nothing_and_are_let_go(crane):
    points = cloud()
    crane.requires_grad_(True)
    expected = crane.distance_jacobian(points, POSE)
    with torch.no_grad(), crane.held_sizes():
        found = crane.distance_jacobian(points, POSE)
        few = crane.distance(points, POSE, parts=[1, 3])
    torch.testing.assert_close(found, expected)
    torch.testing.assert_close(few, crane.distance(points, POSE, parts=[1, 3]))
    with torch.no_grad():
        crane.log_length_scales[1] = math.log(2.0)
    assert not torch.allclose(crane.distance(points, POSE), expected[0])
    with pytest.raises(RuntimeError, match="stop"), crane.held_sizes():
        raise RuntimeError("stop")
    assert crane.log_length_scales.requires_grad
    assert crane.distance(points, POSE).requires_grad


def test_the_state_holds_parameters_and_what_they_multiply(crane):
    names = {"log_length_scales", "log_radius_scales", "log_nu", "log_sharpness"}
    assert {name for name, _ in crane.named_parameters()} == names
    solids = {"primitives.centers", *(f"primitives.sizes.{kind}" for kind in range(4))}
    assert {name for name in crane.state_dict() if not name.startswith("surface_points.")} == names | solids


@torch.no_grad()
def test_the_mesh_lies_on_the_surface_in_any_pose_and_is_of_the_shape_as_it_is_now():
    shape, pose = machine(torch.float32), POSE.float()
    mesh = shape.surface_mesh(pose, spacing=0.02)
    # Where an unrelated part takes over the surface is creased, and the field jumps.
    assert float(shape.distance(mesh.vertices, pose).abs().quantile(0.9)) < 0.05 * shape.nu
    edges = torch.cat([mesh.faces[:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))]).sort(-1).values
    assert bool((edges.unique(dim=0, return_counts=True)[1] == 2).all())
    coarse = shape.surface_mesh(spacing=0.08)
    assert 100 < len(coarse.vertices) < len(mesh.vertices)
    kept = coarse.vertices.clone()
    coarse.vertices.zero_()
    assert torch.equal(shape.surface_mesh(spacing=0.08).vertices, kept), "what a caller does to a mesh is the caller's"
    for name, value in shape.state_dict().items():
        if name.startswith("primitives.sizes"):
            value.mul_(1.3)
    changed = shape.surface_mesh(spacing=0.08)
    assert float(shape.distance(changed.vertices, shape.rest_pose()).abs().quantile(0.9)) < 0.3 * shape.nu
    assert not torch.equal(changed.vertices, kept)
