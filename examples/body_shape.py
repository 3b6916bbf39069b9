"""A person's body from one scan: pose and shape coefficients together, and how well each is known.

python examples/body_shape.py [SCAN.ply START.json]     # without arguments on a made-up person; needs the extra anny
"""

import json
import sys
from pathlib import Path

import torch

import torchreg as tr

body = tr.ArticulatedShape.from_anny("body")  # free; yours: ArticulatedShape.from_npz("SMPLH_MALE.npz")
print(body)
names = body.coefficient_names


def made_up_scan():
    """Return points all over a slim, tall person with bent arms, 2 mm of noise, and the person's coefficients."""
    values = {"gender": 0.4, "age": 0.6, "muscle": 0.3, "weight": 0.3, "height": 0.8, "proportions": 0.5}
    coefficients = torch.tensor([values[name] for name in names])
    pose = body.pose_from_dict({"upperarm01.L_y": 0.4, "upperarm01.R_y": -0.3, "lowerarm01.L_x": -0.3})
    corners = body.vertices(pose, coefficients).detach()[body.surface.faces]  # (F, 3, 3)
    areas = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(dim=-1)
    generator = torch.Generator().manual_seed(0)
    middles = corners[torch.multinomial(areas, 1500, generator=generator)].mean(1)
    return middles + 0.002 * torch.randn(1500, 3, generator=generator), coefficients


if len(sys.argv) > 2:
    scan, truth, start = tr.load_points(sys.argv[1]).points, None, json.loads(Path(sys.argv[2]).read_text())
else:
    (scan, truth), start = made_up_scan(), body.rest_pose()

found = tr.align(body, scan, start, fit_shape=True)
near = found.distances[found.inliers].square().mean().sqrt()
print(
    f"{found.status}, {int(found.inliers.sum())} of {len(scan)} points inliers, {1000 * near:.1f} mm from the surface"
)
if found.doubt:
    print(found.doubt)
deviations = found.coefficient_covariance.diagonal().sqrt()
for number, name in enumerate(names):
    known = "" if truth is None else f", made with {truth[number]:.2f}"
    print(f"{name} {found.coefficients[number]:.2f} +- {deviations[number]:.2f}{known}")

points = found.shape.file_skin()(found.pose)  # the person is a rig of its own, to pose and to track
print(f"{points[:, 2].max() - points[:, 2].min():.2f} m from sole to crown")
found.plot(scan).figure.savefig("body_shape.png")
