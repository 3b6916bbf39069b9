"""A moving hand from rendered stereo pictures: corners and their errors, dense disparity beside OpenCV's, the tracker.

    python benchmarks/stereo_pictures.py                  # three motions of 100 frames, 640 x 480; renders for minutes
    python benchmarks/stereo_pictures.py --folder FOLDER  # keeps the pictures there, and finds them there again
    python benchmarks/stereo_pictures.py --smoke          # seconds: one frame of 160 pixels, our own matcher alone

A hand with its forearm at 0.6 m, 120 mm baseline, 20 frames/s, a wall behind. Bars: 500 to 1,000 corners per pair,
median error of the points at most 3 mm, at least 95 % of them within three of their stated deviations. Dense disparity
of both matchers stands side by side on some of the pairs: error and time. The tracker gets these points alone, and no
first pose: mean error of the fingertips at most 5 mm, never lost but in a flip.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torchreg as tr
from experiments.made_up.pictures import PictureStyle, stereo_cameras
from experiments.made_up.videos import shape_video
from torchreg.capture.disparity import match_disparity
from torchreg.datasets.hand import hand_motion, surface_skin
from torchreg.geometry.rotation import compose_rotation_vectors
from torchreg.io.clouds.npz import save_arrays
from torchreg.io.images import save_image

MOTIONS = ("rotation", "bending_palm", "flip")
TIPS = [4, 8, 12, 16, 20]
NEAREST, FARTHEST, WALL, DISTANCE, FPS = 0.45, 0.8, 0.95, 0.6, 20.0
# Where there are fewer corners, textured places between them stand in.
LEAST = 500
# The palm turns faster than this, radians per frame, during a flip.
FLIPPING = 0.06


def rendered(folder: Path, motion: str, poses: Tensor, hand: tr.Hand, pair: tr.StereoPair) -> None:
    """Write the pictures and true depths of a motion, unless they are there."""
    done = folder / "done"
    if done.exists():
        return
    for name in ("left", "right", "truth"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    frames = shape_video(hand, poses, pair, skin=surface_skin(hand), style=PictureStyle(wall=WALL))
    for number, (left, right) in enumerate(tqdm(frames, desc=motion, total=len(poses), leave=False, disable=None)):
        save_image(folder / "left" / f"{number:04d}.png", left.image)
        save_image(folder / "right" / f"{number:04d}.png", right.image)
        truth = {"depth": left.depth.float(), "mask": left.mask}
        save_arrays(folder / "truth" / f"{number:04d}.npz", truth)
    done.touch()


def truth_of(folder: Path, number: int) -> tuple[Tensor, Tensor]:
    """Return the true depth (H, W) of the left picture, and which pixels show the hand."""
    import numpy as np

    with np.load(folder / "truth" / f"{number:04d}.npz") as file:
        return torch.from_numpy(file["depth"]), torch.from_numpy(file["mask"])


def point_figures(frames: tr.StereoFrames, folder: Path) -> dict[str, float]:
    """Return what the points of a sequence are worth."""
    counts, errors, inside, on_hand, seconds = [], [], [], [], []
    for number in tqdm(range(len(frames)), desc="points", leave=False, disable=None):
        started = time.perf_counter()
        found = frames.sight(number).corners
        seconds.append(time.perf_counter() - started)
        depth, mask = truth_of(folder, number)
        column, row = found.pixels.long().unbind(-1)
        # The pixel is right: what is off lies along its ray.
        error = (found.points - frames.pair.left.unproject(found.pixels, depth[row, column])).norm(dim=-1)
        counts.append(len(found))
        errors.append(error)
        inside.append((frames.pair.left.project(found.points)[1] - depth[row, column]).abs() <= 3 * found.depth_std)
        on_hand.append(int(mask[row, column].sum()))
    count = torch.tensor(counts, dtype=torch.float64)
    return {
        "corners per pair, mean": float(count.mean()),
        "corners per pair, least": float(count.min()),
        "corners per pair, most": float(count.max()),
        "of them on the hand, mean": float(torch.tensor(on_hand).double().mean()),
        "median 3-D error, mm (<= 3)": 1e3 * float(torch.cat(errors).median()),
        "within 3 sigma, % (>= 95)": 100 * float(torch.cat(inside).double().mean()),
        "seconds per pair": sum(seconds) / len(seconds),
    }


def track_figures(hand: tr.Hand, poses: Tensor, frames: tr.StereoFrames, flips: bool) -> dict[str, float]:
    """Return how well the tracker follows the hand on these points alone."""
    times = [number / FPS for number in range(len(frames))]
    clouds = tqdm(frames, desc="tracking", leave=False, disable=None)
    result = tr.Tracker(hand).run(clouds, times=times)
    errors = 1e3 * (result.keypoints - hand.keypoints(poses)).norm(dim=-1)[:, TIPS]
    turns = compose_rotation_vectors(poses[1:, 3:6], -poses[:-1, 3:6]).norm(dim=-1)
    # With a tenth of a second before and after.
    flipping = torch.nn.functional.pad((turns > FLIPPING).float(), (3, 2)).unfold(0, 5, 1).amax(-1) > (
        0 if flips else 1
    )
    lost = torch.tensor([not status.usable for status in result.statuses])
    return {
        "fingertips, mean mm (<= 5)": float(errors.mean()),
        "fingertips outside flips, mean mm": float(errors[~flipping].mean()),
        "fingertips, median mm": float(errors.median()),
        "frames with a mean over 5 mm": int((errors.mean(1) > 5).sum()),
        "frames lost": int(lost.sum()),
        "frames lost outside flips (0)": int((lost & ~flipping).sum()),
    }


def dense_figures(
    frames: tr.StereoFrames, folder: Path, methods: Sequence[str], count: int
) -> dict[str, dict[str, float]]:
    """Return error and time of each matcher's dense disparity, everywhere and on the hand, on some of the pairs."""
    rows: dict[str, list[list[float]]] = {method: [] for method in methods}
    pair = frames.pair
    highest = int(pair.disparity(torch.tensor(NEAREST))) + 2
    for number in range(0, len(frames), max(1, len(frames) // count)):
        left, right = frames.pictures(number)
        depth, mask = truth_of(folder, number)
        for method in methods:
            started = time.perf_counter()
            dense = match_disparity(left, right, highest, method=method)
            seconds = time.perf_counter() - started
            error = (dense - pair.disparity(depth)).abs()
            known = error.isfinite()
            figures = (
                error[known].median(), error[known & mask].median(), known.float().mean(), known[mask].float().mean(),
                (error[known] > 1).float().mean(), (error[known & mask] > 1).float().mean(),
            )  # fmt: skip
            rows[method].append([*(float(value) for value in figures), seconds])
    names = (
        "median error, px", "median error on the hand, px", "pixels known", "of the hand known",
        "of them off by a pixel", "of those of the hand", "seconds per pair",
    )  # fmt: skip
    return {
        f"disparity, {method}": dict(zip(names, torch.tensor(rows[method]).nanmean(0).tolist(), strict=True))
        for method in methods
    }


def main(arguments: Sequence[str] | None = None) -> dict[str, dict[str, float]]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, help="where pictures are kept; by default a folder of the system's")
    parser.add_argument("--motions", nargs="+", choices=MOTIONS, default=MOTIONS)
    parser.add_argument("--frames", type=int, default=100, help="at 20/s")
    parser.add_argument("--focal", type=float, default=800.0, help="pixels")
    parser.add_argument("--dense", type=int, default=5, help="pairs of each motion for the matchers side by side")
    parser.add_argument("--matcher", help="what points come from: opencv where it is installed, or semi-global")
    parser.add_argument("--smoke", action="store_true", help="seconds: one frame of 160 pixels, our own matcher alone")
    options = parser.parse_args(arguments)
    count, motions, width = (1, MOTIONS[:1], 160) if options.smoke else (options.frames, options.motions, 640)
    methods = ["semi-global"]
    if not options.smoke and importlib.util.find_spec("cv2"):
        methods.append("opencv")
    matcher = options.matcher or methods[-1]
    focal = options.focal * width / 640
    pair = stereo_cameras(width=width, height=width * 3 // 4, focal=focal)
    hand = tr.Hand().requires_grad_(False)
    results: dict[str, dict[str, float]] = {}
    with tempfile.TemporaryDirectory() as place:
        for motion in motions:
            name = f"{motion}_{count}_{width}_{options.focal:g}"
            folder = (Path(place) if options.smoke else options.folder or _kept()) / name
            poses = hand_motion(hand, motion, count, FPS, distance=DISTANCE)
            rendered(folder, motion, poses, hand, pair)
            config = tr.StereoConfig(nearest=NEAREST, farthest=FARTHEST, method=matcher, least=LEAST)
            frames = tr.StereoFrames(folder / "left", folder / "right", pair, config=config, reach=hand.length)
            found = {f"{motion}, points by {matcher}": point_figures(frames, folder)}
            if not options.smoke:
                found[f"{motion}, tracker"] = track_figures(hand, poses, frames, motion == "flip")
            for key, figures in dense_figures(frames, folder, methods, options.dense).items():
                found[f"{motion}, {key}"] = figures
            for title, figures in found.items():
                print(title, *(f"  {what:36s} {value:.4g}" for what, value in figures.items()), sep="\n", flush=True)
            results |= found
    return results


def _kept() -> Path:
    return Path(tempfile.gettempdir()) / "torchreg-stereo-pictures"


if __name__ == "__main__":
    main()
