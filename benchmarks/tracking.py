"""A tracker on made-up stereo sequences of a hand, on a rig, for a thousand frames, and on frames that are no use.

    python benchmarks/tracking.py                   # every figure, some minutes
    python benchmarks/tracking.py --data FOLDER     # also the rig webxr_hand_right.glb, which lies in FOLDER
    python benchmarks/tracking.py --smoke           # a few frames, to see that it runs

No first pose is given, and one default configuration serves all. Data: what a pair of cameras sees at 20 frames/s,
300 to 600 points of the hand per frame, 1.5 mm noise in depth, and 257 outliers on the forearm, a wall and in the air.
Fingertips count as seen where at least 8 points lie on the last phalanx.

- exact: the model is the true hand. Bars: seen fingertips 1.5 mm off on average; the worst of a frame at most 5 mm in
  99 % of the frames of rotation and bending; after a flip, back under 5 mm within 5 frames; never lost, but where less
  than a fifth of what is otherwise seen is in view; 30 frames/s once the shape is found, after the second frame.
- other: the true hand has another skin (sharpness 10, nu 2 mm) and bone lengths and radii that are 5 % off, part by
  part. The model is calibrated on poses that the plain one was tracked in. Bar: 3 mm on average in later frames.
- rig: a hand from a glTF file flexes and turns, seen from the front, 1 mm noise, 20 % outliers. Bar: vertices of seen
  parts 3 mm off on average, never lost.
- long: a thousand frames. Bars: the last hundred take no longer, in processor time, than the first by a tenth, and no
  more memory.
- corrupted: an empty frame, one in millimeters, one of noise, one without numbers and five that are missing. Bar: each
  is named, and the hand is back under 5 mm within 5 frames.

"least squares" stands beside it: from the true pose with the true inliers, and joints held to 0.1 radians about the
truth, so that neither outliers nor a search can spoil it.
"""

from __future__ import annotations

import argparse
import math
import resource
import runpy
import sys
import time
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torchreg as tr
from experiments.made_up.shape_sequences import other_hand, rig_sequence
from torchreg.alignment.fit.objectives import GaussianPosePrior, distance_objective
from torchreg.datasets.hand import HandCloud, surface_skin
from torchreg.datasets.sequences import hand_sequence
from torchreg.geometry.rotation import compose_rotation_vectors
from torchreg.shapes.surface import FusedSurface
from torchreg.solvers.levenberg_marquardt import levenberg_marquardt

MOTIONS = ("rotation", "bending_palm", "bending_back", "flip", "fast", "occlusion")
STEADY = ("rotation", "bending_palm", "bending_back")
TIPS = [4, 8, 12, 16, 20]
MEAN_BAR, WORST_BAR, WORST_SHARE, BACK_FRAMES, OTHER_BAR, RIG_BAR, RATE_BAR = 1.5, 5.0, 0.99, 5, 3.0, 3.0, 30.0
# In view: this share of the points of the frame that shows most.
IN_VIEW = 0.2
# Radians per frame: faster turns belong to a flip.
FLIPPING = 0.06
NOISE, HELD = 0.0012, 0.1
OTHER_SHARPNESS, OTHER_NU, CALIBRATED, EVERY = 10.0, 0.002, 40, 8
RIG_FILE, RIG_BEND, RIG_FACING = "webxr_hand_right.glb", math.radians(45), (0.0, -math.pi / 2, 0.0)
LONG_GROWTH, LONG_MEGABYTES = 1.1, 16.0
# The first frame is searched everywhere, the second checks what was found.
STARTED = 2


@dataclass(frozen=True)
class Line:
    """One figure beside its bar; without a bar it is told only."""

    case: str
    figure: str
    measured: float
    bar: float | None = None
    least: bool = False

    @property
    def passed(self) -> bool:
        """Whether the bar is met."""
        return self.bar is None or (self.measured >= self.bar if self.least else self.measured <= self.bar)

    def __str__(self) -> str:
        text = f"{self.case:16} {self.figure:46} {self.measured:8.2f}"
        sign = ">=" if self.least else "<="
        return text if self.bar is None else f"{text}   {sign} {self.bar:g}: {'pass' if self.passed else 'FAIL'}"


@dataclass(frozen=True)
class Track:
    """A tracked sequence beside the truth.

    Args:
        result: of T frames.
        errors: (T, 5) of fingertips in mm.
        seen: (T, 5) which of them are seen.
        in_view: (T,) whether the hand is.
        busy: (T,) seconds of processor time of each frame.
    """

    result: tr.TrackResult
    errors: Tensor
    seen: Tensor
    in_view: Tensor
    busy: Tensor = field(default_factory=lambda: torch.zeros(0))

    @property
    def worst(self) -> Tensor:
        """The largest error (T,) of a seen fingertip."""
        return torch.where(self.seen, self.errors, 0.0).amax(1)

    @property
    def lost(self) -> int:
        """Frames in which the hand is in view and lost."""
        usable = torch.tensor([status.usable for status in self.result.statuses])
        return int((~usable & self.in_view).sum())


def timed_run(tracker: tr.Tracker, clouds: Sequence[HandCloud]) -> tuple[tr.TrackResult, Tensor]:
    """Return what a tracker makes of clouds, and the processor time (T,) of each frame, which other programs spare."""
    ticks = [time.process_time()]
    points = tqdm([cloud.points for cloud in clouds], leave=False, disable=None)
    result = tracker.run(points, lambda cloud, frame: ticks.append(time.process_time()))
    return result, torch.tensor(ticks, dtype=torch.float64).diff()


def track(tracker: tr.Tracker, clouds: Sequence[HandCloud]) -> Track:
    """Return what a tracker makes of clouds of a hand."""
    result, busy = timed_run(tracker, clouds)
    true = torch.stack([cloud.keypoints for cloud in clouds])
    seen = torch.stack([cloud.seen_parts[list(tr.Hand().fingertip_parts)] for cloud in clouds])
    counts = torch.stack([cloud.inliers.sum() for cloud in clouds])
    errors = 1e3 * (result.keypoints - true).norm(dim=-1)[:, TIPS]
    return Track(result, errors, seen, counts >= IN_VIEW * counts.max(), busy)


def least_squares(hand: tr.Hand, clouds: Sequence[HandCloud]) -> Tensor:
    """Return errors (T, 5) in mm of fingertips where squared surface distances of the true inliers are least."""
    precision = torch.zeros(hand.num_dofs)
    precision[6:] = HELD**-2
    poses = []
    for cloud in clouds:
        data, pose = cloud.points[cloud.inliers][None], cloud.pose[None]
        wide, noise = torch.tensor([0.1]), torch.tensor([NOISE])
        objective = distance_objective(
            FusedSurface(hand), data, torch.ones_like(data[..., 0]), wide, noise, GaussianPosePrior(pose, precision)
        )
        with torch.no_grad():
            found = levenberg_marquardt(
                objective, pose, retract=hand.retract, lower=hand.lower, upper=hand.upper, max_steps=8
            )
        poses.append(found.state[0])
    true = torch.stack([cloud.keypoints for cloud in clouds])
    with torch.no_grad():
        return 1e3 * (hand.keypoints(torch.stack(poses)) - true).norm(dim=-1)[:, TIPS]


def smoothed_errors(tracked: Track, clouds: Sequence[HandCloud], config: tr.TrackConfig) -> Tensor:
    """Return errors (T, 5) in mm of fingertips after a second pass over all frames."""
    result = tr.smooth_track(tracked.result, [cloud.points for cloud in clouds], config=config)
    true = torch.stack([cloud.keypoints for cloud in clouds])
    return 1e3 * (result.keypoints - true).norm(dim=-1)[:, TIPS]


def frames_back(tracked: Track, clouds: Sequence[HandCloud]) -> list[int]:
    """Return after how many frames from the end of each flip the seen fingertips are under 5 mm again, on average."""
    turns = torch.stack([cloud.pose[3:6] for cloud in clouds])
    fast = compose_rotation_vectors(turns[1:], -turns[:-1]).norm(dim=-1) > FLIPPING
    ends = [k + 2 for k in range(len(fast) - 1) if fast[k] and not fast[k + 1]]
    mean = torch.where(tracked.seen, tracked.errors, torch.nan).nanmean(1)
    under = (mean < WORST_BAR).tolist()
    return [next((k for k, good in enumerate(under[end:]) if good), len(under)) for end in ends]


def exact_lines(hand: tr.Hand, config: tr.TrackConfig, frames: int, seeds: Sequence[int]) -> list[Line]:
    lines, surface = [], surface_skin(hand)
    for motion in MOTIONS:
        clouds = [hand_sequence(motion, frames, shape=hand, skin=surface, seed=seed) for seed in seeds]
        tracks = [track(tr.Tracker(hand, config=config), sequence) for sequence in clouds]
        least = torch.cat([least_squares(hand, sequence) for sequence in clouds])
        errors, seen = (torch.cat([getattr(one, name) for one in tracks]) for name in ("errors", "seen"))
        pairs = zip(tracks, clouds, strict=True)
        second = torch.cat([smoothed_errors(one, sequence, config) for one, sequence in pairs])
        worst, in_view = (torch.cat([getattr(one, name) for one in tracks]) for name in ("worst", "in_view"))
        seconds = torch.cat([one.result.seconds[STARTED:] for one in tracks])
        busy = torch.cat([one.busy[STARTED:] for one in tracks])
        how = Counter(how for one in tracks for how in one.result.acquired)
        bar = WORST_SHARE if motion in STEADY else None
        lines += [
            Line(motion, "seen fingertips, mean mm", float(errors[seen].mean()), MEAN_BAR),
            Line(motion, "the same by least squares from the truth", float(least[seen].mean())),
            Line(motion, "the same after the second pass", float(second[seen].mean()), float(errors[seen].mean())),
            Line(
                motion, "share of frames with the worst <= 5 mm", float((worst <= WORST_BAR).double().mean()), bar, True
            ),
            Line(motion, "median of frames in view, worst mm", float(worst[in_view].median())),
            Line(motion, "hidden fingertips, mean mm", float(errors[~seen].mean())),
            Line(motion, "the same after the second pass", float(second[~seen].mean())),
            Line(motion, "frames lost in view", sum(one.lost for one in tracks), None if motion == "flip" else 0),
            Line(motion, "frames/s after the start", float(1 / seconds.mean()), RATE_BAR, True),
            Line(motion, "the same by processor time", float(1 / busy.mean())),
            Line(motion, "the same of the median frame", float(1 / busy.median())),
            *(Line(motion, f"frames {name}", count) for name, count in sorted(how.items())),
        ]
        if motion == "flip":
            back = [count for one, sequence in zip(tracks, clouds, strict=True) for count in frames_back(one, sequence)]
            lines.append(Line(motion, "frames after a flip until under 5 mm", max(back, default=0), BACK_FRAMES))
    return lines


def other_lines(model: tr.Hand, config: tr.TrackConfig, frames: int, seeds: Sequence[int]) -> list[Line]:
    plain, fitted, least = [], [], []
    for seed in seeds:
        truth = other_hand(torch.Generator().manual_seed(seed), nu=OTHER_NU)
        surface = surface_skin(truth, sharpness=OTHER_SHARPNESS)
        clouds = hand_sequence("bending_palm", frames, shape=truth, skin=surface, seed=seed)
        first = min(CALIBRATED, frames // 2)
        before = track(tr.Tracker(model, config=config), clouds)
        chosen = list(range(0, first, max(1, min(EVERY, first // 2))))
        found = tr.calibrate(model, [clouds[k].points for k in chosen], before.result.poses[chosen])
        hand = found.shape
        after = track(tr.Tracker(hand, before.result.poses[first], config=config), clouds[first:])
        fitted.append(after.errors[after.seen])
        plain.append(before.errors[first:][before.seen[first:]])
        least.append(least_squares(hand, clouds[first:])[after.seen])
    return [
        Line("other", "seen fingertips, mean mm, calibrated", float(torch.cat(fitted).mean()), OTHER_BAR),
        Line("other", "the same, not calibrated", float(torch.cat(plain).mean())),
        Line("other", "the same by least squares, calibrated", float(torch.cat(least).mean())),
    ]


def rig_lines(folder: Path, config: tr.TrackConfig, frames: int) -> list[Line]:
    parents = runpy.run_path(str(Path(__file__).with_name("rig_hand.py")))["hand_parents"]
    shape = tr.ArticulatedShape.from_gltf(folder / RIG_FILE, parents=parents())
    bend = torch.zeros(shape.num_dofs)
    bend[torch.tensor(["phalanx" in name and name.endswith("_x") for name in shape.dof_names])] = -RIG_BEND
    clouds = rig_sequence(shape, bend, frames, facing=RIG_FACING)
    skin = shape.file_skin()
    lines = []
    starts = {"rig": None, "rig, told a pose": clouds[0].pose}
    for case, start in starts.items():
        result, busy = timed_run(tr.Tracker(shape, start, config=config), clouds)
        with torch.no_grad():
            errors = 1e3 * (skin(result.poses) - torch.stack([cloud.vertices for cloud in clouds])).norm(dim=-1)
        parts = skin.weights.argmax(-1)
        seen = torch.stack([cloud.seen_parts[parts] for cloud in clouds])
        lost = sum(not status.usable for status in result.statuses)
        lines += [
            Line(case, "vertices of seen parts, mean mm", float(errors[seen].mean()), RIG_BAR),
            Line(case, "the same in the worst frame", float(torch.where(seen, errors, torch.nan).nanmean(1).max())),
            Line(case, "frames lost", lost, 0),
            Line(case, "frames/s after the start", float(1 / result.seconds[STARTED:].mean())),
            Line(case, "the same by processor time", float(1 / busy[STARTED:].mean())),
        ]
    return lines


def long_lines(hand: tr.Hand, config: tr.TrackConfig, frames: int, period: int) -> list[Line]:
    """Return the lines of a motion that comes back after a number of frames, followed again and again."""
    clouds = hand_sequence("bending_palm", period, shape=hand)
    tracker, megabytes, seconds, busy, statuses = tr.Tracker(hand, config=config), [], [], [], []
    for number in tqdm(range(frames), leave=False, disable=None):
        begin, tick = time.perf_counter(), time.process_time()
        statuses.append(tracker.step(clouds[number % period].points).statuses[0])
        seconds.append(time.perf_counter() - begin)
        busy.append(time.process_time() - tick)
        megabytes.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    tenth = max(1, frames // 10)
    first, last = (torch.tensor(part).median() for part in (busy[STARTED : tenth + STARTED], busy[-tenth:]))
    return [
        Line("long", "median time of the last over the first tenth", float(last / first), LONG_GROWTH),
        Line("long", "MB more at the end than after a tenth", megabytes[-1] - megabytes[tenth], LONG_MEGABYTES),
        Line("long", "frames lost", sum(not status.usable for status in statuses), 0),
        Line("long", "frames/s after the start", (frames - STARTED) / sum(seconds[STARTED:]), RATE_BAR, True),
        Line("long", "the same by processor time", (frames - STARTED) / sum(busy[STARTED:])),
    ]


def corrupted_lines(hand: tr.Hand, config: tr.TrackConfig, frames: int) -> list[Line]:
    """Return the lines of a sequence some of whose frames are no use."""
    clouds = hand_sequence("bending_palm", frames, shape=hand)
    generator = torch.Generator().manual_seed(0)
    low, high = clouds[0].vertices.amin(0) - 0.1, clouds[0].vertices.amax(0) + 0.1
    noise = low + (high - low) * torch.rand(800, 3, generator=generator)
    bad = {
        0.2: ("an empty frame", torch.zeros(0, 3), tr.Status.NO_DATA),
        0.35: ("a frame in millimeters", None, tr.Status.OTHER_UNITS),
        0.5: ("a frame of noise", noise, tr.Status.LOST),
        0.65: ("a frame without numbers", torch.full((800, 3), torch.nan), tr.Status.NO_DATA),
    }
    at = {round(share * frames): entry for share, entry in bad.items()}
    dropped = range(round(0.8 * frames), round(0.8 * frames) + 5)
    tracker, lines, mean = tr.Tracker(hand, config=config), [], {}
    for number, cloud in enumerate(clouds):
        if number in dropped:
            continue
        name, points, status = at.get(number, ("", cloud.points, None))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", tr.errors.UnitsWarning)
            result = tracker.step(1000 * cloud.points if points is None else points, number / 20)
        if status is not None:
            lines.append(Line("corrupted", f"{name}: named so", float(result.status is status), 1, True))
        seen = cloud.seen_parts[list(hand.fingertip_parts)]
        mean[number] = float((result.keypoints - cloud.keypoints)[TIPS][seen].norm(dim=-1).mean()) * 1e3
    for number, name in [*((number, entry[0]) for number, entry in at.items()), (dropped[-1], "five frames missing")]:
        back = next((k for k in range(frames - number - 1) if mean[number + 1 + k] < WORST_BAR), frames)
        lines.append(Line("corrupted", f"{name}: frames until under 5 mm", back, BACK_FRAMES))
    return lines


def main(arguments: Sequence[str] | None = None) -> list[Line]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    cases = ("exact", "other", "rig", "long", "corrupted")
    parser.add_argument("--case", choices=cases, action="append", help="one of the cases; all by default")
    parser.add_argument("--frames", type=int, default=100, help="frames per sequence (default 100)")
    parser.add_argument("--long-frames", type=int, default=1000, help="frames of the long sequence (default 1000)")
    parser.add_argument("--seeds", type=int, default=2, help="sequences per motion (default 2)")
    parser.add_argument("--data", type=Path, help=f"folder with {RIG_FILE}, for the rig")
    parser.add_argument("--model-points", choices=("seen", "data", "shape"), default=tr.TrackConfig().model_points)
    parser.add_argument("--prediction", choices=("velocity", "none"), default=tr.TrackConfig().prediction)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--smoke", action="store_true", help="a few frames of every case but the rig")
    options = parser.parse_args(arguments)
    if options.smoke:
        options.frames, options.long_frames, options.seeds = 4, 10, 1
    torch.set_num_threads(options.threads)
    chosen = options.case or [case for case in cases if case != "rig" or options.data is not None]
    if "rig" in chosen and (options.data is None or not (options.data / RIG_FILE).is_file()):
        parser.error(f"the rig needs --data FOLDER with {RIG_FILE} in it")
    config = tr.TrackConfig(model_points=options.model_points, prediction=options.prediction)
    hand, seeds = tr.Hand().requires_grad_(False), range(options.seeds)
    lines: list[Line] = []
    for case in chosen:
        if case == "exact":
            lines += exact_lines(hand, config, options.frames, seeds)
        elif case == "other":
            lines += other_lines(hand, config, options.frames, seeds)
        elif case == "rig":
            lines += rig_lines(options.data, config, min(options.frames, 60))
        elif case == "long":
            lines += long_lines(hand, config, options.long_frames, options.frames)
        else:
            lines += corrupted_lines(hand, config, max(options.frames, 30))
    for line in lines:
        print(line)
    judged = [line for line in lines if line.bar is not None]
    print(f"{sum(line.passed for line in judged)} of {len(judged)} bars met")
    return lines


if __name__ == "__main__":
    main()
