"""Volume, time and memory of the visual hull of an ellipsoid, and starfish from masks to one spine with five limbs.

The exact hull is a little larger than the body; its volume is found by Monte Carlo with the exact silhouettes, no grid
and no pixels. Bars: 3 % of the volume, 10 s on two cores, 1 GB.

The starfish moves; its masks, rendered for every camera and frame, are all that is known. Bars: five limbs in one
graph. Distances of the spine's tips from the true ones are shares of an arm's length.
"""

from __future__ import annotations

import argparse
import math
import resource
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torchreg as tr
from experiments.made_up.pictures import camera_ring
from torchreg.datasets.creatures import STARFISH, creature_sequence
from torchreg.geometry.visibility import rasterize

CENTER, RADII = (0.1, -0.05, 0.2), (0.3, 0.2, 0.15)


def hits(camera: tr.Camera, rays: Tensor) -> Tensor:
    """Return which rays (..., 3) from a camera meet the ellipsoid."""
    radii = rays.new_tensor(RADII)
    start, rays = (camera.position.to(rays) - rays.new_tensor(CENTER)) / radii, rays / radii
    return (rays @ start) ** 2 > (rays**2).sum(-1) * ((start**2).sum() - 1)


def exact_volume(cameras: tr.CameraRig, samples: int) -> float:
    """Return the volume of the hull of the exact silhouettes: Monte Carlo, in a box half as large again as the body."""
    generator = torch.Generator().manual_seed(0)
    half = 1.5 * torch.tensor(RADII, dtype=torch.float64)
    points = torch.rand(samples, 3, generator=generator, dtype=torch.float64) * 2 - 1
    points = torch.tensor(CENTER, dtype=torch.float64) + half * points
    inside = torch.ones(samples, dtype=torch.bool)
    for camera in cameras:
        inside &= hits(camera, points - camera.position)
    return float(inside.double().mean() * 8 * half.prod())


def starfish(frames: int, count: int, pixels: int, resolution: int) -> dict[str, float]:
    """Return what becomes of a moving starfish whose masks alone are known."""
    truth = creature_sequence(STARFISH, frames, resolution=48)
    middle = torch.stack([mesh.vertices.mean(0) for mesh in truth.meshes]).mean(0)
    cameras = camera_ring(middle, 5.0, count, focal=1.6 * pixels, width=pixels, height=pixels)
    started = time.perf_counter()
    hulls = []
    for mesh in truth.meshes:
        masks = [rasterize(mesh, camera.view()).face_index >= 0 for camera in cameras]
        hulls.append(tr.visual_hull(masks, cameras, resolution=resolution).mesh())
    carved = time.perf_counter() - started
    spine = tr.extract_spine(hulls, workers=1)
    seconds = time.perf_counter() - started
    # Names are the spine's own: the true tips in the order that fits the first frame.
    order = torch.cdist(spine.tips[0].double(), truth.tips[0].double()).argmin(1)
    off = (spine.tips.double() - truth.tips[:, order].double()).norm(dim=-1)
    return {
        "tips (5)": float(spine.num_tips),
        "limbs (5)": float(len(spine.graph)),
        "junctions (1)": float(spine.junctions.shape[1]),
        "frames with this tree by themselves": float(sum(map(str.__eq__, spine.own_topologies, spine.topologies))),
        "tips off, mean share of an arm": float(off.mean()),
        "tips off, worst": float(off.max()),
        "rendering and carving, seconds per frame": carved / frames,
        "seconds per frame": seconds / frames,
    }


def main(arguments: Sequence[str] | None = None) -> dict[str, float]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--resolution", type=int, default=256)
    parser.add_argument("--cameras", type=int, default=24)
    parser.add_argument("--frames", type=int, default=8, help="of the starfish")
    parser.add_argument("--smoke", action="store_true", help="seconds: small pictures, a coarse grid")
    options = parser.parse_args(arguments)
    scale = 0.2 if options.smoke else 1.0
    resolution, count = (40, 8) if options.smoke else (options.resolution, options.cameras)
    wide, high = round(640 * scale), round(480 * scale)
    cameras = camera_ring(CENTER, 1.2, count, focal=600.0 * scale, width=wide, height=high)
    masks = [hits(camera, camera.directions(camera.pixel_grid())) for camera in cameras]
    started = time.perf_counter()
    hull = tr.visual_hull(masks, cameras, resolution=resolution)
    carved = time.perf_counter() - started
    mesh = hull.mesh()
    seconds = time.perf_counter() - started
    exact = exact_volume(cameras, 50_000 if options.smoke else 2_000_000)
    figures = {
        "volume over exact hull": hull.volume() / exact,
        "exact hull over body": exact / (4 / 3 * math.pi * math.prod(RADII)),
        "seconds": seconds,
        "carving seconds": carved,
        "peak memory, MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "triangles": mesh.num_faces,
    }
    frames, side, cells = (2, 100, 40) if options.smoke else (options.frames, 320, 128)
    fish = starfish(frames, count, side, cells) if frames else {}
    print(f"visual hull at {resolution}^3 from {count} cameras of {wide} x {high} pixels")
    for name, value in figures.items():
        print(f"  {name:24s} {value:.4g}")
    if fish:
        print(f"starfish in {frames} frames at {cells}^3 from {count} cameras of {side} x {side} pixels")
    for name, value in fish.items():
        print(f"  {name:42s} {value:.4g}")
    return figures | fish


if __name__ == "__main__":
    main()
