"""A shape among other things: whole depth pictures of rooms, tables and crates, with it and without.

    python benchmarks/scenes.py                         # 32 pictures of each kind, some minutes
    python benchmarks/scenes.py --kinds held --list     # of one kind, scene by scene
    python benchmarks/scenes.py --calibrate --count 160 # on other seeds: fits the model of whole pictures
    python benchmarks/scenes.py --smoke                 # two pictures, to see that it runs

Each picture is drawn, see `experiments.made_up.rooms`: a camera looks onto a table before a wall, with crates, cans and
balls on it. hand: a hand with its forearm held over it; arm: an arm of random links that stands on it; held: a hand of
other proportions that holds a thing. In half of them the shape is not there; of the kind held a creature is instead, of
kinds that nothing was fitted to. Depths have the errors of a sensor. No mask, no start.

A hand is right if its fingertips are off by at most 15 mm on average, an arm if its joints are by at most 3 degrees and
its base by 20 mm; its foot looks alike after half a turn. Sure means that the status is usable.

Bars: of the pictures without the thing, sure in at most 1 %; of those with it, right in 80 %; the area under the curve
of the confidence .95.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).parent))
from confidence import area_under_curve, fitted_model

import torchreg as tr
from experiments.made_up.rooms import KINDS, TRAINING_SEEDS, Scene
from torchreg.alignment.evidence.picture_agreement import PictureAgreement, PictureModel
from torchreg.alignment.fit.problem import model_size
from torchreg.capture.depth_segments import candidate_crops

MOST_CROPS = 4  # of a picture that the model is fitted to


@dataclass(frozen=True)
class Row:
    """What came out of a scene."""

    scene: Scene
    seed: int
    right: bool
    status: tr.Status
    confidence: float
    seconds: float

    @property
    def there(self) -> bool:
        """Whether the picture shows the shape."""
        return self.scene.pose is not None

    def line(self) -> str:
        """Return what came out in words."""
        truth, found = ("there" if self.there else "absent"), "right" if self.right else "wrong"
        return f"{self.scene.kind:5} {self.seed:4} {truth:6} {found} {self.status.name:12} {self.confidence:.2f}"


def cases(kinds: Sequence[str], count: int, start: int) -> Iterator[tuple[str, int, bool]]:
    """Yield kind, seed and whether the shape is there; hands have even seeds, arms odd ones."""
    for number in range(count):
        seeds = {"hand": 2 * number, "arm": 2 * number + 1}
        for kind in kinds:
            yield kind, start + seeds.get(kind, number), number % 2 == 0


def measure(kind: str, seed: int, there: bool) -> Row:
    scene = KINDS[kind](seed, there)
    begin = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = tr.align(scene.shape, scene.frame)
    return Row(
        scene=scene, seed=seed, right=scene.is_right(found.pose), status=found.status,
        confidence=float(found.confidence), seconds=time.process_time() - begin,
    )  # fmt: skip


def crop_cases(kind: str, seed: int, there: bool) -> Iterator[tuple[Tensor, bool]]:
    """Yield the agreement (E,) of poses found in the first crops of a picture, and whether they lie on the shape.

    Where the shape is in a crop, it is also fitted from the true pose.
    """
    scene = KINDS[kind](seed, there)
    skin, quick = tr.sample_skin(scene.shape), tr.AlignConfig(search="never")
    near = replace(quick, schedule=tr.SigmaSchedule.geometric(0.008, 0.004, 2))
    crops = [crop for surface in candidate_crops(scene.frame, model_size(skin)) for crop in surface]
    starts = [(None, quick)] + [(scene.pose, near)] * there
    for crop in crops[:MOST_CROPS]:
        for start, config in starts:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                pose = tr.align(scene.shape, crop, start, model_points=skin, config=config).pose
            yield PictureAgreement.of(skin, pose, crop).table(), scene.is_near(pose, model_size(skin))


def calibrated(rows: Sequence[tuple[Tensor, bool]]) -> PictureModel:
    """Return the model of highest likelihood on crops, at even odds before."""
    near = torch.tensor([row[1] for row in rows])
    bias, weights = fitted_model(torch.stack([row[0] for row in rows]), near)
    return PictureModel(round(bias - float(near.double().mean().logit()), 2), weights)


def render(rows: Sequence[Row]) -> str:
    """Return the table by kind, with its bars."""
    lines = []
    for kind in dict.fromkeys(row.scene.kind for row in rows):
        mine = [row for row in rows if row.scene.kind == kind]
        shown, absent = [row for row in mine if row.there], [row for row in mine if not row.there]
        right, sure = sum(row.right for row in shown), sum(row.right and row.status.usable for row in shown)
        lies = sum(row.status.usable and not row.right for row in shown)
        seconds = sorted(row.seconds for row in mine)
        lines.append(
            f"{kind:5} there {len(shown):3}: right {right:3}, sure and right {sure:3}, sure and wrong {lies:3} | "
            f"absent {len(absent):3}: sure {sum(row.status.usable for row in absent):3}, not found "
            f"{sum(row.status is tr.Status.NOT_FOUND for row in absent):3} | area under the curve "
            f"{area(*mine):.3f}, median {seconds[len(seconds) // 2]:.1f} CPU s"
        )
    lines.append(f"area under the curve of all {area(*rows):.3f}  >= .95: {'pass' if area(*rows) >= 0.95 else 'FAIL'}")
    return "\n".join(lines)


def area(*rows: Row) -> float:
    return area_under_curve(torch.tensor([row.confidence for row in rows]), torch.tensor([row.right for row in rows]))


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=32, help="pictures of each kind")
    parser.add_argument("--kinds", nargs="+", choices=tuple(KINDS), default=list(KINDS), help="of scenes")
    parser.add_argument("--list", action="store_true", help="print every scene, too")
    parser.add_argument("--calibrate", action="store_true", help="fit the model of whole pictures")
    parser.add_argument("--smoke", action="store_true", help="two pictures")
    given = parser.parse_args(arguments)
    count, kinds = (2, ["hand"]) if given.smoke else (given.count, given.kinds)
    chosen = list(cases(kinds, count, TRAINING_SEEDS if given.calibrate else 0))
    bar = tqdm(chosen, desc="pictures", leave=False, disable=None)
    if given.calibrate:
        print(calibrated([row for case in bar for row in crop_cases(*case)]))
        return 0
    rows = []
    for case in bar:
        rows.append(measure(*case))
        if given.list:
            print(rows[-1].line(), flush=True)
    print(render(rows))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
