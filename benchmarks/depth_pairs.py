"""Two depth pictures of a room in which a creature moved: what is found to move, and what a registration makes of it.

    python benchmarks/depth_pairs.py                         # creatures of kinds that no model was trained on
    python benchmarks/depth_pairs.py --data SHARED --count 60     # and rigs of the folder SHARED/library
    python benchmarks/depth_pairs.py --smoke                 # one pair

- overlap: intersection over union of the pixels found to move with the true ones, mean of both pictures;
- registered: pairs of whose creature 90 % of the points end within 2.5 % of its diagonal of the truth, and the mean
  error; of the whole pictures, of what is found to move (the default), and of the true masks;
- sure and wrong: pairs with a usable status, a confidence of .5 or more and a mean error over 4 %.
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torchreg as tr
from experiments.made_up.creature_kinds import HELD_OUT_KINDS
from experiments.made_up.creature_parts import Draw
from experiments.made_up.matching_pairs import PosableBody, drawn_body
from experiments.made_up.room_pairs import RoomPair, room_pair
from experiments.matcher.rigs import body_of_rig

# Of the creature's diagonal: a point is right, a pair is wrong.
RIGHT, WRONG = 0.025, 0.04
WAYS = ("whole", "moved", "true masks")


def bodies(folder: Path | None, count: int) -> Iterator[tuple[str, PosableBody]]:
    """Yield so many bodies: of kinds never trained on, or rigs spread evenly over those of a folder."""
    if folder is None:
        kinds = list(HELD_OUT_KINDS)
        for number in range(count):
            kind = kinds[number % len(kinds)]
            yield kind, drawn_body(HELD_OUT_KINDS[kind][0], Draw(torch.Generator().manual_seed(number)))
        return
    with (folder / "index.csv").open(encoding="utf-8", newline="") as index:
        rows = [row for row in csv.DictReader(index) if row["torchreg"] == "ok"]
    for number in range(count):
        row = rows[number * len(rows) // count]
        yield row["kind"], body_of_rig(folder / row["file"])


def overlap(found: Tensor, mask: Tensor, frame: tr.DepthFrame) -> float:
    """Return the intersection over the union of two masks (H, W) among measured pixels."""
    true = mask & frame.measured
    return float((found & true).sum() / (found | true).sum().clamp_min(1))


def outcome(pair: RoomPair, way: str) -> tuple[float, bool, bool, float]:
    """Return the mean error in diagonals, whether the pair is registered, whether it is sure and wrong, CPU seconds."""
    begin = time.process_time()
    frames = list(pair.frames)
    if way == "true masks":
        frames = [frame.cropped(mask) for frame, mask in zip(frames, pair.masks, strict=True)]
    if way == "whole":
        scans = [tr.depth_scan(frame.depth, frame.camera) for frame in frames]
        found = tr.register(scans[0], scans[1])
    else:
        found = tr.register(frames[0], frames[1])
    seconds = time.process_time() - begin
    column, row = pair.frames[0].camera.project(found.points.double())[0].round().long().unbind(-1)
    truth = pair.truth[row, column]
    shown = truth.isfinite().all(-1)
    errors = (found.deformed - truth)[shown].norm(dim=-1) / pair.size
    if not len(errors):
        return 1.0, False, found.status.usable and (found.confidence or 0.0) >= 0.5, seconds
    error = float(errors.mean())
    sure = found.status.usable and (found.confidence or 0.0) >= 0.5
    return error, float((errors < RIGHT).double().mean()) >= 0.9, sure and error > WRONG, seconds


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder that holds library; without, made-up creatures alone")
    parser.add_argument("--count", type=int, default=20, help="pairs of each of both")
    parser.add_argument("--seed", type=int, default=0, help="of the first room")
    parser.add_argument("--shake", type=float, default=0.0, help="of the camera between pictures, radians and metres")
    parser.add_argument("--smoke", action="store_true", help="one pair")
    given = parser.parse_args(arguments)
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    folders = [None] if given.data is None or given.smoke else [None, given.data / "library"]
    for folder in folders:
        rows, overlaps = {way: [] for way in WAYS}, []
        for number, (_, body) in enumerate(bodies(folder, 1 if given.smoke else given.count)):
            pair = room_pair(body, given.seed + number, shake=given.shake)
            moved = tr.moved_masks(*pair.frames)
            sides = zip((moved.source, moved.target), pair.masks, pair.frames, strict=True)
            overlaps.append(sum(overlap(*side) for side in sides) / 2)
            for way in WAYS:
                rows[way].append(outcome(pair, way))
        values = torch.tensor(overlaps)
        name = "made up" if folder is None else "rigs"
        print(f"{name}: {len(overlaps)} pairs, overlap {values.mean():.3f}, {int((values < 0.5).sum())} below .5")
        for way in WAYS:
            error, right, wrong, seconds = zip(*rows[way], strict=True)
            print(
                f"  {way:10s} registered {sum(right):3d}, error {100 * sum(error) / len(error):5.2f} %, "
                f"sure and wrong {sum(wrong)}, {sum(seconds) / len(seconds):.1f} CPU s"
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
