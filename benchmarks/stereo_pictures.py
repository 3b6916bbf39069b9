"""Errors of stereo points on rendered pictures of a moving hand, and of the dense disparity beside OpenCV's."""

from __future__ import annotations

import argparse
import importlib.util
import time
from collections.abc import Sequence

import torch

from torchreg.capture.stereo import StereoConfig, stereo_points
from torchreg.datasets.hand import hand_motion, surface_skin
from torchreg.datasets.pictures import PictureStyle, hand_pictures, stereo_cameras
from torchreg.models.hand import Hand


def main(arguments: Sequence[str] | None = None) -> dict[str, dict[str, float]]:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=5, help="spread over a motion of 100 frames at 20/s")
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--smoke", action="store_true", help="seconds: one frame of 160 pixels, our own matcher alone")
    options = parser.parse_args(arguments)
    frames, width = (1, 160) if options.smoke else (options.frames, options.width)
    methods = ["semi-global"]
    if not options.smoke and importlib.util.find_spec("cv2"):
        methods.append("opencv")
    pair = stereo_cameras(width=width, height=width * 3 // 4, focal=width * 600 / 640)
    hand = Hand().requires_grad_(False)
    skin = surface_skin(hand)
    poses = hand_motion(hand, "bending_palm", 100, distance=0.6)[:: max(1, 100 // frames)][:frames]
    rows: dict[str, list[list[float]]] = {method: [] for method in methods}
    for frame, pose in enumerate(poses):
        left, right = hand_pictures(hand, pose, pair, skin=skin, style=PictureStyle(wall=0.95), seed=frame)
        for method in methods:
            started = time.perf_counter()
            config = StereoConfig(nearest=0.45, farthest=0.8, method=method)
            found = stereo_points(left.image, right.image, pair, config=config)
            seconds = time.perf_counter() - started
            column, row = found.pixels.long().unbind(-1)
            error = (pair.left.project(found.points)[1] - left.depth[row, column]).abs()
            dense = (found.dense - pair.disparity(left.depth)).abs()
            inside, known = (error <= 3 * found.depth_std).float().mean(), dense.isfinite()
            wrong = (dense[known] > 1).float().mean()
            figures = (len(found), 1e3 * error.median(), 100 * inside, dense.nanmedian(), known.float().mean(), wrong)
            rows[method].append([float(value) for value in (*figures, seconds)])
    names = ("points", "median depth error, mm", "within 3 sigma, %", "median disparity error, px", "pixels known", "of them off by a pixel", "seconds")  # fmt: skip # noqa: E501
    results = {}
    for method in methods:
        means = torch.tensor(rows[method]).nanmean(0).tolist()
        results[method] = dict(zip(names, means, strict=True))
        print(f"{method}, {frames} frames of {width} x {width * 3 // 4} pixels")
        for name, value in results[method].items():
            print(f"  {name:28s} {value:.4g}")
    return results


if __name__ == "__main__":
    main()
