"""The fit of all joints of a robot to all scans, and what its standard deviations say."""

import torch
import trimesh

from tests.geometry.draws import D, seeded
from torchreg.registration.robots.fit import Mechanism, axis_stds, fitted
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
