"""Inlier precision and recall of alignments of a hand with 0 to 60 % outliers.

    python benchmarks/outliers.py            # every figure
    python benchmarks/outliers.py --smoke    # one ratio, two clouds, to see that it runs

Data: 500 points of a random hand pose, on all sides or on the side that a camera sees, 1.5 mm noise, and outliers
uniform in the hand's bounding box grown by 5 cm. Starts: every joint 10 degrees off. Bar at 40 % outliers: precision
and recall >= 0.95.

Some outliers lie within the inlier distance of the true surface by chance: no distance to a surface tells them from
inliers. "near" is their share of all outliers, "limit" the precision and recall of the same distance around the truth.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from tqdm import tqdm

import torchreg as tr
from torchreg.datasets.hand import HandCloud, make_hand_cloud, random_hand_pose, surface_skin

NOISE, NUM_POINTS = 0.0015, 500
JOINT_OFF = math.radians(10)
RATIOS = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
BAR_RATIO, BAR = 0.4, 0.95
# The default inlier distance of AlignConfig, as a share of the model's size.
INLIER_SHARE = 0.02
VIEWS: dict[str, Tensor | None] = {"whole": None, "one side": torch.zeros(3)}


@dataclass(frozen=True)
class Row:
    """One line of the table: means over the trials, and the precision and recall (trials, 2) themselves."""

    view: str
    ratio: float
    scores: Tensor
    limits: Tensor
    near: float
    tip_error: float

    @property
    def passed(self) -> bool:
        """Whether mean precision and mean recall reach the bar."""
        return bool((self.scores.mean(0) >= BAR).all())


def precision_recall(found: Tensor, truth: Tensor) -> Tensor:
    """Return precision and recall (2,) of a labeling; precision is 1 where nothing was found."""
    right = (found & truth).sum().double()
    return torch.stack([right / found.sum() if bool(found.any()) else right.new_ones(()), right / truth.sum()])


def start_of(hand: tr.Hand, pose: Tensor, generator: torch.Generator) -> Tensor:
    start = pose.clone()
    start[6:] += JOINT_OFF * (2.0 * torch.randint(2, (hand.num_dofs - 6,), generator=generator) - 1.0)
    return hand.clamp(start)


def measure(
    hand: tr.Hand, skin: tr.LinearBlendSkin, view: str, ratio: float, clouds: list[tuple[HandCloud, Tensor]]
) -> Row:
    """Return the row of clouds with their starts."""
    distance = INLIER_SHARE * float((skin.points.amax(0) - skin.points.amin(0)).norm())
    config = tr.AlignConfig(inlier_distance=distance)
    scores, limits, near, tips = [], [], [], []
    for cloud, start in clouds:
        found = tr.align(hand, cloud.points, start, model_points=skin, config=config)
        with torch.no_grad():
            possible = hand.distance(cloud.points, cloud.pose).abs() < distance
            tips.append((found.keypoints - hand.keypoints(cloud.pose)).norm(dim=-1)[[4, 8, 12, 16, 20]])
        scores.append(precision_recall(found.inliers, cloud.inliers))
        limits.append(precision_recall(possible, cloud.inliers))
        near.append(possible[~cloud.inliers])
    share = float(torch.cat(near).double().mean()) if ratio > 0 else math.nan
    return Row(view, ratio, torch.stack(scores), torch.stack(limits), share, float(torch.cat(tips).median()))


def make_clouds(
    hand: tr.Hand, surface: tr.LinearBlendSkin, view: str, ratio: float, num_trials: int, seed: int
) -> list[tuple[HandCloud, Tensor]]:
    """Return clouds and starts; the same poses at every ratio and in both views."""
    clouds = []
    for number in range(num_trials):
        generator = torch.Generator().manual_seed(1000 * seed + number)
        pose = random_hand_pose(hand, generator)
        start = start_of(hand, pose, generator)
        cloud = make_hand_cloud(
            hand,
            pose,
            num_points=NUM_POINTS,
            noise=NOISE,
            outlier_ratio=ratio,
            camera=VIEWS[view],
            skin=surface,
            generator=generator,
        )
        clouds.append((cloud, start))
    return clouds


def render(rows: Sequence[Row]) -> str:
    """Return the table of all rows."""
    lines = [
        f"{'view':9} {'outliers':>8} | {'precision':>9} {'limit':>6} {'worst':>6} | {'recall':>6} {'limit':>6} "
        f"{'worst':>6} | {'near':>5} | {'tips, median mm':>15}"
    ]
    for row in rows:
        (precision, recall), (best_precision, best_recall) = row.scores.mean(0).tolist(), row.limits.mean(0).tolist()
        worst_precision, worst_recall = row.scores.amin(0).tolist()
        near = "" if math.isnan(row.near) else f"{row.near:.1%}"
        line = f"{row.view:9} {row.ratio:8.0%} | {precision:9.3f} {best_precision:6.3f} {worst_precision:6.3f} | "
        line += f"{recall:6.3f} {best_recall:6.3f} {worst_recall:6.3f} | {near:>5} | {1e3 * row.tip_error:15.2f}"
        if row.ratio == BAR_RATIO:
            line += f"  both >= {BAR}: {'pass' if row.passed else 'FAIL'}"
        lines.append(line)
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> list[Row]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=20, help="clouds per ratio and view (default 20)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--smoke", action="store_true", help="two clouds of each view at 40 %% outliers")
    options = parser.parse_args(arguments)
    ratios, trials = ((BAR_RATIO,), 2) if options.smoke else (RATIOS, options.trials)
    hand = tr.Hand()
    surface, skin = surface_skin(hand), tr.sample_skin(hand)
    rows = []
    with tqdm(total=len(VIEWS) * len(ratios), leave=False, disable=None) as progress:
        for view in VIEWS:
            for ratio in ratios:
                rows.append(
                    measure(hand, skin, view, ratio, make_clouds(hand, surface, view, ratio, trials, options.seed))
                )
                progress.update()
    print(f"inliers lie within {INLIER_SHARE:.0%} of the hand's size of the aligned surface; {trials} clouds per row")
    print(render(rows))
    return rows


if __name__ == "__main__":
    main()
