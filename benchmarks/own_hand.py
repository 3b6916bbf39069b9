"""Fingertip errors of a hand from single-view clouds, with the exact model and with a model of another hand.

    python benchmarks/own_hand.py            # every figure
    python benchmarks/own_hand.py --smoke    # a cloud and a short sequence, to see that it runs

Data: 500 points of the side that a camera sees, 1.5 mm noise on each coordinate, and outliers, 33 % of all points.
Starts: every joint 20 degrees off; in a second variant the base is also turned by 20 degrees and shifted by 2 cm.
Fingertips count where at least 8 inliers lie on the last phalanx.

- exact: the aligned hand is the true one. Bar: mean <= 1.5 mm.
- other: the true hand has another skin (sharpness 10, nu 2 mm) and bone lengths and radii that are 5 % off, part by
  part. The model is calibrated on the first frames of a sequence and aligned with the frames after them. Bar: mean
  <= 3 mm.

Beside them stands what the data allow: "least squares" starts at the truth and uses the true inliers, so that neither
outliers nor a search can spoil it; "bound" is the Cramer-Rao bound of the fingertips with the prior on the joints.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torchreg as tr
from experiments.made_up.shape_sequences import other_hand
from torchreg.alignment.fit.objectives import GaussianPosePrior, distance_objective
from torchreg.datasets.hand import HandCloud, hand_motion, make_hand_cloud, random_hand_pose, surface_skin
from torchreg.datasets.sequences import range_clouds
from torchreg.shapes.surface import FusedSurface
from torchreg.solvers.levenberg_marquardt import levenberg_marquardt

NOISE, OUTLIERS, NUM_POINTS = 0.0015, 0.33, 500
JOINT_OFF, TURN_OFF, SHIFT_OFF = math.radians(20), math.radians(20), 0.02
TIPS, MIN_SEEN = [4, 8, 12, 16, 20], 8
SCALE_OFF, OTHER_SHARPNESS, OTHER_NU = 0.05, 10.0, 0.002
BARS_MM = {"exact": 1.5, "other": 3.0}
VARIANTS = ("joints", "joints+base")
# Slow enough that the frames of a calibration differ.
FPS = 4.0
CAMERA = torch.zeros(3)


@dataclass(frozen=True)
class Trial:
    """One cloud, the true fingertips (5, 3), which of them (5,) are seen, and a start per variant."""

    cloud: HandCloud
    tips: Tensor
    seen: Tensor
    starts: dict[str, Tensor]


@dataclass(frozen=True)
class Row:
    """One line of the table: errors of the seen fingertips and seconds per alignment."""

    case: str
    variant: str
    method: str
    errors: Tensor
    seconds: float = math.nan
    bar_mm: float = math.nan

    @property
    def passed(self) -> bool:
        """Whether the mean reaches the bar."""
        return float(1e3 * self.errors.double().mean()) <= self.bar_mm


def signs(count: int, generator: torch.Generator) -> Tensor:
    return 2.0 * torch.randint(2, (count,), generator=generator) - 1.0


def start_of(hand: tr.Hand, pose: Tensor, generator: torch.Generator) -> dict[str, Tensor]:
    """Return a start per variant: every joint off, and the base off too."""
    joints = pose.clone()
    joints[6:] += JOINT_OFF * signs(hand.num_dofs - 6, generator)
    axis, direction = torch.nn.functional.normalize(torch.randn(2, 3, generator=generator), dim=-1)
    step = torch.zeros_like(pose)
    step[:3], step[3:6] = SHIFT_OFF * direction, TURN_OFF * axis
    return {"joints": hand.clamp(joints), "joints+base": hand.clamp(hand.retract(joints, step))}


def make_trial(hand: tr.Hand, cloud: HandCloud, generator: torch.Generator) -> Trial:
    with torch.no_grad():
        tips = hand.keypoints(cloud.pose)[TIPS]
    counts = [(cloud.inliers & (cloud.part_labels == part)).sum() for part in hand.fingertip_parts]
    return Trial(cloud, tips, torch.stack(counts) >= MIN_SEEN, start_of(hand, cloud.pose, generator))


def seen_errors(hand: tr.Hand, poses: Sequence[Tensor], trials: Sequence[Trial]) -> Tensor:
    """Return the distances of all seen fingertips to the truth, metres."""
    with torch.no_grad():
        tips = hand.keypoints(torch.stack(list(poses)))[:, TIPS]
    far = (tips - torch.stack([trial.tips for trial in trials])).norm(dim=-1)
    return far[torch.stack([trial.seen for trial in trials])]


def align_all(hand: tr.Hand, trials: Sequence[Trial], variant: str) -> tuple[Tensor, float]:
    """Return the errors of the seen fingertips after `align` as it comes, and seconds per alignment."""
    skin = tr.sample_skin(hand)
    tr.align(hand, trials[0].cloud.points, trials[0].starts[variant], model_points=skin)
    poses, begin = [], time.perf_counter()
    for trial in tqdm(trials, desc=f"align {variant}", leave=False, disable=None):
        poses.append(tr.align(hand, trial.cloud.points, trial.starts[variant], model_points=skin).pose)
    return seen_errors(hand, poses, trials), (time.perf_counter() - begin) / len(trials)


def prior_precision(hand: tr.Hand) -> Tensor:
    precision = torch.zeros(hand.num_dofs)
    precision[6:] = (tr.AlignConfig().prior_std or math.inf) ** -2
    return precision


def least_squares(hand: tr.Hand, trial: Trial, variant: str) -> Tensor:
    """Return the pose of least squared surface distances of the true inliers, from the true pose."""
    data = trial.cloud.points[trial.cloud.inliers].unsqueeze(0)
    prior = GaussianPosePrior(trial.starts[variant].unsqueeze(0), prior_precision(hand))
    wide, noise = torch.tensor([1e3 * NOISE]), torch.tensor([NOISE])
    objective = distance_objective(FusedSurface(hand), data, torch.ones_like(data[..., 0]), wide, noise, prior)
    with torch.no_grad():
        return levenberg_marquardt(
            objective,
            trial.cloud.pose.unsqueeze(0),
            retract=hand.retract,
            lower=hand.lower,
            upper=hand.upper,
            max_steps=20,
        ).state[0]


def least_squares_all(hand: tr.Hand, trials: Sequence[Trial], variant: str) -> Tensor:
    return seen_errors(hand, [least_squares(hand, trial, variant) for trial in trials], trials)


def bound_draws(hand: tr.Hand, trial: Trial, generator: torch.Generator, draws: int = 200) -> Tensor:
    """Return errors (draws, seen) of fingertips whose pose has the covariance of the Cramer-Rao bound."""
    pose = trial.cloud.pose.double()
    exact = tr.Hand(nu=hand.nu, dtype=torch.float64)
    exact.load_state_dict(hand.state_dict())
    with torch.no_grad():
        jacobian = exact.distance_jacobian(trial.cloud.points[trial.cloud.inliers].double(), pose)[1]
        information = jacobian.mT @ jacobian / NOISE**2 + prior_precision(hand).double().diag()
        factor = torch.linalg.cholesky(information)
        normal = torch.randn(len(pose), draws, generator=generator, dtype=torch.float64)
        moved = torch.linalg.solve_triangular(factor.mT, normal, upper=True)
        by_pose = torch.autograd.functional.jacobian(exact.keypoints, pose)[TIPS][trial.seen]
        return (by_pose @ moved).norm(dim=1).T


def bound_row(case: str, pairs: Sequence[tuple[tr.Hand, Trial]], seed: int) -> Row:
    generator = torch.Generator().manual_seed(seed)
    return Row(
        case, "any", "bound", torch.cat([bound_draws(hand, trial, generator).flatten() for hand, trial in pairs])
    )


def exact_rows(num_trials: int, seed: int) -> list[Row]:
    """Return the rows of the exact model: random poses before the camera."""
    hand, generator = tr.Hand(), torch.Generator().manual_seed(seed)
    surface, trials = surface_skin(hand), []
    for _ in range(num_trials):
        pose = random_hand_pose(hand, generator)
        cloud = make_hand_cloud(
            hand,
            pose,
            num_points=NUM_POINTS,
            noise=NOISE,
            outlier_ratio=OUTLIERS,
            camera=CAMERA,
            skin=surface,
            generator=generator,
        )
        trials.append(make_trial(hand, cloud, generator))
    rows = []
    for variant in VARIANTS:
        rows.append(Row("exact", variant, "align", *align_all(hand, trials, variant), BARS_MM["exact"]))
        rows.append(Row("exact", variant, "least squares", least_squares_all(hand, trials, variant)))
    return [*rows, bound_row("exact", [(hand, trial) for trial in trials], seed)]


def other_rows(num_sequences: int, num_frames: int, num_calibrated: int, seed: int) -> list[Row]:
    """Return the rows of a model calibrated on the first frames of sequences of other hands."""
    model = tr.Hand()
    sequences, pairs = [], []
    for number in range(num_sequences):
        generator = torch.Generator().manual_seed(seed + number)
        truth = other_hand(generator, SCALE_OFF, nu=OTHER_NU)
        surface = surface_skin(truth, sharpness=OTHER_SHARPNESS)
        poses = hand_motion(truth, "bend", num_calibrated + num_frames, FPS, seed=seed + number)
        clouds = range_clouds(
            truth, poses, num_points=NUM_POINTS, noise=NOISE, outlier_ratio=OUTLIERS, camera=CAMERA, skin=surface,
            seed=seed + number,
        )  # fmt: skip
        trials = [make_trial(truth, cloud, generator) for cloud in clouds]
        sequences.append((trials[:num_calibrated], trials[num_calibrated:]))
        pairs += [(truth, trial) for trial in trials[num_calibrated:]]
    rows = []
    for variant in VARIANTS:
        plain, fitted, least = [], [], []
        for first, trials in tqdm(sequences, desc=f"calibrate {variant}", leave=False, disable=None):
            frames = [trial.cloud.points for trial in first]
            hand = tr.calibrate(model, frames, torch.stack([trial.starts[variant] for trial in first])).shape
            fitted.append(align_all(hand, trials, variant))
            least.append(least_squares_all(hand, trials, variant))
            plain.append(align_all(model, trials, variant))
        for method, results, bar in (("align", fitted, BARS_MM["other"]), ("not calibrated", plain, math.nan)):
            seconds = sum(seconds for _, seconds in results) / len(results)
            rows.append(Row("other", variant, method, torch.cat([errors for errors, _ in results]), seconds, bar))
        rows.append(Row("other", variant, "least squares", torch.cat(least)))
    return [*rows, bound_row("other", pairs, seed)]


def render(rows: Sequence[Row]) -> str:
    """Return the table of all rows, in millimeters."""
    figures = ("mean", "rms", "median", "p95", ">10mm", "ms")
    lines = [f"{'model':6} {'start off':12} {'method':15} {'tips':>5} " + " ".join(f"{name:>6}" for name in figures)]
    for row in rows:
        errors = 1e3 * row.errors.double()
        numbers = errors.mean(), errors.square().mean().sqrt(), errors.median(), errors.quantile(0.95)
        line = f"{row.case:6} {row.variant:12} {row.method:15} {'' if row.method == 'bound' else len(errors):>5} "
        line += " ".join(f"{number:6.2f}" for number in numbers) + f" {(errors > 10).double().mean():6.1%}"
        if not math.isnan(row.seconds):
            line += f" {1e3 * row.seconds:6.0f}"
        if not math.isnan(row.bar_mm):
            line += f"  mean <= {row.bar_mm} mm: {'pass' if row.passed else 'FAIL'}"
        lines.append(line)
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> list[Row]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=40, help="clouds with the exact model (default 40)")
    parser.add_argument("--sequences", type=int, default=4, help="other hands, calibrated one by one (default 4)")
    parser.add_argument("--frames", type=int, default=10, help="frames aligned per sequence (default 10)")
    parser.add_argument("--calibrated", type=int, default=5, help="frames before them to calibrate on (default 5)")
    parser.add_argument("--case", choices=("exact", "other", "both"), default="both")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--smoke", action="store_true", help="one cloud and one sequence of two frames")
    options = parser.parse_args(arguments)
    if options.smoke:
        options.trials, options.sequences, options.frames, options.calibrated = 1, 1, 2, 2
    rows: list[Row] = []
    if options.case in ("exact", "both"):
        rows += exact_rows(options.trials, options.seed)
    if options.case in ("other", "both"):
        rows += other_rows(options.sequences, options.frames, options.calibrated, options.seed)
    print("seen fingertips, distance to the truth in mm; seed", options.seed)
    print(render(rows))
    return rows


if __name__ == "__main__":
    main()
