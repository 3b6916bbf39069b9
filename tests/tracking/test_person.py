"""Shape coefficients over time: every frame tells more of them, states go on, and what does not go with a fit."""

import math
from types import SimpleNamespace

import pytest
import torch

import torchreg as tr
from tests.alignment.made import person_cloud
from torchreg.geometry.mesh import sample_surface
from torchreg.tracking.person_filter import KnownPerson, OrientedScan, PersonFilter

TRUTH = torch.tensor([0.7, -0.6, 0.9])


def motion(shape, frames):
    """Return poses (T, D) of a person who turns a little and swings head and arms."""
    generator = torch.Generator().manual_seed(1)
    swing = math.radians(15) * torch.randn(2, shape.num_dofs - 6, generator=generator)
    time = 0.25 * torch.arange(frames).unsqueeze(-1)
    base = torch.tensor([0.3, -0.2, 0.9, 0.1, -0.1, 0.15]) + time * torch.tensor([0.04, 0, 0, 0, 0, 0.2])
    return torch.cat([base, time.sin() * swing[0] + (time.cos() - 1) * swing[1]], dim=-1)


def scans(shape, poses, coefficients):
    """Return what a camera at -y sees of a person, with noise and 5 % outliers."""
    generator = torch.Generator().manual_seed(2)
    return [person_cloud(shape, pose, coefficients, generator, 400, noise=0.003) for pose in poses]


def coefficients_of(covariance):
    """Return the block of the coefficients of a covariance of pose and coefficients."""
    return covariance[-len(TRUTH) :, -len(TRUTH) :]


def start_near(poses):
    start = torch.zeros_like(poses[0])
    start[:3] = poses[0, :3] + torch.tensor([0.05, -0.05, 0.04])
    return start


@pytest.fixture(scope="module")
def tracked(person):
    """The tracker of eight frames of a person, its clouds, results and states."""
    poses = motion(person, 8)
    clouds = scans(person, poses, TRUTH)
    tracker = tr.Tracker(person, start_near(poses), fit_shape=True)
    results, states = zip(*((tracker.step(cloud), tracker.state) for cloud in clouds), strict=True)
    return SimpleNamespace(tracker=tracker, clouds=clouds, results=results, states=states)


def test_the_error_of_the_coefficients_falls_with_the_frames(tracked):
    errors = torch.stack([(result.coefficients - TRUTH).norm() for result in tracked.results])
    deviations = torch.stack([result.coefficient_covariance.diagonal().sqrt() for result in tracked.results])
    assert all(result.status is tr.Status.CONVERGED for result in tracked.results)
    assert float(errors[-1]) < 0.7 * float(errors[0])
    assert float(errors[-1]) < 0.08
    # Information adds up; with the frames it grows in proportion. Errors of the model are the same in all frames.
    noise = torch.stack([coefficients_of(state.person_covariance).diagonal().sqrt() for state in tracked.states])
    assert bool((noise.diff(dim=0) < 0).all())
    assert bool((noise[-1] < 0.7 * noise[0]).all())
    assert bool((deviations >= noise).all())
    assert float(deviations.diff(dim=0)[-1].abs().max()) < 0.05 * float(deviations[-1].max())
    assert bool(((tracked.results[-1].coefficients - TRUTH).abs() < 4 * deviations[-1] + 0.02).all())


def test_a_part_off_its_place_moves_the_estimate_as_its_sensitivity_says(person):
    pose = motion(person, 1)[0]
    body, generator = PersonFilter(person, True), torch.Generator().manual_seed(3)
    mesh = tr.TriangleMesh(person.vertices(pose, TRUTH), person.surface.faces)
    points, face, _ = sample_surface(mesh, 1500, generator=generator)
    points += 0.003 * torch.randn(points.shape, generator=generator)
    outward, part = mesh.face_normals()[face], person.surface.weights.argmax(-1)[mesh.faces[face, 0]]
    known = KnownPerson(TRUTH, 0.04 * torch.eye(3), torch.zeros(3, person.num_parts))

    def fitted(data):
        found = body.fit(known, OrientedScan(data[None], outward[None]), pose, None)
        return found.known.coefficients, found.known.alone.sensitivity

    _, sensitivity = fitted(points)
    for number in range(person.num_parts):
        shift = 1e-3 * outward * (part == number).unsqueeze(-1)
        (more, _), (less, _) = fitted(points + shift), fitted(points - shift)
        moved, told = (more - less) / 2, sensitivity[:, number]
        # One deviation is twice that of the residuals, 6 mm.
        assert float((6 * moved - told).norm()) < 0.2 * float(told.norm())


def test_the_rig_that_is_followed_is_that_of_the_person(tracked, person):
    rest = torch.zeros(person.num_dofs)
    wanted = person.vertices(rest, TRUTH)
    assert float((tracked.tracker.shape(rest).points - wanted).norm(dim=-1).mean()) < 0.01
    assert float((person(rest).points - wanted).norm(dim=-1).mean()) > 0.03


def test_a_frame_that_shows_nobody_tells_nobody_and_the_pose_of_one_just_found_is_not_sought_again(person, monkeypatch):
    def no_search(*arguments, **options):
        raise AssertionError("the pose was found together with the person")

    monkeypatch.setattr("torchreg.tracking.tracker.align", no_search)
    monkeypatch.setattr("torchreg.tracking.recovery.find_pose", no_search)
    poses = motion(person, 1)
    tracker = tr.Tracker(person, start_near(poses), fit_shape=True)
    nobody = tracker.step(torch.zeros(0, 3))
    assert (nobody.status, nobody.coefficients) == (tr.Status.NO_DATA, None)
    result = tracker.step(scans(person, poses, TRUTH)[0])
    assert result.status is tr.Status.CONVERGED
    found = person.vertices(result.pose, result.coefficients)
    assert float((found - person.vertices(poses[0], TRUTH)).norm(dim=-1).mean()) < 0.02


def test_a_state_goes_on_in_another_tracker(tracked, person, tmp_path):
    tracked.states[1].save(tmp_path / "s.safetensors")
    second = tr.Tracker(person, fit_shape=True)
    second.state = tr.load(tmp_path / "s.safetensors")
    result = second.run(tracked.clouds[2:3])
    torch.testing.assert_close(result.poses[0], tracked.results[2].pose)
    torch.testing.assert_close(result.coefficients, tracked.results[2].coefficients)
    torch.testing.assert_close(result.coefficient_covariance, tracked.results[2].coefficient_covariance)
    with pytest.raises(tr.errors.InputError, match="fit_shape must be the same"):
        tr.Tracker(person).state = second.state


def test_bones_of_any_rig_are_followed(person):
    rig = person.with_coefficients(torch.zeros(3))
    poses = motion(person, 2)
    tracker = tr.Tracker(rig, start_near(poses), fit_shape="bones")
    results, told = [], []
    for cloud in scans(person, poses, TRUTH):
        results.append(tracker.step(cloud))
        told.append(tracker.state.person_covariance)
    assert len(results[0].coefficients) == 2 + 2 * rig.num_parts
    assert float(coefficients_of(told[1]).diagonal().sum()) < float(coefficients_of(told[0]).diagonal().sum())
