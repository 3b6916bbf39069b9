"""Fits the models of an alignment's confidence: limbs in pictures, whole pictures, and poses by family.

    python benchmarks/calibrate_confidence.py --data SHARED --rooms 80 --count 200   # prints all models; hours
    python benchmarks/calibrate_confidence.py --smoke              # 3 rooms, 6 others: 30 CPU s, to see that it runs

Alignments are drawn as by confidence.py (clouds and cut pictures of hands, with SHARED a robot arm and a fox), by
company.py (with SHARED: clouds of any rig alone, among others, and of others) and by scenes.py, on seeds that none
measures: hands among other things, hands that hold things, arms, and rooms without them. In a room every crop that is
tried counts, not the answer alone. What each is judged by is kept, so that it is judged again by the models fitted
before it:

1. `LimbModel`: whether the end of a limb is off by at most a tenth of the shape's size, where most limbs are right;
2. `PictureModel`: whether a pose lies about on the shape, at even odds before;
3. `Calibration`: whether a pose is right, by the evidence that uses both; with weights for rooms and for elsewhere, and
   a bias for each family of shapes;
4. `PresenceModel` (alone: ``--only presence``): whether a tracker's search in a cloud of many things found the shape.

The table is of models of poses fitted to the other cases, five times without a fifth of the seeds.
"""

from __future__ import annotations

import argparse
import math
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).parent))
import company
from confidence import Drawn, Subject, area_under_curve, ends_of, observed, subjects, turns
from scenes import cases

import torchreg as tr
from experiments.made_up.rooms import KINDS, TRAINING_SEEDS
from torchreg.alignment import pose_rows
from torchreg.alignment.evidence import picture_agreement, reliability
from torchreg.alignment.evidence.confidence import limb_data
from torchreg.alignment.evidence.picture_agreement import LimbModel, PictureModel, picture_views
from torchreg.alignment.evidence.reliability import EVIDENCE_NAMES, Calibration
from torchreg.alignment.find_pose import FindPoseConfig
from torchreg.geometry.rotation import so3_exp
from torchreg.shapes.pose_algebra import shifted
from torchreg.solvers.calibration import fit_logistic
from torchreg.tracking.evidence import PresenceModel, presence_evidence
from torchreg.tracking.frame import Frame

FOLDS, MISPLACED, ABOUT, BIAS_STD = 5, 0.1, 0.15, 1.0
ROOM_FAMILIES = {"hand": "room with a hand", "held": "room with a hand", "arm": "room with a robot"}
LIMB_DATA = 30.0  # that only one limb explains: with fewer no picture is needed to doubt it
FAR, CUT_OFF = 0.4, 0.7  # of the size, between which poses tell nothing; of the data, at most
# Of poses that explain as much one is right, which shapes without symmetry do not teach.
RIVALS = [EVIDENCE_NAMES.index(name) for name in ("rival", "rival_share")]
UNKNOWN, WRONG = EVIDENCE_NAMES.index("unknown"), 2.0  # times that a wrong pose counts: a lie costs more than a doubt
FIRST_SEED = 50_000  # of clouds and cut pictures: those before are measured by confidence.py


@dataclass
class Judged:
    """What an alignment was judged by, and the truth.

    Args:
        told: what `judge` takes: problem, pose, lead, error, frames, rivals, and whether it is a crop.
        ends: (L,) errors of the limbs' ends, metres; None where the shape is not there.
        right: whether the pose is right.
        near: whether it lies about on the shape.
        is_answer: whether it is what `align` returned.
    """

    kind: str
    family: str
    seed: int
    told: tuple[Any, ...]
    ends: Tensor | None
    right: bool
    near: bool
    is_answer: bool
    views: list[Any] = field(default_factory=list)
    evidence: Tensor | None = None

    @property
    def in_room(self) -> bool:
        """Whether it is of a whole picture."""
        return self.family in ROOM_FAMILIES.values()

    @property
    def size(self) -> float:
        """Of the shape, metres."""
        return float(self.told[0].size)


def recorded(align: Callable[[], tr.AlignResult]) -> tuple[list[tuple[Any, ...]], tr.AlignResult]:
    """Return what each judgement of an alignment was given, and the answer."""
    calls = []

    def judge(problem: Any, pose: Tensor, lead: Any, error: Any, *told: Any) -> Any:
        calls.append((problem, pose, lead, error, *told))
        return reliability.judge(problem, pose, lead, error, *told)

    with patch.object(pose_rows, "judge", judge), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return calls, align()


def world_pose(told: tuple[Any, ...]) -> Tensor:
    return shifted(told[1], told[0].origin)[0]


def in_rooms(kind: str, seed: int, there: bool) -> Iterator[Judged]:
    """Yield all judgements of a room."""
    scene = KINDS[kind](seed, there)
    calls, found = recorded(lambda: tr.align(scene.shape, scene.frame))
    for told in calls:
        pose, ends = world_pose(told), None
        if there and scene.keypoints is not None:
            ends = (scene.shape.keypoints(pose) - scene.keypoints)[4::4].norm(dim=-1)
        yield Judged(
            kind=f"room, {kind}", family=ROOM_FAMILIES[kind], seed=seed, told=told, ends=ends,
            right=scene.is_right(pose), near=scene.is_near(pose, told[0].size),
            is_answer=torch.allclose(pose, found.pose),
        )  # fmt: skip


def alone(thing: Subject, seed: int) -> Iterator[Judged]:
    """Yield the judgement of a cloud or cut picture of one shape."""
    drawn = Drawn.of(thing, seed)
    calls, _ = recorded(lambda: tr.align(thing.shape, drawn.data, drawn.start, model_points=thing.skin))
    pose = world_pose(calls[-1])
    ends = drawn.end_errors(thing, pose)
    right = float(ends.mean()) <= reliability.CALIBRATION.right * thing.size
    yield Judged(
        kind=drawn.kind, family={"arm": "robot", "fox": "rig"}.get(thing.name, "hand"), seed=seed, told=calls[-1],
        ends=ends, right=right, near=float(ends.mean()) <= ABOUT * thing.size, is_answer=True,
    )  # fmt: skip


def in_company(data: Path, seed: int) -> Iterator[Judged]:
    """Yield the judgement of a cloud that may show other things, too, or instead."""
    asked = company.scene(data, seed)
    calls, _ = recorded(lambda: tr.align(asked.thing.shape, asked.data, asked.start, model_points=asked.thing.skin))
    right = asked.is_right(world_pose(calls[-1]))
    yield Judged(
        kind=asked.place, family="rig" if asked.thing.name.endswith(".glb") else asked.thing.name, seed=seed,
        told=calls[-1], ends=None, right=right, near=right, is_answer=True,
    )  # fmt: skip


def looked_at(cases: Sequence[Judged]) -> list[Judged]:
    """Return the cases with a picture, with how it agrees."""
    for case in cases:
        case.views = picture_views(*case.told[:2], case.told[4])
    return [case for case in cases if case.views]


def limb_rows(cases: Sequence[Judged]) -> tuple[Tensor, Tensor]:
    """Return the views (N, E) of limbs with data, in poses mostly right, and whether each is in place (N,)."""
    views, right = [], []
    for case in cases:
        if case.ends is not None and float(case.ends.median()) <= MISPLACED * case.size:
            told = limb_data(*case.told[:2])[0] > LIMB_DATA
            views.append(case.views[0][1].table()[told])
            right.append((case.ends <= MISPLACED * case.size)[told])
    return torch.cat(views), torch.cat(right)


def fitted_limbs(cases: Sequence[Judged]) -> LimbModel:
    return LimbModel(**vars(fit_logistic(*limb_rows(cases))))


def fitted_pictures(cases: Sequence[Judged]) -> PictureModel:
    """Return the model of whether a pose lies about on the shape, at even odds before."""
    near = torch.tensor([case.near for case in cases])
    model = fit_logistic(torch.stack([case.views[0][0].table() for case in cases]), near)
    return PictureModel(bias=round(model.bias - float(near.double().mean().logit()), 2), weights=model.weights)


def judge_again(cases: Sequence[Judged], limbs: LimbModel, pictures: PictureModel) -> None:
    """Gather the evidence of all cases by other models of pictures."""
    with patch.multiple(picture_agreement, LIMB_MODEL=limbs, PICTURE_MODEL=pictures), torch.inference_mode():
        for case in cases:
            case.evidence = reliability.judge(*case.told).evidence.table()[0].clone()


def fitted_poses(cases: Sequence[Judged]) -> dict[str, Calibration]:
    """Return the model of whether a pose is right of each family; rooms have weights of their own, too.

    In a room, poses from a network's start have no rivals: they choose a crop, and what they find is judged again.
    """
    told = [case for case in cases if not case.in_room or case.told[2] is not None]
    rooms = by_family([case for case in told if case.in_room], reliability.PICTURE_CALIBRATION)
    return rooms | by_family([case for case in told if not case.in_room], reliability.CALIBRATION, [*RIVALS, UNKNOWN])


def by_family(cases: Sequence[Judged], before: Calibration, held: Sequence[int] = ()) -> dict[str, Calibration]:
    """Return a model of each family: the weights are those of all, the bias is its own.

    The model fitted to other cases ``before`` is moved, except for weights that are ``held``. A family's bias is off
    the common one by a normal deviate of `BIAS_STD`, so that few cases change little. Of poses cases count as far as
    the data show all limbs.
    """
    if not cases:
        return {}
    table, right = torch.stack([case.evidence for case in cases if case.evidence is not None]).double(), rights(cases)
    weights = torch.where(right, 1.0, WRONG) * (1 - table[:, UNKNOWN]) if before.is_of_poses else None
    common, found = fit_logistic(table, right, weights, before, held), {}
    for family in dict.fromkeys(case.family for case in cases):
        chosen = torch.tensor([case.family == family for case in cases])
        offsets = torch.linspace(-4, 4, 161, dtype=torch.float64).unsqueeze(-1)
        odds = common.log_odds(table[chosen]) + offsets
        likelihood = -torch.nn.functional.softplus(torch.where(right[chosen], -odds, odds)).sum(-1, keepdim=True)
        offset = float(offsets[(likelihood - 0.5 * (offsets / BIAS_STD).square()).argmax()])
        found[family] = replace(before, bias=round(common.bias + offset, 2), weights=common.weights)
    return found


def rights(cases: Sequence[Judged]) -> Tensor:
    return torch.tensor([case.right for case in cases])


def crossed(cases: Sequence[Judged]) -> Tensor:
    """Return the confidence (N,) in each case by models of poses that were fitted without a fifth of the seeds.

    It is zero where no other case is of a family.
    """
    found = torch.zeros(len(cases), dtype=torch.float64)
    for fold in range(FOLDS):
        models = fitted_poses([case for case in cases if case.seed % FOLDS != fold])
        for number, case in enumerate(cases):
            if case.seed % FOLDS == fold and case.family in models:
                found[number] = models[case.family].probability(case.evidence.double())
    return found


def render(cases: Sequence[Judged], sure: Tensor) -> str:
    """Return area and calibration of the answers' confidence (N,) by family and by kind of scene."""
    lines = []
    for name in ("family", "kind"):
        for value in dict.fromkeys(getattr(case, name) for case in cases):
            chosen = torch.tensor([getattr(case, name) == value and case.is_answer for case in cases])
            right, mine = rights(cases)[chosen], sure[chosen]
            is_sure = mine >= reliability.CALIBRATION.doubtful
            lines.append(
                f"{value:12} {len(mine):4} answers: mean confidence {float(mine.mean()):.2f}, right "
                f"{float(right.double().mean()):.2f}, area under the curve {area_under_curve(mine, right):.2f}; sure "
                f"{int(is_sure.sum())}, {int((is_sure & ~right).sum())} of them wrong"
            )
    return "\n".join(lines)


def drawn(data: Path | None, rooms: int, count: int) -> Iterator[Judged]:
    """Yield all judgements of some rooms of each kind, and of clouds and cut pictures."""
    for case in tqdm(list(cases(tuple(KINDS), rooms, TRAINING_SEEDS)), desc="rooms", leave=False, disable=None):
        yield from in_rooms(*case)
    things = turns(subjects(data))
    for seed in tqdm(range(FIRST_SEED, FIRST_SEED + count), desc="alone", leave=False, disable=None):
        yield from alone(things[seed % len(things)], seed)
    if data is not None:
        for seed in tqdm(range(min(count, company.FIRST_SEED)), desc="company", leave=False, disable=None):
            yield from in_company(data, seed)


def among_others(things: Sequence[Subject], seed: int) -> tuple[Subject, Tensor, Tensor | None]:
    """Return a thing, a cloud (M, 3), and the ends (L, 3) of the thing's limbs; None where the cloud does not show it.

    In the cloud are a tube, a wall and outliers beside the thing, of which a side may be cut off, or another one or
    nothing in its place.
    """
    generator, thing = torch.Generator().manual_seed(seed), things[seed % len(things)]
    there, whole, part = (torch.rand(3, generator=generator) - torch.tensor([0.5, 0.5, 0.0])).tolist()
    shown = thing if there < 0 else things[seed % len(things) - 1]
    _, data, pose, truth = observed(shown, generator)
    points = (data.points if isinstance(data, tr.DepthFrame) else data).float()
    middle = points.mean(0)
    ends = ends_of(truth, thing.skin, pose) if there < 0 else None
    if ends is None:
        scaled = middle + (0.6 + 0.6 * part) * thing.size / shown.size * (points - middle)
        points = scaled if whole < 0 and shown is not thing else points[:1]
    elif whole < 0:
        along = points @ torch.randn(3, generator=generator)
        points = points[along >= along.quantile(CUT_OFF * part)]
    angle = math.pi * torch.rand(150, generator=generator)
    tube = torch.stack([0.15 * angle.cos(), 0.15 * angle.sin(), 0.8 * torch.rand(150, generator=generator)], dim=-1)
    wall = torch.tensor([2.0, 2.0, 0.01]) * (torch.rand(300, 3, generator=generator) - 0.5)
    turned = so3_exp(math.pi * torch.randn(2, 3, generator=generator)).mT
    sides = 0.6 * torch.nn.functional.normalize(torch.randn(2, 3, generator=generator), dim=-1)
    placed = zip((tube, wall), turned, sides, strict=True)
    others = [middle + thing.size * (side + each @ turn) for each, turn, side in placed]
    return thing, torch.cat([points, *others]).to(thing.shape.rest), ends


def fitted_presence(things: Sequence[Subject], count: int) -> PresenceModel:
    """Return the model of whether a search shows its shape; poses neither near nor far from it tell nothing."""
    evidence, right = [], []
    for seed in tqdm(range(FIRST_SEED, FIRST_SEED + count), desc="searches", leave=False, disable=None):
        thing, cloud, ends = among_others(things, seed)
        tracker = tr.Tracker(thing.shape, model_points=thing.skin)
        frame = Frame(cloud=cloud, finite=torch.ones(len(cloud), dtype=torch.bool), elapsed=1.0)
        with torch.no_grad():
            fit = tracker._recover._find(tracker.state, frame, FindPoseConfig())
            error = math.inf
            if fit is not None and ends is not None:
                found = ends_of(thing.shape, thing.skin, fit.world_pose)
                error = float((found - ends).norm(dim=-1).mean()) / thing.size
            if fit is not None and not ABOUT < error <= FAR:
                evidence.append(presence_evidence(fit))
                right.append(error <= ABOUT)
    return PresenceModel(**vars(fit_logistic(torch.stack(evidence), torch.tensor(right))))


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder with xarm7 and rigs")
    parser.add_argument("--rooms", type=int, default=80, help="pictures of each kind of room")
    parser.add_argument("--count", type=int, default=200, help="clouds and cut pictures")
    parser.add_argument("--smoke", action="store_true", help="a few of each")
    parser.add_argument("--only", choices=["presence"], help="one of the models")
    given = parser.parse_args(arguments)
    rooms, count = (1, 6) if given.smoke else (given.rooms, given.count)
    if given.only == "presence":
        print(fitted_presence([thing for thing in subjects(given.data) if thing.name != "fox"], count))
        return 0
    found = list(drawn(None if given.smoke else given.data, rooms, count))
    pictured = looked_at(found)
    limbs, pictures = fitted_limbs(pictured), fitted_pictures(pictured)
    judge_again(found, limbs, pictures)
    print(render(found, crossed(found)))
    print(limbs, pictures, fitted_poses(found), sep="\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
