"""Colors of bones and errors: distinct, mixed, on a fixed scale, and in files that read back."""

import math

import pytest
import torch

from torchreg.errors import InputError
from torchreg.io.points import load_points
from torchreg.registration.bones.grid_lbs import GridLBS
from torchreg.registration.bones.sparse_grid import SparseGrid
from torchreg.viz.bone_colors import bone_palette, error_colors, save_error_ply, save_weight_ply, weight_colors


def test_bones_have_distinct_colors():
    colors = bone_palette(40)
    assert colors.shape == (40, 3)
    assert bool(((colors >= 0) & (colors <= 1)).all())
    apart = torch.cdist(colors, colors) + torch.eye(40)
    assert float(apart.min()) > 0.03
    assert float((torch.cdist(colors[:6], colors[:6]) + torch.eye(6)).min()) > 0.2
    assert torch.equal(bone_palette(5), colors[:5])


def test_weights_mix_colors():
    palette = bone_palette(3)
    weights = torch.tensor([[1.0, 0, 0], [0, 2.0, 0], [0.5, 0, 0.5]])
    expected = torch.stack([palette[0], palette[1], (palette[0] + palette[2]) / 2])
    torch.testing.assert_close(weight_colors(weights), expected)
    positive = (weights.double() + 0.1).requires_grad_()
    assert torch.autograd.gradcheck(weight_colors, (positive,))


def test_errors_run_from_blue_to_red():
    errors = torch.tensor([0.0, 0.75, 1.0, 5.0])
    colors = error_colors(errors, 1.0)
    assert bool(colors[0].argmax() == 2)
    assert bool(colors[1].argmax() == 0)
    torch.testing.assert_close(colors[2], colors[3])
    torch.testing.assert_close(error_colors(2 * errors, 2.0), colors)
    inside = torch.tensor([0.1, 0.4, 0.9], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda e: error_colors(e, 1.0), (inside,))


def scan():
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([2.0, 1.0, 0.5])
    grid = SparseGrid.from_points(points, 6)
    labels = (grid.cell_centers()[:, 0] > 1).long()
    motions = torch.eye(4).repeat(2, 1, 1)
    motions[:, 0, 3] = 0.25
    return GridLBS.from_labels(grid, labels, 2, motions), points, torch.tensor([[0, 1, 2], [3, 4, 5]])


def test_weight_colors_are_written(tmp_path):
    model, points, faces = scan()
    for moved in (False, True):
        save_weight_ply(tmp_path / "w.ply", model, points, faces, moved=moved)
        cloud = load_points(tmp_path / "w.ply")
        torch.testing.assert_close(cloud.points, points + torch.tensor([0.25 * moved, 0, 0]))
        assert torch.equal(cloud.faces, faces)
        expected = weight_colors(model.weights_at(points)).detach()
        torch.testing.assert_close(cloud.colors, expected, atol=1 / 255, rtol=0)
    several = GridLBS(model.grid, model.weights, model.transforms.expand(2, 2, 4, 4))
    save_weight_ply(tmp_path / "w.ply", several, points)
    with pytest.raises(InputError, match="the model holds several poses"):
        save_weight_ply(tmp_path / "w.ply", several, points, moved=True)
    with pytest.raises(InputError, match=r"path must end in .ply"):
        save_weight_ply(tmp_path / "w.xyz", model, points)


def test_error_colors_are_written(tmp_path):
    _, points, faces = scan()
    errors = torch.linspace(0, 2, 50)
    errors[3] = math.inf
    save_error_ply(tmp_path / "e.ply", points, errors, faces)
    cloud = load_points(tmp_path / "e.ply")
    assert torch.equal(cloud.points, points)
    torch.testing.assert_close(cloud.colors[3], torch.full((3,), 0.5), atol=1 / 255, rtol=0)
    torch.testing.assert_close(cloud.colors[[0, 49]], error_colors(errors[[0, 49]], 2.0), atol=1 / 255, rtol=0)
    save_error_ply(tmp_path / "e.ply", points, torch.zeros(50), largest=0.1)
    assert load_points(tmp_path / "e.ply").faces is None
    save_error_ply(tmp_path / "e.ply", points, torch.full((50,), math.nan))
    with pytest.raises(InputError, match="errors must have shape"):
        save_error_ply(tmp_path / "e.ply", points, torch.zeros(3))
    with pytest.raises(InputError, match="errors must not be negative"):
        save_error_ply(tmp_path / "e.ply", points, -torch.ones(len(points)))
    with pytest.raises(InputError, match="largest must be zero or positive"):
        save_error_ply(tmp_path / "e.ply", points, torch.ones(len(points)), largest=-1.0)
