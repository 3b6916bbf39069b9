"""Bodies over time: a made-up person of anny's, and captured people, followed with their shape coefficients.

A made-up person has random phenotypes (as in shape_fit.py); each joint turns about an axis of its own, by 12 degrees in
the standard deviation, and goes to and fro in 1 to 4 s; the whole walks 0.3 m and turns by 20 degrees a second. A
camera that stands still sees 2,000 points a frame at 30 frames/s, with 3 mm of noise and 5 % outliers; with --whole the
points are of all sides. The error is the distance of every vertex, hidden ones too, from its true place. Needs
`pip install "torchreg-articulated[anny]"`.

    python benchmarks/body_tracking.py                         # made-up people, 100 frames
    python benchmarks/body_tracking.py --smooth                # what the second pass makes of them
    python benchmarks/body_tracking.py --data DIR              # captured people: DIR/samba.npz, DIR/captured_people

Of samba the vertices are followed through all frames: each is bound in the first frame to the nearest place of the body
found there. Of DIR/captured_people, whose meshes have no vertices in common, distances of the surfaces are told. Of
made-up people it is also told how many joints of all frames lie within their 95 % ellipsoids, and how many coefficients
within their 95 % intervals.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torchreg as tr
from benchmarks.shape_fit import SPREAD, load_model, make_person, measured, start_pose, whole_scan
from torchreg.geometry.mesh import interpolate, sample_surface
from torchreg.geometry.neighbors import nearest_neighbor
from torchreg.geometry.rotation import so3_exp
from torchreg.geometry.visibility import aim, rasterize
from torchreg.shapes.shaped import ShapedTree
from torchreg.tracking.person_filter import KnownPerson

FPS, COUNT, NOISE, PIXELS, CAMERA = 30.0, 2000, 0.003, 400, 4.0
# Samples of a body to which captured points are bound.
BOUND = 20000
PERIODS, WALK, TURN = (1.0, 4.0), 0.3, math.radians(20)
# The last ten frames may not be worse than the first ten by more than this share; frames per CPU second.
DRIFT_BAR, RATE_BAR, ENDS = 1.05, 2.0, 10
# 95 % of a normal distribution in three dimensions, squared, and in one; a step of differences.
ELLIPSOID, INTERVAL, DIFFERENCE = 7.815, 1.96, 1e-2
# The tracker finds the person in the first frame.
STARTED = 1


@dataclass(frozen=True)
class Clip:
    """A person in T frames: data (M, 3), meshes, and the true joints (T, P, 3) and phenotypes (K,) of a made-up one."""

    data: Sequence[Tensor]
    meshes: Sequence[tr.TriangleMesh]
    start: Tensor | None
    up: tuple[float, float, float]
    joints: Sequence[Tensor] = ()
    phenotypes: Tensor | None = None


def made_up(shape: tr.ArticulatedShape, seed: int, frames: int, *, whole: bool) -> Clip:
    """Return the clip of a made-up person."""
    model = load_model("body")
    person = make_person(model, "body", shape.part_names[0], seed, count=10)
    generator = torch.Generator().manual_seed(500 + seed)
    count, faces = len(model.bone_labels), model.get_triangular_faces().long()
    axes = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1).double()
    angles = SPREAD * torch.randn(count, 1, generator=generator).double()
    phase, share = torch.rand(2, count, 1, generator=generator).double()
    pace = 1 / (FPS * (PERIODS[0] + (PERIODS[1] - PERIODS[0]) * share))
    angles[0], up = 0, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    azimuth = 2 * math.pi * float(torch.rand((), generator=generator))
    camera, meshes, data, joints = None, [], [], []
    parts = [model.bone_labels.index(name) for name in shape.part_names]
    for number in range(frames):
        deltas, seconds = person.deltas.clone(), number / FPS
        swing = (2 * math.pi * (pace * number + phase)).sin() - (2 * math.pi * phase).sin()
        deltas[:, :3, :3] = deltas[:, :3, :3] @ so3_exp(axes * angles * swing)
        deltas[0, :3, :3] = so3_exp(seconds * TURN * up) @ deltas[0, :3, :3]
        deltas[0, 1, 3] += WALK * seconds
        with torch.no_grad():
            posed = model(pose_parameters=deltas[None], phenotype_kwargs=person.phenotypes[None])
        vertices = posed["vertices"][0]
        joints.append(posed["bone_poses"][0, parts, :3, 3])
        meshes.append(tr.TriangleMesh(vertices, faces))
        if camera is None:
            away = torch.tensor([math.cos(azimuth), math.sin(azimuth), 0.1], dtype=torch.float64)
            camera = vertices.mean(0) + CAMERA * away
        data.append((whole_scan if whole else partial(seen_from, camera))(meshes[-1], NOISE, COUNT, generator))
    start = start_pose(model, shape, person)
    return Clip(data, meshes, start, (0.0, 0.0, 1.0), joints, person.phenotypes)


def seen_from(camera: Tensor, mesh: tr.TriangleMesh, noise: float, count: int, generator: torch.Generator) -> Tensor:
    """Return points (M, 3) of a mesh that a camera (3,) sees, with noise and outliers."""
    picture = rasterize(mesh, aim(mesh.vertices, camera, up=torch.tensor([0.0, 0.0, 1.0]), size=PIXELS))
    seen = (picture.face_index >= 0).nonzero()
    row, column = seen[torch.randperm(len(seen), generator=generator)[:count]].unbind(1)
    face, shares = picture.face_index[row, column], picture.barycentric[row, column]
    return measured(mesh, interpolate(mesh.vertices, mesh.faces, face, shares), noise, generator)


def captured(path: Path, frames: int) -> Clip:
    """Return a captured person, who stands along y: frames of a mesh, or of meshes with nothing in common."""
    with np.load(path) as file:
        arrays = {
            name: torch.from_numpy(file[name].astype(np.float64 if name == "vertices" else np.int64)) for name in file
        }
    if "vertex_counts" in arrays:
        vertices = arrays["vertices"].split(arrays["vertex_counts"].tolist())
        faces = arrays["faces"].split(arrays["face_counts"].tolist())
        meshes = [tr.TriangleMesh(*mesh) for mesh in zip(vertices, faces, strict=True)]
    else:
        meshes = [tr.TriangleMesh(vertices, arrays["faces"]) for vertices in arrays["vertices"]]
    generator = torch.Generator().manual_seed(0)
    data = [sample_surface(mesh, COUNT, generator=generator)[0] for mesh in meshes[:frames]]
    return Clip(data, meshes[:frames], None, (0.0, 1.0, 0.0))


@dataclass(frozen=True)
class Followed:
    """What a tracker made of a clip: bodies (T, V, 3), statuses and confidences of frames, CPU seconds of each.

    `covered` are the shares of joints and of coefficients within their ellipsoids, (T, 2).
    """

    bodies: list[Tensor]
    statuses: list[tr.Status]
    confidences: list[float]
    seconds: list[float]
    covered: list[tuple[float, float]]


def follow(shape: tr.ArticulatedShape, clip: Clip, *, smooth: bool = False) -> Followed:
    """Return what a tracker makes of a clip, and a second pass where that is wanted."""
    tracker = tr.Tracker(shape, clip.start, fit_shape=True, config=tr.TrackConfig(upright=clip.up))
    bodies, statuses, confidences, known, ticks = [], [], [], [], [time.process_time()]
    data = [points.float() for points in clip.data]

    def note(points: Tensor, result: tr.FrameResult) -> None:
        ticks.append(time.process_time())
        bodies.append(shape.vertices(result.pose, result.coefficients).double())
        statuses.append(result.status)
        confidences.append(float(result.confidence))
        known.append((result.pose, tracker.state.known_person))

    track = tracker.run(data, note)
    seconds = torch.tensor(ticks, dtype=torch.float64).diff().tolist()
    covered = [] if clip.phenotypes is None else [
        coverage(shape, pose, person, joints, clip.phenotypes)
        for (pose, person), joints in zip(known, clip.joints, strict=True)
        if person is not None and len(person.covariance) > len(person.coefficients)
    ]  # fmt: skip
    if not smooth:
        return Followed(bodies, statuses, confidences, seconds, covered)
    again = tr.smooth_track(track, data)
    bodies = [shape.vertices(pose, track.coefficients).double() for pose in again.poses]
    spent = (time.process_time() - ticks[-1]) / len(bodies)
    return Followed(bodies, statuses, confidences, [value + spent for value in seconds], covered)


def coverage(
    shape: tr.ArticulatedShape, pose: Tensor, known: KnownPerson, joints: Tensor, phenotypes: Tensor
) -> tuple[float, float]:
    """Return the shares of joints (P, 3) and coefficients (K,) within the 95 % ellipsoids about a pose (D,) found."""
    space, count = shape.coefficient_space(), shape.num_dofs + len(phenotypes)
    tree, covariance = ShapedTree(shape, space), known.total[:count, :count].double()
    state = torch.cat([pose, known.coefficients.to(pose)])[:count]
    ends = torch.cat([torch.eye(count), -torch.eye(count), torch.zeros(1, count)]) * DIFFERENCE
    with torch.no_grad():
        placed = tree.posed(tree.retract(state, ends), tree.space.restricted(torch.zeros(1, dtype=torch.int64)))
    places = placed.frames[:, shape.part_index, :3, 3].double()
    moves = ((places[:count] - places[count:-1]) / (2 * DIFFERENCE)).permute(1, 2, 0)
    error = (places[-1] - joints).unsqueeze(-1)
    squares = (error.mT @ torch.linalg.solve(moves @ covariance @ moves.mT, error)).flatten()
    off = (state[-len(phenotypes) :] - phenotypes).abs() / covariance.diagonal()[-len(phenotypes) :].sqrt()
    return float((squares < ELLIPSOID).double().mean()), float((off < INTERVAL).double().mean())


def vertex_errors(found: Followed, clip: Clip) -> Tensor:
    """Return the mean distances (T,) of vertices from their true places, mm."""
    pairs = zip(found.bodies, clip.meshes, strict=True)
    return 1e3 * torch.stack([(body - mesh.vertices).norm(dim=-1).mean() for body, mesh in pairs])


def material_errors(found: Followed, clip: Clip, faces: Tensor) -> Tensor:
    """Return the mean distances (T,) of captured vertices from the places of the body they are bound to, mm."""
    first = tr.TriangleMesh(found.bodies[0], faces)
    _, face, shares = sample_surface(first, BOUND, generator=torch.Generator().manual_seed(0))
    bound = nearest_neighbor(clip.meshes[0].vertices.double(), interpolate(first.vertices, faces, face, shares))[0]
    pairs = zip(found.bodies, clip.meshes, strict=True)
    places = [(interpolate(body, faces, face, shares)[bound], mesh.vertices.double()) for body, mesh in pairs]
    return 1e3 * torch.stack([(body - vertices).norm(dim=-1).mean() for body, vertices in places])


def surface_errors(found: Followed, clip: Clip, faces: Tensor) -> Tensor:
    """Return the larger (T,) of the mean distances from a captured surface to the body's and back, mm."""
    errors, generator = [], torch.Generator().manual_seed(0)
    for body, mesh in zip(found.bodies, clip.meshes, strict=True):
        one, other = (sample_surface(tr.TriangleMesh(*surface), BOUND // 4, generator=generator)[0].double()
                      for surface in ((body, faces), (mesh.vertices.double(), mesh.faces)))  # fmt: skip
        errors.append(max(nearest_neighbor(one, other)[1].mean(), nearest_neighbor(other, one)[1].mean()))
    return 1e3 * torch.stack(errors)


def report(name: str, errors: Tensor, found: Followed) -> bool:
    """Print the figures of a clip; return whether it neither drifts nor takes too long."""
    ends, busy = min(ENDS, max(1, len(errors) // 2)), found.seconds[STARTED:]
    first, last = float(errors[:ends].mean()), float(errors[-ends:].mean())
    rate = len(busy) / max(sum(busy), 1e-9)
    sure = sum(status is tr.Status.CONVERGED for status in found.statuses)
    alike = sum((status is tr.Status.CONVERGED) == (value >= 0.5)
                for status, value in zip(found.statuses, found.confidences, strict=True))  # fmt: skip
    if found.covered:
        joints, coefficients = torch.tensor(found.covered).mean(0).tolist()
        print(f"{name}: 95 % ellipsoids cover {joints:.0%} of the joints, {coefficients:.0%} of the coefficients")
    print(f"{name}: first {ends} frames {first:.1f} mm, last {ends} {last:.1f} mm, mean {float(errors.mean()):.1f}, "
          f"worst {float(errors.max()):.1f}; {rate:.2f} frames per CPU s after the first ({found.seconds[0]:.1f} s); "
          f"{sure} of {len(errors)} converged; status and confidence agree in {alike} "
          f"({dict(Counter(status.value for status in found.statuses))}, confidences "
          f"{min(found.confidences):.2f} to {max(found.confidences):.2f})", flush=True)  # fmt: skip
    return last <= DRIFT_BAR * first and rate >= RATE_BAR


def main() -> int:
    """Run what is asked for; 0 if every bar is met."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first", type=int, default=0, help="seed")
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--whole", action="store_true", help="scans of all sides")
    parser.add_argument("--smooth", action="store_true", help="with the second pass")
    parser.add_argument("--data", type=Path, help="folder with samba.npz and captured_people, in place of made-up ones")
    options = parser.parse_args()
    if find_spec("anny") is None:
        print("skipped: anny is not installed; pip install 'torchreg-articulated[anny]'")
        return 0
    shape = tr.ArticulatedShape.from_anny("body")
    faces, met = shape.file_surface().faces, True
    if options.data is None:
        for seed in range(options.first, options.first + options.seeds):
            clip = made_up(shape, seed, options.frames, whole=options.whole)
            found = follow(shape, clip, smooth=options.smooth)
            met &= report(f"seed {seed}", vertex_errors(found, clip), found)
        return 0 if met else 1
    paths = [options.data / "samba.npz", *sorted((options.data / "captured_people").glob("*.npz"))]
    for path in filter(Path.exists, paths):
        clip = captured(path, options.frames)
        found = follow(shape, clip, smooth=options.smooth)
        if path == paths[0]:
            met &= report(f"{path.stem}, points followed", material_errors(found, clip, faces), found)
        report(f"{path.stem}, surfaces", surface_errors(found, clip, faces), found)
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
