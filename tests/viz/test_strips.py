"""Strips hold one panel per step, part or frame, painted as they should be; what does not fit is refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from torchreg.alignment.results import AlignRecord
from torchreg.errors import InputError
from torchreg.geometry.mesh import TriangleMesh, unit_sphere
from torchreg.viz.spines import spine_view
from torchreg.viz.strips import annealing_strip, convergence_figure, registration_strip, spine_strip


def panels(path, count, margin=0.0):
    """Return the pictures of a strip as which pixels are painted, (count, H, W)."""
    picture = np.asarray(Image.open(path).convert("RGB")).astype(int)
    width = round(picture.shape[1] / (count + margin))
    assert abs(width - 300) <= 1
    return np.stack([picture[:300, k * 300 : k * 300 + 299] for k in range(count)])


def test_the_annealing_goes_from_the_start_to_the_end(hand, track, alignment, tmp_path):
    poses = torch.stack([torch.lerp(track.poses[1], track.poses[2], share) for share in torch.linspace(0, 1, 6)])
    one = torch.ones(1)
    history = tuple(
        AlignRecord("em" if k < 4 else "surface", k % 4, 4, 0.01 * one / (k + 1), one, pose[None], one)
        for k, pose in enumerate(poses)
    )
    result = replace(alignment, history=history)
    start = hand.rest_pose()
    start[:3] = track.poses[1][:3]
    data = alignment.registered
    path = annealing_strip(tmp_path / "a.png", hand, data, result, start=start, columns=3)
    found = panels(path, 3)
    painted = (found < 250).any(-1)
    assert painted.mean((1, 2)).min() > 0.02
    assert (painted[0] != painted[2]).mean() > 0.005  # the shape moved
    assert panels(annealing_strip(tmp_path / "b.png", hand, data, result, columns=2), 2).shape[0] == 2
    with pytest.raises(InputError, match="with its history"):
        annealing_strip(tmp_path / "c.png", hand, data, alignment)
    with pytest.raises(InputError, match="columns"):
        annealing_strip(tmp_path / "c.png", hand, data, result, columns=1)


def test_a_registration_by_bones_and_by_error(registration, tmp_path):
    target = TriangleMesh(registration.deformed, registration.faces)
    errors = torch.zeros(len(registration.points))
    errors[registration.points[:, 0] > 0] = 1.0
    path = registration_strip(tmp_path / "r.png", registration, target, errors=errors, unit="mm", largest=1.0)
    found = panels(path, 4, 0.35)
    painted = (found < 250).any(-1)
    assert painted.mean((1, 2)).min() > 0.01
    error = found[3][painted[3]]
    assert (error[:, 2] > error[:, 0] + 30).any()  # blue: none
    assert (error[:, 0] > error[:, 2] + 30).any()  # red: much
    assert registration_strip(tmp_path / "s.png", registration, target).exists()
    with pytest.raises(InputError, match="must have triangles"):
        registration_strip(tmp_path / "t.png", replace(registration, faces=None), target)
    with pytest.raises(InputError, match="errors must have shape"):
        registration_strip(tmp_path / "t.png", registration, target, errors=torch.zeros(2))


def test_a_spine_over_time(spine, tmp_path):
    meshes = [unit_sphere(2)] * 3
    found = panels(spine_strip(tmp_path / "s.png", spine, meshes, columns=2), 2)
    assert (found[0] != found[1]).any()
    view = spine_view(meshes, size=(300, 300))
    assert panels(spine_strip(tmp_path / "t.png", spine, meshes, columns=9, view=view), 3).shape[0] == 3
    with pytest.raises(InputError, match="one surface per frame"):
        spine_strip(tmp_path / "u.png", spine, meshes[:2])


def test_convergence(tmp_path):
    path = convergence_figure(tmp_path / "c.png", {"one": [1.0, 0.1, 0.0], "two": [2.0]})
    assert (np.asarray(Image.open(path).convert("RGB")) < 200).any()
    assert convergence_figure(tmp_path / "l.svg", {"one": [1.0, -1.0]}, logarithmic=False).exists()
    with pytest.raises(InputError, match="one line at least"):
        convergence_figure(tmp_path / "d.png", {})
