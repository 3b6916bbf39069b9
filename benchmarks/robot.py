"""Joint angles of public robots from one noisy view, read from their URDF files.

The robots come with example-robot-data (`pip install "torchreg-articulated[benchmark]"`, which also brings the reader
of their meshes): two arms and a hand, their bases bolted to the ground, and the hand again with a free base. The truth
is a random pose within the limits; the start has every joint 20 degrees off (sliding joints 1 cm, a free base 2 % of
the size and 10 degrees). The data are 1,000 points of the side of the file's meshes that a camera at a random place
sees, with 2 mm noise and 10 % outliers, uniform in the bounding box grown by 5 % of the size.

Some joints cannot be measured: a flange that is round about its own axis, a part that is hidden. Which these are
follows from truth and data alone: the least standard deviation that noise and points leave to a joint, with the true
correspondences but all other joints unknown too (the Cramer-Rao bound of point-to-plane distances). Where even that
exceeds the bar of 2 degrees, the joint counts as not determined; such joints have a line of their own and are part of
the line over all joints, but the bar is for the others.

    python benchmarks/robot.py
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import torch
from public_shapes import robots_folder
from torch import Tensor

import torchreg as tr
from torchreg.geometry.mesh import interpolate
from torchreg.geometry.visibility import sample_visible

ROBOTS = {
    "UR5 arm": "ur_description/urdf/ur5_robot.urdf",
    "Panda arm": "panda_description/urdf/panda.urdf",
    "Allegro hand": "allegro_hand_description/urdf/allegro_right_hand.urdf",
}
FREE_BASE = ("Allegro hand",)
NUM_POINTS, NOISE, OUTLIER_SHARE, BOX_MARGIN = 1000, 0.002, 0.1, 0.05
START_OFF, SLIDE_OFF, BASE_TURN, BASE_SHIFT = math.radians(20), 0.01, math.radians(10), 0.02
CAMERA_DISTANCE = 3.0
# Degrees: median over determined joints; a trial in which one of them is further off than the second has failed.
MEDIAN_BAR, FAILURE = 2.0, 10.0
DETERMINED_BELOW = math.radians(MEDIAN_BAR)


@dataclass(frozen=True)
class Trial:
    """One problem.

    Args:
        truth: (num_dofs,).
        start: (num_dofs,).
        data: (M, 3) measured points, metres.
        bound: (J,) least standard deviation of each joint by noise and points, radians; infinite if it does not show.
    """

    truth: Tensor
    start: Tensor
    data: Tensor
    bound: Tensor


@dataclass(frozen=True)
class Outcome:
    """All trials with one robot.

    Args:
        robot: name.
        names: of the joints that turn.
        errors: (T, J) degrees.
        seen: (T, J) True where the data determine the joint.
        vertices: (T,) mean distance of all vertices from their true places, millimeters.
        seconds: mean time of an alignment.
    """

    robot: str
    names: tuple[str, ...]
    errors: Tensor
    seen: Tensor
    vertices: Tensor
    seconds: float

    def failures(self) -> float:
        """Return the share of trials in which a determined joint was lost."""
        return float((torch.where(self.seen, self.errors, 0.0).amax(1) > FAILURE).float().mean())

    def passed(self) -> bool:
        """Return True if the median over determined joints meets the bar."""
        return float(self.errors[self.seen].median()) <= MEDIAN_BAR


def turning_joints(shape: tr.ArticulatedShape) -> Tensor:
    """Return (num_dofs - 6,) True where a degree of freedom is an angle."""
    return shape.kinematics.couplings.abs().mT @ (1 - shape.kinematics.is_revolute) == 0


def random_poses(shape: tr.ArticulatedShape, size: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Return a true pose inside the limits, and a start that is off by the same amount in every joint."""
    lower, upper = shape.lower[6:].clamp_min(-math.pi), shape.upper[6:].clamp_max(math.pi)
    joints = lower + (upper - lower) * torch.rand(len(lower), generator=generator)
    off = torch.where(turning_joints(shape), START_OFF, SLIDE_OFF)
    off = off * torch.where(torch.rand(len(lower), generator=generator) < 0.5, -1.0, 1.0)
    start = joints + off
    # Away from a limit, so that clamping does not bring the start nearer.
    start = torch.where((start < shape.lower[6:]) | (start > shape.upper[6:]), joints - off, start)
    scale = torch.tensor([BASE_SHIFT * size] * 3 + [BASE_TURN] * 3)
    base = torch.nn.functional.normalize(torch.randn(2, 3, generator=generator), dim=-1).flatten() * scale
    truth = shape.clamp(torch.cat([torch.zeros(6), joints]))
    return truth, shape.clamp(torch.cat([base, start]))


def make_trial(shape: tr.ArticulatedShape, skin: tr.LinearBlendSkin, seed: int, count: int = NUM_POINTS) -> Trial:
    generator = torch.Generator().manual_seed(seed)
    vertices = skin.points
    size = float((vertices.amax(0) - vertices.amin(0)).norm())
    truth, start = random_poses(shape, size, generator)
    mesh = tr.TriangleMesh(skin(truth), skin.faces)
    low, high = mesh.vertices.amin(0), mesh.vertices.amax(0)
    direction = torch.nn.functional.normalize(torch.randn(3, generator=generator), dim=0)
    camera = (low + high) / 2 + CAMERA_DISTANCE * (high - low).norm() * direction
    points, face, barycentric = sample_visible(mesh, camera, count, generator)
    bound = joint_bounds(shape, skin, truth, mesh, points.to(low), face, barycentric.to(low))
    points = points.to(low) + NOISE * torch.randn(points.shape, generator=generator)
    low, high = points.amin(0) - BOX_MARGIN * size, points.amax(0) + BOX_MARGIN * size
    outliers = low + (high - low) * torch.rand(
        round(count * OUTLIER_SHARE / (1 - OUTLIER_SHARE)), 3, generator=generator
    )
    return Trial(truth, start, torch.cat([points, outliers]), bound)


def joint_bounds(
    shape: tr.ArticulatedShape,
    skin: tr.LinearBlendSkin,
    pose: Tensor,
    mesh: tr.TriangleMesh,
    points: Tensor,
    face: Tensor,
    barycentric: Tensor,
) -> Tensor:
    """Return the Cramer-Rao bound (J,) of each joint, all others unknown too, from point-to-plane distances."""
    weights = interpolate(skin.weights, skin.faces, face, barycentric)
    on_surface = tr.LinearBlendSkin(shape, points, weights / weights.sum(-1, keepdim=True), pose)
    normals = mesh.face_normals()[face]
    jacobian = (normals.unsqueeze(-2) @ on_surface.jacobian(pose)[1]).squeeze(-2)
    free = shape.upper > shape.lower
    jacobian = jacobian[:, free].double() / NOISE
    # A very weak prior keeps the inverse finite where a joint does not show at all.
    information = jacobian.mT @ jacobian + torch.eye(jacobian.shape[1], dtype=torch.float64)
    bound = torch.zeros(shape.num_dofs, dtype=torch.float64)
    bound[free] = information.inverse().diagonal().sqrt()
    return bound[6:]


def measure(
    name: str, shape: tr.ArticulatedShape, trials: int, config: tr.AlignConfig, count: int = NUM_POINTS
) -> Outcome:
    """Return errors and times over the trials of one robot."""
    skin, model = shape.file_skin(), tr.sample_skin(shape, 500)
    turning = turning_joints(shape)
    errors, seen, vertices, seconds = [], [], [], 0.0
    for seed in range(trials):
        trial = make_trial(shape, skin, seed, count)
        begin = time.perf_counter()
        pose = tr.align(shape, trial.data, trial.start, model_points=model, config=config).pose
        seconds += time.perf_counter() - begin
        errors.append(torch.rad2deg((pose - trial.truth)[6:][turning].abs()))
        seen.append(trial.bound[turning] < DETERMINED_BELOW)
        vertices.append(1000 * (skin(pose) - skin(trial.truth)).norm(dim=-1).mean())
    names = tuple(joint for joint, turns in zip(shape.dof_names[6:], turning.tolist(), strict=True) if turns)
    return Outcome(
        name, names, torch.stack(errors), torch.stack(seen), torch.stack(vertices), seconds / max(trials, 1)
    )  # fmt: skip


def print_table(outcomes: list[Outcome]) -> None:
    """Print errors of all joints, of those the data determine, and of the others."""
    header = f"{'robot':26s} {'joints':22s} {'share':>6s} {'median':>7s} {'p90':>7s}"
    print(f"{header} {'failed':>7s} {'mesh mm':>8s} {'s':>5s}  bar")
    for outcome in outcomes:
        groups = {"all": torch.ones_like(outcome.seen), "determined": outcome.seen, "not determined": ~outcome.seen}
        for label, chosen in groups.items():
            errors = outcome.errors[chosen]
            if errors.numel() == 0:
                continue
            line = f"{outcome.robot:26s} {label:22s} {float(chosen.float().mean()):6.0%} "
            line += f"{float(errors.median()):7.2f} {float(errors.quantile(0.9)):7.2f}"
            if label == "determined":
                line += f" {outcome.failures():7.0%} {float(outcome.vertices.median()):8.1f} {outcome.seconds:5.2f}"
                line += f"  {'pass' if outcome.passed() else 'FAIL'}"
            print(line)
    print(f"degrees; bar: median <= {MEDIAN_BAR} over determined joints; failed: one of them > {FAILURE:.0f} off")
    for outcome in outcomes:
        hidden = (~outcome.seen).float().mean(0)
        shown = [f"{name} {share:.0%}" for name, share in zip(outcome.names, hidden.tolist(), strict=True) if share > 0]
        medians = ", ".join(f"{value:.1f}" for value in outcome.errors.median(0).values.tolist())
        print(f"{outcome.robot}: median per joint {medians}")
        print(f"{outcome.robot}: trials in which a joint is not determined: {', '.join(shown) or 'none'}")


def main(arguments: list[str] | None = None) -> int:
    """Run the benchmark; return 0 if every bar was met or there was nothing to do."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of robots, instead of that of example-robot-data")
    parser.add_argument("--trials", type=int, default=30, help="poses per robot")
    parser.add_argument("--search", default="auto", choices=("auto", "always", "never"), help="see AlignConfig")
    parser.add_argument("--smoke", action="store_true", help="the hand and three poses, for a quick look")
    options = parser.parse_args(arguments)
    folder = options.data or robots_folder()
    files = (
        {} if folder is None else {name: folder / file for name, file in ROBOTS.items() if (folder / file).is_file()}
    )
    if not files:
        print('skipped: no robots found; pip install "torchreg-articulated[benchmark]" brings example-robot-data')
        return 0
    jobs = [(name, False) for name in files] + [(name, True) for name in FREE_BASE if name in files]
    if options.smoke:
        jobs = jobs[-1:]
    outcomes = []
    with torch.no_grad():
        for name, free in jobs:
            shape = tr.ArticulatedShape.from_urdf(files[name], package_dirs=[folder.parent.parent], free_base=free)
            label = f"{name}, {'free' if free else 'fixed'} base"
            trials = 3 if options.smoke else options.trials
            outcomes.append(measure(label, shape, trials, tr.AlignConfig(search=options.search)))
    print_table(outcomes)
    return 0 if all(outcome.passed() for outcome in outcomes) else 1


if __name__ == "__main__":
    sys.exit(main())
