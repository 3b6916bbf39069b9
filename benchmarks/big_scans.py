"""How time and memory of an alignment, a registration and a skeleton grow with the number of points.

    python benchmarks/big_scans.py                    # all, some ten minutes
    python benchmarks/big_scans.py --part align       # one of align, register, skeletonize
    python benchmarks/big_scans.py --rig RIG.glb      # beside hand and arm a skinned rig
    python benchmarks/big_scans.py --smoke            # few points, to see that it runs

Each line is a process of its own with one thread: CPU seconds without the start of Python, for clouds with reading them
from a file, and the most memory held before and until the end. Everything is made up.

- align: clouds of a hand from one side, of which the network that comes with torchreg proposes poses, and of an arm, of
  which there is none; each with a start that is off by .1 at every joint, and without. Noise is .5 % of the
  shape's size, a tenth of the points are outliers. Error: of the keypoints, as a share of the size. Bar: 10 CPU s for
  300,000 points, 30 CPU s and 2 GB for 5 million, an error of 4 %.
- register: two scans of a walking figure. Error: of the moved points from their true places, as a share of the scan's
  diagonal. Bar: 15 CPU s for 400,000 points. Memory before is that of making them.
- skeletonize: a starfish. Error: tips that are not five. Bar: 15 CPU s for 400,000 vertices. Memory: the same.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torchreg as tr
from experiments.made_up.walks import walking_figure
from torchreg.datasets.creatures import STARFISH, creature_sequence
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.datasets.hand import make_hand_cloud, random_hand_pose
from torchreg.geometry.mesh import sample_surface

POINTS = (1_000, 10_000, 100_000, 300_000, 1_000_000, 5_000_000)
SCANS = (20_000, 100_000, 400_000)
VOXELS = (130, 288, 572)  # along the longest side of a starfish of 20,000, 100,000 and 400,000 vertices
SMOKE_POINTS, SMOKE_SCANS, SMOKE_VOXELS = (12_000,), (300,), (48,)
NOISE, OUTLIERS, START, CHUNK = 0.005, 0.1, 0.1, 200_000
ERROR_BAR, MEMORY_BAR, SCAN_BAR = 0.04, 2000.0, 15.0
ALIGN_BARS = {300_000: 10.0}
CLOUD = "cloud.npy"
PARTS = ("align", "register", "skeletonize")

LINK = """<link name="{name}"><visual><origin xyz="{at}"/><geometry><box size="{size}"/></geometry></visual></link>"""
JOINT = """<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/><origin xyz="{at}"/>
<axis xyz="{axis}"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint>"""
ARM = "\n".join((
    '<robot name="arm">',
    LINK.format(name="base", at="0.03 0 0.05", size="0.3 0.2 0.1"),
    LINK.format(name="turret", at="0 0.03 0.1", size="0.12 0.16 0.2"),
    LINK.format(name="upper", at="0 0 0.18", size="0.09 0.07 0.36"),
    LINK.format(name="fore", at="0.05 0 0.15", size="0.16 0.06 0.3"),
    JOINT.format(name="pan", parent="base", child="turret", at="0 0 0.1", axis="0 0 1"),
    JOINT.format(name="lift", parent="turret", child="upper", at="0 0 0.2", axis="0 1 0"),
    JOINT.format(name="elbow", parent="upper", child="fore", at="0 0 0.36", axis="0 1 0"),
    "</robot>",
))  # fmt: skip


@dataclass(frozen=True)
class Cost:
    """What a piece of work took: points, CPU seconds, megabytes before and at most, and the error."""

    count: int
    seconds: float
    before: float
    most: float
    error: float


def measured(work: str, *given: str | int | bool) -> Cost:
    """Return what work of some name costs in a process of its own: one that did anything else has held more already."""
    command = [sys.executable, __file__, "--one", json.dumps([work, *given])]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return Cost(*json.loads(done.stdout.splitlines()[-1]))


def measure(work: str, given: Sequence[Any]) -> Cost:
    """Return what work of some name costs in this process, but for making what it works on."""
    torch.set_num_threads(1)
    call = WORK[work](*given)
    before, start = _held(), time.process_time()
    count, error = call()
    return Cost(count, time.process_time() - start, before, _held(), error)


def _held() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def shape_of(name: str, folder: Path) -> tr.ArticulatedShape:
    """Return the hand, the arm, or the rig of a file."""
    if name == "hand":
        return tr.Hand().requires_grad_(False)
    if name == "arm":
        path = folder / "arm.urdf"
        path.write_text(ARM, encoding="utf-8")
        return tr.ArticulatedShape.from_urdf(path)
    return tr.ArticulatedShape.from_gltf(name)


def true_pose(name: str, shape: tr.ArticulatedShape) -> Tensor:
    """Return the pose of which clouds are made."""
    draw = torch.Generator().manual_seed(3)
    if name == "hand":
        return random_hand_pose(shape, draw)
    bend = 0.6 if name == "arm" else 0.1
    pose = shape.rest_pose() + bend * torch.randn(shape.num_dofs, generator=draw)
    pose[:3] = torch.tensor([0.3, -0.2, 0.8])
    return shape.clamp(pose)


def size_of(shape: tr.ArticulatedShape) -> float:
    keypoints = shape.keypoints(shape.rest_pose())
    return float((keypoints.amax(0) - keypoints.amin(0)).norm())


def cloud_of(name: str, shape: tr.ArticulatedShape, count: int) -> Tensor:
    """Return a cloud (count, 3) of a shape in its true pose, a part at a time."""
    return torch.cat([
        _part(name, shape, min(CHUNK, count - first), torch.Generator().manual_seed(first))
        for first in range(0, count, CHUNK)
    ])  # fmt: skip


def _part(name: str, shape: tr.ArticulatedShape, count: int, draw: torch.Generator) -> Tensor:
    pose, size = true_pose(name, shape), size_of(shape)
    if name == "hand":
        made = make_hand_cloud(
            shape, pose, num_points=count, noise=NOISE * size, outlier_ratio=OUTLIERS, camera=torch.zeros(3),
            generator=draw,
        )  # fmt: skip
        return made.points[torch.randperm(len(made.points), generator=draw)[:count]]
    surface = tr.TriangleMesh(shape.file_skin()(pose), shape.file_surface().faces)
    points = sample_surface(surface, count, draw)[0]
    points = points + NOISE * size * torch.randn(points.shape, generator=draw)
    lower, upper = points.amin(0), points.amax(0)
    far = torch.rand(count, generator=draw) < OUTLIERS
    return torch.where(far[:, None], lower + (upper - lower) * torch.rand(points.shape, generator=draw), points)


def align(name: str, folder: str, with_start: bool) -> Callable[[], tuple[int, float]]:
    """Return a call that aligns a shape to a cloud and returns its number of points, and the error."""
    shape = shape_of(name, Path(folder))
    size, truth, start = size_of(shape), true_pose(name, shape), None
    if with_start:
        start = truth + START * torch.randn(len(truth), generator=torch.Generator().manual_seed(1))
        start[:3] = truth[:3] + 0.02 * size

    def call() -> tuple[int, float]:
        found = tr.align(shape, tr.load_points(Path(folder) / CLOUD), start)
        return len(found.distances), float((found.keypoints - shape.keypoints(truth)).norm(dim=-1).mean() / size)

    return call


def register(count: int) -> Callable[[], tuple[int, float]]:
    """Return a call that registers two scans and returns the points of one, and the mean error of where they go."""
    pair = walking_figure(2, scanner=DepthScanner(num_points=count)).pair(0, 1)
    diagonal = (pair.source.points.amax(0) - pair.source.points.amin(0)).norm()

    def call() -> tuple[int, float]:
        found = tr.register(pair.source, pair.target)
        return len(pair.source.points), float((found.deformed - pair.truth).norm(dim=1).mean() / diagonal)

    return call


def skeletonize(voxels: int) -> Callable[[], tuple[int, float]]:
    """Return a call that skeletonizes a starfish and returns its vertices, and the tips too many or too few."""
    mesh = creature_sequence(STARFISH, 1, resolution=voxels).meshes[0]
    return lambda: (mesh.num_vertices, float(abs(len(tr.skeletonize(mesh).tips) - STARFISH.num_arms)))


def write_cloud(name: str, folder: str, count: int) -> Callable[[], tuple[int, float]]:
    """Return a call that writes a cloud of a shape: whatever starts a process must not have held much memory itself."""

    def call() -> tuple[int, float]:
        points = cloud_of(name, shape_of(name, Path(folder)), count)
        np.save(Path(folder) / CLOUD, points.numpy().astype(np.float32))
        return count, 0.0

    return call


WORK = {"write_cloud": write_cloud, "align": align, "register": register, "skeletonize": skeletonize}


def print_cost(name: str, cost: Cost, seconds: float, error: float, memory: float = math.inf) -> None:
    passed = cost.seconds <= seconds and cost.most <= memory and cost.error <= error
    work, held = f"{cost.count:8d} points {cost.seconds:6.1f} CPU s", f"{cost.before:5.0f} to {cost.most:4.0f} MB"
    print(f"{name:<28}{work} {held}  error {cost.error:.4f}  {'pass' if passed else 'FAIL'}", flush=True)


def print_align(names: Sequence[str], counts: Sequence[int]) -> None:
    for name in names:
        with tempfile.TemporaryDirectory() as folder:
            for count in counts:
                measured("write_cloud", name, folder, count)
                for with_start in (False, True):
                    title = f"align {Path(name).stem}, {'with a' if with_start else 'no'} start"
                    cost = measured("align", name, folder, with_start)
                    print_cost(title, cost, ALIGN_BARS.get(count, 30.0), ERROR_BAR, MEMORY_BAR)


def print_register(counts: Sequence[int]) -> None:
    for count in counts:
        print_cost("register figure", measured("register", count), SCAN_BAR, ERROR_BAR)


def print_skeletonize(resolutions: Sequence[int]) -> None:
    for voxels in resolutions:
        print_cost("skeletonize starfish", measured("skeletonize", voxels), SCAN_BAR, 0.0)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables; return 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", choices=PARTS, help="all by default")
    parser.add_argument("--most", type=int, default=POINTS[-1], help="clouds of more points are left out")
    parser.add_argument("--rig", type=Path, help="a rigged .glb or .gltf file that is aligned, too")
    parser.add_argument("--smoke", action="store_true", help="few points of everything")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.one is not None:
        work, *given = json.loads(options.one)
        print(json.dumps(astuple(measure(work, given))))
        return 0
    parts = PARTS if options.part is None else [options.part]
    names = ["hand"] if options.smoke else ["hand", "arm", *([str(options.rig)] if options.rig else [])]
    if "align" in parts:
        print_align(names, SMOKE_POINTS if options.smoke else [count for count in POINTS if count <= options.most])
    if "register" in parts:
        print_register(SMOKE_SCANS if options.smoke else SCANS)
    if "skeletonize" in parts:
        print_skeletonize(SMOKE_VOXELS if options.smoke else VOXELS)
    return 0


if __name__ == "__main__":
    sys.exit(main())
