"""Rigs of sequences: python benchmarks/rig_sequence.py --data FOLDER [--rigs 12] [--frames 20] [--captured samba].

FOLDER/library holds rigged .glb files: those with a clip in which joints move are taken, spread over their names. Each
gives frames at equal times, every frame meshed anew by another tessellation, with noise of .1 % of the diagonal. FOLDER
also holds captured sequences as .npz of vertices and faces. Prints mean two-way distances of the posed surface, % of
the template's diagonal, of all frames but the template and of the worst one; the same of the template held still, and
of its parts registered rigidly one by one from frame to frame; bones beside those that move in the clip; moving joints
with a found one within 5 % of the diagonal, and with one of as many points spread evenly; CPU s a frame; last the sums
over all rigs. --alone leaves out the parts, which cost as much as the rigs. Without --data nothing is measured.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import trimesh
from torch import Tensor

import torchreg as tr
from torchreg.geometry.mesh import even_samples
from torchreg.geometry.neighbors import NeighborTree, nearest_neighbor
from torchreg.geometry.rigid import fit_rigid, transform_points
from torchreg.geometry.rotation import so3_exp, so3_log
from torchreg.geometry.sampling import farthest_points
from torchreg.geometry.scan_clusters import clustered_scan
from torchreg.registration.rigging.distances import surface_distances

NOISE, POINTS, SAMPLES, MOVING, NEAR = 0.001, 8000, 20_000, 0.15, 0.05


@dataclass(frozen=True)
class Figures:
    """What is measured of a sequence: a line of text, and for sums the errors, joints near and all, bones of both."""

    text: str
    mean: float
    worst: float
    near: int = 0
    joints: int = 0
    bones: int = 0


def clip(file: Path, count: int) -> tuple[list[tr.TriangleMesh], Tensor]:
    """Return frames of a rig's clip at equal steps between its keyframes, and its moving joints (T, J, 3) in each."""
    keys: list[tr.TriangleMesh] = []
    try:
        while len(keys) < 10 * count:
            keys.append(tr.load_mesh(file, frame=len(keys)))
    except tr.errors.TorchregError:
        pass
    if len(keys) < 3:
        return [], torch.zeros(0, 0, 3)
    chosen = np.unique(np.linspace(0, len(keys) - 1, min(count, len(keys))).round().astype(int))
    meshes = [keys[index] for index in chosen]
    return meshes, moving_joints(tr.ArticulatedShape.from_gltf(file), meshes)


def moving_joints(shape: tr.ArticulatedShape, meshes: Sequence[tr.TriangleMesh]) -> Tensor:
    """Return the joints (T, J, 3) that turn by more than MOVING, radians, in the motion of the vertices they own."""
    skin = shape.file_skin()
    rest = shape.part_transforms(shape.rest_pose())[:, :3, 3].double()
    owner = skin.weights.argmax(1)
    moved: dict[int, Tensor] = {}
    for part in range(shape.num_parts):
        own = (owner == part).nonzero()[:, 0]
        if len(own) >= 6:
            moved[part] = torch.stack([
                fit_rigid(skin.points[own].double(), mesh.vertices[own].double()) for mesh in meshes
            ])  # fmt: skip
    joints = []
    for part, motion in moved.items():
        parent = shape.part_parents[part]
        while parent >= 0 and parent not in moved:
            parent = shape.part_parents[parent]
        if parent >= 0:
            turn = moved[parent][:, :3, :3].mT @ motion[:, :3, :3]
            if float(so3_log((turn[:1].mT @ turn).contiguous()).norm(dim=-1).max()) > MOVING:
                joints.append(transform_points(moved[parent], rest[part].expand(len(meshes), 1, 3))[:, 0])
    return torch.stack(joints, 1) if joints else rest.new_zeros(len(meshes), 0, 3)


def anew(mesh: tr.TriangleMesh, seed: int) -> tr.TriangleMesh:
    """Return a surface in another tessellation, with noise: subdivided, turned, clustered, and turned back."""
    generator = torch.Generator().manual_seed(seed)
    size = float((mesh.vertices.amax(0) - mesh.vertices.amin(0)).norm())
    fine, faces = trimesh.remesh.subdivide_to_size(mesh.vertices.double().numpy(), mesh.faces.numpy(), 0.01 * size, 20)
    turn = so3_exp(3 * torch.rand(3, generator=generator, dtype=torch.float64))
    scan = tr.RangeScan(torch.tensor(fine) @ turn.mT, torch.tensor(faces).long())
    coarse = clustered_scan(scan, POINTS // 2)[0]
    points = coarse.points @ turn
    return tr.TriangleMesh(
        points + NOISE * size * torch.randn(points.shape, generator=generator, dtype=points.dtype), coarse.faces
    )


def captured(file: Path, count: int) -> list[tr.TriangleMesh]:
    """Return frames of a captured sequence."""
    stored = np.load(file)
    vertices, faces = stored["vertices"], stored["faces"]
    if vertices.ndim == 2:
        vertices = np.split(vertices, np.cumsum(stored["vertex_counts"])[:-1])
        faces = np.split(faces, np.cumsum(stored["face_counts"])[:-1])
    else:
        faces = [faces] * len(vertices)
    chosen = np.linspace(0, len(vertices) - 1, min(count, len(vertices))).round().astype(int)
    return [tr.TriangleMesh(torch.tensor(vertices[index]), torch.tensor(faces[index]).long()) for index in chosen]


def distance(one: tr.TriangleMesh, other: tr.TriangleMesh) -> float:
    """Return the mean two-way distance of two surfaces."""
    points, normals = [], []
    for mesh in (one, other):
        sample, face = even_samples(mesh, SAMPLES)
        points.append(sample.double())
        normals.append(mesh.face_normals()[face].double())
    spacing = float(one.face_areas().sum() / SAMPLES) ** 0.5
    both = []
    for here, there in ((0, 1), (1, 0)):
        index, _ = nearest_neighbor(points[here], points[there])
        both.append(surface_distances(points[here] - points[there][index], normals[there][index], spacing).mean())
    return float(both[0] + both[1]) / 2


def part_by_part(rig: tr.SequenceRig, meshes: Sequence[tr.TriangleMesh]) -> Tensor:
    """Return the template's vertices (T, V, 3), each part moved rigidly by ICP from frame to frame."""
    start = rig.shape.file_skin().points.double()
    owner = rig.weights.argmax(1)
    placed = start.expand(len(meshes), *start.shape).clone()
    for step, end in ((1, len(meshes)), (-1, -1)):
        for frame in range(rig.template + step, end, step):
            target = even_samples(meshes[frame], SAMPLES)[0].double()
            tree = NeighborTree(target)
            for part in owner.unique().tolist():
                own = owner == part
                moved = placed[frame - step][own]
                for _ in range(15):
                    goal = target[tree.nearest(moved)[0]]
                    moved = transform_points(fit_rigid(moved, goal), moved) if len(moved) > 3 else goal
                placed[frame, own] = moved
    return placed


def measure(name: str, meshes: Sequence[tr.TriangleMesh], joints: Tensor | None, *, alone: bool) -> Figures:
    begin = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", tr.errors.TorchregWarning)
        rig = tr.rig_sequence(meshes)
    seconds = (time.process_time() - begin) / len(meshes)
    faces, still = rig.shape.file_skin().faces, rig.shape.file_skin().points
    size = float((still.amax(0) - still.amin(0)).norm())
    posed = rig.vertices()
    others = [frame for frame in range(len(meshes)) if frame != rig.template and bool(posed[frame].isfinite().all())]
    rivals = {"rig": posed, "still": still.expand_as(posed)} | ({} if alone else {"parts": part_by_part(rig, meshes)})
    text, rows = f"{name:24}", []
    for word, placed in rivals.items():
        row = torch.tensor([distance(tr.TriangleMesh(placed[frame], faces), meshes[frame]) for frame in others]) / size
        text += f" {word} {float(row.mean()):6.2%}, worst {float(row.max()):6.2%} "
        rows.append(row)
    near = count = 0
    if joints is not None:
        count = joints.shape[1]
        found = rig.joints[1:].double()
        even = still[farthest_points(still, max(1, len(found)))].double()[: len(found)]
        near, chance = (
            int((torch.cdist(joints[rig.template], each) / size < NEAR).any(1).sum()) if len(each) else 0
            for each in (found, even)
        )
        text += f" bones {len(rig.joints)} of {count + 1}, joints {near} of {count} ({chance} by chance)"
    text += f"  {rig.status}  {seconds:.1f} CPU s"
    return Figures(text, float(rows[0].mean()), float(rows[0].max()), near, count, len(rig.joints))


def rigs(
    folder: Path, names: Sequence[str], count: int, frames: int
) -> Iterator[tuple[str, list[tr.TriangleMesh], Tensor]]:
    """Yield names, frames meshed anew and moving joints of rigs whose clips move any, spread over all names."""
    files = sorted(folder.glob("*.glb"))
    files = [file for file in files if file.stem in names] if names else files
    # Multiples of the golden ratio, modulo one, spread any number of files evenly.
    order = np.argsort(np.arange(len(files)) * 0.6180339887498949 % 1)
    for index in order:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", tr.errors.TorchregWarning)
            try:
                meshes, joints = clip(files[index], frames)
            except tr.errors.TorchregError as error:
                print(f"{files[index].stem:24} not read: {error}")
                continue
        if joints.shape[1] and count > 0:
            count -= 1
            yield files[index].stem, [anew(mesh, seed) for seed, mesh in enumerate(meshes)], joints
        if count == 0:
            return


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder with library/ and captured sequences")
    parser.add_argument("--rigs", type=int, default=12, help="of the library, evenly spread by name")
    parser.add_argument("--names", nargs="*", default=[], help="these of the library alone")
    parser.add_argument("--frames", type=int, default=20, help="of each sequence, at most")
    parser.add_argument("--captured", nargs="*", default=["samba", "horse_gallop", "thomas"], help="names without .npz")
    parser.add_argument("--alone", action="store_true", help="without the parts registered one by one")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    if options.data is None:
        print("nothing is measured without --data")
        return
    for name in options.captured:
        file = next(iter(sorted(options.data.rglob(f"{name}.npz"))), None)
        if file is not None:
            print(measure(name, captured(file, options.frames), None, alone=options.alone).text, flush=True)
    found = []
    for name, meshes, joints in rigs(options.data / "library", options.names, options.rigs, options.frames):
        found.append(measure(name, meshes, joints, alone=options.alone))
        print(found[-1].text, flush=True)
    if found:
        near, joints = (sum(getattr(each, word) for each in found) for word in ("near", "joints"))
        print(
            f"{len(found)} rigs: mean {sum(each.mean for each in found) / len(found):.2%}, worst "
            f"{max(each.worst for each in found):.2%}; joints {near} of {joints}, {near / joints:.0%}; bones at most "
            f"1.5 times as many in {sum(each.bones <= 1.5 * (each.joints + 1) for each in found)}"
        )


if __name__ == "__main__":
    main()
