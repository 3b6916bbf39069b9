"""A limb of three bones, and turns about points, that the tests of scan registration share."""

import math
from types import SimpleNamespace

import pytest
import torch

import torchreg as tr
from torchreg.geometry.rigid import se3_exp
from torchreg.registration.bones.correspondences import Correspondences
from torchreg.registration.bones.motion_problem import BoneProblem
from torchreg.registration.bones.sparse_grid import SparseGrid

BONES = 3


def draw(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def turned_about(point, vector):
    """Return the motion (4, 4) that turns by a rotation vector about a point."""
    point, vector = (torch.as_tensor(value, dtype=torch.float64) for value in (point, vector))
    motion = se3_exp(torch.cat([torch.zeros_like(vector), vector]))
    motion[:3, 3] = point - motion[:3, :3] @ point
    return motion


def limb(count=400):
    """A bent limb of three bones, with outward normals of a tube."""
    along, around = torch.rand(2, count, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    angle = 2 * math.pi * around
    ring = torch.stack([torch.zeros_like(angle), angle.cos(), 0.7 * angle.sin()], dim=-1)
    points = 0.15 * ring + torch.stack([3 * along, 0.1 * along, 0 * along], dim=-1)
    return points, torch.nn.functional.normalize(ring / torch.tensor([1.0, 1.0, 0.49]), dim=-1)


def model_of(points, blend="linear", resolution=24):
    grid = SparseGrid.from_points(points, resolution, frame="world")
    labels = grid.cell_centers()[:, 0].long().clamp(0, BONES - 1)
    return tr.GridLBS.from_labels(grid, labels, BONES, blend=blend)


def bent(angle=0.6):
    """Motions of the limb: bent at x = 1 and x = 2."""
    motions = [torch.eye(4, dtype=torch.float64)]
    for place in (1.0, 2.0):
        motions.append(motions[-1] @ turned_about([place, 0.05 * place, 0], [0.2 * angle, 0, angle]))
    return se3_exp(torch.tensor([0.1, -0.2, 0.1, 0.2, 0.1, 0], dtype=torch.float64)) @ torch.stack(motions)


def problem_of(points, weights, targets, normals=None, match_weights=None, point_to_point=0.0, **terms):
    """The energy of bones with weights at points, matched with targets."""
    match_weights = torch.ones_like(targets[..., 0]) if match_weights is None else match_weights
    matches = Correspondences(targets, normals, match_weights, point_to_point)
    return BoneProblem.of_weights(points, weights.detach(), matches, **terms)


def noisy_problem(blend="linear", share=0.0, batch=(2,)):
    points, _ = limb(60)
    model = model_of(points, blend, 8)
    with torch.no_grad():
        weights, moments = model.weights_at(points), model.joint_moments()
    normals = torch.nn.functional.normalize(draw(*batch, 60, 3, seed=1), dim=-1)
    problem = problem_of(
        points,
        weights,
        points + 0.1 * draw(*batch, 60, 3, seed=3),
        normals,
        draw(*batch, 60, seed=2).clamp_min(0),
        share,
        moments=moments,
        joint_weight=0.7,
        pair_weights=torch.linspace(0.5, 1.5, len(moments.pairs)).double(),
        anchors=se3_exp(0.3 * draw(BONES, 6, seed=4)),
        anchor_weights=torch.tensor([0.1, 0.0, 0.3], dtype=torch.float64),
        blend=blend,
    )
    return problem, model


@pytest.fixture(scope="session")
def bones():
    """A limb of three bones: how to make it, its model, poses and noisy matches."""
    makers = (draw, turned_about, limb, model_of, bent, problem_of, noisy_problem)
    return SimpleNamespace(COUNT=BONES, **{maker.__name__: maker for maker in makers})
