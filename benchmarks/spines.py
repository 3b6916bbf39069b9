"""How well one spine holds a whole sequence: topology, identity of tips, time, what is borne, and poses of hands.

    python benchmarks/spines.py --data FOLDER     # every figure
    python benchmarks/spines.py --smoke           # small ones, to see that it runs

- captured: sequences of meshes from FOLDER (NPZ with vertices (T, V, 3) and faces), each frame voxelized (128 along the
  longest side), filled and meshed anew, so that frames share nothing. "own": the share of frames whose tree is the
  final one before the graph is imposed (bar: 70 %). "after": different trees afterwards (bar: 1). "named": the share of
  frames in which each tip is nearest to the place of its own vertex, the one that it is nearest to in the reference
  frame, of all tips' vertices (bar: 99 %). "inside": curve points inside the surface (bar: 99.5 %).
- identity: the same sequences, every frame and every second, fourth, eighth and sixteenth. A tip is right in a frame if
  it is within 6 % of the diagonal of its own vertex, the one nearest to it in the frame that speaks best for it (bar
  for all frames and for every fourth: 97 % of tips and frames, one tree). Beside it the mean confidence in names; in
  the end how well confidence tells right names from wrong ones, here and of frames left out.
- creatures: starfish and octopuses of known tips, with noise and with two arms that touch side by side or end to end.
  Bars: all arms and one junction in every frame, every name right. Where tips of arms touch end to end names are
  judged by the whole arm.
- left out: made-up people and animals that step, gallop and tuck limbs in, left and right in the mirror, and creatures
  whose arms touch, meshed anew; all of 48 frames and every second, fourth, eighth and sixteenth. Identity as above (bar
  for all frames: 98 %). A cycle of steps is 24 frames long: every eighth is a third of it.
- clouds: the same sequences, every frame, as 12,000 points with noise of 0.2 % of the diagonal (standard deviation),
  and with 30 % of the points missing in round holes. Identity as above (bar without holes: 95 %). "off": how far tips
  are from those of the meshes, in diagonals: the median and the share within 2 % (bar: the median).
- time: CPU seconds of all processes for the captured sequences, and what two cores need at best (bar for 44 frames of
  about 14,000 vertices: 60 s).
- speed: the same sequences, every second frame up to twelve, of about 100,000 vertices: seconds a frame from meshes to
  named limbs, with two workers and their start (bar: .25 s), and CPU seconds of all processes.
- borne: noise, holes, thin limbs, fragments, wrong winding, one frame, a missing limb: the result, or the error.
- hands: surfaces of hands, each joint bent by up to half its range, turned in any way. `find_pose` with candidates from
  the skeleton alone, and as it comes. Right: fingertips within 10 mm on average (bar: 90 %). The time of the skeleton
  is counted in (bar: below that without).
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torchreg as tr
from experiments.made_up.bodies import person, quadruped
from experiments.made_up.gaits import animal_walk, person_tucks, person_walk
from torchreg.datasets.creatures import OCTOPUS, STARFISH, CreatureForm, CreatureSequence, creature_sequence
from torchreg.datasets.figures import Figure
from torchreg.geometry.mesh import concatenate, sample_surface, unit_sphere
from torchreg.geometry.rigid import rigid_matrix
from torchreg.geometry.rotation import so3_exp
from torchreg.geometry.voxels import VoxelGrid, voxelize
from torchreg.solvers.assignment import assign
from torchreg.spines.skeleton.clearance import Inside

# Voxels along the longest side for some 100,000 vertices, and frames that are timed.
FINE_RESOLUTION, SPEED_FRAMES = 340, 12
BAR_OWN, BAR_NAMED, BAR_INSIDE, BAR_SECONDS, BAR_HANDS, BAR_FRAME = 0.7, 0.99, 0.995, 60.0, 0.9, 0.25
BARS_IDENTITY, BARS_LEFT_OUT = {1: 0.97, 4: 0.97}, {1: 0.98}
BINS = (0.0, 0.5, 0.8, 0.95, 0.99, 1.0)
WITHIN, STEPS, CYCLE, TOUCHING = 0.06, (1, 2, 4, 8, 16), 24, "flanks touch"
CLOUD_POINTS, CLOUD_NOISE, HOLES, HOLE_RADIUS, BAR_CLOUDS, BAR_OFF = 12_000, 0.002, 0.3, 0.03, 0.95, 0.02
PARTS = ("captured", "identity", "clouds", "creatures", "left-out", "borne", "hands", "speed")
TIPS, RIGHT, NUM_POINTS, BEND = [4, 8, 12, 16, 20], 0.01, 500, 0.5
CREATURES: dict[str, tuple[CreatureForm, str, float]] = {
    "starfish": (STARFISH, "none", 0.0),
    "starfish, noise": (STARFISH, "none", 0.5),
    "starfish, flanks touch": (STARFISH, "flanks", 0.0),
    "starfish, tips touch": (STARFISH, "tips", 0.0),
    "starfish, both": (STARFISH, "flanks", 0.5),
    "octopus": (OCTOPUS, "none", 0.0),
    "octopus, flanks touch": (OCTOPUS, "flanks", 0.0),
}
FIGURES: dict[str, tuple[Callable[[], Figure], Callable[..., tuple[Tensor, Tensor]]]] = {
    "person, walks": (person, person_walk),
    "person, tucks limbs in": (person, person_tucks),
    "animal, trots": (quadruped, partial(animal_walk, gait="trot")),
    "animal, gallops": (quadruped, partial(animal_walk, gait="gallop")),
}


@dataclass(frozen=True)
class Row:
    """One sequence.

    Args:
        name: of it.
        tips: K.
        junctions: number of them.
        own: share of frames whose own tree is the final one.
        trees: different trees before and after.
        named: share of frames with all names right.
        inside: share of curve points.
        seconds: of CPU, all processes.
        frames: number of them.
        vertices: of a frame, on average.
    """

    name: str
    tips: int
    junctions: int
    own: float
    trees: tuple[int, int]
    named: float
    inside: float
    seconds: float
    frames: int
    vertices: int


def cpu_seconds() -> float:
    return sum(sum(resource.getrusage(who)[:2]) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))


def judged(name: str, meshes: Sequence[tr.TriangleMesh], named: object, *, workers: int | None = None) -> Row:
    """Return the figures of a sequence; ``named(spine)`` says in which frames (T,) all names are right."""
    start = cpu_seconds()
    with tqdm(total=len(meshes), desc=name, leave=False, disable=None) as bar:
        spine = tr.extract_spine(meshes, workers=workers, on_step=lambda _: bar.update())
    seconds = cpu_seconds() - start
    final = max(set(spine.topologies), key=spine.topologies.count)
    inside = [Inside(mesh)(curves.flatten(0, 1)) for mesh, curves in zip(meshes, spine.curves, strict=True)]
    return Row(
        name,
        spine.num_tips,
        spine.junctions.shape[1],
        sum(own == final for own in spine.own_topologies) / len(meshes),
        (len(set(spine.own_topologies)), len(set(spine.topologies))),
        float(named(spine).double().mean()),
        float(torch.stack(inside).double().mean()),
        seconds,
        len(meshes),
        sum(mesh.num_vertices for mesh in meshes) // len(meshes),
    )


def from_file(path: Path, every: int) -> tuple[Tensor, Tensor]:
    """Return the vertices (T, V, 3) and the faces of a sequence."""
    with np.load(path, allow_pickle=False) as archive:
        return torch.from_numpy(archive["vertices"][::every]), torch.from_numpy(archive["faces"].astype(np.int64))


def right_names(tips: Tensor, vertices: Tensor) -> Tensor:
    """Return in which frames tips (T, K, 3) are near their own vertices, of all vertices (T, V, 3): (T, K) bool."""
    diagonal = (vertices.amax(1) - vertices.amin(1)).norm(dim=-1).median()
    own = torch.stack([torch.cdist(*frame).argmin(-1) for frame in zip(tips, vertices, strict=True)])
    near = torch.stack([(tips - vertices[:, row]).norm(dim=-1) <= WITHIN * diagonal for row in own])
    best = near.double().mean(1).argmax(0)
    return near[best, :, torch.arange(tips.shape[1])].mT


def tip_identity(tips: Tensor, vertices: Tensor) -> float:
    """Return the share of tips (T, K, 3) and frames that are near their own vertices, of all vertices (T, V, 3)."""
    return float(right_names(tips, vertices).double().mean())


@dataclass
class Confidences:
    """Confidences of names (N,), and which names are right."""

    values: Tensor = field(default_factory=lambda: torch.zeros(0))
    right: Tensor = field(default_factory=lambda: torch.zeros(0, dtype=torch.bool))

    def add(self, values: Tensor, right: Tensor) -> None:
        """Add those of a sequence, (T, K)."""
        self.values = torch.cat((self.values, values.reshape(-1)))
        self.right = torch.cat((self.right, right.reshape(-1)))

    def render(self) -> str:
        """Return the probability that a right name is surer than a wrong one, and what is right in bins."""
        apart = self.values[self.right][:, None] - self.values[~self.right]
        area = float(((apart > 0).double() + 0.5 * (apart == 0)).mean())
        lines = [f"confidence: area under the curve {area:.3f}, {len(self.right)} names"]
        for low, high in pairwise(BINS):
            which = (self.values >= low) & ((self.values < high) | (high == 1))
            share = f"{float(self.right[which].double().mean()):.3f}" if bool(which.any()) else "-"
            lines.append(f"  {low:4.2f} to {high:4.2f}: {int(which.sum()):5} names, right {share}")
        return "\n".join(lines)


def identities(
    name: str, meshes: Sequence[tr.TriangleMesh], places: Tensor, bars: Mapping[int, float], told: Confidences
) -> Iterator[str]:
    """Yield a line per share of the frames of a sequence, on whose surfaces places (T, V, 3) are known.

    Some shares, every first or fourth frame, have bars. Confidences are added to those that were told.
    """
    for step in STEPS:
        if len(meshes[::step]) < 3:
            return
        spine = tr.extract_spine(meshes[::step])
        right, trees = right_names(spine.tips.double(), places[::step].double()), len(set(spine.topologies))
        told.add(spine.confidence, right)
        share = float(right.double().mean())
        line = f"{name:24} every {step:2}: {len(spine.tips):3} frames, {spine.num_tips} tips, {trees} tree(s), "
        line += f"identity {share:.3f}, confidence {float(spine.confidence.mean()):.3f}"
        yield f"{line}  {verdict(share >= bars[step] and trees == 1)}" if step in bars else line


def cloud(mesh: tr.TriangleMesh, holes: float, seed: int) -> Tensor:
    """Return noisy points (N, 3) of a surface, a share of which is missing in balls around random ones."""
    generator = torch.Generator().manual_seed(seed)
    points = sample_surface(mesh, CLOUD_POINTS, generator)[0]
    diagonal = (points.amax(0) - points.amin(0)).norm()
    kept = torch.ones(len(points), dtype=torch.bool)
    while float((~kept).double().mean()) < holes:
        center = points[torch.randint(len(points), (1,), generator=generator)]
        kept &= (points - center).norm(dim=-1) > HOLE_RADIUS * diagonal
    return (points + CLOUD_NOISE * diagonal * torch.randn(points.shape, generator=generator))[kept]


def cloud_lines(name: str, meshes: Sequence[tr.TriangleMesh], places: Tensor) -> Iterator[str]:
    """Yield a line per kind of cloud of a sequence, on whose surfaces places (T, V, 3) are known."""
    diagonal = float((places.amax(1) - places.amin(1)).norm(dim=-1).median())
    of_meshes = tr.extract_spine(meshes).tips.double()
    share = tip_identity(of_meshes, places.double())
    yield f"{name:24} meshes: {len(of_meshes):3} frames, {of_meshes.shape[1]} tips, identity {share:.3f}"
    for holes in (0.0, HOLES):
        spine = tr.extract_spine([cloud(mesh, holes, seed) for seed, mesh in enumerate(meshes)])
        tips, trees = spine.tips.double(), len(set(spine.topologies))
        apart = (of_meshes.unsqueeze(2) - tips.unsqueeze(1)).norm(dim=-1) / diagonal
        off = apart.transpose(0, 1)[torch.arange(apart.shape[1]), :, assign(apart.median(0).values)]
        share = tip_identity(tips, places.double())
        line = f"{name:24} {holes:4.0%} missing: {len(tips):3} frames, {spine.num_tips} tips, {trees} tree(s), "
        near = float((off < BAR_OFF).double().mean())
        line += f"identity {share:.3f}, off {float(off.median()):.2%}, within {BAR_OFF:.0%}: {near:.3f}"
        passed = share >= BAR_CLOUDS and float(off.median()) < BAR_OFF and trees == 1
        yield line if holes else f"{line}  {verdict(passed)}"


def made_figure(name: str, num_frames: int, resolution: int) -> tuple[list[tr.TriangleMesh], Tensor]:
    """Return the meshes of a figure that steps while it turns, and its vertices (T, V, 3)."""
    make, moving = FIGURES[name]
    figure, numbers = make(), torch.arange(num_frames)
    rotations, heights = moving(figure, numbers / CYCLE)
    turns, shifts = torch.zeros(2, num_frames, 3, dtype=torch.float64)
    turns[:, 1], shifts[:, 0], shifts[:, 1] = 0.03 * numbers, 0.01 * numbers, heights
    places = figure.vertices(figure.transforms(rotations, rigid_matrix(so3_exp(turns), shifts)))
    return [voxelize(tr.TriangleMesh(row.float(), figure.mesh.faces), resolution).mesh() for row in places], places


def captured(path: Path, resolution: int, every: int, *, touching: bool, smoothing: int) -> Row:
    """Return the figures of a sequence of one file, meshed anew from voxels."""
    vertices, faces = from_file(path, every)
    grids: list[VoxelGrid] = [
        voxelize(tr.TriangleMesh(frame, faces), resolution, touching=touching) for frame in vertices
    ]

    def named(spine: tr.SpineSequence) -> Tensor:
        tips, places = spine.tips.double(), vertices.double()
        own = torch.cdist(tips[spine.reference], places[spine.reference]).argmin(-1)
        return (torch.cdist(tips, places[:, own]).argmin(-1) == torch.arange(spine.num_tips)).all(-1)

    return judged(path.stem, [grid.mesh(smoothing) for grid in grids], named)


def creature(name: str, num_frames: int, resolution: int) -> Row:
    form, touching, noise = CREATURES[name]
    sequence = creature_sequence(form, num_frames, touching=touching, noise=noise, resolution=resolution)
    return judged(name, sequence.meshes, lambda spine: named_arms(spine, sequence))


def named_arms(spine: tr.SpineSequence, sequence: CreatureSequence) -> Tensor:
    """Return in which frames (T,) every limb is nearest to the axis of its own arm."""
    curves, axes = spine.curves[:, : spine.num_tips].double(), sequence.curves.double().flip(2)
    few = torch.linspace(0, axes.shape[2] - 1, curves.shape[2]).round().long()
    apart = (curves.unsqueeze(2) - axes[:, None, :, few]).norm(dim=-1).mean(-1)
    own = assign(apart.mean(0))
    return (apart.argmin(-1) == own).all(-1)


def borne(resolution: int) -> Iterator[tuple[str, str]]:
    """Yield what is done to a starfish, and what comes of it."""
    plain = creature_sequence(STARFISH, 4, resolution=resolution)
    noisy = creature_sequence(STARFISH, 4, resolution=resolution, noise=1.0)
    thin = creature_sequence(CreatureForm(5, 0.25, 0.06, 0.03, 0.5, 0.5), 4, resolution=resolution)
    first, *rest = plain.meshes
    ball = unit_sphere(2)
    dust = tr.TriangleMesh(0.04 * ball.vertices + 1.5, ball.faces)
    generator = torch.Generator().manual_seed(0)
    loose = torch.rand(first.num_faces, generator=generator) > 0.02
    arm, root = plain.curves[0, 1, 20], plain.curves[0, 1, 0]
    lost = ((first.vertices - arm) @ (arm - root) > 0) & ((first.vertices - plain.curves[0, 1, 32]).norm(dim=-1) < 0.5)
    empty = tr.TriangleMesh(torch.zeros(0, 3), torch.zeros(0, 3).long())
    cases = {
        "noise of a voxel": (noisy.meshes, noisy),
        "2 % of the faces missing": ([tr.TriangleMesh(first.vertices, first.faces[loose]), *rest], plain),
        "thin limbs": (thin.meshes, thin),
        "isolated fragment": ([concatenate([first, dust]), *rest], plain),
        "wrong winding": ([tr.TriangleMesh(first.vertices, first.faces.flip(1)), *rest], plain),
        "one frame": ([first], plain),
        "a missing limb": ([tr.TriangleMesh(first.vertices, first.faces[~lost[first.faces].any(-1)]), *rest], plain),
        "a frame without a surface": ([first, empty], plain),
    }
    for name, (meshes, truth) in cases.items():
        try:
            spine = tr.extract_spine(meshes)
        except tr.errors.TorchregError as error:
            yield name, f"error: {error}"
            continue
        apart = torch.cdist(spine.tips, truth.tips[: len(meshes)]).argmin(-1)
        good = spine.num_tips == 5 and bool((apart == apart[0]).all()) and set(spine.topologies) == {truth.topology}
        told = next((warning for warning in spine.warnings if warning.startswith("frame 0")), "no warning")
        yield name, f"{'sound' if good else 'WRONG'}, {spine.status.value}: {told}"


def random_pose(hand: tr.Hand, generator: torch.Generator) -> Tensor:
    """Return a pose of any rotation, with each joint bent by up to half its range."""
    pose = hand.rest_pose()
    pose[6:] = BEND * torch.rand(hand.num_dofs - 6, generator=generator) * hand.upper[6:].clamp_min(0)
    quaternion = torch.nn.functional.normalize(torch.randn(4, generator=generator, dtype=torch.float64), dim=0)
    angle = 2 * torch.atan2(quaternion[1:].norm(), quaternion[0])
    pose[3:6] = (angle * torch.nn.functional.normalize(quaternion[1:], dim=0)).to(pose)
    return hand.clamp(pose)


def hands(count: int, seed: int) -> Tensor:
    """Return per hand the error of the fingertips, metres, and CPU seconds, with skeleton and without, (N, 2, 2)."""
    hand, generator = tr.Hand().requires_grad_(False), torch.Generator().manual_seed(seed)
    skin, rows = tr.sample_skin(hand), []
    for _ in tqdm(range(count), desc="hands", leave=False, disable=None):
        pose = random_pose(hand, generator)
        mesh = hand.surface_mesh(pose)
        data = sample_surface(mesh, NUM_POINTS, generator)[0]
        row = []
        for with_spine in (True, False):
            start = time.process_time()
            sources = {"sources": [tr.SpineLimbs.of_surface(mesh)]} if with_spine else {}
            starts = tr.find_pose(hand, data, model_points=skin, **sources)
            seconds = time.process_time() - start
            error = (hand.keypoints(starts.best) - hand.keypoints(pose))[TIPS].norm(dim=-1).mean()
            row.append([float(error), seconds])
        rows.append(row)
    return torch.tensor(rows)


def speed(name: str, meshes: Sequence[tr.TriangleMesh]) -> str:
    """Return what a sequence of meshes takes with two workers."""
    wall, cpu = time.perf_counter(), cpu_seconds()
    tr.extract_spine(meshes, workers=2)
    wall, cpu = ((now - before) / len(meshes) for now, before in ((time.perf_counter(), wall), (cpu_seconds(), cpu)))
    vertices = sum(len(mesh.vertices) for mesh in meshes) // len(meshes)
    told = f"{len(meshes)} frames of {vertices} vertices: {wall:.2f} s a frame ({cpu:.2f} CPU s)"
    return f"{name:24} {told}: {verdict(wall <= BAR_FRAME)}"


def verdict(passed: bool) -> str:
    return "pass" if passed else "FAIL"


def render(rows: Sequence[Row], *, bars: bool) -> str:
    lines = [f"{'sequence':24} {'frames':>6} {'K':>2} {'junc.':>5} {'own':>6} {'trees':>7} {'named':>6} {'inside':>7}"]
    for row in rows:
        line = f"{row.name:24} {row.frames:6} {row.tips:2} {row.junctions:5} {row.own:6.1%} "
        line += f"{row.trees[0]:3} > {row.trees[1]} {row.named:6.1%} {row.inside:7.2%}"
        passed = row.trees[1] == 1 and row.named >= BAR_NAMED and row.inside >= BAR_INSIDE
        lines.append(f"{line}  {verdict(passed and (row.own >= BAR_OWN or not bars))}")
    return "\n".join(lines)


def render_time(rows: Sequence[Row]) -> str:
    return "\n".join(
        f"{row.name:24} {row.frames} frames of {row.vertices} vertices: {row.seconds:.1f} s of CPU, "
        f"{row.seconds / 2:.1f} s on two cores: {verdict(row.seconds / 2 < BAR_SECONDS)}"
        for row in rows
    )


def render_hands(rows: Tensor) -> str:
    right = (rows[..., 0] <= RIGHT).double().mean(0).tolist()
    errors, seconds = (1e3 * rows[..., 0]).median(0).values.tolist(), rows[..., 1].mean(0).tolist()
    lines = [
        f"{name:18} {share:6.1%} right, median {error:.1f} mm, {spent:.2f} s of CPU"
        for name, share, error, spent in zip(("with the skeleton", "without"), right, errors, seconds, strict=True)
    ]
    return "\n".join([*lines, f"right: {verdict(right[0] >= BAR_HANDS)}, faster: {verdict(seconds[0] < seconds[1])}"])


def main(arguments: Sequence[str] | None = None) -> list[Row]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of NPZ files; without it captured sequences are left out")
    parser.add_argument("--part", choices=PARTS, help="this one only")
    parser.add_argument("--resolution", type=int, default=128, help="voxels along the longest side (default 128)")
    parser.add_argument("--touching", action="store_true", help="also fill voxels that the surface touches")
    parser.add_argument("--staircase", action="store_true", help="mesh the voxels without smoothing")
    parser.add_argument("--frames", type=int, default=24, help="of each creature (default 24)")
    parser.add_argument("--hands", type=int, default=50, help="number of hands (default 50)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--smoke", action="store_true", help="few, coarse frames and one hand")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    parts = (options.part,) if options.part else PARTS
    rows: list[Row] = []
    if "captured" in parts:
        rows += run_captured(options)
    if "identity" in parts:
        run_identity(options)
    if "clouds" in parts:
        run_clouds(options)
    if "speed" in parts:
        run_speed(options)
    if "creatures" in parts:
        names = ["starfish"] if options.smoke else list(CREATURES)
        made = [creature(name, 3 if options.smoke else options.frames, 32 if options.smoke else 96) for name in names]
        print(f"creatures\n{render(made, bars=False)}")
        rows += made
    if "left-out" in parts:
        run_left_out(options)
    if "borne" in parts and not options.smoke:
        print("borne")
        for name, outcome in borne(64):
            print(f"{name:26} {outcome}")
    if "hands" in parts:
        print(f"hands\n{render_hands(hands(1 if options.smoke else options.hands, options.seed))}")
    return rows


def run_captured(options: argparse.Namespace) -> list[Row]:
    # A sequence of meshes has vertices of several frames; other files of the folder are left alone.
    paths = sorted(options.data.glob("*.npz")) if options.data else []
    if not paths:
        print("captured: left out, as there is no --data FOLDER with NPZ files")
        return []
    resolution, every = (40, 6) if options.smoke else (options.resolution, 1)
    rows = [
        captured(path, resolution, every, touching=options.touching, smoothing=0 if options.staircase else 1)
        for path in paths
    ]
    print(f"captured, {resolution} voxels\n{render(rows, bars=True)}\ntime\n{render_time(rows)}")
    return rows


def meshed_anew(
    options: argparse.Namespace, part: str, every: int = 1, most: int | None = None
) -> Iterator[tuple[str, list[tr.TriangleMesh], Tensor]]:
    """Yield the sequences: their names, meshes from voxels, and the vertices (T, V, 3) that they came from."""
    paths = sorted(options.data.glob("*.npz")) if options.data else []
    print(part if paths else f"{part}: left out, as there is no --data FOLDER with NPZ files")
    resolution, every = (40, 6) if options.smoke else (options.resolution, every)
    for path in paths:
        places, faces = from_file(path, every)
        places = places[:most]
        meshes = [voxelize(tr.TriangleMesh(frame.float(), faces), resolution).mesh() for frame in places]
        yield path.stem, meshes, places


def run_speed(options: argparse.Namespace) -> None:
    options = argparse.Namespace(**vars(options) | {"resolution": FINE_RESOLUTION})
    for name, meshes, _ in meshed_anew(options, "speed", every=2, most=SPEED_FRAMES):
        print(speed(name, meshes), flush=True)


def run_identity(options: argparse.Namespace) -> None:
    told = Confidences()
    for name, meshes, places in meshed_anew(options, "identity"):
        for line in identities(name, meshes, places, BARS_IDENTITY, told):
            print(line, flush=True)
    if len(told.right):
        print(told.render())


def run_clouds(options: argparse.Namespace) -> None:
    for name, meshes, places in meshed_anew(options, "clouds"):
        for line in cloud_lines(name, meshes, places):
            print(line, flush=True)


def run_left_out(options: argparse.Namespace) -> None:
    print("frames left out")
    num_frames, resolution = (3, 32) if options.smoke else (2 * options.frames, options.resolution // 2)
    bars, told = {} if options.smoke else BARS_LEFT_OUT, Confidences()
    for name in list(FIGURES)[:1] if options.smoke else FIGURES:
        for line in identities(name, *made_figure(name, num_frames, resolution), bars, told):
            print(line, flush=True)
    for name in [] if options.smoke else [name for name in CREATURES if name.endswith(TOUCHING)]:
        form, touching, noise = CREATURES[name]
        made = creature_sequence(form, num_frames, touching=touching, noise=noise, resolution=resolution)
        for line in identities(name, made.meshes, made.tips, bars, told):
            print(line, flush=True)
    print(told.render())


if __name__ == "__main__":
    main()
