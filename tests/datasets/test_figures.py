"""The kit of made-up bodies: distances of solids, trees of parts, and how they move a surface."""

import math

import pytest
import torch

from torchreg.datasets import figures, solids, toys


def limb(start, end, radius=0.15):
    return (solids.RoundCone((start, 0, 0), (end, 0, 0), radius, radius),)


ARM = (
    figures.Part("upper", None, (0, 0, 0), limb(0, 1)),
    figures.Part("lower", "upper", (1, 0, 0), limb(1, 2)),
    figures.Part("tip", "lower", (2, 0, 0), limb(2.1, 2.4, 0.1)),
)


@pytest.fixture(scope="module")
def bending():
    return figures.meshed_figure(ARM, spacing=0.08, blend=0.03, softness=0.05)


@pytest.fixture(scope="module")
def jointed():
    return figures.meshed_figure(ARM, spacing=0.08)


@pytest.fixture(scope="module")
def toy():
    return toys.robot(spacing=0.02)


def turns(*angles):
    turn = torch.zeros(len(angles), 3, 3, dtype=torch.float64)
    turn[:, 1, 0] = torch.tensor(angles, dtype=torch.float64)
    return torch.matrix_exp(turn - turn.mT)


def test_parts_carry_what_hangs_on_them_and_the_base_carries_all(bending, jointed):
    for figure in (bending, jointed):
        still = figure.transforms(turns(0.0, 0.0, 0.0))
        torch.testing.assert_close(figure.vertices(still), figure.mesh.vertices)
        torch.testing.assert_close(figure.joint_positions(still), figure.joints[1:])
    bent = turns(math.pi / 2, math.pi / 2, 0.0)
    # The upper arm goes along y, the lower one back along -x from (0, 1, 0).
    expected = torch.tensor([[0.0, 1, 0], [-1, 1, 0]], dtype=torch.float64)
    torch.testing.assert_close(jointed.joint_positions(jointed.transforms(bent)), expected)
    base = torch.eye(4, dtype=torch.float64)
    base[:3, 3] = torch.tensor([1.0, 2, 3])
    moved = bending.vertices(bending.transforms(torch.stack([bent, bent]), base))
    torch.testing.assert_close(moved[1], bending.vertices(bending.transforms(bent)) + base[:3, 3])


def test_skins_bend_smoothly_and_pieces_stay_rigid(bending, jointed):
    assert 0.3 < float(bending.weights.amax(-1).min()) < 0.7
    torch.testing.assert_close(bending.weights.sum(-1), torch.ones(len(bending.weights), dtype=torch.float64))
    assert set(jointed.weights.unique().tolist()) == {0.0, 1.0}
    pose, edges = jointed.vertices(jointed.transforms(turns(0.3, -0.7, 0.9))), jointed.mesh.faces[:, :2]
    rest, lengths = ((v[edges[:, 0]] - v[edges[:, 1]]).norm(dim=-1) for v in (jointed.mesh.vertices, pose))
    torch.testing.assert_close(lengths, rest)


@pytest.mark.parametrize(
    ("solid", "points", "distances"),
    [
        (solids.ball((0, 0, 1), 0.5), [[0, 0, 3], [0, 0.1, 1]], [1.5, -0.4]),
        (solids.RoundCone((0, 0, 0), (0, 0, 2), 0.3, 0.3), [[1, 0, 1], [0, 0, 3], [0, 0.1, 0.5]], [0.7, 0.7, -0.2]),
        (solids.RoundBox((1, 0, 0), (0.5, 0.4, 0.3), 0.1), [[1, 0, 0], [2, 0, 0], [1.8, 0.7, 0]],
         [-0.3, 0.5, math.hypot(0.4, 0.4) - 0.1]),
    ],
)  # fmt: skip
def test_solids_know_how_far_points_are_and_lie_in_their_bounds(solid, points, distances):
    torch.testing.assert_close(solid.distance(torch.tensor(points, dtype=torch.float32)), torch.tensor(distances))
    lower, upper = (torch.tensor(corner) for corner in solid.bounds())
    around = lower - 1 + torch.rand(4000, 3, generator=torch.Generator().manual_seed(1)) * (upper - lower + 2)
    inside = around[solid.distance(around) <= 0]
    assert len(inside) > 10
    assert bool(((inside >= lower - 1e-6) & (inside <= upper + 1e-6)).all())


def test_a_blended_union_rounds_the_seam_and_leaves_the_rest():
    cones = [solids.RoundCone((0, 0, 0), (1, 0, 0), 0.2, 0.2), solids.RoundCone((1, 0, 0), (1, 1, 0), 0.2, 0.2)]
    points = torch.tensor([[0.8, 0.2, 0.0], [-0.2, 0.0, 0.0]], dtype=torch.float64)
    sharp, smooth = solids.union_distance(cones, points, 0.0), solids.union_distance(cones, points, 0.02)
    expected = sharp.new_tensor([0.02 * math.log(2), 0.0])
    torch.testing.assert_close(sharp - smooth, expected, atol=1e-6, rtol=0)


def test_meshes_are_closed_and_lie_on_the_surface():
    solid = solids.ball((0.1, 0.2, 0.3), 0.5)
    mesh = solids.mesh_of([solid], 0.1)
    sides = mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).sort(dim=-1).values
    assert set(sides.unique(dim=0, return_counts=True)[1].tolist()) == {2}
    assert float(solid.distance(mesh.vertices).abs().max()) < 0.01
    outwards = mesh.vertices[mesh.faces].mean(1) - mesh.vertices.new_tensor(solid.start)
    assert bool(((outwards * mesh.face_normals()).sum(-1) > 0).all())


def test_hinges_turn_their_part_about_the_joint(toy):
    for number, hinge in enumerate(toy.hinges):
        angles = torch.zeros(len(toy.hinges), dtype=torch.float64)
        angles[number] = 0.3
        transforms, index = toy.figure.transforms(toy.rotations(angles)), toy.figure.index(hinge.part)
        relative = torch.linalg.inv(transforms[toy.figure.parents[index]]) @ transforms[index]
        axis = torch.tensor(hinge.axis, dtype=torch.float64)
        on_axis = toy.figure.joints[index] + torch.stack([0 * axis, 0.1 * axis])
        torch.testing.assert_close(on_axis @ relative[:3, :3].mT + relative[:3, 3], on_axis)
        assert math.isclose(float(relative[:3, :3].trace()), 1 + 2 * math.cos(0.3), rel_tol=1e-9)


def test_motion_stays_in_its_limits_takes_steps_and_runs_into_nothing(toy):
    angles = toy.random_motion(12, 0.4, torch.Generator().manual_seed(5))
    lower, upper = (torch.tensor([getattr(hinge, end) for hinge in toy.hinges]) for end in ("lower", "upper"))
    assert bool(((angles >= lower - 1e-9) & (angles <= upper + 1e-9)).all())
    assert 0.2 < float((angles[1:] - angles[:-1]).abs().max()) <= 0.4 + 1e-9
    assert max(toy.overlap(pose) for pose in angles) <= 0.002
    inwards = torch.zeros(len(toy.hinges), dtype=torch.float64)
    assert toy.overlap(inwards) == 0
    # The left arm swung inwards, so that the forearm is inside the body.
    inwards[[hinge.part for hinge in toy.hinges].index("left forearm") - 1] = -0.8
    assert toy.overlap(inwards) > 0.02
