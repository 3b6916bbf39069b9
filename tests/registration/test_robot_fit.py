"""The fit of all joints of a robot to all scans, and what its standard deviations say."""

import torch
import trimesh

from tests.geometry.draws import D, seeded
from torchreg.geometry.rigid import rigid_matrix, se3_exp
from torchreg.registration.robots.fit import Mechanism, axis_stds, fitted
from torchreg.registration.robots.links import merge_losses, without_idle
from torchreg.registration.robots.surfaces import Noise, Surfaces, Target

NOISE, FRAMES = 5e-4, 8
POINTS = torch.tensor([[0.0, 0.0, 0.15], [0.0, 0.02, 0.2]], dtype=D)
AXES = torch.nn.functional.normalize(torch.tensor([[0.0, 0.6, 0.8], [1.0, 0.3, 0.0]], dtype=D), dim=1)


def fit(seed):
    """Errors (2,) of two hinges in a row across a link that has no samples, and their stds, radians."""
    draw = seeded(seed)
    box = trimesh.creation.box((0.1, 0.08, 0.24))
    local, face = trimesh.sample.sample_surface(box, 300, seed=seed)
    normals = torch.from_numpy(box.face_normals[face].copy()).repeat(2, 1)
    points, label = torch.from_numpy(local.copy()), torch.tensor([0, 2]).repeat_interleave(300)
    points = torch.cat([points, points + torch.tensor([0.0, 0.0, 0.35], dtype=D)])
    values = torch.cat([torch.zeros(FRAMES, 1, dtype=D), 0.2 * torch.randn(FRAMES, 2, generator=draw, dtype=D)], 1)
    axes = torch.cat([torch.zeros(1, 6, dtype=D), torch.cat([torch.linalg.cross(POINTS, AXES), AXES], 1)])
    truth = Mechanism((-1, 0, 1), axes, torch.eye(4, dtype=D).repeat(FRAMES, 1, 1), values)
    targets = []
    for frame in truth.motions()[:, label]:
        moved = (frame[:, :3, :3] @ points.unsqueeze(-1)).squeeze(-1) + frame[:, :3, 3]
        noisy = moved + NOISE * torch.randn(moved.shape, generator=draw, dtype=D)
        targets.append(Target(noisy, (frame[:, :3, :3] @ normals.unsqueeze(-1)).squeeze(-1)))
    surfaces = Surfaces.of(points, normals, targets)
    found = fitted(surfaces, truth, label, [3 * NOISE] * 40)  # from the truth to where noise takes it, along valleys
    last = fitted(surfaces, found, label, [3 * NOISE])
    places = torch.cat([torch.zeros(1, 3, dtype=D), POINTS])
    stds = axis_stds(surfaces, last, Noise(NOISE, 1.0), last.steps_from(found), label, places)[0][1:]
    return torch.linalg.cross(last.axes[1:, 3:], AXES).norm(dim=-1), stds


def test_stds_are_those_of_errors_across_a_link_that_has_no_samples():
    errors, stds = (torch.stack(rows) for rows in zip(*(fit(seed) for seed in range(6)), strict=True))
    # They hold for the worse of two directions, and for what frames and pieces share, of which there is nothing here.
    assert 0.3 < float((errors / stds).square().mean().sqrt()) < 1.2
    assert float((errors / stds).max()) < 3


def test_a_link_that_explains_no_points_of_its_own_does_not_pay_for_itself():
    draw = seeded(0)
    box = trimesh.creation.box((0.1, 0.08, 0.3))
    local, face = trimesh.sample.sample_surface(box, 600, seed=1)
    points, normals = torch.from_numpy(local.copy()), torch.from_numpy(box.face_normals[face].copy())
    label = (points[:, 2] > 0).long()
    hidden = (points[:, 2] > 0.12).long() + label
    turn = se3_exp(0.3 * torch.randn(FRAMES, 1, generator=draw, dtype=D) * torch.tensor([0, 0, 0, 0.6, 0.8, 0.0]))
    still = torch.eye(4, dtype=D).expand(FRAMES, 4, 4)
    noise = Noise(NOISE, 1.0)

    def losses(labels, motions, shown):
        targets = []
        for frame in torch.stack([still, turn], 1)[:, label[shown]]:
            moved = (frame[:, :3, :3] @ points[shown].unsqueeze(-1)).squeeze(-1) + frame[:, :3, 3]
            targets.append(Target(moved + NOISE * torch.randn(moved.shape, generator=draw, dtype=D), normals[shown]))
        surfaces = Surfaces.of(points, normals, targets)
        return merge_losses(surfaces, torch.stack(motions, 1), labels, noise), surfaces

    # Both halves are shown, and move: each saves far more than it costs. The best to join is the other.
    (found, beside), _ = losses(label, [still, turn], torch.ones_like(label, dtype=torch.bool))
    assert float(found.min()) > 10
    assert beside.tolist() == [1, 0]
    # An end that no scan shows lies on the other half, as if it had moved: it explains nothing, and joins its link.
    folded = turn @ rigid_matrix(torch.eye(3, dtype=D), torch.tensor([0.0, 0.0, -0.03], dtype=D))
    (found, beside), surfaces = losses(hidden, [still, turn, folded], hidden < 2)
    assert float(found[:2].min()) > 10
    assert float(found[2]) < 1
    assert int(beside[2]) == 1
    motions, labels = without_idle(surfaces, torch.stack([still, turn, folded], 1), hidden, noise)
    assert labels.tolist() == label.tolist()
    torch.testing.assert_close(motions, torch.stack([still, turn], 1), rtol=0, atol=0)
