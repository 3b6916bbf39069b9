"""Two range scans of something that moved, without a template: parts, errors, and a new pose by dragging a point.

python examples/register_and_pose.py [SOURCE.ply TARGET.ply]     # without arguments on a made-up toy
"""

import math
import sys

import torch

import torchreg as tr
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.datasets.scan_sequences import jointed_toy

if len(sys.argv) > 2:
    source, target, truth = tr.load_scan(sys.argv[1]), tr.load_scan(sys.argv[2]), None
else:
    truth = jointed_toy(2, seed=5, scanner=DepthScanner(num_points=2500), step=math.radians(25)).pair(0, 1)
    source, target = truth.source, truth.target

found = tr.register(source, target, num_bones=10, grid_resolution=40)
diagonal = (source.points.amax(0) - source.points.amin(0)).norm()
print(f"{found.status}: {found.matched.float().mean():.0%} of the points match")
print(f"{found.model.num_bones} bones, {int(found.parts().max()) + 1} parts that moved")
print(f"distance from the target, median {found.distances.nanmedian() / diagonal:.2%} of the diagonal")
if truth is not None:
    print(f"error, mean {truth.error(found.deformed).mean():.2%} of the diagonal")

top = source.points[[int(source.points[:, 1].argmin())]]  # a camera's y points down
posed = tr.solve_pose(found.model, top, top + 0.05 * diagonal * torch.tensor([[1.0, 0.0, 0.0]]))
moved = found.model(source.points, posed.transforms)
print(f"handle {posed.residuals.max():.4f} off its target")
print(f"the others moved by {(moved - source.points).norm(dim=-1).median():.3f} in the median")

found.save("toy.safetensors")  # torchreg pose toy.safetensors drags points in the browser
found.plot(target.points).figure.savefig("register_and_pose.png")
