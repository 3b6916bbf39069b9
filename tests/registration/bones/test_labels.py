"""Labels of cells: parts of a bent bar, the W-step's energy, label costs, lost labels used again where it helps."""

import pytest
import torch

import torchreg as tr
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
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(1500, 3, generator=generator, dtype=torch.float64) * torch.tensor([6.0, 0.6, 0.6])
    part = (points[:, 0] > 2).long() + (points[:, 0] > 4).long()
    motions = rest(3)
    motions[0] = bones.turned_about([2.0, 0.3, 0.3], [0, 0, 0.6])
    motions[2] = bones.turned_about([4.0, 0.3, 0.3], [0, 0, -0.8])
    moved = transform_points(motions[part], points[:, None])[:, 0]
    data = CellData(SparseGrid.from_points(points, 40), points, 150)
    return data, moved[None], torch.ones(1, len(points), dtype=torch.float64), part, motions


def test_first_labels_are_the_parts(bar):
    data, moved, weights, part, _ = bar
    labels = first_labels(data, moved, weights, 3, COSTS)
    assert float(tr.metrics.adjusted_rand(labels[data.cell], part)) > 0.9
    assert first_labels(data, moved, weights, 1, COSTS).unique().tolist() == [0]
    # More bones than parts: none that saves nothing.
    assert len(first_labels(data, moved, weights, 12, COSTS).unique()) <= 5
    frames = torch.cat([data.points[None], moved])
    both = first_labels(data, frames, weights.expand(2, -1), 3, COSTS)
    assert float(tr.metrics.adjusted_rand(both[data.cell], part)) > 0.9


def test_regions_that_do_not_touch_share_labels_if_there_are_too_few(bar):
    data, moved, weights, _, _ = bar
    islands = torch.cat([data.points, data.points + 30.0, data.points - 30.0])
    apart = CellData(SparseGrid.from_points(islands, 100), islands, 60)
    labels = first_labels(apart, moved.repeat(1, 3, 1), weights.repeat(1, 3), 2, COSTS)
    assert labels.unique().tolist() == [0, 1]


@pytest.mark.parametrize(("linked", "label"), [(False, 0), (True, 2)])
def test_islands_that_hardly_anything_matches_follow_what_they_hang_on(bar, linked, label):
    data, moved, _, _, motions = bar
    cut = (data.points[:, 0] < 4.4) | (data.points[:, 0] > 5.2)
    points = data.points[cut]
    island = points[:, 0] > 5.2
    places = torch.where(island[:, None], transform_points(motions[0], points), moved[0, cut])
    trust = torch.where(island, 1e-6, 1.0).expand(1, -1)
    apart = CellData(SparseGrid.from_points(points, 40), points, 150, linked=linked)
    start = torch.zeros(apart.grid.num_cells, dtype=torch.int64)
    labels, _ = relabel(apart, Correspondences(places[None], None, trust), motions[None], start, COSTS)
    assert labels[apart.cell[island]].unique().tolist() == [label]


@pytest.mark.parametrize("seam", [0.0, 0.3])
def test_the_w_step_finds_borders_and_its_energy_is_as_defined(bar, seam):
    data, moved, weights, part, motions = bar
    frames, poses = torch.cat([data.points[None], moved]), torch.stack([rest(3), motions])
    start = torch.zeros(data.grid.num_cells, dtype=torch.int64)
    alone, _ = relabel(data, Correspondences(moved, None, weights), motions[None], start, COSTS)
    assert float(tr.metrics.adjusted_rand(alone[data.cell], part)) > 0.95
    matches = Correspondences(frames, None, weights.expand(2, -1))
    labels, energy = relabel(data, matches, poses, start, LabelCosts(0.2, 4.0, 4.0, seam=seam))
    spacing, cells, centers = data.grid.spacing, data.grid.neighbors(), data.grid.cell_centers()
    own = poses[:, labels[data.cell]]
    images = (own[..., :3, :3] @ data.points[..., None])[..., 0] + own[..., :3, 3]
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
    generator = torch.Generator().manual_seed(1)
    start = torch.zeros(data.grid.num_cells, dtype=torch.int64)
    wrong = {0.0: 0.0, 0.5: 0.0}
    for _ in range(3):
        pairs = Correspondences(
            moved + 0.1 * torch.randn(moved.shape, generator=generator, dtype=torch.float64), None, weights
        )
        for seam in wrong:
            labels, _ = relabel(data, pairs, motions[None], start, LabelCosts(0.02, 4.0, 4.0, seam=seam))
            wrong[seam] += float((labels[data.cell] != part).double().mean())
    assert wrong[0.5] < 0.75 * wrong[0.0]


def test_what_merely_touches_can_part():
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(3000, 3, generator=generator, dtype=torch.float64) * torch.tensor([6.0, 1.0, 0.3])
    lower, motions = (points[:, 1] < 0.5).long(), rest(2)
    motions[1, 1, 3] = -0.4
    moved = transform_points(motions[lower], points[:, None])[:, 0]
    data = CellData(SparseGrid.from_points(points, 40), points, 60)
    matches = Correspondences(moved[None], None, torch.ones(1, len(points), dtype=torch.float64))
    start = torch.zeros(data.grid.num_cells, dtype=torch.int64)
    labels, _ = relabel(data, matches, motions[None], start, LabelCosts(0.02, 4.0, 4.0, seam=0.2))
    assert float(tr.metrics.adjusted_rand(labels[data.cell], lower)) > 0.8
    # Labels and borders that cost too much are not used.
    for costs in (LabelCosts(0.02, 4.0, 4.0, seam=1000.0), LabelCosts(0.2, 1e6, 4.0)):
        assert len(relabel(data, matches, motions[None], start, costs)[0].unique()) == 1
