"""What the tests of several pipelines share."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.geometry.rigid import rigid_matrix, se3_exp
from torchreg.geometry.rotation import so3_exp
from torchreg.geometry.sampling import farthest_points
from torchreg.geometry.sparse_grid import SparseGrid
from torchreg.models.grid_lbs import GridLBS
from torchreg.pipelines.bone_problem import BoneProblem, bind
from torchreg.pipelines.track import Tracker
from torchreg.pipelines.track_config import Frame, TrackConfig
from torchreg.pipelines.track_fit import FrameFitter
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.primitives import Primitive
from torchreg.shapes.skin import sample_skin

BONES = 3


def draw(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


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
    return GridLBS.from_labels(grid, labels, BONES, blend=blend)


def bent(angle=0.6):
    """Motions of the limb: bent at x = 1 and x = 2."""
    motions = [torch.eye(4, dtype=torch.float64)]
    for place in (1.0, 2.0):
        pivot = torch.tensor([place, 0.05 * place, 0], dtype=torch.float64)
        turn = so3_exp(torch.tensor([0.2 * angle, 0, angle], dtype=torch.float64))
        motions.append(motions[-1] @ rigid_matrix(turn, pivot - turn @ pivot))
    return se3_exp(torch.tensor([0.1, -0.2, 0.1, 0.2, 0.1, 0], dtype=torch.float64)) @ torch.stack(motions)


def noisy_problem(blend="linear", share=0.0, batch=(2,)):
    points, _ = limb(60)
    model = model_of(points, blend, 8)
    with torch.no_grad():
        weights = model.weights_at(points)
        moments = model.joint_moments()
    normals = torch.nn.functional.normalize(draw(*batch, 60, 3, seed=1), dim=-1)
    match_weights = draw(*batch, 60, seed=2).clamp_min(0)
    targets = points + 0.1 * draw(*batch, 60, 3, seed=3)
    problem = BoneProblem(
        points,
        bind(weights),
        targets,
        normals,
        match_weights,
        point_to_point=share,
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
    makers = (draw, limb, model_of, bent, noisy_problem)
    return SimpleNamespace(COUNT=BONES, **{maker.__name__: maker for maker in makers})


@pytest.fixture(scope="session")
def arm():
    """A body with an arm on one hinge, in float64, that takes no gradients; not to be changed."""
    eye = torch.eye(4, dtype=torch.float64)
    joints = Joint("base", -1, eye), Joint("arm", 0, eye, "revolute", (0.0, 1.0, 0.0), -2.0, 2.0)
    center = eye.clone()
    center[0, 3] = 0.15
    solids = Primitive("ellipsoid", (0.06, 0.09, 0.05), eye), Primitive("ellipsoid", (0.15, 0.03, 0.04), center)
    tree = KinematicTree(joints)
    shape = ArticulatedShape(tree, ["base", "arm"], solids, nu=0.01, dtype=torch.float64)
    return shape.requires_grad_(False)


@pytest.fixture(scope="session")
def arm_tracking(arm):
    """A pose of the arm, 300 points of its surface there, and how to make a fitter and a state of a tracker of it."""
    pose = torch.tensor([0.3, -0.2, 0.8, 0.4, 0.2, -0.5, 0.7], dtype=torch.float64)
    vertices = arm.surface_mesh(pose, spacing=0.01).vertices
    cloud = vertices[farthest_points(vertices, 300)]
    skin = sample_skin(arm, 200)
    new = Tracker(arm, pose, model_points=skin).state

    def fitter(**options):
        return FrameFitter(arm, TrackConfig(**options), skin)

    def state(**changes):
        tracked = {"frame": 1, "inliers": 300.0, "ratio": 1.0, "residual": 0.001, "total": 300.0, "interval": 1.0}
        motion = {"error": 0.005, "surprise": pose.new_tensor([0.005, 0.04, 0.04])}
        return replace(new, **tracked | motion | changes)

    def frame(points=cloud, gap=1.0):
        return Frame(points, points.isfinite().all(-1), gap)

    return SimpleNamespace(pose=pose, cloud=cloud, skin=skin, fitter=fitter, state=state, frame=frame)


@pytest.fixture(scope="session")
def lower_legs():
    """Return a function of a problem and its pair of a figure: samples (S,) of the left and of the right lower leg."""

    def find(problem, pair):
        names, labels = pair.part_names, pair.labels[problem.samples]
        below = [[names.index(f"{side} {part}") for part in ("shin", "foot")] for side in ("left", "right")]
        return [torch.isin(labels, torch.tensor(parts)) for parts in below]

    return find
