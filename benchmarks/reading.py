"""How long files take to be read: a million points beside numpy and trimesh, and rigs.

    OMP_NUM_THREADS=1 python benchmarks/reading.py [--data FOLDER] [--points 1000000]

FOLDER holds rigs/*.glb; without it only points are timed, and a rig that is made here.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from torchreg.datasets.hand import surface_skin
from torchreg.io.points import load_points, save_points
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.hand import Hand
from torchreg.viz.gltf import save_shape_animation

REPEATS = 3


def seconds(read: Callable[[], object]) -> float:
    """Return the least processor time of a few calls, after one that loads what is needed."""
    read()
    times = []
    for _ in range(REPEATS):
        start = time.process_time()
        read()
        times.append(time.process_time() - start)
    return min(times)


def time_points(folder: Path, count: int) -> None:
    """Print how long the same points take in each format, in torchreg and in other libraries."""
    import trimesh

    points = torch.randn(count, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64).float()
    others: dict[str, dict[str, Callable[[Path], object]]] = {
        "ply": {"trimesh": lambda path: trimesh.load(path, process=False)},
        "xyz": {"numpy": np.loadtxt, "trimesh": trimesh.load},
        "csv": {"numpy": lambda path: np.loadtxt(path, delimiter=",", skiprows=1)},
        "npz": {"numpy": lambda path: np.load(path)["points"]},
    }
    for ending, readers in others.items():
        path = folder / f"cloud.{ending}"
        save_points(path, points)
        ours = seconds(lambda path=path: load_points(path))  # type: ignore[misc]
        theirs = {name: seconds(lambda path=path, read=read: read(path)) for name, read in readers.items()}  # type: ignore[misc]
        beside = ", ".join(f"{name} {value:.3f} s" for name, value in theirs.items())
        ratio = ours / min(theirs.values())
        print(f"{count} points .{ending}: torchreg {ours:.3f} s, {beside}: {ratio:.2f} times the quickest")


def time_rigs(folder: Path, data: Path | None) -> None:
    """Print how long rigs take."""
    hand = Hand()
    made = save_shape_animation(folder / "hand.glb", hand, hand.rest_pose()[None], skin=surface_skin(hand))
    files = sorted((data / "rigs").glob("*.glb")) if data is not None else []
    for path in (made, *files):
        shape = ArticulatedShape.from_gltf(path)
        count = 0 if shape.surface is None else len(shape.surface.vertices)
        took = seconds(lambda path=path: ArticulatedShape.from_gltf(path))  # type: ignore[misc]
        print(f"{path.name}: {count} vertices, {shape.num_parts} parts: {took:.2f} s")
    if data is None:
        print("no --data FOLDER: no other rigs are timed")


def main() -> None:
    """Print all times."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--points", type=int, default=1_000_000)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        time_points(Path(name), options.points)
        time_rigs(Path(name), options.data)


if __name__ == "__main__":
    main()
