"""Labels of cells: parts of a bent bar, the W-step's energy, label costs, lost labels used again where it helps."""

import pytest
import torch

import torchreg as tr
from tests.geometry.draws import rand, randn
from torchreg.geometry.rigid import transform_points
from torchreg.registration.bones.correspondences import Correspondences
from torchreg.registration.bones.labels import CellData, LabelCosts, first_labels, relabel
from torchreg.registration.bones.sparse_grid import SparseGrid

COSTS = LabelCosts(smoothness=0.2, label=4.0, truncation=4.0)


def rest(count):
    return torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)


@pytest.fixture(scope="module")
def bar(bones):
    """A bar of three parts, its middle one still, bent at both ends; sampled on its sides."""
    points = rand(1500, 3) * torch.tensor([6.0, 0.6, 0.6])
    part = (points[:, 0] > 2).long() + (points[:, 0] > 4).long()
    ends = bones.turned_about([2.0, 0.3, 0.3], [0, 0, 0.6]), bones.turned_about([4.0, 0.3, 0.3], [0, 0, -0.8])
    motions = torch.stack([ends[0], rest(1)[0], ends[1]])
    moved = transform_points(motions[part], points[:, None])[:, 0]
    data = CellData(SparseGrid.from_points(points, 40), points, 150)
    return data, moved[None], torch.ones(1, len(points), dtype=torch.float64), part, motions


def test_first_labels_are_the_parts(bar):
    data, moved, weights, part, _ = bar
    frames = torch.cat([data.points[None], moved])
    for targets in (moved, frames):
        labels = first_labels(data, targets, weights.expand(len(targets), -1), 3, COSTS)
        assert float(tr.metrics.adjusted_rand(labels[data.cell], part)) > 0.9
    assert first_labels(data, moved, weights, 1, COSTS).unique().tolist() == [0]
    # More bones than parts: none that saves nothing.
    assert len(first_labels(data, moved, weights, 12, COSTS).unique()) <= 5
    # Regions that do not touch share labels if there are too few.
    islands = torch.cat([data.points, data.points + 30.0, data.points - 30.0])
    apart = CellData(SparseGrid.from_points(islands, 100), islands, 60)
    labels = first_labels(apart, moved.repeat(1, 3, 1), weights.repeat(1, 3), 2, COSTS)
    assert labels.unique().tolist() == [0, 1]


@pytest.mark.parametrize(("linked", "label"), [(False, 0), (True, 2)])
def test_islands_that_hardly_anything_matches_follow_what_they_hang_on(bar, linked, label):
    data, moved, _, _, motions = bar
    kept = (data.points[:, 0] < 4.4) | (data.points[:, 0] > 5.2)
    points = data.points[kept]
    island = points[:, 0] > 5.2
    targets = torch.where(island[:, None], transform_points(motions[0], points), moved[0, kept])
    matches = Correspondences(targets[None], None, torch.where(island, 1e-6, 1.0).expand(1, -1))
    apart = CellData(SparseGrid.from_points(points, 40), points, 150, linked=linked)
    labels, _ = relabel(apart, matches, motions[None], start(apart), COSTS)
    assert labels[apart.cell[island]].unique().tolist() == [label]


def start(data):
    return torch.zeros(data.grid.num_cells, dtype=torch.int64)


@pytest.mark.parametrize("seam", [0.0, 0.3])
def test_the_w_step_finds_borders_and_its_energy_is_as_defined(bar, seam):
    data, moved, weights, part, motions = bar
    frames, poses = torch.cat([data.points[None], moved]), torch.stack([rest(3), motions])
    alone, _ = relabel(data, Correspondences(moved, None, weights), motions[None], start(data), COSTS)
    assert float(tr.metrics.adjusted_rand(alone[data.cell], part)) > 0.95
    matches = Correspondences(frames, None, weights.expand(2, -1))
    labels, energy = relabel(data, matches, poses, start(data), LabelCosts(0.2, 4.0, 4.0, seam=seam))
    spacing, cells, centers = data.grid.spacing, data.grid.neighbors(), data.grid.cell_centers()
    images = transform_points(poses[:, labels[data.cell]], data.points[:, None])[:, :, 0]
    squares = (images - frames).square().sum(-1)
    expected = float(data.grid.num_cells * squares.clamp(max=(4 * spacing) ** 2).mean() / spacing**2)
    expected += 4.0 * len(labels.unique())
    for first, second in cells[labels[cells[:, 0]] != labels[cells[:, 1]]].tolist():
        # What the two bones tear apart, in cells, up to one.
        middle = torch.cat([0.5 * (centers[first] + centers[second]), torch.ones(1, dtype=torch.float64)])
        gaps = (poses[:, labels[first], :3] - poses[:, labels[second], :3]) @ middle
        expected += 0.2 + seam * min(float(gaps.square().sum(-1).mean().sqrt() / spacing), 1.0)
    assert energy == pytest.approx(expected, rel=1e-6)


def test_seams_draw_borders_to_the_joints(bar):
    data, moved, weights, part, motions = bar
    wrong = {0.0: 0.0, 0.5: 0.0}
    for seed in range(3):
        pairs = Correspondences(moved + 0.1 * randn(*moved.shape, seed=seed), None, weights)
        for seam in wrong:
            labels, _ = relabel(data, pairs, motions[None], start(data), LabelCosts(0.02, 4.0, 4.0, seam=seam))
            wrong[seam] += float((labels[data.cell] != part).double().mean())
    assert wrong[0.5] < 0.75 * wrong[0.0]


def test_what_merely_touches_can_part():
    points = rand(3000, 3) * torch.tensor([6.0, 1.0, 0.3])
    lower, motions = (points[:, 1] < 0.5).long(), rest(2)
    motions[1, 1, 3] = -0.4
    moved = transform_points(motions[lower], points[:, None])[:, 0]
    data = CellData(SparseGrid.from_points(points, 40), points, 60)
    matches = Correspondences(moved[None], None, torch.ones(1, len(points), dtype=torch.float64))
    labels, _ = relabel(data, matches, motions[None], start(data), LabelCosts(0.02, 4.0, 4.0, seam=0.2))
    assert float(tr.metrics.adjusted_rand(labels[data.cell], lower)) > 0.8
    # Labels and borders that cost too much are not used.
    for costs in (LabelCosts(0.02, 4.0, 4.0, seam=1000.0), LabelCosts(0.2, 1e6, 4.0)):
        assert len(relabel(data, matches, motions[None], start(data), costs)[0].unique()) == 1
