"""How often a hand is found without a start, how sure the answer is of itself, and how long it takes.

    python benchmarks/find_pose.py            # every figure
    python benchmarks/find_pose.py --smoke    # a cloud of each case, to see that it runs
    python benchmarks/find_pose.py --rig RIG.glb [--initializer WEIGHTS.safetensors]     # clouds of a rig instead

Data: 500 points of a hand half a metre away, turned in any way, each joint bent by up to half its range, 1.5 mm noise
on each coordinate. A cloud is right if its fingertips are off by at most 10 mm on average.

- whole: the whole surface. Bar: 95 % right.
- front: the side that a camera sees, and outliers, 10 % of all points. Bar: 80 % right. A finger that the camera does
  not see may be anywhere; "seen" judges by the fingertips alone that have at least 4 points on the last phalanx.

Bar for the time: 2 s each, on two cores.

- rig: clouds of 600 points at most as a network is trained on, see `torchreg train-initializer`, found by the search,
  and by the network where one is given; then aligned without a search. Right: points of the surface off by at most 5 %
  of the size on average. And clouds of the rig's own clip, in its first second: 540 points of the side that a camera
  sees, turned in any way, with noise of .3 % of the size and 5 % outliers.

The second table says how far `PoseStarts.confidence` can be trusted: of the clouds in a bin, the share that is right.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import torch
from shape_fit import one_sided_scan
from torch import Tensor
from tqdm import tqdm

import torchreg as tr
from torchreg.alignment.search.pose_proposer import PoseProposer
from torchreg.datasets.cloud_batches import random_clouds, random_poses
from torchreg.datasets.hand import HandCloud, make_hand_cloud, surface_skin
from torchreg.errors import FormatError
from torchreg.geometry.rotation_representations import rotation_from_quaternion

NOISE, OUTLIERS, NUM_POINTS, DISTANCE, BEND = 0.0015, 0.1, 500, 0.5, 0.5
TIPS, MIN_SEEN = [4, 8, 12, 16, 20], 4
RIGHT = 0.01
CLIP_POINTS, CLIP_NOISE = 540, 0.003
RIGHT_OF_RIG, RIG_POINTS, RIG_SURFACE = 0.05, 600, 3000
CASES = ("whole", "front")
BARS, BAR_SECONDS = {"whole": 0.95, "front": 0.8}, 2.0
BINS = (0.0, 0.2, 0.4, 0.6, 0.8, 0.9, 1.0)


@dataclass(frozen=True)
class Row:
    """All clouds of a case.

    Args:
        case: "whole" or "front".
        errors: (N, 5) of the fingertips, metres.
        seen: (N, 5) which of them have data.
        confidence: (N,).
        seconds: (N,).
    """

    case: str
    errors: Tensor
    seen: Tensor
    confidence: Tensor
    seconds: Tensor

    @property
    def right(self) -> Tensor:
        """Which clouds (N,) are right."""
        return self.errors.mean(-1) <= RIGHT

    @property
    def seen_right(self) -> Tensor:
        """Which clouds (N,) are right as far as the fingertips are seen; none of which are seen is right."""
        return (self.errors * self.seen).sum(-1) <= RIGHT * self.seen.sum(-1)

    @property
    def passed(self) -> bool:
        """Whether enough clouds are right."""
        return float(self.right.double().mean()) >= BARS[self.case]

    @property
    def fast(self) -> bool:
        """Whether the mean time is below its bar."""
        return float(self.seconds.mean()) < BAR_SECONDS


def random_pose(hand: tr.Hand, generator: torch.Generator) -> Tensor:
    """Return a pose of any rotation, uniformly, with each joint bent by up to half its range."""
    pose = hand.rest_pose()
    share = BEND * torch.rand(hand.num_dofs - 6, generator=generator)
    pose[6:] = share * hand.upper[6:].clamp_min(0)
    quaternion = torch.nn.functional.normalize(torch.randn(4, generator=generator, dtype=torch.float64), dim=0)
    angle = 2 * torch.atan2(quaternion[1:].norm(), quaternion[0])
    pose[3:6] = (angle * torch.nn.functional.normalize(quaternion[1:], dim=0)).to(pose)
    pose[2] = DISTANCE
    return hand.clamp(pose)


def make_cloud(hand: tr.Hand, case: str, surface: tr.LinearBlendSkin, generator: torch.Generator) -> HandCloud:
    front = case == "front"
    return make_hand_cloud(
        hand,
        random_pose(hand, generator),
        num_points=NUM_POINTS,
        noise=NOISE,
        outlier_ratio=OUTLIERS if front else 0.0,
        camera=torch.zeros(3) if front else None,
        skin=surface,
        generator=generator,
    )


def seen_tips(hand: tr.Hand, cloud: HandCloud) -> Tensor:
    counts = [(cloud.inliers & (cloud.part_labels == part)).sum() for part in hand.fingertip_parts]
    return torch.stack(counts) >= MIN_SEEN


def measure(hand: tr.Hand, case: str, count: int, seed: int) -> Row:
    """Return what `find_pose` makes, as it comes, of some clouds."""
    generator = torch.Generator().manual_seed(seed)
    surface, skin = surface_skin(hand), tr.sample_skin(hand)
    errors, seen, confidence, seconds = [], [], [], []
    for _ in tqdm(range(count), desc=case, leave=False, disable=None):
        cloud = make_cloud(hand, case, surface, generator)
        begin = time.perf_counter()
        starts = tr.find_pose(hand, cloud.points, model_points=skin)
        seconds.append(time.perf_counter() - begin)
        with torch.no_grad():
            errors.append((hand.keypoints(starts.best) - hand.keypoints(cloud.pose))[TIPS].norm(dim=-1))
        seen.append(seen_tips(hand, cloud))
        confidence.append(starts.confidence)
    times = torch.tensor(seconds, dtype=torch.float64)
    return Row(case, torch.stack(errors), torch.stack(seen), torch.stack(confidence), times)


@dataclass(frozen=True)
class RigRow:
    """All clouds of a rig by one way.

    Args:
        way: "search" or "network", or "clip", found by the search.
        errors: (N,) mean distance of points of the surface, as a share of the size.
        seconds: (N,) of CPU time.
    """

    way: str
    errors: Tensor
    seconds: Tensor

    def render(self) -> str:
        """Return a line."""
        right = float((self.errors <= RIGHT_OF_RIG).double().mean())
        return (
            f"{self.way:8} {len(self.errors)} clouds, within {RIGHT_OF_RIG:.0%}: {right:.0%}, median "
            f"{float(self.errors.median()):.1%}, {float(self.seconds.mean()):.1f} CPU s each"
        )


@torch.no_grad()
def measure_rig(shape: tr.ArticulatedShape, network: PoseProposer | None, count: int, seed: int) -> list[RigRow]:
    """Return how a rig is found by the search and, where there is one, by a network."""
    generator, skin = torch.Generator().manual_seed(seed), tr.sample_skin(shape, RIG_SURFACE)
    rest = skin(shape.rest_pose())
    size = float((rest.amax(0) - rest.amin(0)).norm())
    batch = random_clouds(skin, size, random_poses(shape, count, generator), RIG_POINTS, generator)
    truth, rows = skin(batch.poses), []
    for way in ("search",) if network is None else ("search", "network"):
        errors, seconds = [], []
        for points, mask, wanted in zip(batch.points, batch.mask, truth, strict=True):
            begin = time.process_time()
            start = tr.find_pose(shape, points[mask], initializer=network if way == "network" else None).poses[0]
            found = tr.align(shape, points[mask], start, config=tr.AlignConfig(search="never"))
            seconds.append(time.process_time() - begin)
            errors.append((skin(found.pose) - wanted).norm(dim=-1).mean() / size)
        rows.append(RigRow(way, torch.stack(errors), torch.tensor(seconds)))
    return rows


@torch.no_grad()
def measure_clip(shape: tr.ArticulatedShape, file: Path, count: int, seed: int) -> RigRow | None:
    """Return how a rig is found in clouds of its own clip; None without one, or where it moves other vertices."""
    generator, errors, seconds = torch.Generator().manual_seed(seed), [], []
    rest = shape.vertices(shape.rest_pose())
    size = float((rest.amax(0) - rest.amin(0)).norm())
    for _ in range(count):
        try:
            mesh = tr.load_mesh(file, time=float(torch.rand((), generator=generator)))
        except FormatError:
            return None
        if mesh.vertices.shape != rest.shape:
            return None
        turn = rotation_from_quaternion(torch.randn(4, generator=generator, dtype=torch.float64))
        turned = tr.TriangleMesh(mesh.vertices.double() @ turn.mT, mesh.faces)
        points = one_sided_scan(turned, CLIP_NOISE * size, CLIP_POINTS, generator).to(rest)
        begin = time.process_time()
        found = tr.align(shape, points, tr.find_pose(shape, points).poses[0], config=tr.AlignConfig(search="never"))
        seconds.append(time.process_time() - begin)
        errors.append((shape.vertices(found.pose) - turned.vertices.to(rest)).norm(dim=-1).mean() / size)
    return RigRow("clip", torch.stack(errors), torch.tensor(seconds))


def verdict(passed: bool) -> str:
    return "pass" if passed else "FAIL"


def render(rows: Sequence[Row]) -> str:
    """Return the table of all cases: shares of clouds, errors in millimeters, seconds."""
    lines = [f"{'data':6} {'clouds':>6} {'right':>6} {'seen':>6} {'hidden':>6} {'median':>6} {'p90':>6} {'s':>6}"]
    for row in rows:
        errors = 1e3 * row.errors.mean(-1).double()
        shares = row.right.double().mean(), row.seen_right.double().mean(), 1 - row.seen.double().mean()
        line = f"{row.case:6} {len(errors):6} " + " ".join(f"{share:6.1%}" for share in shares)
        line += f" {errors.median():6.1f} {errors.quantile(0.9):6.1f} {row.seconds.mean():6.2f}"
        line += f"  right >= {BARS[row.case]:.0%}: {verdict(row.passed)}, < {BAR_SECONDS:g} s: {verdict(row.fast)}"
        lines.append(line)
    return "\n".join(lines)


def reliability(rows: Sequence[Row]) -> str:
    """Return the table of confidence against the share that is right, over all clouds of the cases together."""
    confidence = torch.cat([row.confidence for row in rows])
    right = torch.cat([row.right for row in rows]).double()
    seen = torch.cat([row.seen_right for row in rows]).double()
    lines = [f"{'confidence':12} {'clouds':>6} {'mean':>6} {'right':>6} {'seen':>6}"]
    for low, high in pairwise(BINS):
        inside = (confidence >= low) & ((confidence < high) | (high == BINS[-1]))
        if bool(inside.any()):
            figures = confidence[inside].mean(), right[inside].mean(), seen[inside].mean()
            lines.append(
                f"{low:.1f} to {high:.1f}   {int(inside.sum()):6} {figures[0]:6.2f} {figures[1]:6.1%} {figures[2]:6.1%}"
            )
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> list[Row]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clouds", type=int, default=100, help="of each case (default 100)")
    parser.add_argument("--case", choices=(*CASES, "both"), default="both")
    parser.add_argument("--threads", type=int, default=2, help="of torch (default 2)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--smoke", action="store_true", help="a cloud of each case")
    parser.add_argument("--rig", type=Path, help="rigged glTF file to find instead of hands")
    parser.add_argument("--initializer", type=Path, help="weights of a network for the rig")
    options = parser.parse_args(arguments)
    torch.set_num_threads(options.threads)
    if options.rig is not None:
        shape = tr.ArticulatedShape.from_gltf(options.rig)
        network = None if options.initializer is None else PoseProposer.load(options.initializer, shape)
        count = 1 if options.smoke else options.clouds
        clip = measure_clip(shape, options.rig, count, options.seed)
        for row in [*measure_rig(shape, network, count, options.seed), *([] if clip is None else [clip])]:
            print(f"{options.rig.stem:24} {row.render()}")
        return []
    hand, count = tr.Hand(), 1 if options.smoke else options.clouds
    cases = CASES if options.case == "both" else (options.case,)
    rows = [measure(hand, case, count, options.seed) for case in cases]
    print("clouds right: mean distance of the fingertips at most 10 mm; seed", options.seed)
    print(render(rows))
    print(reliability(rows))
    return rows


if __name__ == "__main__":
    main()
