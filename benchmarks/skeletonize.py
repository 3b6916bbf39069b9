"""Skeletons of single surfaces: how steady their topology is, how well centered they are, and how long they take.

    python benchmarks/skeletonize.py                   # every figure on made-up bodies, some minutes
    python benchmarks/skeletonize.py --data FOLDER     # also horse_gallop.npz and samba.npz, which lie in FOLDER
    python benchmarks/skeletonize.py --smoke           # a few frames, to see that it runs

Every frame is turned into voxels, 128 along the longest side, filled and meshed anew, and its skeleton is drawn without
a look at other frames. One default configuration serves all.

- topology: the share of frames whose tree is the most frequent one, and how many tips that has. Bar: 70 %, with 5 tips
  for people and starfish and 5 to 7 for animals, which have two junctions or more; the starfish one of degree five.
- inside: the share of the nodes that lie inside the surface they were drawn from. Bar: 99.5 %.
- tubes: bent tubes of known axis, thick, thin and tapering. Bar: nodes at most 10 % of the radius from the axis, but in
  the round ends beyond it.
- time: one core, from 5,000 to 400,000 vertices, of starfish. Bar: 5 s for 115,000 (aim: 2 s).
- sequence: 44 frames of 10,000 vertices. Bar: 120 s of one core, which is 60 s on two.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torchreg as tr
from experiments.made_up.bodies import person, quadruped
from experiments.made_up.gaits import animal_walk, person_walk
from torchreg.datasets.creatures import OCTOPUS, STARFISH, creature_sequence
from torchreg.datasets.figures import Figure
from torchreg.geometry.isosurface import isosurface
from torchreg.geometry.voxels import voxelize
from torchreg.spines.skeleton.clearance import Inside

RESOLUTION, STEADY_BAR, INSIDE_BAR, AXIS_BAR = 128, 0.70, 0.995, 0.10
TIME_BAR, SEQUENCE_BAR, SEQUENCE_FRAMES = 5.0, 120.0, 44
# Voxels along the longest side at which a starfish has about 5,000, 10,000, 115,000 and 400,000 vertices.
SIZES = {5_000: 66, 10_000: 92, 115_000: 308, 400_000: 572}
FILES = {"samba": ("samba.npz", (5, 5), 1), "horse": ("horse_gallop.npz", (5, 7), 2)}


@dataclass(frozen=True)
class Line:
    """One figure beside its bar."""

    name: str
    text: str
    passed: bool

    def __str__(self) -> str:
        return f"{self.name:<26}{self.text:<88}{'pass' if self.passed else 'FAIL'}"


def meshed_anew(vertices: Tensor, faces: Tensor) -> tr.TriangleMesh:
    return voxelize(tr.TriangleMesh(vertices, faces), RESOLUTION).mesh()


def walking(figure: Figure, walk: Callable[..., tuple[Tensor, Tensor]], frames: int) -> Iterator[tr.TriangleMesh]:
    phase = 2 * torch.arange(frames, dtype=torch.float64) / max(frames, 1)
    for vertices in figure.vertices(figure.transforms(walk(figure, phase)[0])):
        yield meshed_anew(vertices, figure.mesh.faces)


def from_file(path: Path) -> Iterator[tr.TriangleMesh]:
    with np.load(path) as data:
        vertices, faces = torch.from_numpy(data["vertices"]), torch.from_numpy(data["faces"])
    for frame in vertices:
        yield meshed_anew(frame, faces)


def drawn(name: str, meshes: Iterator[tr.TriangleMesh], tips: tuple[int, int], junctions: int) -> list[Line]:
    """Return the lines on topology and centeredness of a sequence."""
    forms: Counter[str] = Counter()
    skeletons: dict[str, tr.Skeleton] = {}
    inside = []
    for mesh in meshes:
        skeleton = tr.skeletonize(mesh)
        forms[skeleton.topology] += 1
        skeletons.setdefault(skeleton.topology, skeleton)
        inside.append(Inside(mesh)(skeleton.nodes))
    (form, number), count = forms.most_common(1)[0], forms.total()
    usual = skeletons[form]
    share, within = number / count, float(torch.cat(inside).double().mean())
    sound = tips[0] <= len(usual.tips) <= tips[1] and len(usual.junctions) >= junctions
    degrees = sorted(usual.degrees[usual.junctions].tolist())
    text = f"{share:.1%} of {count} frames alike, {len(forms)} topologies; {len(usual.tips)} tips, junctions {degrees}"
    lines = [Line(f"topology {name}", text, share >= STEADY_BAR and sound)]
    return [*lines, Line(f"inside {name}", f"{within:.3%} of {sum(map(len, inside))} nodes", within >= INSIDE_BAR)]


def tube(axis: Tensor, radii: Tensor, spacing: float) -> tr.TriangleMesh:
    margin = float(radii.max()) + 2 * spacing
    lower, upper = axis.amin(0) - margin, axis.amax(0) + margin
    return isosurface(lambda points: (torch.cdist(points, axis) - radii).amin(1), lower, upper, spacing)


def off_axis(radius: tuple[float, float]) -> float:
    """Return how far nodes of the skeleton of a bent tube are from its axis at most, in radii."""
    turn = torch.linspace(0, 1.2 * math.pi, 1500, dtype=torch.float64)
    axis = torch.stack((turn.cos(), turn.sin(), 0.3 * turn), dim=1)
    radii = torch.linspace(*radius, len(axis), dtype=torch.float64)
    nodes = tr.skeletonize(tube(axis, radii, min(radius) / 4)).nodes
    distance, nearest = torch.cdist(nodes, axis).min(1)
    beside = (nearest > 0) & (nearest < len(axis) - 1)
    return float((distance / radii[nearest])[beside].max())


def tubes(radii: Sequence[tuple[float, float]]) -> list[Line]:
    worst = [off_axis(radius) for radius in radii]
    text = ", ".join(f"{off:.1%} at radius {a:g} to {b:g}" for off, (a, b) in zip(worst, radii, strict=True))
    return [Line("tubes off the axis", text, max(worst) <= AXIS_BAR)]


def seconds(mesh: tr.TriangleMesh) -> float:
    start = time.process_time()
    tr.skeletonize(mesh)
    return time.process_time() - start


def times(sizes: Sequence[int]) -> list[Line]:
    lines = []
    for size in sizes:
        mesh = creature_sequence(STARFISH, 1, resolution=SIZES[size]).meshes[0]
        took = seconds(mesh)
        lines.append(Line("time", f"{took:.2f} s for {mesh.num_vertices} vertices", took <= TIME_BAR or size > 115_000))
    return lines


def sequence(frames: int) -> list[Line]:
    meshes = creature_sequence(STARFISH, frames, resolution=SIZES[10_000]).meshes
    took = sum(map(seconds, meshes))
    text = f"{took:.1f} s for {frames} frames of {meshes[0].num_vertices} vertices, one core"
    return [Line("sequence", text, took <= SEQUENCE_BAR * frames / SEQUENCE_FRAMES)]


def smoke() -> list[Callable[[], list[Line]]]:
    return [
        lambda: drawn("starfish", iter(creature_sequence(STARFISH, 1, resolution=48).meshes), (5, 5), 1),
        lambda: tubes([(0.3, 0.3)]),
        lambda: times([5_000]),
        lambda: sequence(1),
    ]


def everything(data: Path | None, frames: int = 24) -> list[Callable[[], list[Line]]]:
    work: list[Callable[[], list[Line]]] = [
        lambda: drawn("starfish", iter(creature_sequence(STARFISH, frames).meshes), (5, 5), 1),
        lambda: drawn("noisy starfish", iter(creature_sequence(STARFISH, frames, noise=0.5).meshes), (5, 5), 1),
        lambda: drawn("octopus", iter(creature_sequence(OCTOPUS, frames).meshes), (8, 8), 1),
        lambda: drawn("person", walking(person(), person_walk, frames), (5, 5), 2),
        lambda: drawn("animal", walking(quadruped(), animal_walk, frames), (5, 7), 2),
        lambda: tubes([(0.2, 0.2), (0.1, 0.1), (0.3, 0.15)]),
        lambda: times(list(SIZES)),
        lambda: sequence(SEQUENCE_FRAMES),
    ]
    if data is None:
        print("without --data: horse and dancer are skipped")
        return work
    for name, (file, tips, junctions) in FILES.items():
        meshes = from_file(data / file)
        work.append(lambda name=name, meshes=meshes, bars=(tips, junctions): drawn(name, meshes, *bars))
    return work


def main(arguments: Sequence[str] | None = None) -> list[Line]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder with horse_gallop.npz and samba.npz")
    parser.add_argument("--smoke", action="store_true", help="a few frames of everything")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    lines = []
    for part in smoke() if options.smoke else everything(options.data):
        for line in part():
            print(line, flush=True)
            lines.append(line)
    return lines


if __name__ == "__main__":
    main()
