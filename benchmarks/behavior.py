"""What the library answers on small made-up data, a digest per output: the guard of a change that must not show.

    python benchmarks/behavior.py                             # digests, to be read or kept
    python benchmarks/behavior.py --output before.npz         # all output tensors; then, after the change
    python benchmarks/behavior.py --against before.npz        # equal bit for bit? exit 1 if not
    python benchmarks/behavior.py --against before.npz --rtol 1e-5
    python benchmarks/behavior.py --only align,find_pose      # some of the cases

It runs on one thread, without which sums have no fixed order. Differences are relative to a tensor's largest entry.
"""

from __future__ import annotations

import argparse
import hashlib
import math
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torchreg as tr
from experiments.made_up.pictures import PictureStyle, camera_ring, stereo_cameras
from experiments.made_up.videos import shape_video
from experiments.made_up.walks import walking_figure
from torchreg.datasets.creatures import STARFISH, creature_sequence
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.datasets.hand import hand_motion, make_hand_cloud, random_hand_pose
from torchreg.datasets.scan_sequences import jointed_toy

# Fields that hold wall times.
CLOCKS = {"seconds"}
# What results keep of their input; of a calibration the shape is an output.
GIVEN = {"shape", "up"}
CAMERA = torch.zeros(3)


def generator(seed: int = 0) -> torch.Generator:
    """Return a new generator of its own."""
    return torch.Generator().manual_seed(seed)


def hand_problem(seed: int = 1, bend: float = 0.15) -> tuple[tr.Hand, Tensor, Tensor]:
    """Return a hand, a one-sided cloud (M, 3) with outliers, and a start (27,) that is off at every joint."""
    hand, draw = tr.Hand().requires_grad_(False), generator(seed)
    truth = random_hand_pose(hand, draw)
    cloud = make_hand_cloud(hand, truth, num_points=300, outlier_ratio=0.2, camera=CAMERA, generator=draw)
    joints = torch.arange(27) > 5
    return hand, cloud.points, hand.clamp(truth + bend * joints * torch.randn(27, generator=draw))


def align_cases() -> Iterator[Any]:
    """Yield one alignment for each rule of correspondence and of search, and a batch."""
    hand, points, start = hand_problem()
    skin = tr.sample_skin(hand, 200)
    for options in (
        {"search": "never"}, {"search": "always", "num_candidates": 8}, {"search": "never", "outlier": "volume"},
        {"search": "never", "correspondence": "softassign"}, {"search": "never", "correspondence": "closest"},
    ):  # fmt: skip
        yield tr.align(hand, points, start, model_points=skin, config=tr.AlignConfig(**options))
    clouds = torch.stack([points[:150], points[-150:]])
    yield tr.align(hand, clouds, start, model_points=skin, config=tr.AlignConfig(search="never"))
    yield tr.align(hand, points, torch.stack([hand.rest_pose(), start]), model_points=skin)


def find_pose_cases() -> Iterator[Any]:
    """Yield the poses found of a hand without a start."""
    hand, points, _ = hand_problem()
    yield tr.find_pose(hand, points, num_starts=3)


def tracker_cases() -> Iterator[Any]:
    """Yield what a tracker says of a moving hand, which hides for two frames, and the state it ends in."""
    hand = tr.Hand().requires_grad_(False)
    poses, draw = hand_motion(hand, "rotation", 8), generator()
    clouds = [make_hand_cloud(hand, pose, num_points=250, camera=CAMERA, generator=draw).points for pose in poses]
    clouds[4:6] = [torch.zeros(0, 3), 0.1 * torch.rand(60, 3, generator=draw) + torch.tensor([2.0, 0.0, 0.0])]
    tracker = tr.Tracker(hand, poses[0])
    yield tracker.run(clouds)
    yield tracker.state


def initializer_cases() -> Iterator[Any]:
    """Yield poses of a batch from starts, their gradient, a pose prior, a head and a calibrated hand."""
    hand = tr.Hand().requires_grad_(False)
    poses, draw = hand_motion(hand, "bend", 4)[1:4], generator()
    clouds = [make_hand_cloud(hand, pose, num_points=250, camera=CAMERA, generator=draw).points for pose in poses]
    batch = torch.stack([cloud[:200] for cloud in clouds]).requires_grad_()
    found = tr.PoseInitializer(hand)(batch, start=poses)
    found.pose.square().sum().backward()
    prior, head = tr.PosePrior.fit(hand, poses), tr.PoseHead(hand)
    yield (
        found,
        batch.grad,
        prior,
        prior.log_prob(poses),
        prior(prior.coefficients(poses)),
        head(torch.zeros(2, head.num_features)),
    )
    yield tr.calibrate(tr.Hand(), clouds, poses)


def loss_cases() -> Iterator[Any]:
    """Yield the EM loss and its gradients, both skins, and the hand's surface."""
    hand, points, start = hand_problem()
    start = start.requires_grad_()
    skin = tr.BendingSkin(hand, tr.sample_skin(hand, 100).points, hand.rest_pose())
    posed = skin(start)
    loss = tr.EMLoss(0.01)(posed, points)
    loss.backward()
    yield posed, loss, start.grad, hand.keypoints(start), hand.surface_mesh(start.detach(), spacing=0.01)


def register_cases() -> Iterator[Any]:
    """Yield two pairs of scans registered, the first one posed anew by dragging, and another blend."""
    toy = jointed_toy(2, seed=2, scanner=DepthScanner(num_points=900)).pair(0, 1)
    found = tr.register(toy.source, toy.target, num_bones=8, grid_resolution=30)
    yield found, found.parts()
    handles = found.points[::200]
    yield tr.solve_pose(found.model, handles, found.deformed[::200] + 0.02)
    figure = walking_figure(2, seed=1, scanner=DepthScanner(num_points=900)).pair(0, 1)
    yield tr.register(figure.source, figure.target, num_bones=10, grid_resolution=30)


def sequence_cases() -> Iterator[Any]:
    """Yield three scans registered to one."""
    toy = jointed_toy(3, seed=2, scanner=DepthScanner(num_points=700), step=math.radians(12))
    yield tr.register_sequence([toy[frame] for frame in range(3)], 8, 30, reference=1)


def spine_cases() -> Iterator[Any]:
    """Yield the skeleton of one starfish and the spine of six, whose arms touch in some."""
    sequence = creature_sequence(STARFISH, 6, touching="flanks", resolution=40)
    yield tr.skeletonize(sequence.meshes[0])
    found = tr.extract_spine(sequence.meshes)
    yield found, found.model(0.5)


def camera_cases() -> Iterator[Any]:
    """Yield points from a stereo pair, a scan from a depth picture, two scans fused and a hull of silhouettes."""
    hand = tr.Hand().requires_grad_(False)
    pair = stereo_cameras(width=200, height=150, focal=240.0)
    poses = hand_motion(hand, "rotation", 1, distance=0.6)
    [(left, right)] = shape_video(hand, poses, pair, style=PictureStyle(wall=0.95))
    yield tr.stereo_points(left.image, right.image, pair, config=tr.StereoConfig(nearest=0.45, farthest=0.9))
    depth = torch.where(left.mask, left.depth, 0.0)
    scan = tr.depth_scan(depth, pair.left)
    yield scan, tr.depth_scan(depth, pair.left, smoothing=1e-3), tr.fuse_scans([scan, scan], spacing=0.004)
    ring = camera_ring(hand.keypoints(poses[0]).mean(0), 0.6, 4, focal=240.0, width=200, height=150)
    [views] = shape_video(hand, poses, ring, forearm=False)
    hull = tr.visual_hull([view.mask for view in views], ring, resolution=32)
    yield hull, hull.mesh()


def saved_cases() -> Iterator[Any]:
    """Yield a result as it comes back from its file."""
    hand, points, start = hand_problem()
    found = tr.align(hand, points, start, config=tr.AlignConfig(search="never", num_model_points=100))
    with tempfile.TemporaryDirectory() as folder:
        found.save(Path(folder) / "result.safetensors")
        yield tr.load(Path(folder) / "result.safetensors")


CASES: dict[str, Callable[[], Iterator[Any]]] = {
    "align": align_cases,
    "find_pose": find_pose_cases,
    "tracker": tracker_cases,
    "initializer": initializer_cases,
    "losses": loss_cases,
    "register": register_cases,
    "sequence": sequence_cases,
    "spines": spine_cases,
    "cameras": camera_cases,
    "saved": saved_cases,
}


def outputs(value: Any, name: str) -> Iterator[tuple[str, Tensor | str]]:
    """Yield every tensor and word of an answer, under a dotted name."""
    if isinstance(value, Tensor):
        yield name, value.detach()
    elif isinstance(value, Enum):
        yield name, str(value.value)
    elif isinstance(value, nn.Module):
        for key, entry in value.state_dict().items():
            yield from outputs(entry, f"{name}.{key}")
    elif is_dataclass(value):
        for item in fields(value):
            if item.name not in CLOCKS and not (item.name in GIVEN and not isinstance(value, tr.Calibration)):
                yield from outputs(getattr(value, item.name), f"{name}.{item.name}")
    elif isinstance(value, dict) and value:
        for key, entry in value.items():
            yield from outputs(entry, f"{name}.{key}")
    elif isinstance(value, (tuple, list)):
        for index, entry in enumerate(value):
            yield from outputs(entry, f"{name}.{index}")
    elif isinstance(value, (bool, int, float)):
        yield name, torch.tensor(value, dtype=torch.float64)
    elif value is not None:
        yield name, str(value)


def record(cases: Sequence[str]) -> dict[str, np.ndarray]:
    """Return every output of the named cases."""
    found: dict[str, np.ndarray] = {}
    for case in cases:
        started = time.process_time()
        for index, answer in enumerate(CASES[case]()):
            found |= {name: np.asarray(entry) for name, entry in outputs(answer, f"{case}.{index}")}
        print(f"{case}: {time.process_time() - started:.1f} CPU seconds", file=sys.stderr, flush=True)
    return found


def digest(entry: np.ndarray) -> str:
    """Return a short digest of type, shape and every bit."""
    header = f"{entry.dtype} {entry.shape}".encode()
    return hashlib.sha256(header + np.ascontiguousarray(entry).tobytes()).hexdigest()[:16]


def difference(before: np.ndarray, after: np.ndarray) -> float:
    """Return the largest difference relative to the largest entry; infinite where type, shape or words differ."""
    if before.dtype != after.dtype or before.shape != after.shape:
        return math.inf
    if digest(before) == digest(after):
        return 0.0
    if before.dtype.kind not in "fiub":
        return math.inf
    before, after = before.astype(np.float64), after.astype(np.float64)
    if not np.array_equal(np.isfinite(before), np.isfinite(after)):
        return math.inf
    before, after = before[np.isfinite(before)], after[np.isfinite(after)]
    return float(np.abs(before - after).max(initial=0.0) / max(np.abs(before).max(initial=0.0), 1e-30))


def compared(before: dict[str, np.ndarray], after: dict[str, np.ndarray], rtol: float) -> int:
    """Print what differs by more than ``rtol``; return how many outputs do."""
    names = sorted({*before, *after})
    off = {
        name: difference(before[name], after[name]) if {name} <= {*before} & {*after} else math.inf for name in names
    }
    wrong = [name for name in names if off[name] > rtol]
    for name in wrong:
        kind = "missing" if name not in after else "new" if name not in before else f"{off[name]:.1e}"
        print(f"{kind:>8s}  {name}")
    print(
        f"{len(names)} outputs, {len(wrong)} differ by more than {rtol:g}; largest {max(off.values(), default=0):.1e}"
    )
    return len(wrong)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the cases; return the number of outputs that differ from a record, if one is given."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, help="an .npz that all outputs are written to")
    parser.add_argument("--against", type=Path, help="an .npz of an earlier run, to compare with")
    parser.add_argument("--rtol", type=float, default=0.0, help="relative difference that is no difference")
    parser.add_argument("--only", help=f"some of {', '.join(CASES)}, separated by commas")
    parser.add_argument("--smoke", action="store_true", help="the quick cases alone")
    arguments = parser.parse_args(argv)
    cases = ["losses", "saved"] if arguments.smoke else list(CASES)
    if arguments.only:
        cases = arguments.only.split(",")
    if unknown := [case for case in cases if case not in CASES]:
        parser.error(f"unknown cases: {', '.join(unknown)}; known: {', '.join(CASES)}")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        found = record(cases)
    finally:
        torch.set_num_threads(threads)
    if arguments.output is not None:
        np.savez_compressed(arguments.output, **found)
    if arguments.against is None:
        print(*(f"{digest(entry)}  {name}" for name, entry in sorted(found.items())), sep="\n")
        return 0
    with np.load(arguments.against, allow_pickle=False) as kept:
        before = {name: kept[name] for name in kept.files if name.split(".")[0] in cases}
    return compared(before, found, arguments.rtol)


if __name__ == "__main__":
    raise SystemExit(min(main(), 1))
