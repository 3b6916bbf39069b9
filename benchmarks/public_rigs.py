"""Rigs that others made: python benchmarks/public_rigs.py --data FOLDER [--refine 30].

Prints how many of the .glb and .gltf files `ArticulatedShape.from_gltf` opens, the wall seconds that it takes, those
that the solids take when a search asks for them, of some of the files, and why the others are refused.
"""

from __future__ import annotations

import argparse
import re
import statistics
import time
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import torch

import torchreg as tr

Value = TypeVar("Value")


def timed(call: Callable[[], Value]) -> tuple[Value, float]:
    """Return the result of a call and its wall seconds."""
    begin = time.perf_counter()
    return call(), time.perf_counter() - begin


def line(name: str, seconds: dict[str, float]) -> str:
    """Return the line on the times of some files."""
    slowest = max(seconds, key=lambda file: seconds[file])
    median = statistics.median(seconds.values())
    return f"{name:10}  {len(seconds):4}  median {median:6.3f} s  most {seconds[slowest]:6.3f} s ({slowest})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder of .glb and .gltf files")
    parser.add_argument("--refine", type=int, default=30, help="number of files whose solids are refined")
    options = parser.parse_args()
    files = sorted(file for file in options.data.iterdir() if file.suffix in (".glb", ".gltf"))
    every = max(1, len(files) // max(1, options.refine))
    from_gltf = tr.ArticulatedShape.from_gltf  # imported before the clock runs
    opened, refined, reasons = dict[str, float](), dict[str, float](), Counter[str]()
    for number, file in enumerate(files):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", tr.errors.FileWarning)
            try:
                shape, seconds = timed(lambda file=file: from_gltf(file))
            except tr.errors.TorchregError as error:
                # Names and numbers aside, reasons are alike.
                reasons[re.sub(r"'[^']*'|\([^)]*\)|\d[\d.e+-]*", "_", str(error).removeprefix(f"{file}: "))] += 1
                continue
        opened[file.name] = seconds
        if number % every == 0:
            refined[file.name] = timed(lambda shape=shape: shape.primitives)[1]
    print(f"{len(opened)} of {len(files)} opened, {torch.get_num_threads()} threads")
    for name, seconds in (("loaded", opened), ("refined", refined)):
        if seconds:
            print(line(name, seconds))
    for reason, count in reasons.most_common():
        print(f"refused     {count:4}  {reason}")


if __name__ == "__main__":
    main()
