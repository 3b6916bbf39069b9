"""Gradients of a fitted person in the data: those of fitting again, and of moving everything."""

import pytest
import torch

import torchreg as tr
from tests.alignment.made import person_pose
from torchreg.geometry.mesh import sample_surface
from torchreg.geometry.rotation import so3_exp, so3_log

TRUTH = torch.tensor([0.8, -0.9, 0.7])
QUICK = tr.AlignConfig(num_model_points=150, search="never")


@pytest.fixture(scope="module")
def scanned(person):
    """A cloud of all sides of a person with little noise, its pose, and the fit to it with gradients."""
    generator = torch.Generator().manual_seed(0)
    pose = person_pose(person, generator)
    mesh = tr.TriangleMesh(person.vertices(pose, TRUTH), person.surface.faces)
    data = sample_surface(mesh, 700, generator=generator)[0]
    data = (data + 0.001 * torch.randn(data.shape, generator=generator)).requires_grad_()
    return data, pose, tr.align(person, data, pose, fit_shape=True, config=QUICK)


def test_a_fit_has_gradients_where_the_data_have_and_the_same_numbers(person, scanned, tmp_path):
    data, pose, result = scanned
    assert result.pose.requires_grad
    assert result.coefficients.requires_grad
    plain = tr.align(person, data.detach(), pose, fit_shape=True, config=QUICK)
    assert not plain.pose.requires_grad
    torch.testing.assert_close(result.pose.detach(), plain.pose)
    torch.testing.assert_close(result.coefficients.detach(), plain.coefficients)
    with torch.no_grad():
        assert not tr.align(person, data, pose, fit_shape=True, config=QUICK).pose.requires_grad
    result.save(tmp_path / "r.safetensors")
    assert torch.equal(tr.load(tmp_path / "r.safetensors").pose, plain.pose)


def test_moving_all_data_moves_the_base_alone(scanned):
    data, _, result = scanned
    outputs = torch.cat([result.pose, result.coefficients])
    for number in (0, 1, 2, 7, len(result.pose)):
        (gradient,) = torch.autograd.grad(outputs[number], data, retain_graph=True)
        wanted = torch.nn.functional.one_hot(torch.tensor(number), 7)[:3] if number < 3 else torch.zeros(3)
        torch.testing.assert_close(gradient.sum(0), wanted.float(), atol=2e-3, rtol=0)


def test_turning_all_data_turns_the_base(scanned):
    data, _, result = scanned
    axis = torch.tensor([0.2, -0.5, 0.3])
    points = data.detach()
    along = torch.linalg.cross(axis.expand_as(points), points)
    turn = so3_exp(result.pose[3:6].detach().double())
    step = 1e-6
    wanted = (so3_log(so3_exp(step * axis.double()) @ turn) - so3_log(turn)) / step
    for number in range(3):
        (gradient,) = torch.autograd.grad(result.pose[3 + number], data, retain_graph=True)
        assert float((gradient * along).sum()) == pytest.approx(float(wanted[number]), abs=5e-3)


def test_stretching_the_data_changes_a_fit_as_a_fit_to_stretched_data(person, scanned):
    data, pose, result = scanned
    middle = result.pose[:3].detach()
    share = 0.01
    ahead, behind = (
        tr.align(person, middle + (1 + sign * share) * (data.detach() - middle), pose, fit_shape=True, config=QUICK)
        for sign in (1, -1)
    )
    numeric = (ahead.coefficients - behind.coefficients) / (2 * share)
    (gradient,) = torch.autograd.grad(result.coefficients[0], data, retain_graph=True)
    found = float((gradient * (data.detach() - middle)).sum())
    # Stature is 15 % a unit.
    assert found == pytest.approx(1 / 0.15, rel=0.2)
    assert found == pytest.approx(float(numeric[0]), rel=0.1)
