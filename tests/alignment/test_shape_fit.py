"""Fitting pose and shape together: made-up people with a head, arms and legs whose coefficients are known."""

import math
from dataclasses import replace

import pytest
import torch

import torchreg as tr
from tests.alignment.made import person_cloud, person_pose
from torchreg.alignment.shape.person_search import limb_restarts
from torchreg.alignment.shape.shape_fit import shape_problem
from torchreg.geometry.facing_normals import facing_normals
from torchreg.geometry.mesh import sample_surface
from torchreg.geometry.rotation import compose_rotation_vectors, so3_exp, so3_log
from torchreg.solvers.e_step import expectation
from torchreg.solvers.oriented_e_step import oriented_expectation

QUICK = tr.AlignConfig(num_model_points=150, search="never")


def scan(shape, coefficients, seed, *, one_sided=True, count=700):
    """A pose of a person and its cloud, with 2 mm noise and 5 % outliers."""
    generator = torch.Generator().manual_seed(seed)
    pose = person_pose(shape, generator)
    return pose, person_cloud(shape, pose, coefficients, generator, count, one_sided=one_sided)


def start_near(shape, pose):
    start = shape.rest_pose()
    start[:3] = pose[:3] + torch.tensor([0.06, -0.05, 0.06])
    return start


def beside(shape, result, wanted):
    """Return the mean distance of the vertices found from the nearest of the true ones."""
    return float(torch.cdist(shape.vertices(result.pose, result.coefficients), wanted).amin(-1).mean())


def test_one_side_of_a_person_tells_pose_and_shape(person, tmp_path):
    coefficients = torch.tensor([0.8, -0.9, 0.7])
    pose, data = scan(person, coefficients, seed=0)
    steps = []
    result = tr.align(person, data, start_near(person, pose), fit_shape=True, config=QUICK, on_step=steps.append)
    error = (person.vertices(result.pose, result.coefficients) - person.vertices(pose, coefficients)).norm(dim=-1)
    assert float(error.mean()) < 0.01
    deviation = result.coefficient_covariance.diagonal().sqrt()
    assert bool(((result.coefficients - coefficients).abs() < 4 * deviation + 0.02).all())
    assert result.covariance.shape == (person.num_dofs, person.num_dofs)
    assert result.status is tr.Status.CONVERGED
    assert float(result.confidence) > 0.8
    mean = torch.zeros(3)
    alone = tr.align(person.with_coefficients(mean), data, start_near(person, pose), config=QUICK)
    off = (person.vertices(alone.pose, mean) - person.vertices(pose, coefficients)).norm(dim=-1)
    assert float(off.mean()) > 3 * float(error.mean())
    assert {step.stage for step in steps} == {"em", "surface"}
    assert all(step.pose.shape[-1] == person.num_dofs for step in steps)
    result.save(tmp_path / "r.safetensors")
    assert torch.equal(tr.load(tmp_path / "r.safetensors").coefficients, result.coefficients)


@pytest.mark.parametrize("started", [True, False])
def test_scans_of_one_person_share_its_coefficients(person, started):
    """From one side with starts; from all sides they are searched, and it looks the same from the back."""
    coefficients, config = torch.tensor([-0.7, 0.8, 0.5]), tr.CalibrateConfig(align=QUICK)
    poses, clouds = zip(
        *(scan(person, coefficients, seed, count=500, one_sided=started) for seed in (1, 2)), strict=True
    )
    starts = torch.stack([start_near(person, pose) for pose in poses]) if started else None
    found = tr.calibrate(person, list(clouds), starts, config=config)
    assert (found.status.usable, found.outliers) == (True, ())
    assert found.poses.shape == (2, person.num_dofs)
    assert float((found.coefficients - coefficients).abs().max()) < 0.12
    posed, wanted = person.vertices(found.poses, found.coefficients), person.vertices(torch.stack(poses), coefficients)
    assert float(torch.cdist(posed, wanted).amin(-1).mean()) < 0.02
    assert not started or float((posed - wanted).norm(dim=-1).mean()) < 0.01
    rest = person.rest_pose()
    torch.testing.assert_close(found.shape(rest).points, person.vertices(rest, found.coefficients))


def test_bones_of_a_rig_take_the_lengths_of_another(person):
    plain = person.with_coefficients(torch.zeros(3))
    coefficients = torch.tensor([0.9, 0.6, 0.8])
    pose, data = scan(person, coefficients, seed=4, one_sided=False, count=1200)
    result = tr.align(plain, data, start_near(person, pose), fit_shape="bones", config=QUICK)
    rig = plain.with_bone_coefficients()
    assert rig.coefficient_names[:2] == ("size", "girth")
    # Arms are round: how they are twisted, no surface tells.
    assert beside(rig, result, person.vertices(pose, coefficients)) < 0.025
    fitted, true = (one.keypoints(one.rest_pose()) for one in (
        rig.with_coefficients(result.coefficients), person.with_coefficients(coefficients)
    ))  # fmt: skip
    lengths = [(keypoints[1:] - keypoints[0]).norm(dim=-1) for keypoints in (fitted, true)]
    assert float((lengths[0] / lengths[1] - 1).abs().max()) < 0.06


def test_by_how_much_parts_differ_from_the_whole_is_learned(person):
    rig = person.with_coefficients(torch.zeros(3)).with_bone_coefficients()
    pose = scan(person, torch.zeros(3), seed=4)[0]
    whole = torch.zeros(len(rig.coefficient_names))
    whole[:2] = torch.tensor([0.15, 0.1])
    uneven = whole.clone()
    uneven[2 : 2 + rig.num_parts] = torch.tensor([0.1, -0.1, 0.1, -0.1])
    deviations, lengths = [], []
    for truth in (whole, uneven):
        mesh = tr.TriangleMesh(rig.vertices(pose, truth), rig.surface.faces)
        data = sample_surface(mesh, 1200, generator=torch.Generator().manual_seed(1))[0]
        found = tr.align(rig, data, start_near(person, pose), fit_shape=True, config=QUICK)
        parts = slice(2, 2 + rig.num_parts)
        lengths.append((found.coefficients - truth)[parts].abs().mean())
        deviations.append(found.coefficient_covariance.diagonal()[parts].sqrt().mean())
    assert float(lengths[0]) < 0.02
    assert float(lengths[1]) < 0.04
    # The less parts differ, the surer those are that the data hardly tell.
    assert float(deviations[0]) < 0.6 * float(deviations[1])


def test_without_normals_the_oriented_e_step_is_the_plain_one():
    generator = torch.Generator().manual_seed(0)
    model, data = torch.rand(2, 30, 3, generator=generator), torch.rand(2, 50, 3, generator=generator)
    sigma, mask = torch.tensor([0.1, 0.2]), torch.rand(2, 50, generator=generator) > 0.2
    normals = torch.nn.functional.normalize(model - 0.5, dim=-1)
    found = oriented_expectation(
        torch.cat([model, normals], -1), torch.cat([data, torch.zeros_like(data)], -1), sigma, 3.0, mask=mask
    )
    wanted = expectation(model, data, sigma, 3.0, mask=mask)
    for name in ("weights", "targets", "inlier_posterior", "squared_error"):
        torch.testing.assert_close(getattr(found, name), getattr(wanted, name), rtol=1e-4, atol=1e-4)


def test_a_datum_goes_to_the_point_that_faces_as_it_does():
    model = torch.tensor([[[0.0, 0, 0, 0, 0, 1], [0.0, 0, 0.02, 0, 0, -1]]])
    data = torch.tensor([[[0.0, 0, 0.01, 0, 0, 1]]])
    weights = oriented_expectation(model, data, torch.tensor([0.1]), 1.0).weights[0]
    assert float(weights[0]) > 100 * float(weights[1])


@pytest.mark.parametrize("told", [False, True])
def test_normals_of_one_side_face_the_camera(person, told):
    _, data = scan(person, torch.zeros(3), seed=5, count=1500)
    camera = torch.tensor([0.0, -3.0, 1.0], dtype=torch.float64)
    turn = so3_exp(torch.tensor([0.3, 0.8, 2.0]))
    normals = facing_normals(data @ turn.mT, (turn.double() @ camera) if told else None) @ turn.double()
    facing = (normals[:1500] * (camera - data[:1500])).sum(-1) > 0
    assert float(facing.double().mean()) > 0.97


def test_noise_has_no_normals():
    assert bool((facing_normals(torch.rand(500, 3, generator=torch.Generator().manual_seed(0))) == 0).all())


def test_a_person_is_found_without_a_start(person):
    coefficients = torch.tensor([0.9, -0.8, 0.4])
    pose, data = scan(person, coefficients, seed=3, count=600)
    pose[3:6], moved = torch.tensor([0.4, 1.9, -0.7]), so3_exp(pose[3:6])
    turn = so3_exp(pose[3:6]) @ moved.mT
    data = (data - pose[:3]) @ turn.mT + pose[:3]
    result = tr.align(person, data, fit_shape=True, config=QUICK)
    assert beside(person, result, person.vertices(pose, coefficients)) < 0.02
    assert float(result.evidence[-1]) < 1, "no rival was compared"


@pytest.mark.parametrize("seed", [0, 3])
def test_a_person_found_leaning_is_set_upright(person, seed, monkeypatch):
    coefficients = torch.tensor([0.9, -0.8, 0.4])
    pose, data = scan(person, coefficients, seed, count=600)

    def leaning(problem, rig, people, count, generator, upright):
        """The mean person at rest who leans by 50 degrees to the side, as the camera sees it."""
        state = torch.cat([person.rest_pose(), torch.zeros(3)]).unsqueeze(0)
        state[0, 3:6] = compose_rotation_vectors(torch.tensor([0.0, math.radians(50), 0.0]), pose[3:6])
        state[:, :3] += problem.data[0].mean(0) - problem.skin(state)[0].mean(0)
        return state

    monkeypatch.setattr("torchreg.alignment.shape.shape_fit.find_people", leaning)
    result = tr.align(person, data, fit_shape=True, config=QUICK)
    off = (person.vertices(result.pose, result.coefficients) - person.vertices(pose, coefficients)).norm(dim=-1)
    assert float(off.mean()) < 0.02


def test_a_person_who_stands_is_sought_standing(person):
    coefficients = torch.tensor([0.9, -0.8, 0.4])
    pose, data = scan(person, coefficients, seed=3, count=600)
    # Upright in the data is x, and the person is turned about it.
    turn = so3_exp(torch.tensor([2.2, 0.0, 0.0])) @ so3_exp(torch.tensor([0.0, math.pi / 2, 0.0]))
    pose[3:6], pose[:3] = so3_log((turn @ so3_exp(pose[3:6])).unsqueeze(0))[0], turn @ pose[:3]
    data = data @ turn.mT
    result = tr.align(person, data, fit_shape=True, config=replace(QUICK, upright=(2, 0, 0)))
    assert beside(person, result, person.vertices(pose, coefficients)) < 0.02
    upside_down = tr.align(person, data, fit_shape=True, config=replace(QUICK, upright=(-1, 0, 0)))
    assert float(upside_down.confidence) < float(result.confidence)


def test_a_limb_on_the_data_of_another_is_swung_onto_its_own(person):
    coefficients = torch.zeros(3)
    pose, data = scan(person, coefficients, seed=3, one_sided=False, count=800)
    names = list(person.dof_names)
    arm = [names.index(f"{person.part_names[2]}_{axis}") for axis in "xyz"]
    problem, state = shape_problem(
        person, data[None], torch.ones(1, len(data), dtype=torch.bool), pose[None], None, config=QUICK,
        generator=torch.Generator().manual_seed(0),
    )  # fmt: skip
    problem, right = problem.rows(torch.zeros(1, dtype=torch.int64)), state[0].clone()
    right[person.num_dofs :] = 0
    right[:3] = pose[:3] - problem.origin[0]
    wrong = right.clone()
    wrong[arm] += torch.tensor([0.3, 1.2, 0.0])
    swung = limb_restarts(problem, wrong, 3, torch.Generator().manual_seed(0))
    assert len(swung) == 3
    points = problem.skin(torch.stack([right, wrong, swung[0]]))
    apart = (points - points[0]).square().sum(-1).mean(-1).sqrt()
    assert float(apart[2]) < 0.5 * float(apart[1])
    kept = [dof for dof in range(len(wrong)) if dof not in arm]
    torch.testing.assert_close(swung[0, kept], wrong[kept])


def test_a_person_in_what_is_none_is_doubtful(person):
    generator = torch.Generator().manual_seed(0)
    sheet = torch.rand(400, 3, generator=generator) * torch.tensor([1.2, 0.5, 0.02])
    result = tr.align(person, sheet, person.rest_pose(), fit_shape=True, config=QUICK)
    assert result.status is tr.Status.DOUBTFUL
    assert float(result.confidence) < 0.2
