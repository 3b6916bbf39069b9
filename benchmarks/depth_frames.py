"""A hand in depth pictures: real ones, cut to the hand and whole, made-up ones with and without free space, and tracks.

    python benchmarks/depth_frames.py --data SHARED   # every figure; an hour on a busy core, less with --only
    python benchmarks/depth_frames.py --smoke         # a made-up cloud, picture and short track, to see that it runs

- cut, whole: SHARED/hand_depth, a right hand before a body, fingertips marked by eye; no start. Cut to what is within
  19 cm of the middle fingertip, and as they are. A tip's error is its distance from the mark at the depth there; the
  marks lie on the skin, the model's tips at the end of its bones. Bars: cut, 90 % of the tips within 15 mm, 7 of 8
  pictures whole; whole, 75 % and 6 of 8; no picture with a tip over 40 mm off may count as usable.
- clouds: hands of any rotation from one side, 15 % outliers, no start; with --data a fifth as many of a robot arm and
  of a fox. Bars: 95 % right, which is 15 mm on average (5.8 % of another shape's size), none converged and over 25 mm
  off, 80 % of the right ones converged, area under the curve of the confidence .85, 2 CPU seconds.
- landmarks: 300 points of one side and 21 keypoints in the picture, 5 pixels off, 10 % of them wrong: either and both.
- few: made-up pictures of which a side is cut off, with free space and as clouds alone: right, and flipped, which is
  over 60 mm off.
- track: a rendered sequence, tracked as clouds and as frames. Bar: 1.2 times as long.
"""

from __future__ import annotations

import argparse
import json
import time
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from confidence import Subject, area_under_curve, ends_of, other_subjects, picture, random_pose, subject
from torch import Tensor
from tqdm import tqdm

import torchreg as tr
from experiments.made_up.depth_noise import DepthNoise
from torchreg.datasets.hand import hand_motion, make_hand_cloud

TIPS = [4, 8, 12, 16, 20]
REACH, RIGHT, FAR, FLIPPED, UNUSABLE = 0.19, 0.015, 0.025, 0.06, 0.04
SENSOR = DepthNoise(quadratic=1e-3, step=1e-3, jitter=0.3, dropout=0.01)
FPS = 20.0
PARTS = ("cut", "whole", "clouds", "landmarks", "few", "track")
OTHERS = 5  # times as many hands as other things
PIXELS, WRONG, WRONG_PIXELS, NUM_BESIDE = 5.0, 0.1, 60.0, 300


@dataclass(frozen=True)
class Outcome:
    """An alignment: errors of the ends (L,), metres of a hand of that size, status, confidence, CPU seconds."""

    name: str
    errors: Tensor
    status: tr.Status
    confidence: float
    seconds: float

    @property
    def mean(self) -> float:
        """Mean error, metres."""
        return float(self.errors.mean())


def aligned(
    name: str,
    shape: tr.ArticulatedShape,
    skin: tr.LinearBlendSkin,
    data: Any,
    ends: Tensor,
    size: float = 1.0,
    **told: Any,
) -> Outcome:
    """Return the outcome of an alignment to data, with the ends (L, 3) of the limbs known, on a shape of a size."""
    begin = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = tr.align(shape, data, model_points=skin, **told)
    seconds = time.process_time() - begin
    errors = (ends_of(shape, skin, found.pose) - ends.to(found.pose)).norm(dim=-1) / size
    return Outcome(name, errors, found.status, float(found.confidence), seconds)


def marked_tips(frame: tr.DepthFrame, marks: dict[str, list[int]]) -> Tensor:
    """Return the positions (5, 3) of marked pixels, by the median depth of the 25 pixels around each."""
    pixels = torch.tensor(list(marks.values()), dtype=torch.float64)
    depths = []
    for column, row in pixels.long().tolist():
        near = frame.depth[row - 2 : row + 3, column - 2 : column + 3]
        depths.append(near[near > 0].median())
    return frame.camera.unproject(pixels, torch.stack(depths).double())


def real_pictures(hand: tr.Hand, skin: tr.LinearBlendSkin, data: Path, *, cut: bool) -> list[Outcome]:
    """Return the outcomes for the pictures of a folder."""
    marks, outcomes = json.loads((data / "fingertips_px.json").read_text(encoding="utf-8")), []
    for name in tqdm(marks, desc="cut" if cut else "whole", leave=False, disable=None):
        frame = tr.DepthFrame.load(data / f"{name}.png", data / "camera.json")
        tips = marked_tips(frame, marks[name])
        if cut:
            points = frame.camera.unproject(frame.camera.pixel_grid(), frame.depth.double())
            frame = frame.cropped((frame.depth > 0) & ((points - tips[2]).norm(dim=-1) < REACH))
        outcomes.append(aligned(name, hand, skin, frame, tips))
    return outcomes


def clouds(thing: Subject, count: int, hand_size: float) -> list[Outcome]:
    """Return outcomes of one-sided clouds of a shape, its errors in those of a hand as large."""
    outcomes, scale = [], thing.size / hand_size
    for seed in tqdm(range(count), desc=thing.name, leave=False, disable=None):
        generator = torch.Generator().manual_seed(seed)
        pose = random_pose(thing.shape, thing.size, generator)
        cloud = make_hand_cloud(
            thing.shape, pose, noise=0.0015 * scale, outlier_ratio=0.15, camera=torch.zeros(3),
            skin=thing.truths[0][1], generator=generator,
        )  # fmt: skip
        ends = ends_of(thing.shape, thing.skin, pose)
        outcomes.append(aligned(str(seed), thing.shape, thing.skin, cloud.points, ends, size=scale))
    return outcomes


def landmarks(hand: tr.Hand, thing: Subject, count: int) -> dict[str, list[Outcome]]:
    """Return outcomes of few points, of keypoints in the picture, and of both."""
    kinds: dict[str, list[Outcome]] = {"points": [], "keypoints": [], "both": []}
    for seed in tqdm(range(count), desc="landmarks", leave=False, disable=None):
        generator = torch.Generator().manual_seed(20_000 + seed)
        pose = random_pose(hand, thing.size, generator)
        frame = picture(thing.truths[0][1], pose, generator, sensor=SENSOR)
        step = max(1, round((int(frame.measured.sum()) / NUM_BESIDE) ** 0.5))
        thin = torch.zeros_like(frame.measured)
        thin[::step, ::step] = frame.measured[::step, ::step]
        frame = tr.DepthFrame(torch.where(thin, frame.depth, 0.0), frame.camera, frame.mask)
        with torch.no_grad():
            truth = hand.keypoints(pose)
        pixels = frame.camera.project(truth.double())[0].float()
        pixels += PIXELS * torch.randn(pixels.shape, generator=generator)
        wrong = torch.rand(len(pixels), generator=generator) < WRONG
        pixels[wrong] += WRONG_PIXELS * torch.randn(int(wrong.sum()), 2, generator=generator)
        told = {"keypoints": pixels, "keypoint_std": PIXELS}
        for name, data, beside in (
            ("points", frame, {}), ("keypoints", frame.camera, told), ("both", frame, told),
        ):  # fmt: skip
            kinds[name].append(aligned(str(seed), hand, thing.skin, data, truth[TIPS], **beside))
    return kinds


def few_fingers(hand: tr.Hand, thing: Subject, count: int) -> tuple[list[Outcome], list[Outcome]]:
    """Return outcomes with free space and without, of the same pictures."""
    kinds: tuple[list[Outcome], list[Outcome]] = ([], [])
    for seed in tqdm(range(count), desc="few fingers", leave=False, disable=None):
        generator = torch.Generator().manual_seed(10_000 + seed)
        pose = random_pose(hand, thing.size, generator)
        frame = picture(thing.truths[0][1], pose, generator, cut=1.0)
        with torch.no_grad():
            tips = hand.keypoints(pose)[TIPS]
        for outcomes, data in zip(kinds, (frame, frame.points), strict=True):
            outcomes.append(aligned(str(seed), hand, thing.skin, data, tips))
    return kinds


def track(hand: tr.Hand, thing: Subject, count: int) -> str:
    """Return the table of a sequence tracked as frames and as clouds."""
    poses, generator = hand_motion(hand, "bend", count, FPS), torch.Generator()
    frames = [picture(thing.truths[0][1], pose, generator, sensor=SENSOR) for pose in poses]
    with torch.no_grad():
        truth = hand.keypoints(poses)[:, TIPS]
    lines = []
    for name, data in (("clouds", [frame.points for frame in frames]), ("frames", frames)):
        begin = time.process_time()
        found = tr.Tracker(hand, poses[0]).run(data)
        seconds = (time.process_time() - begin) / count
        errors = 1e3 * (found.keypoints[:, TIPS] - truth).norm(dim=-1)
        counts = Counter(status.value for status in found.statuses)
        lines.append(
            f"track, {name}: tips {errors.mean():.1f} mm, 90 % {errors.quantile(0.9):.1f}, largest {errors.max():.1f}; "
            f"{1 / seconds:.0f} frames per CPU second; {dict(counts)}"
        )
    return "\n".join(lines)


def pictures_table(name: str, outcomes: Sequence[Outcome], share: float, whole: int) -> str:
    """Return the lines of real pictures against their bars."""
    near = torch.stack([outcome.errors <= RIGHT for outcome in outcomes])
    wrong = [o.name for o in outcomes if o.status.usable and float(o.errors.max()) > UNUSABLE]
    good = [o for o in outcomes if bool((o.errors <= RIGHT).all())]
    lines = [
        f"  {o.name}: {', '.join(f'{1e3 * error:.0f}' for error in o.errors.tolist())} mm, {o.status.value}, "
        f"confidence {o.confidence:.2f}, {o.seconds:.1f} CPU s"
        for o in outcomes
    ]
    passed = float(near.double().mean()) >= share and len(good) >= whole and not wrong
    usable = sum(o.status.usable for o in good)
    lines.append(
        f"{name}: {near.double().mean():.0%} of the tips within 15 mm, {len(good)} of {len(outcomes)} pictures whole, "
        f"{usable} of these usable; usable but over 40 mm off: {wrong or 'none'}: {'pass' if passed else 'FAIL'}"
    )
    return "\n".join(lines)


def line_of(name: str, outcomes: Sequence[Outcome]) -> str:
    """Return a line about made-up data."""
    surest = torch.tensor([outcome.confidence for outcome in outcomes])
    errors = torch.tensor([outcome.mean for outcome in outcomes])
    sure = torch.tensor([outcome.status is tr.Status.CONVERGED for outcome in outcomes])
    seconds = torch.tensor([outcome.seconds for outcome in outcomes])
    right = errors <= RIGHT
    return (
        f"{name}: {len(outcomes)} cases, {right.double().mean():.0%} right, {int((errors > FLIPPED).sum())} flipped; "
        f"converged: {sure[right].double().mean():.0%} of the right ones, {int((sure & (errors > FAR)).sum())} over 25 "
        f"mm off; area under the curve {area_under_curve(surest, right):.2f}; median {1e3 * errors.median():.1f} mm, "
        f"{seconds.median():.1f} CPU s"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder with hand_depth")
    parser.add_argument("--only", choices=PARTS, nargs="*", default=PARTS)
    parser.add_argument("--count", type=int, default=100, help="made-up hands of each kind")
    parser.add_argument("--frames", type=int, default=200, help="of the track")
    parser.add_argument("--smoke", action="store_true")
    options = parser.parse_args(arguments)
    count, frames = (1, 3) if options.smoke else (options.count, options.frames)
    if options.smoke:
        options.only = [part for part in PARTS if part != "few"]
    hand = tr.Hand()
    known = subject("hand", hand)
    bars = {"cut": (0.9, 7), "whole": (0.75, 6)}
    for name in [part for part in bars if part in options.only]:
        if options.data is None:
            print(f"{name}: left out without --data")
        else:
            found = real_pictures(hand, known.skin, options.data / "hand_depth", cut=name == "cut")
            print(pictures_table(name, found, *bars[name]))
    if "clouds" in options.only:
        print(line_of("clouds", clouds(known, count, known.size)))
        for thing in other_subjects(options.data):
            print(line_of(f"clouds of the {thing.name}", clouds(thing, -(-count // OTHERS), known.size)))
    if "landmarks" in options.only:
        for name, found in landmarks(hand, known, -(-count // OTHERS)).items():
            print(line_of(f"landmarks, {name}", found))
    if "few" in options.only:
        for name, found in zip(("with free space", "clouds alone"), few_fingers(hand, known, count), strict=True):
            print(line_of(f"few fingers, {name}", found))
    if "track" in options.only:
        print(track(hand, known, frames))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
