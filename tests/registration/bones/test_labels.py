"""Labels of cells: parts of a bent bar, the W-step's energy, label costs, lost labels used again where it helps."""

import pytest
import torch

from torchreg.geometry.rigid import rigid_matrix, transform_points
from torchreg.geometry.rotation import so3_exp
from torchreg.metrics import adjusted_rand
from torchreg.registration.bones.correspondences import Correspondences
from torchreg.registration.bones.labels import CellData, LabelCosts, first_labels, relabel
from torchreg.registration.bones.sparse_grid import SparseGrid

COSTS = LabelCosts(smoothness=0.2, label=4.0, truncation=4.0)


@pytest.fixture(scope="module")
def bar():
    """A bar of three parts, its middle one still, bent at both ends; sampled on its sides."""
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(1500, 3, generator=generator, dtype=torch.float64) * torch.tensor([6.0, 0.6, 0.6])
    part = (points[:, 0] > 2).long() + (points[:, 0] > 4).long()
    motions = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    for end, (angle, pivot) in {0: (0.6, 2.0), 2: (-0.8, 4.0)}.items():
        turn, place = so3_exp(torch.tensor([0.0, 0.0, angle]).double()), torch.tensor([pivot, 0.3, 0.3]).double()
        motions[end] = rigid_matrix(turn, place - turn @ place)
    moved = transform_points(motions[part], points[:, None])[:, 0]
    data = CellData(SparseGrid.from_points(points, 40), points, 150)
    return data, moved[None], torch.ones(1, len(points), dtype=torch.float64), part, motions


def test_first_labels_are_the_parts(bar):
    data, moved, weights, part, _ = bar
    labels = first_labels(data, moved, weights, 3, COSTS)
    assert float(adjusted_rand(labels[data.cell], part)) > 0.9
    assert first_labels(data, moved, weights, 1, COSTS).unique().tolist() == [0]
    # More bones than parts: none that saves nothing.
    assert len(first_labels(data, moved, weights, 12, COSTS).unique()) <= 5


def test_regions_that_do_not_touch_share_labels_if_there_are_too_few(bar):
    data, moved, weights, _, _ = bar
    islands = torch.cat([data.points, data.points + 30.0, data.points - 30.0])
    apart = CellData(SparseGrid.from_points(islands, 100), islands, 60)
    labels = first_labels(apart, moved.repeat(1, 3, 1), weights.repeat(1, 3), 2, COSTS)
    assert labels.unique().tolist() == [0, 1]


@pytest.mark.parametrize(("linked", "label"), [(False, 0), (True, 2)])
def test_what_is_cut_off_follows_what_it_hangs_on_where_hardly_anything_is_told(bar, linked, label):
    data, moved, _, _, motions = bar
    cut = (data.points[:, 0] < 4.4) | (data.points[:, 0] > 5.2)
    points = data.points[cut]
    island = points[:, 0] > 5.2
    there = torch.where(island[:, None], transform_points(motions[0], points), moved[0, cut])
    trust = torch.where(island, 1e-6, 1.0).expand(1, -1)
    seen = CellData(SparseGrid.from_points(points, 40), points, 150, linked=linked)
    start = torch.zeros(seen.grid.num_cells, dtype=torch.int64)
    labels, _ = relabel(seen, Correspondences(there[None], None, trust), motions[None], start, COSTS)
    assert labels[seen.cell[island]].unique().tolist() == [label]


def test_the_w_step_finds_borders_and_its_energy_is_as_defined(bar):
    data, moved, weights, part, motions = bar
    pairs = Correspondences(moved, None, weights)
    start = torch.zeros(data.grid.num_cells, dtype=torch.int64)
    labels, energy = relabel(data, pairs, motions[None], start, COSTS)
    assert float(adjusted_rand(labels[data.cell], part)) > 0.95
    own = transform_points(motions[labels[data.cell]], data.points[:, None])[:, 0]
    squares = (own - moved[0]).square().sum(-1).clamp(max=(4 * data.grid.spacing) ** 2) / data.grid.spacing**2
    distance = data.grid.num_cells * squares.mean()
    first, second = data.grid.neighbors().unbind(-1)
    borders = (labels[first] != labels[second]).sum()
    assert energy == pytest.approx(float(distance + 0.2 * borders + 4.0 * 3), rel=1e-6)


def test_seams_cost_what_two_bones_tear_apart_up_to_a_cap(bar):
    data, moved, weights, _, motions = bar
    frames = torch.cat([data.points[None], moved])
    both = torch.stack([torch.eye(4, dtype=torch.float64).expand(3, 4, 4), motions])
    pairs = Correspondences(frames, None, weights.expand(2, -1))
    start = (data.grid.cell_centers()[:, 0] > 3).long()
    spacing, cells = data.grid.spacing, data.grid.neighbors()
    plain, seamed = (LabelCosts(0.2, 4.0, 4.0, seam=seam) for seam in (0.0, 0.3))
    labels, energy = relabel(data, pairs, both, start, seamed)
    centers, seams = data.grid.cell_centers(), 0.0
    for one, other in cells[labels[cells[:, 0]] != labels[cells[:, 1]]].tolist():
        middle = torch.cat([0.5 * (centers[one] + centers[other]), torch.ones(1, dtype=torch.float64)])
        gaps = [(motion[labels[one], :3] - motion[labels[other], :3]) @ middle for motion in both]
        apart = torch.stack(gaps).square().sum(-1).mean().sqrt() / spacing
        seams += 0.3 * min(float(apart), 1.0)
    own = both[:, labels[data.cell], :3, :3] @ data.points[..., None]
    squares = (own[..., 0] + both[:, labels[data.cell], :3, 3] - frames).square().sum(-1)
    distance = data.grid.num_cells * squares.clamp(max=(4 * spacing) ** 2).mean() / spacing**2
    borders = (labels[cells[:, 0]] != labels[cells[:, 1]]).sum()
    expected = float(distance) + 0.2 * float(borders) + 4.0 * len(labels.unique()) + seams
    assert energy == pytest.approx(expected, rel=1e-6)
    assert seams > 0
    assert relabel(data, pairs, both, start, plain)[1] < energy


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
    lower = (points[:, 1] < 0.5).long()
    motions = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    motions[1, 1, 3] = -0.4
    moved = transform_points(motions[lower], points[:, None])[:, 0]
    data = CellData(SparseGrid.from_points(points, 40), points, 60)
    weights = torch.ones(1, len(points), dtype=torch.float64)
    start = torch.zeros(data.grid.num_cells, dtype=torch.int64)
    labels, _ = relabel(
        data, Correspondences(moved[None], None, weights), motions[None], start, LabelCosts(0.02, 4.0, 4.0, seam=0.2)
    )
    assert float(adjusted_rand(labels[data.cell], lower)) > 0.8
    stuck = LabelCosts(0.02, 4.0, 4.0, seam=1000.0)
    assert len(relabel(data, Correspondences(moved[None], None, weights), motions[None], start, stuck)[0].unique()) == 1


def test_labels_that_cost_too_much_are_not_used(bar):
    data, moved, weights, _, motions = bar
    start = torch.zeros(data.grid.num_cells, dtype=torch.int64)
    labels, _ = relabel(data, Correspondences(moved, None, weights), motions[None], start, LabelCosts(0.2, 1e6, 4.0))
    assert len(labels.unique()) == 1


def test_frames_decide_together(bar):
    data, moved, weights, part, motions = bar
    still = data.points[None]
    frames = torch.cat([still, moved])
    labels = first_labels(data, frames, weights.expand(2, -1), 3, COSTS)
    assert float(adjusted_rand(labels[data.cell], part)) > 0.9
    both = torch.stack([torch.eye(4, dtype=torch.float64).expand(3, 4, 4), motions])
    found, _ = relabel(data, Correspondences(frames, None, weights.expand(2, -1)), both, labels, COSTS)
    assert float(adjusted_rand(found[data.cell], part)) > 0.95
