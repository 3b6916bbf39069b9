"""A robot's base in a camera and joints in single frames: a real arm with encoders, and made-up frames of it.

The real arm stands in five depth pictures with its encoders' angles and a base that another project found (about 5 mm
exact). The base is sought from all frames and from each three of them, without a start; then, with the base held, the
joints of each frame from its encoders plus noise of 0.2 radians, with that prior: how often three standard deviations
cover the error, and how many joints are told within 5 degrees. Made-up frames are the same arm in random joints before
a depth camera with 2 mm of noise, once with an offset of 1 degree at each joint in turn; then each frame alone, with
the base held, from encoders with noise. Coverage is the share of subsets of frames whose 95 % ellipsoid holds the
reference, or the base from frames apart.

    python benchmarks/base_calibration.py --data FOLDER       # FOLDER/xarm7: frames, camera.json, truth.json, URDF
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

import torchreg as tr
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.rigid import invert_rigid, rigid_matrix, transform_points
from torchreg.geometry.rotation import so3_exp, so3_log
from torchreg.geometry.visibility import sample_visible

# Where the base is told to be off, in base coordinates.
WORKSPACE = torch.tensor([0.3, 0.0, 0.3, 1.0], dtype=torch.float64)
ENCODER_STD, TOLD, SEEN = 0.2, math.radians(5), math.radians(1)
CHI2_50, CHI2_95 = 5.348, 12.592  # of six degrees of freedom
REFERENCE_M, REFERENCE_RAD = 0.003, math.radians(0.3)  # error of the reference along each axis: 5 mm in all
NUM_POINTS, NOISE, OFFSET = 1500, 0.002, math.radians(1)


@dataclass(frozen=True)
class Arm:
    """A real arm: its shape, frames, joints (T, J), and base (4, 4) in the camera."""

    shape: tr.ArticulatedShape
    frames: list[tr.DepthFrame]
    joints: Tensor
    base: Tensor

    @classmethod
    def load(cls, folder: Path) -> Arm:
        """Return the arm of a folder."""
        truth = json.loads((folder / "truth.json").read_text())
        shape = tr.ArticulatedShape.from_urdf(folder / "xarm7.urdf")
        names, pictures = sorted(truth["joints"]), folder / "frames"
        frames = [
            tr.DepthFrame.load(pictures / f"{n}_depth.png", folder / "camera.json", pictures / f"{n}_mask.png")
            for n in names
        ]
        joints = [[truth["joints"][name][joint] for joint in shape.dof_names[6:]] for name in names]
        base = invert_rigid(torch.tensor(truth["base_from_camera"], dtype=torch.float64))
        return cls(shape, frames, torch.tensor(joints, dtype=torch.float64), base)

    @property
    def base_pose(self) -> Tensor:
        """The base as the first six numbers of a pose."""
        return torch.cat([self.base[:3, 3], so3_log(self.base[None, :3, :3])[0]])


def base_error(found: Tensor, base: Tensor) -> tuple[float, float]:
    """Return how far a point of the workspace is off, millimeters, and the rotation, degrees."""
    turn = ((found[:3, :3] * base[:3, :3]).sum() - 1) / 2
    return 1e3 * float(((found - base) @ WORKSPACE).norm()), math.degrees(math.acos(min(1.0, float(turn))))


def show_bases(arm: Arm, triples: bool) -> None:
    """Print the base from all frames and from each three."""
    count = len(arm.frames)
    subsets = [tuple(range(count)), *(itertools.combinations(range(count), 3) if triples else ())]
    for chosen in subsets:
        begin = time.process_time()
        found = tr.calibrate_base(arm.shape, [arm.frames[k] for k in chosen], arm.joints[list(chosen)])
        seconds = time.process_time() - begin
        off, turn = base_error(found.T_camera_base, arm.base)
        std = found.covariance.diagonal().sqrt()
        print(
            f"base, frames {','.join(map(str, chosen)):10s} off {off:5.1f} mm {turn:5.2f} deg, std "
            f"{1e3 * std[:3].max():4.1f} mm {math.degrees(std[3:].max()):4.2f} deg, residuals "
            f"{', '.join(f'{1e3 * value:.1f}' for value in found.residuals.tolist())} mm, {seconds:4.1f} CPU s, "
            f"{found.status.value}",
            flush=True,
        )


def show_coverage(arm: Arm) -> None:
    """Print how often 95 % ellipsoids of the base from some frames hold the reference, and that from others."""
    count = len(arm.frames)
    subsets = [chosen for size in range(1, count + 1) for chosen in itertools.combinations(range(count), size)]
    found = {
        chosen: tr.calibrate_base(arm.shape, [arm.frames[k] for k in chosen], arm.joints[list(chosen)])
        for chosen in subsets
    }
    reference = torch.diag(torch.tensor([REFERENCE_M] * 3 + [REFERENCE_RAD] * 3, dtype=torch.float64).square())
    for size in range(1, count + 1):
        one = [found[chosen] for chosen in subsets if len(chosen) == size]
        plain = [squared_distance(each.T_camera_base, arm.base, each.covariance) for each in one]
        known = [squared_distance(each.T_camera_base, arm.base, each.covariance + reference) for each in one]
        print_coverage(f"frames {size} against the reference", plain)
        print_coverage(f"frames {size}, its error counted", known)
    pairs = [(a, b) for a, b in itertools.combinations(subsets, 2) if not set(a) & set(b) and min(len(a), len(b)) > 1]
    apart = [
        squared_distance(found[a].T_camera_base, found[b].T_camera_base, found[a].covariance + found[b].covariance)
        for a, b in pairs
    ]
    print_coverage("two or more frames against others", apart)


def show_made_up_coverage(arm: Arm, trials: int, scale: float) -> None:
    """Print the coverage of made-up frames without doubt; the camera's distances are off by a share, alike in all."""
    for size in (1, 2, 3, 5):
        apart = []
        for trial in range(trials):
            clouds, joints, base = made_up_frames(arm, torch.Generator().manual_seed(100 + trial), size)
            clouds = [cloud * (1 + scale * (-1) ** trial) for cloud in clouds]
            found = tr.calibrate_base(arm.shape, clouds, joints)
            if found.status is tr.Status.CONVERGED:
                apart.append(squared_distance(found.T_camera_base, base, found.covariance))
        print_coverage(f"made up, depth off by {scale:.1%}, frames {size}", apart)


def squared_distance(found: Tensor, base: Tensor, covariance: Tensor) -> float:
    """Return the squared Mahalanobis distance of two bases (4, 4)."""
    turn = so3_log((found[:3, :3] @ base[:3, :3].mT)[None])[0]
    error = torch.cat([found[:3, 3] - base[:3, 3], turn])
    return float(error @ torch.linalg.solve(covariance, error))


def print_coverage(words: str, squared: list[float]) -> None:
    """Print the share within the 95 % ellipsoid, and how wide it is by the median distance: 1 is right, 3 too wide."""
    values = torch.tensor(squared, dtype=torch.float64)
    share, wide = float((values < CHI2_95).double().mean()), math.sqrt(CHI2_50 / float(values.median()))
    print(f"coverage, {words}: {share:.0%} of {len(values)}; ellipsoids {wide:.2f} times as wide as needed", flush=True)


def show_joints(arm: Arm, seeds: int, config: tr.AlignConfig) -> None:
    """Print the joints of single frames with the base held, from encoders with noise."""
    skin = tr.sample_skin(arm.shape, config.num_model_points)
    errors, stds, seconds, exact = [], [], 0.0, []
    for frame, joints in zip(arm.frames, arm.joints, strict=True):
        pose = torch.cat([arm.base_pose, joints]).float()
        held = tr.align(arm.shape, frame, pose, model_points=skin, locked=arm.shape.dof_names, config=config)
        exact.append(1e3 * float(held.distances.abs().median()))
    for seed in range(seeds):
        generator = torch.Generator().manual_seed(seed)
        for frame, joints in zip(arm.frames, arm.joints, strict=True):
            noise = ENCODER_STD * torch.randn(len(joints), generator=generator, dtype=torch.float64)
            start = torch.cat([arm.base_pose, joints + noise]).float()
            begin = time.process_time()
            found = tr.align(
                arm.shape, frame, start, model_points=skin, locked="base", prior=(start, ENCODER_STD), config=config
            )  # fmt: skip
            seconds += time.process_time() - begin
            errors.append(found.pose[6:].double() - joints)
            stds.append(found.covariance.diagonal()[6:].clamp_min(0).sqrt().double())
    print(
        f"at the encoders' angles data lie {', '.join(f'{value:.1f}' for value in exact)} mm from the meshes (medians)"
    )
    print_joints(torch.stack(errors), torch.stack(stds), seeds, len(arm.frames), seconds / len(errors))


def print_joints(errors: Tensor, std: Tensor, seeds: int, frames: int, seconds: float) -> None:
    """Print how joints (seeds x frames, J) are off, radians, and how well their standard deviations tell that."""
    error = errors.abs()
    told = (std < TOLD).reshape(seeds, -1).sum(-1).tolist()
    medians, most = torch.rad2deg(error.median(0).values).tolist(), torch.rad2deg(error.amax(0)).tolist()
    print(f"joints: 3 std cover {float((error <= 3 * std).double().mean()):.1%}; std below 5 degrees for {told} of "
          f"{frames * error.shape[1]}, the worst of them off by {math.degrees(error[std < TOLD].max()):.1f}; "
          f"{seconds:.2f} CPU s a frame")  # fmt: skip
    print("off by, per joint: medians " + ", ".join(f"{value:.1f}" for value in medians)
          + " degrees, most " + ", ".join(f"{value:.1f}" for value in most))  # fmt: skip


def made_up_frames(arm: Arm, generator: torch.Generator, count: int) -> tuple[list[Tensor], Tensor, Tensor]:
    """Return clouds, joints (count, J) and base of the arm in random joints before a camera with noise."""
    shape, skin = arm.shape, arm.shape.file_skin()
    lower, upper = shape.lower[6:].clamp_min(-math.pi), shape.upper[6:].clamp_max(math.pi)
    joints = lower + (upper - lower) * torch.rand(count, len(lower), generator=generator)
    turn = 0.3 * torch.randn(1, 3, generator=generator, dtype=torch.float64)
    base = rigid_matrix(so3_exp(turn)[0] @ arm.base[:3, :3], arm.base[:3, 3])
    clouds = []
    for row in joints:
        vertices = skin(torch.cat([torch.zeros(6), row])).double()
        mesh = TriangleMesh(transform_points(base, vertices), skin.faces)
        points = sample_visible(mesh, torch.zeros(3), NUM_POINTS, generator, density="pixel")[0]
        noise = NOISE * torch.randn(len(points), 1, generator=generator, dtype=torch.float64)
        clouds.append(points * (1 + noise / points[:, 2:]))
    return clouds, joints.double(), base


def show_made_up(arm: Arm, trials: int, frames: int) -> None:
    """Print the base of made-up frames, and offsets of 1 degree found at one joint after the other."""
    names = arm.shape.dof_names[6:]
    for trial in range(trials):
        clouds, joints, base = made_up_frames(arm, torch.Generator().manual_seed(trial), frames)
        off, turn = base_error(tr.calibrate_base(arm.shape, clouds, joints).T_camera_base, base)
        offset = torch.zeros(len(names), dtype=torch.float64)
        offset[1 + trial % (len(names) - 1)] = OFFSET
        found = tr.calibrate_base(arm.shape, clouds, joints - offset, offsets=True)
        told = [
            f"{name} {math.degrees(value):+.2f} (true {math.degrees(true):+.1f})"
            for name, value, true in zip(names, found.offsets.tolist(), offset.tolist(), strict=True)
            if value or true
        ]
        print(f"made up, {frames} frames: base off {off:.2f} mm {turn:.2f} deg; offsets {', '.join(told)}", flush=True)


def show_made_up_joints(arm: Arm, seeds: int, frames: int) -> None:
    """Print the joints of single made-up frames with the base held, from encoders with noise."""
    errors, stds, begin = [], [], time.process_time()
    for seed in range(seeds):
        generator = torch.Generator().manual_seed(seed)
        clouds, joints, base = made_up_frames(arm, generator, frames)
        held = torch.cat([base[:3, 3], so3_log(base[None, :3, :3])[0]])
        for cloud, row in zip(clouds, joints, strict=True):
            start = torch.cat([held, row + ENCODER_STD * torch.randn(len(row), generator=generator)]).float()
            found = tr.align(arm.shape, cloud.float(), start, locked="base", prior=(start, ENCODER_STD))
            errors.append(found.pose[6:].double() - row)
            stds.append(found.covariance.diagonal()[6:].clamp_min(0).sqrt().double())
    error, std = torch.stack(errors), torch.stack(stds)
    seen = std < SEEN
    print(f"made up, single frames: {float(seen.double().mean()):.0%} of the joints have a std below "
          f"{math.degrees(SEEN):.0f} degree, {float((error[seen].abs() < 2 * SEEN).double().mean()):.1%} of these are "
          f"within 2 degrees, the worst off by {math.degrees(error[seen].abs().max()):.1f}")  # fmt: skip
    print_joints(error, std, seeds, frames, (time.process_time() - begin) / len(errors))


def main(arguments: list[str] | None = None) -> int:
    """Print all figures; return 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder that holds xarm7")
    parser.add_argument("--seeds", type=int, default=5, help="of the encoders' noise")
    parser.add_argument("--trials", type=int, default=6, help="made-up sets of frames")
    parser.add_argument("--smoke", action="store_true", help="all frames once, for a quick look")
    options = parser.parse_args(arguments)
    if options.data is None or not (options.data / "xarm7" / "truth.json").is_file():
        print("skipped: no xarm7/truth.json in --data")
        return 0
    arm = Arm.load(options.data / "xarm7")
    with torch.no_grad():
        show_bases(arm, triples=not options.smoke)
        if not options.smoke:
            show_coverage(arm)
            for scale in (0.0, 0.005):
                show_made_up_coverage(arm, options.trials, scale)
            show_joints(arm, options.seeds, tr.AlignConfig())
            show_made_up(arm, options.trials, 5)
            show_made_up_joints(arm, options.seeds, 5)
    return 0


if __name__ == "__main__":
    sys.exit(main())
