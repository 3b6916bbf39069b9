"""A shape among other things: whole depth pictures of rooms, tables and crates, with it and without.

    python benchmarks/scenes.py                         # 32 pictures of each kind, some minutes
    python benchmarks/scenes.py --kinds held --list     # of one kind, scene by scene
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
from dataclasses import dataclass
from pathlib import Path

import torch
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).parent))
from confidence import area_under_curve

import torchreg as tr
from experiments.made_up.rooms import KINDS, Scene


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


def cases(kinds: Sequence[str], count: int, start: int = 0) -> Iterator[tuple[str, int, bool]]:
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
    parser.add_argument("--start", type=int, default=0, help="seed of the first")
    parser.add_argument("--list", action="store_true", help="print every scene, too")
    parser.add_argument("--smoke", action="store_true", help="two pictures")
    given = parser.parse_args(arguments)
    count, kinds = (2, ["hand"]) if given.smoke else (given.count, given.kinds)
    chosen = list(cases(kinds, count, given.start))
    bar = tqdm(chosen, desc="pictures", leave=False, disable=None)
    rows = []
    for case in bar:
        rows.append(measure(*case))
        if given.list:
            print(rows[-1].line(), flush=True)
    print(render(rows))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
