"""How far the confidence and the covariance of an alignment can be trusted, on made-up data.

    python benchmarks/confidence.py --data SHARED              # reliability on data not used to calibrate
    python benchmarks/confidence.py --data SHARED --calibrate  # fits the model of the confidence anew
    python benchmarks/confidence.py --smoke                    # a few alignments, to see that it runs

Each case is drawn: a hand (with another skin and bones 5 % off in half of them) as a cloud of the side that a camera
sees, or as a depth picture with the errors of a sensor; with SHARED/xarm7 and SHARED/rigs also a robot arm and a fox,
as clouds. Clouds hold 200 to 2,000 points, 0.5 to 3 mm noise (of a hand; larger shapes accordingly) and up to 35 %
outliers. Two thirds are searched without a start; the others start from the truth, turned by up to half a turn.

A pose is right if the ends of its limbs are off by at most 5.8 % of the shape's size on average: 15 mm of a hand.

Bars: in every tenth of the confidence with 15 cases or more, the share that is right is within .1 of the mean
confidence; the area under its curve is .85 or more; of right poses 90 to 98 % lie in the covariance's 95 % ellipsoid.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

import torchreg as tr
from torchreg.alignment.confidence import limb_ends
from torchreg.capture.depth_noise import DepthNoise
from torchreg.datasets.hand import make_hand_cloud, surface_skin
from torchreg.datasets.sequences import other_hand
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.rotation import compose_rotation_vectors
from torchreg.geometry.visibility import rasterize
from torchreg.shapes.pose_algebra import difference

SIZES, NOISES, OUTLIERS = (200, 500, 1000, 2000), (0.002, 0.012), 0.35
SEARCHED, OTHER, PICTURES, CUT = 0.67, 0.5, 0.5, 0.3
SENSORS = (DepthNoise.structured_light(), DepthNoise.time_of_flight(), DepthNoise(quadratic=1e-3, jitter=0.3))
FOCAL, WIDTH, HEIGHT = 475.0, 320, 240
RIDGE, EPOCHS, BINS, MIN_CASES = 0.02, 200, 10, 15


@dataclass(frozen=True)
class Subject:
    """A shape, and what is drawn from it.

    Args:
        name: in the tables.
        shape: that is aligned.
        skin: its model points.
        truths: shapes that are measured, each with its surface.
        size: diagonal, metres.
    """

    name: str
    shape: tr.ArticulatedShape
    skin: tr.LinearBlendSkin
    truths: tuple[tuple[tr.ArticulatedShape, tr.LinearBlendSkin], ...]
    size: float


@dataclass(frozen=True)
class Case:
    """An alignment and its truth."""

    kind: str
    searched: bool
    status: tr.Status
    error: float
    evidence: Tensor
    confidence: float
    deviation: float
    seconds: float


def subject(name: str, shape: tr.ArticulatedShape, others: Sequence[tr.ArticulatedShape] = ()) -> Subject:
    skin = tr.sample_skin(shape)
    truths = tuple((truth, surface_skin(truth)) for truth in (shape, *others))
    return Subject(name, shape, skin, truths, float((skin.points.amax(0) - skin.points.amin(0)).norm()))


def subjects(data: Path | None) -> list[Subject]:
    hand = tr.Hand()
    found = [subject("hand", hand, [other_hand(torch.Generator().manual_seed(seed)) for seed in range(3)])]
    if data is None:
        print("without --data: no robot and no animal")
        return found
    arm = tr.ArticulatedShape.from_urdf(data / "xarm7" / "xarm7.urdf")
    fox = tr.ArticulatedShape.from_gltf(data / "rigs" / "fox-animations.glb")
    return [*found, subject("arm", arm), subject("fox", fox)]


def random_pose(shape: tr.ArticulatedShape, size: float, generator: torch.Generator) -> Tensor:
    """Return a pose of any rotation about two sizes before the camera, its joints bent by up to half of their range."""
    pose = shape.rest_pose()
    reach = 0.5 * torch.rand(shape.num_dofs - 6, generator=generator)
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
    surface: tr.LinearBlendSkin, pose: Tensor, generator: torch.Generator, *, cut: float = 0.0
) -> tr.DepthFrame:
    """Return a frame of a posed surface before a wall, in some cases with a side of the mask cut off."""
    camera = tr.Camera(WIDTH, HEIGHT, (FOCAL, FOCAL, 0.5 * (WIDTH - 1), 0.5 * (HEIGHT - 1)))
    raster = rasterize(TriangleMesh(surface(pose), surface.faces), camera.view())
    shown = raster.face_index >= 0
    depth = torch.where(shown, raster.depth, float(pose[2]) + 0.5).float()
    sensor = SENSORS[int(torch.randint(len(SENSORS), (), generator=generator))]
    depth = sensor.measured(depth, generator)
    if float(torch.rand((), generator=generator)) < cut:
        _, columns = shown.nonzero().unbind(-1)
        line = int(columns.float().quantile(0.6 + 0.3 * float(torch.rand((), generator=generator))))
        shown = shown & (torch.arange(WIDTH) < line)
        depth = torch.where(torch.arange(WIDTH) < line, depth, 0.0)
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
        camera=torch.zeros(3),
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


def measure(thing: Subject, seed: int) -> Case:
    """Return a case, drawn by a seed."""
    generator = torch.Generator().manual_seed(seed)
    kind, data, pose, truth = observed(thing, generator)
    searched = float(torch.rand((), generator=generator)) < SEARCHED
    start = None if searched else turned(pose, thing.shape, generator)
    begin = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = tr.align(thing.shape, data, start, model_points=thing.skin)
    seconds = time.process_time() - begin
    surface = thing.skin
    error = (ends_of(thing.shape, surface, found.pose) - ends_of(truth, surface, pose)).norm(dim=-1).mean()
    off = difference(found.pose[None], pose[None])[0].double()
    deviation = float(off @ torch.linalg.solve(found.covariance.double(), off))
    return Case(
        kind=kind, searched=searched, status=found.status, error=float(error) / thing.size, evidence=found.evidence,
        confidence=float(found.confidence), deviation=deviation, seconds=seconds,
    )  # fmt: skip


def collect(things: Sequence[Subject], count: int, seed: int) -> list[Case]:
    """Return cases of all subjects, hands twice as often as the others together."""
    turns = [things[0], things[0], *things[1:]] if len(things) > 1 else list(things)
    return [
        measure(turns[number % len(turns)], seed + number)
        for number in tqdm(range(count), desc="alignments", leave=False, disable=None)
    ]
