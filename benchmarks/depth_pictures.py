"""Range scans from depth images: reprojection, normals under sensor noise, and registration beside exact scans.

    python benchmarks/depth_pictures.py            # some minutes
    python benchmarks/depth_pictures.py --smoke    # seconds: small pictures, no registration

- reprojection: points of a scan from a 16-bit picture against the middles of their pixels, through a lens that distorts
  and a camera that stands somewhere. Bar: half a pixel.
- normals: a sphere of 15 cm and a cylinder of 12 cm radius at one metre, 640 x 480 pixels, by two kinds of sensors.
  Bar: 5 degrees, median.
- registration: toys in two poses, turned at their joints by up to 30 degrees, from exact scans and from depth images of
  the same poses: rendered, with noise, steps, flying pixels and holes, rounded to 16 bits, filtered. Mean errors are
  taken at the points of the exact scan, shares of the diagonal. Bar for the depth camera: 10 % over the exact one's.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torchreg as tr
from experiments.made_up.depth_noise import DepthNoise
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.datasets.scan_sequences import ScanSequence, jointed_toy
from torchreg.geometry.rigid import se3_exp
from torchreg.geometry.visibility import View, rasterize
from torchreg.io.calibration import save_depth_camera
from torchreg.io.images import save_depth

# A tenth of a millimetre per step: 16 bits reach 6.5 m.
STEP = 1e-4
SENSORS = {"structured light": DepthNoise.structured_light(), "time of flight": DepthNoise.time_of_flight()}
# A stereo depth camera of today at one metre: 0.2 mm noise and steps, flying pixels, holes.
GOOD = DepthNoise(quadratic=2e-4, step=2e-4, jitter=0.3, flying=0.3, dropout=0.005)
# Metres of noise at one metre above which depths are smoothed; it costs detail.
SMOOTHED = 1e-3


def reprojection(size: int) -> dict[str, float]:
    """Return how far points of a scan are from the middles of pixels, in pixels."""
    motion = se3_exp(torch.tensor([0.1, -0.2, 0.3, 0.4, -0.3, 0.2], dtype=torch.float64))
    focal = 0.9 * size
    numbers = torch.tensor([focal, 1.01 * focal, 0.49 * size, 0.37 * size], dtype=torch.float64)
    camera = tr.Camera(size, size * 3 // 4, numbers, motion, numbers.new_tensor([-0.15, 0.05, 1e-3, -1e-3, 0.0]))
    column, row = camera.pixel_grid().unbind(-1)
    depth = 1 + 0.2 * torch.sin(6 * column / size) * torch.cos(5 * row / size)
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        save_depth(place / "d.png", depth, STEP)
        save_depth_camera(place / "k.json", camera, STEP)
        scan = tr.load_depth_scan(place / "d.png", place / "k.json")
    pixels, found = camera.project(scan.points.double())
    off = (pixels - pixels.round()).norm(dim=-1)
    column, row = pixels.round().long().unbind(-1)
    return {
        "points": len(scan.points),
        "farthest from its pixel, px (<= 0.5)": float(off.max()),
        "largest error of depth, mm": 1e3 * float((found - depth[row, column]).abs().max()),
    }


def sphere(camera: tr.Camera) -> tuple[Tensor, Tensor]:
    """Return depth (H, W) and normals (H, W, 3) of a sphere of 15 cm at one metre; depth is zero beside it."""
    rays = camera.directions(camera.pixel_grid())
    square, along = (rays**2).sum(-1), rays[..., 2]
    inside = along**2 - square * (1 - 0.15**2)
    depth = torch.where(inside > 0, (along - inside.clamp(min=0).sqrt()) / square, 0.0)
    normals = (depth.unsqueeze(-1) * rays - rays.new_tensor([0.0, 0.0, 1.0])) / 0.15
    return depth, normals


def cylinder(camera: tr.Camera) -> tuple[Tensor, Tensor]:
    """Return the same of an upright cylinder of 12 cm."""
    rays = camera.directions(camera.pixel_grid())
    flat = rays * rays.new_tensor([1.0, 0.0, 1.0])
    square, along = (flat**2).sum(-1), flat[..., 2]
    inside = along**2 - square * (1 - 0.12**2)
    depth = torch.where(inside > 0, (along - inside.clamp(min=0).sqrt()) / square, 0.0)
    normals = (depth.unsqueeze(-1) * flat - rays.new_tensor([0.0, 0.0, 1.0])) / 0.12
    return depth, normals


def normals(size: int) -> dict[str, float]:
    """Return median angles between the normals of scans and the true ones, degrees."""
    focal = 0.9 * size
    high = size * 3 // 4
    numbers = torch.tensor([focal, focal, 0.5 * (size - 1), 0.5 * (high - 1)], dtype=torch.float64)
    camera = tr.Camera(size, high, numbers)
    figures = {}
    for shape, solid in (("sphere", sphere), ("cylinder", cylinder)):
        depth, true = solid(camera)
        for name, sensor in SENSORS.items():
            measured = sensor.measured(depth, torch.Generator().manual_seed(1))
            scan = tr.depth_scan(measured, camera, smoothing=float(sensor.depth_std(torch.tensor(1.0))))
            column, row = camera.project(scan.points)[0].round().long().unbind(-1)
            on_it = depth[row, column] > 0
            cosine = (scan.normals * true[row, column]).sum(-1)[on_it].clamp(-1, 1)
            figures[f"{shape}, {name}, degrees (<= 5)"] = float(torch.rad2deg(cosine.arccos()).median())
    return figures


def depth_camera_scan(sequence: ScanSequence, frame: int, sensor: DepthNoise, finer: int, folder: Path) -> tr.RangeScan:
    """Return the scan that a depth image of a frame gives, through a file; noise of over a millimetre is smoothed."""
    view = sequence.view
    fine = View(view.position, view.rotation, view.corner, view.pitch / finer, finer * view.width, finer * view.height)
    depth = rasterize(sequence.mesh(frame), fine, cull_back=True).depth
    seen = sensor.measured(depth.where(depth.isfinite(), 0.0), torch.Generator().manual_seed(frame))
    focal = torch.full((2,), 1 / fine.pitch, dtype=torch.float64)
    camera = tr.Camera(fine.width, fine.height, torch.cat((focal, -fine.corner / fine.pitch - 0.5)))
    save_depth(folder / "d.png", seen, STEP)
    save_depth_camera(folder / "k.json", camera, STEP)
    noise = float(sensor.depth_std(torch.tensor(1.0)))
    return tr.load_depth_scan(folder / "d.png", folder / "k.json", smoothing=noise if noise > SMOOTHED else 0.0)


def registration(pairs: int, sensors: dict[str, DepthNoise], finer: int) -> dict[str, float]:
    """Return mean errors of registration, as shares of the diagonal, from exact scans and from depth images."""
    errors: dict[str, list[float]] = {name: [] for name in ("exact", *sensors)}
    seconds: dict[str, list[float]] = {name: [] for name in errors}
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(1, pairs + 1):
            scanner = DepthScanner(noise=0.0, num_holes=0)
            sequence = jointed_toy(2, seed=seed, scanner=scanner)
            pair = sequence.pair(0, 1)
            for name in errors:
                started = time.perf_counter()
                if name == "exact":
                    scans = [sequence[frame] for frame in range(2)]
                else:
                    scans = [
                        depth_camera_scan(sequence, frame, sensors[name], finer, Path(folder)) for frame in range(2)
                    ]
                found = tr.register(scans[0], scans[1])
                seconds[name].append(time.perf_counter() - started)
                with torch.no_grad():
                    errors[name].append(float(pair.error(found.model(pair.source.points)).mean()))
                print(f"  toy {seed}, {name}: {100 * errors[name][-1]:.3f} %", flush=True)
    figures = {}
    exact = sum(errors["exact"]) / pairs
    for name, values in errors.items():
        mean = sum(values) / pairs
        figures[f"{name}, mean error, %"] = 100 * mean
        if name != "exact":
            bar = " (<= 1.1)" if name == "depth camera" else ""
            figures[f"{name}, over the exact one{bar}"] = mean / exact
        figures[f"{name}, seconds"] = sum(seconds[name]) / pairs
    return figures


def main(arguments: Sequence[str] | None = None) -> dict[str, dict[str, float]]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=6, help="toys to be registered")
    parser.add_argument(
        "--finer", type=int, default=1, help="pixels of depth images per pixel of exact scans, each way"
    )
    parser.add_argument("--good", action="store_true", help="leave out the two kinds of noisy sensors")
    parser.add_argument("--smoke", action="store_true", help="seconds: small pictures, no registration")
    options = parser.parse_args(arguments)
    size = 320 if options.smoke else 640
    results = {"reprojection": reprojection(size), "normals": normals(size)}
    sensors = {"depth camera": GOOD} | ({} if options.good else SENSORS)
    if not options.smoke and options.pairs:
        results["registration"] = registration(options.pairs, sensors, options.finer)
    for title, figures in results.items():
        print(title, *(f"  {what:44s} {value:.4g}" for what, value in figures.items()), sep="\n")
    return results


if __name__ == "__main__":
    main()
