"""Volume, time and memory of the visual hull of an ellipsoid, whose silhouettes are known exactly.

The exact hull is a little larger than the body; its volume is found by Monte Carlo with the
exact silhouettes, no grid and no pixels.
"""

from __future__ import annotations

import argparse
import math
import resource
import time
from collections.abc import Sequence

import torch
from torch import Tensor

from torchreg.capture.silhouettes import visual_hull
from torchreg.datasets.pictures import camera_ring
from torchreg.geometry.camera import Camera
from torchreg.geometry.camera_rig import CameraRig

CENTER, RADII = (0.1, -0.05, 0.2), (0.3, 0.2, 0.15)


def hits(camera: Camera, rays: Tensor) -> Tensor:
    """Return which rays (..., 3) from a camera meet the ellipsoid."""
    radii = rays.new_tensor(RADII)
    start, rays = (camera.position.to(rays) - rays.new_tensor(CENTER)) / radii, rays / radii
    return (rays @ start) ** 2 > (rays**2).sum(-1) * ((start**2).sum() - 1)


def exact_volume(cameras: CameraRig, samples: int) -> float:
    """Return the volume of the hull of the exact silhouettes: Monte Carlo, in a box half as large again as the body."""
    generator = torch.Generator().manual_seed(0)
    half = 1.5 * torch.tensor(RADII, dtype=torch.float64)
    points = torch.rand(samples, 3, generator=generator, dtype=torch.float64) * 2 - 1
    points = torch.tensor(CENTER, dtype=torch.float64) + half * points
    inside = torch.ones(samples, dtype=torch.bool)
    for camera in cameras:
        inside &= hits(camera, points - camera.position)
    return float(inside.double().mean() * 8 * half.prod())


def main(arguments: Sequence[str] | None = None) -> dict[str, float]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--resolution", type=int, default=256)
    parser.add_argument("--cameras", type=int, default=24)
    parser.add_argument("--smoke", action="store_true", help="seconds: small pictures, a coarse grid")
    options = parser.parse_args(arguments)
    scale = 0.2 if options.smoke else 1.0
    resolution, count = (40, 8) if options.smoke else (options.resolution, options.cameras)
    size = {"focal": 600.0 * scale, "width": round(640 * scale), "height": round(480 * scale)}
    cameras = camera_ring(CENTER, 1.2, count, **size)
    masks = [hits(camera, camera.directions(camera.pixel_grid())) for camera in cameras]
    started = time.perf_counter()
    hull = visual_hull(masks, cameras, resolution=resolution)
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
    print(f"visual hull at {resolution}^3 from {count} cameras of {size['width']} x {size['height']} pixels")
    for name, value in figures.items():
        print(f"  {name:24s} {value:.4g}")
    return figures


if __name__ == "__main__":
    main()
