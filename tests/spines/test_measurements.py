"""The table of a spine: lengths, radii and angles of limbs against closed forms."""

import csv
import math

import pytest
import torch

import torchreg as tr
from tests.spines.bodies import line, moved, similarity
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
