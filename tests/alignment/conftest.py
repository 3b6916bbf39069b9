"""A small arm in double precision, its poses, and alignments of it."""

from dataclasses import replace

import pytest
import torch

from torchreg.alignment.objectives import GaussianPosePrior
from torchreg.alignment.problem import AlignProblem, model_size
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.primitives import Primitive
from torchreg.shapes.skin import sample_skin
from torchreg.shapes.surface import FusedSurface


@pytest.fixture(scope="session")
def links():
    """Three flattened links of 10 cm with two hinges, at right angles."""

    def offset(z):
        pose = torch.eye(4, dtype=torch.float64)
        pose[2, 3] = z
        return pose

    tree = KinematicTree((
        Joint("upper", -1, offset(0.0)),
        Joint("elbow", 0, offset(0.1), "revolute", (1.0, 0.0, 0.0), -2.0, 2.0),
        Joint("wrist", 1, offset(0.1), "revolute", (0.0, 1.0, 0.0), -2.0, 2.0),
    ))  # fmt: skip
    solids = [Primitive("ellipsoid", (0.03, 0.015, 0.06), offset(0.05))] * 3
    shape = ArticulatedShape(tree, ["upper", "elbow", "wrist"], solids, nu=0.005, dtype=torch.float64)
    return shape.requires_grad_(False)


@pytest.fixture(scope="session")
def links_skin(links):
    """300 model points of the links."""
    return sample_skin(links, 300)


@pytest.fixture(scope="session")
def make_problem():
    """A function from a skin and data (B, M, 3) to their alignment in the data's own coordinates."""

    def make(skin, data, **options):
        shape = skin.shape
        mean = shape.rest.expand(len(data), -1)
        problem = AlignProblem(
            skin=skin,
            surface=FusedSurface(shape),
            data=data,
            valid=torch.ones(data.shape[:2], dtype=torch.bool),
            origin=torch.zeros_like(data[:, 0]),
            size=model_size(skin),
            lower=shape.lower,
            upper=shape.upper,
            prior=GaussianPosePrior(mean, torch.zeros_like(shape.rest)),
            pose_atol=1e-6,
        )
        return replace(problem, **options)

    return make
