"""The table of a spine: lengths, radii and angles of limbs against closed forms."""

import csv
import math

import pytest
import torch

from torchreg.errors import FormatError
from torchreg.spines.measurements import measure_limbs


def fork(angle, grown, dtype=torch.float64):
    """A stem that ends in a junction, and two limbs that start at their tips, at an angle to its line."""
    share = torch.linspace(0, 1, 7, dtype=dtype)[:, None]
    ends = [(0.0, 1.0), (math.sin(angle), math.cos(angle)), (-math.sin(angle), math.cos(angle))]
    directions = torch.tensor([(x, 0.0, z) for x, z in ends], dtype=dtype)
    stem = share * torch.tensor([0.0, 0.0, 2.0], dtype=dtype)
    limbs = [stem[-1] + (1 - share) * grown * direction for direction in directions[1:]]
    return torch.stack([stem, *limbs])


GRAPH = torch.tensor([[0, 3], [1, 3], [2, 3]])


def measured(angle=0.4, sizes=(1.0, 1.5)):
    curves = torch.stack([fork(angle, size) for size in sizes])
    radii = torch.arange(7.0, dtype=torch.float64).expand(2, 3, 7)
    return curves, measure_limbs(curves, radii, GRAPH, torch.tensor([0.0, 2.0]))


def test_lengths_radii_and_angles_of_a_fork():
    _, found = measured()
    assert found.pairs.tolist() == [[0, 1], [0, 2], [1, 2]]
    torch.testing.assert_close(found.lengths, torch.tensor([[2.0, 1, 1], [2, 1.5, 1.5]]).double())
    assert bool((found.radii == 3).all())
    wanted = torch.tensor([math.pi - 0.4, math.pi - 0.4, 0.8], dtype=torch.float64)
    torch.testing.assert_close(found.angles, wanted.expand(2, 3))


def test_motion_changes_nothing_and_scale_only_lengths():
    curves, found = measured()
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64))[0]
    moved = measure_limbs(3 * curves @ turn.mT - 5, torch.ones(2, 3, 7).double(), GRAPH, found.times)
    torch.testing.assert_close(moved.lengths, 3 * found.lengths)
    torch.testing.assert_close(moved.angles, found.angles)


def test_a_limb_without_length_has_no_angle():
    _, found = measured(sizes=(0.0, 1.0))
    assert found.angles.isnan().tolist() == [[True, True, True], [False, False, False]]


def test_lengths_and_angles_have_gradients():
    curves = fork(0.4, 1.0)[None].requires_grad_()

    def values(points):
        found = measure_limbs(points, torch.ones(1, 3, 7).double(), GRAPH, torch.zeros(1))
        return found.lengths, found.angles

    assert torch.autograd.gradcheck(values, curves)


def test_the_table_is_written_with_all_digits(tmp_path):
    _, found = measured()
    found.save_csv(tmp_path / "limbs.csv")
    with (tmp_path / "limbs.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["time"]) for row in rows] == [0.0, 2.0]
    assert [float(row["length_1"]) for row in rows] == found.lengths[:, 1].tolist()
    assert float(rows[0]["angle_1_2_deg"]) == pytest.approx(math.degrees(0.8))
    with pytest.raises(FormatError, match=r"must end in \.csv"):
        found.save_csv(tmp_path / "limbs.txt")
