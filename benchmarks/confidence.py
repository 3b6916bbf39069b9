"""How far the confidence and the covariance of an alignment can be trusted, on made-up data.

    python benchmarks/confidence.py --data SHARED              # reliability on data not used to calibrate
    python benchmarks/confidence.py --data SHARED --only arm --count 30
    python benchmarks/confidence.py --diagram FILE.png         # draws the reliability beside
    python benchmarks/confidence.py --smoke                    # a few alignments, to see that it runs

Each case is drawn: a hand (bones and radii 5 to 15 % off in most of them) as a cloud of the side that a camera
sees, or from all sides, or as a depth picture with the errors of a sensor; with SHARED/xarm7 and SHARED/rigs also a
robot arm and a fox, as clouds. Clouds hold 200 to 2,000 points, 0.1 to 3 mm noise (of a hand; larger shapes
accordingly) and up to 35 % outliers. Two thirds of the hands and arms, and a third of the foxes, are searched without a
start; the others start from the truth, turned by up to half a turn.

A pose is right if the ends of its limbs are off by at most 5.8 % of the shape's size on average: 15 mm of a hand.

Bars: in every tenth of the confidence the share that is right is within .1 of the mean confidence, or its 95 %
(Wilson) interval reaches there ("chance"); the area under its curve is .85 or more; of right poses 90 to 98 % lie in
the covariance's 95 % ellipsoid.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torchreg as tr
from experiments.made_up.depth_noise import DepthNoise
from experiments.made_up.shape_sequences import other_hand
from torchreg.alignment.evidence.confidence import limb_ends
from torchreg.alignment.evidence.reliability import CALIBRATION
from torchreg.datasets.hand import make_hand_cloud, surface_skin
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.rotation import compose_rotation_vectors
from torchreg.geometry.visibility import rasterize
from torchreg.shapes.pose_algebra import difference

SIZES, NOISES, OUTLIERS = (200, 500, 1000, 2000), (0.0005, 0.012), 0.35
SEARCHED, OTHER, PICTURES, CUT, STRETCHED, WHOLE = 0.67, 0.7, 0.5, 0.3, 0.3, 0.4
SENSORS = (DepthNoise.structured_light(), DepthNoise.time_of_flight(), DepthNoise(quadratic=1e-3, jitter=0.3))
OTHER_SCALES = (0.05, 0.05, 0.1, 0.1, 0.15)
FOCAL, WIDTH, HEIGHT = 475.0, 320, 240
BINS, HANDS = 10, 8


@dataclass(frozen=True)
class Subject:
    """A shape, and what is drawn from it.

    Args:
        name: in the tables.
        shape: that is aligned.
        skin: its model points.
        truths: shapes that are measured, each with its surface.
        size: diagonal, metres.
        searched: share that is searched without a start.
    """

    name: str
    shape: tr.ArticulatedShape
    skin: tr.LinearBlendSkin
    truths: tuple[tuple[tr.ArticulatedShape, tr.LinearBlendSkin], ...]
    size: float
    searched: float = SEARCHED


@dataclass(frozen=True)
class Case:
    """An alignment and its truth."""

    kind: str
    searched: bool
    status: tr.Status
    error: float
    evidence: Tensor
    confidence: float
    covered: bool
    seconds: float
    seed: int
    pose: Tensor


def subject(name: str, shape: tr.ArticulatedShape, others: Sequence[tr.ArticulatedShape] = ()) -> Subject:
    skin = tr.sample_skin(shape)
    truths = tuple((truth, surface_skin(truth)) for truth in (shape, *others))
    return Subject(name, shape, skin, truths, float((skin.points.amax(0) - skin.points.amin(0)).norm()))


def subjects(data: Path | None) -> list[Subject]:
    hand = tr.Hand()
    found = [
        subject(
            "hand", hand, [other_hand(torch.Generator().manual_seed(k), scale) for k, scale in enumerate(OTHER_SCALES)]
        )
    ]
    return [*found, *other_subjects(data)]


def other_subjects(data: Path | None) -> list[Subject]:
    """Return a robot arm and an animal; nothing without data."""
    if data is None:
        print("without --data: no robot and no animal")
        return []
    arm = tr.ArticulatedShape.from_urdf(data / "xarm7" / "xarm7.urdf")
    fox = tr.ArticulatedShape.from_gltf(data / "rigs" / "fox-animations.glb")
    return [subject("arm", arm), replace(subject("fox", fox), searched=0.5 * SEARCHED)]


def random_pose(shape: tr.ArticulatedShape, size: float, generator: torch.Generator) -> Tensor:
    """Return a pose of any rotation about two sizes before the camera, its joints bent by up to half of their range.

    In a third of the cases the shape is stretched: hardly any joint is bent.
    """
    pose = shape.rest_pose()
    reach = 0.5 * torch.rand(shape.num_dofs - 6, generator=generator)
    reach = reach * (
        1 - (torch.rand((), generator=generator) < STRETCHED) * torch.rand(len(reach), generator=generator).round()
    )
    low, high = shape.lower[6:].clamp_min(-1.0), shape.upper[6:].clamp_max(1.0)
    side = torch.rand(shape.num_dofs - 6, generator=generator) < high / (high - low).clamp_min(1e-6)
    pose[6:] = torch.where(side, high.clamp_min(0), low.clamp_max(0)) * reach
    turn = torch.nn.functional.normalize(torch.randn(4, generator=generator, dtype=torch.float64), dim=0)
    angle = 2 * torch.atan2(turn[1:].norm(), turn[0])
    pose[3:6] = (angle * torch.nn.functional.normalize(turn[1:], dim=0)).to(pose)
    with torch.no_grad():
        middle = shape.keypoints(pose).mean(0)
    pose[:3] -= middle
    pose[2] += size * (1.6 + 1.6 * float(torch.rand((), generator=generator)))
    return shape.clamp(pose)


def picture(
    surface: tr.LinearBlendSkin,
    pose: Tensor,
    generator: torch.Generator,
    *,
    cut: float = 0.0,
    sensor: DepthNoise | None = None,
) -> tr.DepthFrame:
    """Return a frame of a posed surface before a wall, by a sensor, in some cases with a side cut off."""
    camera = tr.Camera(WIDTH, HEIGHT, (FOCAL, FOCAL, 0.5 * (WIDTH - 1), 0.5 * (HEIGHT - 1)))
    raster = rasterize(TriangleMesh(surface(pose), surface.faces), camera.view())
    shown = raster.face_index >= 0
    depth = torch.where(shown, raster.depth, float(pose[2]) + 0.5).float()
    sensor = sensor or SENSORS[int(torch.randint(len(SENSORS), (), generator=generator))]
    depth = sensor.measured(depth, generator)
    if float(torch.rand((), generator=generator)) < cut:
        _, columns = shown.nonzero().unbind(-1)
        line = int(columns.float().quantile(0.6 + 0.3 * float(torch.rand((), generator=generator))))
        # What is cut off may show the hand: the mask tells nothing there.
        beyond = torch.arange(WIDTH) >= line
        shown, depth = shown | beyond, torch.where(beyond, 0.0, depth)
    return tr.DepthFrame(depth, camera, shown)


def observed(thing: Subject, generator: torch.Generator) -> tuple[str, object, Tensor, tr.ArticulatedShape]:
    """Return the kind of a drawn case, its data, the true pose and the shape that was measured."""
    draw = torch.rand(6, generator=generator).tolist()
    number = int(draw[0] / OTHER * (len(thing.truths) - 1)) + 1 if draw[0] < OTHER and len(thing.truths) > 1 else 0
    truth, surface = thing.truths[number]
    pose = random_pose(truth, thing.size, generator)
    if thing.name == "hand" and draw[1] < PICTURES:
        return "picture", picture(surface, pose, generator, cut=CUT), pose, truth
    low, high = NOISES
    cloud = make_hand_cloud(
        truth,
        pose,
        num_points=SIZES[int(draw[2] * len(SIZES))],
        noise=thing.size * (low + (high - low) * draw[3] ** 2),
        outlier_ratio=OUTLIERS * draw[4],
        camera=None if draw[5] < WHOLE else torch.zeros(3),
        skin=surface,
        generator=generator,
    )
    return thing.name, cloud.points, pose, truth


def turned(pose: Tensor, shape: tr.ArticulatedShape, generator: torch.Generator) -> Tensor:
    """Return a pose turned about its middle by up to half a turn, seldom by so much, and bent otherwise."""
    draw = torch.rand(2, generator=generator).tolist()
    axis = torch.nn.functional.normalize(torch.randn(3, generator=generator), dim=0)
    turn = axis * math.pi * draw[0] ** 2
    start = pose.clone()
    start[3:6] = compose_rotation_vectors(turn, pose[3:6])
    start[6:] += 0.6 * draw[1] * torch.randn(len(pose) - 6, generator=generator)
    start = shape.clamp(start)
    with torch.no_grad():
        start[:3] += shape.keypoints(pose).mean(0) - shape.keypoints(start).mean(0)
    return start


def ends_of(shape: tr.ArticulatedShape, surface: tr.LinearBlendSkin, pose: Tensor) -> Tensor:
    with torch.no_grad():
        return surface(pose)[limb_ends(surface)] if not isinstance(shape, tr.Hand) else shape.keypoints(pose)[4::4]


@dataclass(frozen=True)
class Drawn:
    """A drawn case: its kind and data, the start of the alignment or None, the true pose and the shape measured."""

    kind: str
    data: object
    start: Tensor | None
    pose: Tensor
    truth: tr.ArticulatedShape

    @classmethod
    def of(cls, thing: Subject, seed: int) -> Drawn:
        """Return the case of a seed."""
        generator = torch.Generator().manual_seed(seed)
        kind, data, pose, truth = observed(thing, generator)
        searched = float(torch.rand((), generator=generator)) < thing.searched
        return cls(kind, data, None if searched else turned(pose, thing.shape, generator), pose, truth)

    def end_errors(self, thing: Subject, pose: Tensor) -> Tensor:
        """Return how far the ends of the limbs are off in a pose, (L,) metres."""
        found, true = ends_of(thing.shape, thing.skin, pose), ends_of(self.truth, thing.skin, self.pose)
        return (found - true).norm(dim=-1)


def measure(thing: Subject, seed: int) -> Case:
    """Return a case, drawn by a seed."""
    drawn = Drawn.of(thing, seed)
    begin = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = tr.align(thing.shape, drawn.data, drawn.start, model_points=thing.skin)
    seconds = time.process_time() - begin
    error = drawn.end_errors(thing, found.pose).mean()
    off = difference(found.pose[None], drawn.pose[None])[0].double()
    deviation = off @ torch.linalg.solve(found.covariance.double(), off)
    # That a Gaussian of that covariance is no farther off than the truth: 95 % of the time it is within the ellipsoid.
    inside = torch.special.gammainc(torch.tensor(0.5 * len(off), dtype=torch.float64), 0.5 * deviation) <= 0.95
    return Case(
        kind=drawn.kind, searched=drawn.start is None, status=found.status, error=float(error) / thing.size,
        evidence=found.evidence, confidence=float(found.confidence), covered=bool(inside), seconds=seconds, seed=seed,
        pose=found.pose,
    )  # fmt: skip


def turns(things: Sequence[Subject]) -> list[Subject]:
    """Return subjects in the order in which seeds draw them, hands eight times as often as each other one."""
    return [thing for thing in things for _ in range(HANDS if thing.name == "hand" else 1)]


def collect(things: Sequence[Subject], seeds: Sequence[int], kept: Path | None = None) -> list[Case]:
    """Return cases of some seeds of all subjects.

    Args:
        things: subjects.
        seeds: of the cases.
        kept: file of measured cases, which are not measured again; new ones are added.
    """
    order, known = turns(things), {}
    if kept is not None and kept.exists():
        known = {case.seed: case for case in torch.load(kept, weights_only=False)}
    for number, seed in enumerate(tqdm(seeds, desc="alignments", leave=False, disable=None)):
        if seed in known:
            continue
        known[seed] = measure(order[seed % len(order)], seed)
        if kept is not None and (number % 10 == 9 or seed == seeds[-1]):
            torch.save(list(known.values()), kept)
    return [known[seed] for seed in seeds]


def is_right(cases: Sequence[Case]) -> Tensor:
    return torch.tensor([case.error <= CALIBRATION.right for case in cases])


def area_under_curve(confidence: Tensor, right: Tensor) -> float:
    """Return the probability that a right case is surer than a wrong one."""
    good, bad = confidence[right], confidence[~right]
    if not len(good) or not len(bad):
        return math.nan
    return float((good[:, None] > bad).double().mean() + 0.5 * (good[:, None] == bad).double().mean())


def render(cases: Sequence[Case]) -> str:
    """Return the tables of reliability, of statuses and of coverage."""
    lines = reliability(cases)
    area = area_under_curve(confidences(cases), is_right(cases))
    lines.append(f"area under the curve {area:.3f}  >= .85: {'pass' if area >= 0.85 else 'FAIL'}")
    for kind in sorted({case.kind for case in cases}):
        lines.append(line_of(kind, [case for case in cases if case.kind == kind]))
    return "\n".join(lines)


def confidences(cases: Sequence[Case]) -> Tensor:
    return torch.tensor([case.confidence for case in cases])


def reliability(cases: Sequence[Case]) -> list[str]:
    """Return for each tenth of the confidence the cases, the mean, the share that is right, and whether they agree.

    They do if the share is within .1 of the mean, but for chance: if its 95 % interval reaches there.
    """
    right, confidence = is_right(cases), confidences(cases)
    lines = [f"{'confidence':12} {'cases':>6} {'mean':>6} {'right':>6}  95 % interval"]
    for low in torch.arange(BINS) / BINS:
        chosen = (confidence >= low) & ((confidence < low + 1 / BINS) | (low + 1 / BINS >= 1))
        count = int(chosen.sum())
        if count == 0:
            continue
        mean, share = float(confidence[chosen].mean()), float(right[chosen].double().mean())
        least, most = wilson_interval(share, count)
        near = "pass" if abs(mean - share) <= 0.1 else "chance" if least - 0.1 <= mean <= most + 0.1 else "FAIL"
        span = f"{least:.2f} to {most:.2f}  {near}"
        lines.append(f"{low:4.1f} to {low + 1 / BINS:3.1f}  {count:6} {mean:6.2f} {share:6.2f}  {span}")
    return lines


def draw(cases: Sequence[Case], file: Path) -> None:
    """Draw the share that is right over the mean confidence, with 95 % intervals, and how many cases there are."""
    from matplotlib import pyplot

    right, confidence = is_right(cases).double(), confidences(cases).double()
    number = (confidence * BINS).long().clamp_max(BINS - 1)
    figure, (axis, below) = pyplot.subplots(2, 1, figsize=(4.5, 5.2), height_ratios=(3, 1), sharex=True)
    axis.fill_between([0, 1], [-0.1, 0.9], [0.1, 1.1], color="0.9", label="within .1")
    axis.plot([0, 1], [0, 1], color="0.5", linewidth=1)
    for chosen in (number == bin for bin in number.unique()):
        count, share, mean = int(chosen.sum()), float(right[chosen].mean()), float(confidence[chosen].mean())
        low, high = wilson_interval(share, count)
        axis.errorbar(mean, share, [[share - low], [high - share]], fmt="o", color="C0", capsize=3)
    below.hist(confidence.numpy(), bins=BINS, range=(0, 1), color="C0")
    axis.set(xlim=(0, 1), ylim=(-0.02, 1.02), ylabel="share that is right")
    axis.legend(frameon=False, loc="upper left")
    below.set(xlabel="confidence", ylabel="cases")
    figure.tight_layout()
    figure.savefig(file, dpi=110)
    pyplot.close(figure)


def wilson_interval(share: float, count: int) -> tuple[float, float]:
    """Return the 95 % interval of a probability of which a share of some trials came out. References: Wilson 1927."""
    z = 1.96
    middle = (share + z**2 / (2 * count)) / (1 + z**2 / count)
    reach = z / (1 + z**2 / count) * math.sqrt(share * (1 - share) / count + (z / (2 * count)) ** 2)
    return min(middle - reach, share), max(middle + reach, share)


def line_of(kind: str, cases: Sequence[Case]) -> str:
    """Return a line about the cases of a kind: right, statuses, coverage, seconds."""
    right = is_right(cases)
    sure = torch.tensor([case.status is tr.Status.CONVERGED for case in cases])
    far = torch.tensor([case.error > 25 / 15 * CALIBRATION.right for case in cases])
    seconds = torch.tensor([case.seconds for case in cases])
    covered = torch.tensor([case.covered for case in cases])[right].double().mean()
    return (
        f"{kind:8} {len(cases):5} cases: {right.double().mean():4.0%} right, {sure[right].double().mean():4.0%} of "
        f"them converged, {int((sure & far).sum())} converged and far off, 95 % ellipsoid holds {covered:4.0%}, "
        f"median {seconds.median():.1f} CPU s"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder with xarm7 and rigs")
    parser.add_argument("--count", type=int, default=200, help="alignments")
    parser.add_argument("--only", choices=("hand", "arm", "fox"), help="alignments of one shape alone")
    parser.add_argument("--diagram", type=Path, help="picture of the reliability to be written")
    parser.add_argument("--kept", type=Path, help="file of measured cases, to go on with; of this version only")
    parser.add_argument("--smoke", action="store_true", help="four alignments")
    options = parser.parse_args(arguments)
    data = None if options.smoke else options.data
    if data is None and options.only not in (None, "hand"):
        parser.error(f"--only {options.only} needs --data")
    things = [thing for thing in subjects(data) if options.only in (None, thing.name)]
    count = 4 if options.smoke else options.count
    cases = collect(things, range(count), options.kept)
    print(render(cases))
    if options.diagram is not None:
        draw(cases, options.diagram)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
