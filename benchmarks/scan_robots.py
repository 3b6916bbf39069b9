"""Range scans of other kinds of things, public robots and a rigged hand, registered with the defaults.

The robots come with example-robot-data (`pip install "torchreg-articulated[benchmark]"`; those with COLLADA meshes need
the extra `urdf` too), the hand with ``--data FOLDER``, which holds webxr_hand_right.glb. Each pair is two random poses:
the first 14 degrees (standard deviation) from rest in every joint, the second 8, 16 or 26 degrees from the first, in
turn; the hand's fingers are flexed by up to 12, 24 or 36 degrees in both. One depth camera at a random place sees both,
about 7,500 points each. The truth is the mesh posed by the file's own joints. A pair counts as registered when at least
90 % of its source points end within 2.5 % of the diagonal of their true place, visible in the target or not.

    python benchmarks/scan_robots.py --data FOLDER
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from public_shapes import hand_parents, robots_folder
from torch import Tensor

import torchreg as tr
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.errors import MissingExtraError

ROBOTS = {
    "A1": "a1_description/urdf/a1.urdf",
    "ANYmal": "anymal_c_simple_description/urdf/anymal.urdf",
    "G1": "g1_description/urdf/g1_29dof_rev_1_0.urdf",
    "Talos": "talos_data/robots/talos_reduced.urdf",
    "Panda": "panda_description/urdf/panda.urdf",
    "UR5": "ur_description/urdf/ur5_robot.urdf",
    "Allegro": "allegro_hand_description/urdf/allegro_right_hand.urdf",
}
HAND = "webxr_hand_right.glb"
NEAR, REGISTERED = 0.025, 0.9
SCANNER = DepthScanner(num_points=7500, noise=5e-5, num_holes=0)
FROM_REST, APART, FLEXED, SPREAD = math.radians(14), (8, 16, 26), (12, 24, 36), math.radians(5)
# Sizes between the camera and what it sees, and the tangent of what it sees.
DISTANCE, REACH = 2.0, 0.5

Poser = Callable[[int, torch.Generator], tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class Thing:
    """What is scanned.

    Args:
        name: of it.
        shape: its joints.
        poses: gives the two poses of a pair by its number.
        up: axis that points up.
    """

    name: str
    shape: tr.ArticulatedShape
    poses: Poser
    up: int


@dataclass(frozen=True)
class Pair:
    """Two scans, and where the points of the first truly go."""

    source: tr.RangeScan
    target: tr.RangeScan
    truth: Tensor


def robots(folder: Path) -> Iterator[Thing]:
    """Yield the robots that are there and can be read."""
    for name, file in ROBOTS.items():
        try:
            if (folder / file).is_file():
                shape = tr.ArticulatedShape.from_urdf(folder / file, package_dirs=[folder.parent.parent])
                yield Thing(name, shape, robot_poses(shape), 2)
        except MissingExtraError as error:
            print(f"{name} is left out: {error}")


def robot_poses(shape: tr.ArticulatedShape) -> Poser:
    """Return what draws poses: near rest, and some degrees from there."""

    def poses(number: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        free = torch.ones(shape.num_dofs)
        free[:6] = 0
        angles = (FROM_REST, math.radians(APART[number % len(APART)]))
        off = [angle * free * torch.randn(shape.num_dofs, generator=generator) for angle in angles]
        first = shape.clamp(shape.rest_pose() + off[0])
        return first, shape.clamp(first + off[1])

    return poses


def hand(path: Path) -> Thing:
    """Return the hand of a file."""
    shape = tr.ArticulatedShape.from_gltf(path, parents=hand_parents())
    flexed = torch.tensor(["phalanx" in name and name.endswith("_x") for name in shape.dof_names])
    spread = torch.tensor(["proximal" in name and not name.endswith("_x") for name in shape.dof_names])

    def poses(number: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        most = math.radians(FLEXED[number % len(FLEXED)])
        one, other = (
            shape.rest_pose()
            - most * flexed * torch.rand(shape.num_dofs, generator=generator)
            + SPREAD * spread * torch.randn(shape.num_dofs, generator=generator)
            for _ in range(2)
        )
        return one, other

    return Thing("hand", shape, poses, 1)


def make_pair(thing: Thing, number: int, seed: int) -> Pair:
    """Return two scans of a thing by a camera at a random place."""
    generator = torch.Generator().manual_seed(1000 * seed + number)
    skin = thing.shape.file_skin()
    first, second = (skin(pose).double() for pose in thing.poses(number, generator))
    return scan_pair(first, second, skin.faces, thing.up, generator)


def scan_pair(first: Tensor, second: Tensor, faces: Tensor, up: int, generator: torch.Generator) -> Pair:
    """Return two scans of a surface, in two poses of its vertices (V, 3), by a camera at a random place."""
    azimuth, elevation = torch.rand(2, generator=generator, dtype=torch.float64) * torch.tensor([2 * math.pi, 0.6])
    low, high = first.amin(0), first.amax(0)
    frame = camera_frame(float(azimuth), float(elevation) - 0.1, up)
    away = torch.tensor([0.0, 0.0, DISTANCE], dtype=torch.float64)
    meshes = [
        tr.TriangleMesh((vertices - (low + high) / 2) / (high - low).norm() @ frame.mT + away, faces)
        for vertices in (first, second)
    ]
    view = SCANNER.view(meshes[0], REACH)
    source, target = (SCANNER.scan(mesh, view, generator, torch.float64) for mesh in meshes)
    return Pair(source.scan, target.scan, source.transferred(meshes[1].vertices, faces))


def camera_frame(azimuth: float, elevation: float, up: int) -> Tensor:
    """Return the rotation (3, 3) into the frame of a camera that looks along z with -y up."""
    around = torch.tensor([math.cos(azimuth), 0.0, math.sin(azimuth)], dtype=torch.float64)
    over = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    back = torch.linalg.cross(around, over)
    tilted = torch.stack(
        (around, math.cos(elevation) * over - math.sin(elevation) * back,
         math.sin(elevation) * over + math.cos(elevation) * back)
    )  # fmt: skip
    frame = torch.tensor([[1.0], [-1.0], [-1.0]], dtype=torch.float64) * tilted
    # Axes in cyclic order, so that the one that points up comes second.
    return frame.roll(up - 1, dims=1)


def main(arguments: list[str] | None = None) -> int:
    """Print a line per thing and one for all; return 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help=f"folder that holds {HAND}; without it, no hand")
    parser.add_argument("--robots", type=Path, help="folder of robots, instead of that of example-robot-data")
    parser.add_argument("--pairs", type=int, default=6, help="per thing")
    parser.add_argument("--seed", type=int, default=0, help="of poses and places of the camera")
    parser.add_argument("--smoke", action="store_true", help="the first thing alone, one pair of it")
    options = parser.parse_args(arguments)
    folder = options.robots or robots_folder()
    with torch.no_grad():
        things = [] if folder is None else list(robots(folder))
        if options.data is not None and (options.data / HAND).is_file():
            things.append(hand(options.data / HAND))
        if not things:
            print(
                'skipped: no robots found, pip install "torchreg-articulated[benchmark]" brings them; '
                f"no {HAND} in --data either"
            )
            return 0
        if options.smoke:
            things, options.pairs = things[:1], 1
        print(f"{'':12s} registered   near  mean %  seconds")
        rows = []
        for thing in things:
            rows += (own := [score(make_pair(thing, number, options.seed)) for number in range(options.pairs)])
            print_row(thing.name, own)
        print_row("all", rows)
    return 0


def score(pair: Pair) -> tuple[float, float, float]:
    """Return the share of points near their true place, the mean distance from it, and seconds."""
    begin = time.perf_counter()
    found = tr.register(pair.source, pair.target)
    seconds = time.perf_counter() - begin
    error = (found.deformed - pair.truth).norm(dim=-1) / pair.source.diagonal
    return float((error < NEAR).double().mean()), float(error.mean()), seconds


def print_row(name: str, rows: list[tuple[float, float, float]]) -> None:
    """Print the counts, means and the median of seconds."""
    near, error, seconds = torch.tensor(rows, dtype=torch.float64).unbind(-1)
    right = int((near >= REGISTERED).sum())
    print(
        f"{name:12s} {right:4d} / {len(rows):3d} {near.mean():6.3f} {100 * error.mean():7.2f} {seconds.median():8.2f}",
        flush=True,
    )


if __name__ == "__main__":
    sys.exit(main())
