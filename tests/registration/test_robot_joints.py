"""Joints between two links, decided by how well one-parameter motions explain what was seen."""

import math

import pytest
import torch

from torchreg.geometry.rigid import se3_exp, transform_points
from torchreg.registration.robots.joints import best_joint, relative
from torchreg.registration.robots.surfaces import Blocks, Noise

SIGMA, SAMPLES, FRAMES = 1e-3, 200, 9
AXIS = torch.tensor([0.48, 0.6, 0.64], dtype=torch.float64)
POINT = torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64)


def seen(kind, generator, held=slice(None)):
    """Return the best joint between two links of random surfaces, given the errors of fits to noise.

    Args:
        kind: of the joint, or "free".
        generator: of all that is random.
        held: coordinates in which the second link's surface has normals: round things hold fewer directions.
    """
    draw = {"generator": generator, "dtype": torch.float64}
    values = 0.4 * torch.randn(FRAMES, **draw)
    twist = {
        "fixed": torch.zeros(6).double(), "revolute": torch.cat([torch.linalg.cross(POINT, AXIS), AXIS]),
        "prismatic": torch.cat([AXIS, torch.zeros(3).double()]),
    }  # fmt: skip
    moved = se3_exp(0.3 * torch.randn(FRAMES, 6, **draw))
    joint = se3_exp(0.3 * torch.randn(FRAMES, 6, **draw) if kind == "free" else values.unsqueeze(-1) * twist[kind])
    motions = torch.stack([moved, moved @ joint], 1)
    rows, centers = [], []
    for link in range(2):
        points = transform_points(motions[:, link], 0.2 * torch.randn(SAMPLES, 3, **draw) + link * 0.3)
        normals = torch.nn.functional.normalize(torch.randn(SAMPLES, 3, **draw), dim=-1)
        centers.append(points.mean(1))
        arms = points - centers[-1].unsqueeze(1)
        jacobian = torch.cat([normals.expand_as(arms), torch.linalg.cross(arms, normals.expand_as(arms))], -1)
        if link:
            jacobian = jacobian * torch.isin(torch.arange(6), torch.arange(6)[held])
        rows.append(jacobian.mT @ jacobian)
    hessian = torch.stack(rows, 1)
    # Errors of the motions as fits have them.
    spread = torch.linalg.cholesky(torch.linalg.inv(hessian + 1e-9 * torch.eye(6).double()) * SIGMA**2)
    error = (spread @ torch.randn(FRAMES, 2, 6, 1, **draw)).squeeze(-1)
    error = error * (hessian.diagonal(dim1=-2, dim2=-1) > 0)
    centers = torch.stack(centers, 1)
    shift = torch.eye(4).double().repeat(FRAMES, 2, 1, 1)
    shift[..., :3, 3] = centers
    motions = shift @ se3_exp(error) @ torch.linalg.inv(shift) @ motions
    count = torch.full((FRAMES, 2), float(SAMPLES), dtype=torch.float64)
    blocks = Blocks(hessian, torch.zeros(FRAMES, 2, 6).double(), centers, count)
    return best_joint(relative(motions, blocks, (0, 1), Noise(SIGMA, 1.0), 1.0)), values


@pytest.mark.parametrize("kind", ["fixed", "revolute", "prismatic", "free"])
def test_the_kind_of_a_joint_is_found_with_its_axis_and_values(kind):
    for seed in range(2):
        joint, values = seen(kind, torch.Generator().manual_seed(seed))
        if kind == "free":
            assert joint.length > 0
            continue
        assert joint.kind == kind
        assert joint.length < 0
        if kind == "fixed":
            continue
        direction = joint.twist[3:] if kind == "revolute" else joint.twist[:3]
        cosine = float(direction @ AXIS)
        assert abs(cosine) > math.cos(math.radians(0.5))
        torch.testing.assert_close(math.copysign(1, cosine) * joint.values, values, atol=3e-3, rtol=0)
        if kind == "revolute":
            point = torch.linalg.cross(joint.twist[3:], joint.twist[:3])
            assert float(torch.linalg.cross(point - POINT, AXIS).norm()) < 1e-3


def test_what_the_data_do_not_hold_is_no_reason_for_a_joint():
    """A round link that holds no rotation, as a ball does, is welded, however it was turned."""
    joint, _ = seen("fixed", torch.Generator().manual_seed(0), held=slice(0, 3))
    assert joint.kind == "fixed"
