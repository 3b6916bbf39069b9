"""A scan of a hand, from a phone or a depth camera: units, viewpoint, what was found and how far it can be trusted.

python examples/own_scan.py [SCAN.ply METRES_PER_UNIT]     # without arguments on a made-up scan in millimeters
"""

import sys

import torch

import torchreg as tr
from torchreg.datasets.hand import make_hand_cloud, random_hand_pose


def made_up_scan(path="scan.xyz"):
    """Write a scan as apps write them: millimeters, one side, noise, a fifth of it something else."""
    hand, generator = tr.Hand(), torch.Generator().manual_seed(4)
    pose = random_hand_pose(hand, generator)
    cloud = make_hand_cloud(
        hand, pose, num_points=600, noise=0.0015, outlier_ratio=0.2, camera=torch.zeros(3), generator=generator
    )
    lines = ("{:.2f} {:.2f} {:.2f}".format(*point) for point in (1000 * cloud.points).tolist())
    with open(path, "w") as file:
        file.write("\n".join(lines))
    return path, 0.001


path, scale = (sys.argv[1], float(sys.argv[2])) if len(sys.argv) > 2 else made_up_scan()
scan = tr.load_points(path, scale=scale, nan_policy="omit")
size = (scan.points.amax(0) - scan.points.amin(0)).tolist()
print(f"{len(scan.points)} points, {size[0]:.2f} x {size[1]:.2f} x {size[2]:.2f} m")  # a hand is about 0.2 m long

hand = tr.Hand()
found = tr.align(hand, scan.points)  # no start: it is searched for, among all rotations
rms = found.distances[found.inliers].square().mean().sqrt()
print(f"{found.status}, confidence {found.confidence:.1f}, {found.doubt or 'nothing doubtful'}")
print(f"{int(found.inliers.sum())} inliers, {1000 * rms:.1f} mm off the surface")

std = dict(zip(hand.dof_names, found.covariance.diagonal().sqrt().tolist(), strict=True))
for name in ("index_mcp_flexion", "index_pip_flexion", "index_dip_flexion"):
    print(f"{name}: {found.named_pose[name]:.2f} rad, +- {std[name]:.2f}")

found.save("hand.safetensors")  # torchreg view hand.safetensors --data scan.xyz
found.plot(scan).figure.savefig("own_scan.png")
