"""Joints between two links, decided by how well one-parameter motions explain what was seen."""

import math

import pytest
import torch

from tests.geometry.draws import D, seeded
from torchreg.geometry.rigid import rigid_matrix, se3_exp, transform_points
from torchreg.registration.robots.joints import best_joint, relative
from torchreg.registration.robots.surfaces import Blocks, Noise

SIGMA, SAMPLES, FRAMES = 1e-3, 200, 9
AXIS = torch.tensor([0.48, 0.6, 0.64], dtype=torch.float64)
POINT = torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64)
# Of a second hinge, beyond a link that nothing shows.
SECOND_AXIS = torch.nn.functional.normalize(torch.tensor([0.8, -0.6, 0.4], dtype=torch.float64), dim=0)
SECOND = torch.cat([torch.linalg.cross(POINT + torch.tensor([0.02, 0.03, 0.0]).double(), SECOND_AXIS), SECOND_AXIS])


def found(kind, seed, directions=6, wrong=0):
    """The best joint between two links of random surfaces, given the errors of fits to noise, and its values.

    ``directions`` of the second link's coordinates have normals: round things determine fewer. In the first frames,
    ``wrong`` of them, the second link is somewhere else.
    """
    draw = {"generator": seeded(seed), "dtype": D}
    values, others = 0.4 * torch.randn(2, FRAMES, **draw)
    none = torch.zeros(3, dtype=D)
    twist = {"fixed": (none, none), "revolute": (torch.linalg.cross(POINT, AXIS), AXIS), "prismatic": (AXIS, none)}
    moved, joint = se3_exp(0.3 * torch.randn(2, FRAMES, 6, **draw))
    if kind == "universal":
        joint = se3_exp(values.unsqueeze(-1) * torch.cat(twist["revolute"])) @ se3_exp(others.unsqueeze(-1) * SECOND)
    elif kind != "free":
        joint = se3_exp(values.unsqueeze(-1) * torch.cat(twist[kind]))
    joint[:wrong] = joint[:wrong] @ se3_exp(0.5 * torch.randn(wrong, 6, **draw))
    motions, rows, centers = torch.stack([moved, moved @ joint], 1), [], []
    for link, held in enumerate((6, directions)):
        points = transform_points(motions[:, link], 0.2 * torch.randn(SAMPLES, 3, **draw) + link * 0.3)
        normals = torch.nn.functional.normalize(torch.randn(SAMPLES, 3, **draw), dim=-1).expand_as(points)
        centers.append(points.mean(1))
        arms = torch.linalg.cross(points - centers[-1].unsqueeze(1), normals)
        jacobian = torch.cat([normals, arms], -1) * (torch.arange(6) < held)
        rows.append(jacobian.mT @ jacobian)
    hessian, centers = torch.stack(rows, 1), torch.stack(centers, 1)
    # Errors of the motions as fits have them.
    spread = torch.linalg.cholesky(torch.linalg.inv(hessian + 1e-9 * torch.eye(6).double()) * SIGMA**2)
    error = (spread @ torch.randn(FRAMES, 2, 6, 1, **draw)).squeeze(-1) * (hessian.diagonal(dim1=-2, dim2=-1) > 0)
    shift = rigid_matrix(torch.eye(3, dtype=D).expand(FRAMES, 2, 3, 3), centers)
    motions = shift @ se3_exp(error) @ torch.linalg.inv(shift) @ motions
    count = torch.full((FRAMES, 2), float(SAMPLES), dtype=D)
    blocks = Blocks(hessian, torch.zeros(FRAMES, 2, 6).double(), centers, count)
    return best_joint(relative(motions, blocks, (0, 1), Noise(SIGMA, 1.0), 1.0)), values


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("kind", ["fixed", "revolute", "prismatic", "universal", "free"])
def test_the_kind_of_a_joint_is_found_with_its_axis_and_values(kind, seed):
    joint, values = found(kind, seed)
    assert (joint.length > 0) == (kind == "free")
    assert kind in ("free", joint.kind)
    if kind in ("revolute", "prismatic"):
        cosine = float((joint.twists[0, 3:] if kind == "revolute" else joint.twists[0, :3]) @ AXIS)
        assert abs(cosine) > math.cos(math.radians(0.5))
        torch.testing.assert_close(math.copysign(1, cosine) * joint.values[:, 0], values, atol=3e-3, rtol=0)
    if kind == "universal":
        for twist, true in zip(joint.twists, (torch.cat([torch.linalg.cross(POINT, AXIS), AXIS]), SECOND), strict=True):
            assert abs(float(twist[3:] @ true[3:])) > math.cos(math.radians(1))
            point, place = (torch.linalg.cross(values[3:], values[:3]) for values in (twist, true))
            assert float(torch.linalg.cross(point - place, true[3:]).norm()) < 3e-3
    if kind == "revolute":
        point = torch.linalg.cross(joint.twists[0, 3:], joint.twists[0, :3])
        assert float(torch.linalg.cross(point - POINT, AXIS).norm()) < 1e-3


@pytest.mark.parametrize("seed", range(3))
def test_a_hinge_is_found_though_a_third_of_the_frames_is_wrong(seed):
    joint, values = found("revolute", seed, wrong=3)
    assert (joint.kind, joint.length < 0) == ("revolute", True)
    cosine = float(joint.twists[0, 3:] @ AXIS)
    assert abs(cosine) > math.cos(math.radians(0.5))
    torch.testing.assert_close(math.copysign(1, cosine) * joint.values[3:, 0], values[3:], atol=3e-3, rtol=0)


def test_what_the_data_do_not_hold_is_no_reason_for_a_joint():
    # A round link that holds no rotation, as a ball does, is welded, however it was turned.
    assert found("fixed", 0, directions=3)[0].kind == "fixed"
