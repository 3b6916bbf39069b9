"""Curves of limbs against circles and polylines of known length and bend, and the table of a spine."""

import csv
import math

import pytest
import torch

import torchreg as tr
from tests.spines.bodies import circle, line, moved, random, similarity
from torchreg.geometry.rotation import so3_exp
from torchreg.spines import curves
from torchreg.spines.measurements import measure_limbs

GRAPH = torch.tensor([[0, 3], [1, 3], [2, 3]])


def fork(angle, size):
    """A stem of length 2 that ends in a junction, and two limbs that start at their tips, at an angle to its line."""
    x, z = size * math.sin(angle), 2 + size * math.cos(angle)
    top = [0.0, 0.0, 2.0]
    return torch.stack([line([0.0, 0, 0], top, 7), line([x, 0.0, z], top, 7), line([-x, 0.0, z], top, 7)])


def measured(*sizes):
    curves = torch.stack([fork(0.4, size) for size in sizes])
    radii = torch.arange(7.0).double().expand(len(sizes), 3, 7)
    return curves, measure_limbs(curves, radii, GRAPH, torch.tensor([0.0, 2.0]))


def test_lengths_radii_and_angles_of_a_fork_also_where_it_moves_and_grows():
    curves, found = measured(1.0, 1.5)
    assert found.pairs.tolist() == [[0, 1], [0, 2], [1, 2]]
    torch.testing.assert_close(found.lengths, torch.tensor([[2.0, 1, 1], [2, 1.5, 1.5]]).double())
    assert bool((found.radii == 3).all())
    wanted = torch.tensor([math.pi - 0.4, math.pi - 0.4, 0.8], dtype=torch.float64)
    torch.testing.assert_close(found.angles, wanted.expand(2, 3))
    again = measure_limbs(moved(curves, similarity(0, 3.0)), torch.ones(2, 3, 7).double(), GRAPH, found.times)
    torch.testing.assert_close(again.lengths, 3 * found.lengths)
    torch.testing.assert_close(again.angles, found.angles)


def test_a_limb_without_length_has_no_angle():
    _, found = measured(0.0, 1.0)
    assert found.angles.isnan().tolist() == [[True, True, True], [False, False, False]]


def test_lengths_and_angles_have_gradients():
    def values(points):
        found = measure_limbs(points, torch.ones(1, 3, 7).double(), GRAPH, torch.zeros(1))
        return found.lengths, found.angles

    assert torch.autograd.gradcheck(values, fork(0.4, 1.0)[None].requires_grad_())


def test_the_table_is_written_with_all_digits(tmp_path):
    _, found = measured(1.0, 1.5)
    found.save_csv(tmp_path / "limbs.csv")
    with (tmp_path / "limbs.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["time"]) for row in rows] == [0.0, 2.0]
    assert [float(row["length_1"]) for row in rows] == found.lengths[:, 1].tolist()
    assert float(rows[0]["angle_1_2_deg"]) == pytest.approx(math.degrees(0.8))
    with pytest.raises(tr.errors.FormatError, match=r"must end in \.csv"):
        found.save_csv(tmp_path / "limbs.txt")


ARC = circle(2.0, 65, (0, 0.5))


def test_a_half_circle_has_its_length_bend_and_directions():
    assert float(curves.curve_lengths(ARC)) == pytest.approx(2 * math.pi, rel=1e-3)
    torch.testing.assert_close(curves.bend_angles(ARC), torch.full((63,), math.pi / 64).double())
    inner = curves.tangents(ARC)[1:-1]
    torch.testing.assert_close((inner * ARC[1:-1]).sum(-1), torch.zeros(63).double(), atol=1e-9, rtol=0)
    torch.testing.assert_close(inner.norm(dim=-1), torch.ones(63).double())


def test_batches_equal_loops_and_similarities_change_what_they_must():
    batch, matrix = random(3, 4, 9, 3), similarity(0, 2.5)
    for function, factor in ((curves.curve_lengths, 2.5), (curves.bend_angles, 1.0)):
        torch.testing.assert_close(function(batch)[1, 2], function(batch[1, 2]))
        torch.testing.assert_close(function(moved(batch, matrix)), factor * function(batch))
    turned = curves.tangents(batch) @ (matrix[:3, :3] / 2.5).mT
    torch.testing.assert_close(curves.tangents(moved(batch, matrix)), turned)


def test_frames_are_rotations_along_the_curve_without_twist():
    curve = torch.cat((ARC, ARC[-1:] + torch.tensor([[0.0, -1.0, 0.5]])))
    frames = curves.curve_frames(curve)
    torch.testing.assert_close(frames @ frames.mT, torch.eye(3).double().expand(66, 3, 3))
    torch.testing.assert_close(torch.linalg.det(frames), torch.ones(66).double())
    torch.testing.assert_close(frames[..., 2], curves.tangents(curve))
    # Around a plane curve the normal of the plane stays where it is in the frame.
    local = frames[:60].mT @ torch.tensor([0.0, 0.0, 1.0]).double()
    torch.testing.assert_close(local, local[:1].expand(60, 3))


def test_aligned_frames_keep_the_axis_of_rotation():
    frames, direction = so3_exp(random(5, 3)), torch.nn.functional.normalize(random(5, 3, seed=3), dim=-1)
    aligned = curves.align_frames(frames, direction)
    torch.testing.assert_close(aligned[..., 2], direction)
    axis = torch.linalg.cross(frames[..., 2], direction).unsqueeze(-1)
    torch.testing.assert_close(aligned.mT @ axis, frames.mT @ axis)


def test_gradients_are_right_and_finite_where_points_fall_together():
    for function in (curves.curve_lengths, curves.bend_angles, curves.tangents, curves.curve_frames):
        assert torch.autograd.gradcheck(function, (random(2, 6, 3).requires_grad_(),))
    torch.testing.assert_close(curves.tangents(torch.zeros(4, 3))[:, 0], torch.ones(4))
    curve = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 0, 0], [1, 0, 0], [1, 1, 0]]).double().requires_grad_()
    (curves.curve_lengths(curve) + curves.bend_angles(curve).sum() + curves.tangents(curve).sum()).backward()
    assert bool(curve.grad.isfinite().all())


def test_points_along_a_curve_lie_at_their_lengths():
    curve = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 0, 0], [1, 2, 0]], dtype=torch.float64)
    found = curves.points_along(curve, torch.tensor([[0.0, 0.5, 1.0], [2.0, 3.0, 9.0]]).double())
    right = torch.tensor([[[0.0, 0, 0], [0.5, 0, 0], [1, 0, 0]], [[1, 1, 0], [1, 2, 0], [1, 2, 0]]]).double()
    torch.testing.assert_close(found, right)
    at_one = curves.points_along(curve[:1], torch.tensor([0.0, 1.0]).double())
    torch.testing.assert_close(at_one, torch.zeros(2, 3).double())


def test_smoothing_keeps_ends_and_straight_lines_and_takes_the_zigzag_out():
    straight = line([0.0, 0, 0], [1.0, 2.0, -1.0], 40)
    torch.testing.assert_close(curves.moving_average(straight, 0.3, 65), line([0.0, 0, 0], [1.0, 2.0, -1.0], 65))
    zigzag = straight + 0.1 * torch.tensor([[0.0, 0, 1], [0, 0, -1]]).double().repeat(20, 1)
    smooth = curves.moving_average(zigzag, 0.3, 65)
    length, before, after = (float(curves.curve_lengths(row)) for row in (straight, zigzag, smooth))
    assert before > 2 * length
    assert after < 1.15 * length
    torch.testing.assert_close(smooth[[0, -1]], zigzag[[0, -1]], rtol=0, atol=1e-12)
    torch.testing.assert_close(curves.moving_average(ARC, 0.05, 65), ARC, rtol=0, atol=0.02)
