"""How sure an alignment is of a shape among other things, in clouds.

    python benchmarks/company.py --data SHARED --count 60     # seeds that no model was fitted to
    python benchmarks/company.py --smoke                      # two hands, to see that it runs

Every case is drawn: a rig of SHARED/library of any kind, or (a quarter) a hand, or an arm or fox of SHARED, turned in
any way, its joints bent at random, as a cloud of all sides or of the one that a camera sees, 400 to 2,600 points with
noise of .05 to .65 % of the size, some with outliers. It is alone, beside another creature, or touches it, or a
creature of another build is in its place. Half are searched without a start; the others start up to half a turn off.

Right: the ends of the limbs are off by at most 5.8 % of the size on average. Sure: the confidence is at least .5. Bars:
of what is sure at most 2 % is wrong in any place, and 80 % of what is right is sure.
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import torch
from confidence import Subject, area_under_curve, ends_of, random_pose, subject, subjects, turned
from torch import Tensor
from torch.nn.functional import normalize
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torchreg as tr
from torchreg.alignment.evidence.reliability import CALIBRATION
from torchreg.datasets.hand import make_hand_cloud

PLACES = ("alone", "beside", "instead", "alone", "beside", "touching")
MOST_JOINTS, LIBRARY_TURNS = 60, 4
BUILDS = {
    "biped": ("human", "monster", "robot", "toy", "hand", "panda", "koala", "monkey"),
    "fish": ("fish", "shark", "whale", "dolphin", "ray", "turtle"),
    "bug": ("insect", "spider", "crab"),
    **{kind: (kind,) for kind in ("snake", "plant", "object", "vehicle", "bat")},
}
FIRST_SEED = 1000  # those before are for fits
WRONG_BAR, SURE_BAR = 0.02, 0.8


@dataclass(frozen=True)
class Scene:
    """A cloud (M, 3) and the shape that is sought in it; ``ends`` (L, 3) of its limbs, None where it is not there."""

    place: str
    thing: Subject
    data: Tensor
    start: Tensor | None
    ends: Tensor | None

    def is_right(self, pose: Tensor) -> bool:
        """Return whether the shape is there, and the ends of its limbs are where they are in a pose."""
        if self.ends is None:
            return False
        off = (ends_of(self.thing.shape, self.thing.skin, pose) - self.ends).norm(dim=-1).mean()
        return float(off) <= CALIBRATION.right * self.thing.size


@dataclass(frozen=True)
class Answer:
    """What an alignment said, and whether that is right."""

    place: str
    right: bool
    confidence: float
    evidence: Tensor
    seconds: float


@cache
def library(data: Path) -> dict[str, list[str]]:
    """Return the files of rigs by kind."""
    rows: dict[str, list[str]] = {}
    with (data / "library" / "index.csv").open() as lines:
        for row in csv.DictReader(lines):
            if row["torchreg"] == "ok" and int(row["joints"]) <= MOST_JOINTS:
                rows.setdefault(row["kind"], []).append(row["file"])
    return dict(sorted(rows.items()))


@cache
def known_subjects(data: Path | None) -> list[Subject]:
    return subjects(data)


def build_of(kind: str) -> str:
    """Return which kinds are built alike; whatever is not listed walks on four legs."""
    return next((build for build, kinds in BUILDS.items() if kind in kinds), "quadruped")


def any_of(count: int, generator: torch.Generator) -> int:
    return int(torch.randint(count, (), generator=generator))


def creature(data: Path | None, generator: torch.Generator, but: str | None = None) -> tuple[str, Subject]:
    """Return a rig of the library of another build, and its build; a hand without data."""
    if data is None:
        return "biped", known_subjects(None)[0]
    kinds = library(data)
    while True:
        kind = list(kinds)[any_of(len(kinds), generator)]
        file = kinds[kind][any_of(len(kinds[kind]), generator)]
        if build_of(kind) != but:
            return build_of(kind), subject(file, tr.ArticulatedShape.from_gltf(data / "library" / file))


def posed_cloud(thing: Subject, one_sided: bool, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Return the pose of a thing and a cloud (M, 3) of it."""
    pose = random_pose(thing.shape, thing.size, generator)
    if thing.name.endswith(".glb"):
        # The limits of a rig are no habits: bones seldom turn far from rest.
        rest, std = thing.shape.rest_pose()[6:], 0.1 + 0.25 * torch.rand((), generator=generator)
        pose[6:] = rest + std * torch.randn(len(rest), generator=generator)
        pose = thing.shape.clamp(pose)
    count, noise, outliers = torch.rand(3, generator=generator).tolist()
    cloud = make_hand_cloud(
        thing.shape, pose, num_points=int(400 + 2200 * count), noise=thing.size * (0.0005 + 0.006 * noise**2),
        outlier_ratio=0.15 * outliers * (outliers > 0.5), camera=torch.zeros(3) if one_sided else None,
        skin=thing.truths[0][1], generator=generator,
    )  # fmt: skip
    return pose, cloud.points


def scene(data: Path | None, seed: int) -> Scene:
    """Return the scene of a seed."""
    generator, place, build = torch.Generator().manual_seed(seed), PLACES[seed % len(PLACES)], None
    turn = seed // len(PLACES)
    if data is not None and turn % LIBRARY_TURNS:
        build, thing = creature(data, generator)
    else:
        known = known_subjects(data)
        thing = known[turn // LIBRARY_TURNS % len(known)]
    one_sided = float(torch.rand((), generator=generator)) < 0.5
    pose, points = posed_cloud(thing, one_sided, generator)
    if place != "alone":
        _, other = creature(data, generator, build if place == "instead" else None)
        _, cloud = posed_cloud(other, one_sided, generator)
        scale = (0.6 + 0.6 * float(torch.rand((), generator=generator))) * thing.size / other.size
        points = placed(points, scale * (cloud - cloud.mean(0)), place, thing.size, generator)
    searched = float(torch.rand((), generator=generator)) < 0.5
    return Scene(
        place=place, thing=thing, data=points.to(thing.shape.rest),
        start=None if searched else turned(pose, thing.shape, generator),
        ends=None if place == "instead" else ends_of(thing.shape, thing.skin, pose),
    )  # fmt: skip


def placed(points: Tensor, other: Tensor, place: str, size: float, generator: torch.Generator) -> Tensor:
    """Return a cloud (M, 3) with a centered one of another creature beside it, or that one in its place."""
    middle = points.mean(0)
    if place == "instead":
        return other + middle
    side = normalize(torch.randn(3, generator=generator), dim=0)
    gap = 0.0 if place == "touching" else (0.1 + 0.5 * float(torch.rand((), generator=generator))) * size
    apart = float(((points - middle) @ side).max()) - float((other @ side).min()) + gap
    return torch.cat([points, other + middle + apart * side])


def measure(data: Path | None, seed: int) -> Answer:
    """Return what an alignment of a seed's scene says."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        asked, begin = scene(data, seed), time.process_time()
        found = tr.align(asked.thing.shape, asked.data, asked.start, model_points=asked.thing.skin)
    seconds = time.process_time() - begin
    return Answer(asked.place, asked.is_right(found.pose), float(found.confidence), found.evidence, seconds)


def render(answers: Sequence[Answer]) -> str:
    """Return a line about the answers of each place, and of all."""
    lines = []
    for place in (*dict.fromkeys(PLACES), "all"):
        chosen = [answer for answer in answers if place in (answer.place, "all")]
        if not chosen:
            continue
        right = torch.tensor([answer.right for answer in chosen])
        confidence = torch.tensor([answer.confidence for answer in chosen])
        sure, seconds = confidence >= CALIBRATION.doubtful, torch.tensor([answer.seconds for answer in chosen])
        lines.append(
            f"{place:9} {len(chosen):4} clouds: right {int(right.sum()):3}, sure of {int((sure & right).sum()):3}; "
            f"sure and wrong {int((sure & ~right).sum()):2}; area {area_under_curve(confidence, right):.3f}; "
            f"median {float(seconds.median()):.1f} CPU s"
        )
    wrong, told = float((sure & ~right).double().mean()), float(sure[right].double().mean())
    lines.append(f"sure and wrong {wrong:.1%} <= {WRONG_BAR:.0%}: {'pass' if wrong <= WRONG_BAR else 'FAIL'}")
    lines.append(f"sure of what is right {told:.0%} >= {SURE_BAR:.0%}: {'pass' if told >= SURE_BAR else 'FAIL'}")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder with library, xarm7 and rigs")
    parser.add_argument("--count", type=int, default=60, help="clouds")
    parser.add_argument("--start", type=int, default=FIRST_SEED, help="first seed")
    parser.add_argument("--threads", type=int, default=1, help="of torch")
    parser.add_argument("--smoke", action="store_true", help="two hands")
    given = parser.parse_args(arguments)
    if given.data is None and not given.smoke:
        print("skipped: needs --data with library")
        return 0
    torch.set_num_threads(given.threads)
    seeds = range(given.start, given.start + (2 if given.smoke else given.count))
    data = None if given.smoke else given.data
    print(render([measure(data, seed) for seed in tqdm(seeds, desc="clouds", leave=False, disable=None)]))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
