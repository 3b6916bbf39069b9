"""The robot in registered scans: which parts turn, slide or hold together, about which axes, and how far."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from torchreg.errors import InputError
from torchreg.geometry.cloud_surface import CLOSING, cloud_surface
from torchreg.geometry.graphs import minimum_spanning_forest, rooted
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.neighbors import NeighborTree
from torchreg.geometry.poisson_disk import poisson_disk
from torchreg.geometry.rigid import fit_rigid, invert_rigid, rigid_matrix
from torchreg.geometry.sampling import even_order
from torchreg.io.urdf_file.write import save_urdf
from torchreg.registration.robots.fit import Data, Mechanism, axis_stds, fitted, settled
from torchreg.registration.robots.fusion import FusedScans
from torchreg.registration.robots.growth import GROWTH, Growth, grown
from torchreg.registration.robots.joints import Candidate, best_joint, from_ground, relative
from torchreg.registration.robots.links import find_links, labeled, without_gaps
from torchreg.registration.robots.surfaces import NUMBERS, Noise, Surfaces, Target
from torchreg.shapes.posed_tree import PosedTree


@dataclass(frozen=True)
class ModelNumbers:
    """Of the whole search."""

    samples: int = 2500  # of the reference
    rounds: int = 2  # of links, joints and the fit of all; a third changes nothing on scans of arms
    fusions: int = 6  # of all scans to one surface, and fits to it: the axes of later ones change by tenths of degrees
    still: float = 0.1  # standard deviations: a mean step of the samples from which a fusion is the last
    kernels: tuple[float, ...] = (5.0, 4.0, 3.0, 3.0)  # of each fit, standard deviations
    thinned: float = 0.5  # of a scan's spacing, between points of a surface that is made of all scans
    unsure: float = 0.087  # standard deviation of an axis that the scans do not determine, radians: five degrees
    margin: float = 0.05  # beyond the motions seen, that limits allow, radians, or shares of the diagonal


MODEL = ModelNumbers()


@dataclass(frozen=True, eq=False)
class RobotModel:
    """A robot found in scans: its joints, and their values in every frame; links that never parted are one."""

    tree: KinematicTree  # one frame a link, the zero pose that of the reference
    part: Tensor  # (N,) link of each point of the reference
    joint_values: Tensor  # (T, J) radians, or the scans' unit
    base: Tensor  # (T, 4, 4) motions of the root link from the reference
    # (T,) median distances of the reference, moved by the joints, from the scans; zero for the reference
    residuals: Tensor
    axis_std: Tensor  # (J,) standard deviations of the joints' axes, radians, where the links are right
    origin_std: Tensor  # (J,) the same of where a hinge's axis lies, at its link's origin, in the scans' unit
    # names of the joints whose links move in more ways about each other than one joint allows
    loose: tuple[str, ...] = ()

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Names of the joints that moved, but whose axes the scans do not determine within five degrees."""
        unsure = (self.axis_std > MODEL.unsure).tolist()
        return tuple(joint.name for joint, is_unsure in zip(self.tree.joints[1:], unsure, strict=True) if is_unsure)

    def origins(self) -> Tensor:
        """Return where the frames of the links begin in the reference (L, 3)."""
        posed = self._posed()
        return posed.part_transforms(posed.rest)[:, :3, 3]

    def motions(self) -> Tensor:
        """Return the motions (T, L, 4, 4) that take the links from the reference to every frame."""
        posed = self._posed()
        rest = invert_rigid(posed.part_transforms(posed.rest))
        moved = posed.part_transforms(torch.nn.functional.pad(self.joint_values, (6, 0)))
        return self.base.unsqueeze(1) @ moved @ rest

    def moved(self, points: Tensor) -> Tensor:
        """Return the points (N, 3) of the reference in all frames, (T, N, 3), moved by their links."""
        chosen = self.motions()[:, self.part]
        return (chosen[..., :3, :3] @ points.unsqueeze(-1)).squeeze(-1) + chosen[..., :3, 3]

    def _posed(self) -> PosedTree:
        return PosedTree(self.tree, [joint.name for joint in self.tree.joints], None, True).double()


def find_robot(
    points: Tensor,
    normals: Tensor,
    deformed: Tensor,
    part: Tensor,
    scans: Sequence[Target] | None = None,
    reference: int = 0,
    *,
    sparse: bool = False,
) -> RobotModel:
    """Return the robot of a reference scan that was registered to T scans.

    Parts, and pieces of them, propose motions; samples take those of least description length. Two links that touch
    hold together, turn, slide or move freely, by the criterion of Schwarz on what the data hold of their relative
    motions; those that hold together are one. Between two may be a link that no scan shows to turn, with a hinge at
    either end. The joints of most evidence make a tree, whose axes and values are fitted to all scans together; links
    and joints are then looked for once more from there. In ``sparse`` scans, points whose normals are estimates and may
    have wrong signs, links are also looked for one after another, which needs no registration; last, these scans are
    compared with each other on each link.

    ``part``: (N,) labels of bones, at least as many as links that registration tells apart (Isack and Boykov 2012 for
    the links; Schwarz 1978 for the tests; Chow and Liu 1968 for the tree of most evidence).
    """
    points, normals, deformed = (values.detach().cpu().double() for values in (points, normals, deformed))
    part = part.cpu().unique(return_inverse=True)[1]
    moved = torch.stack([fit_rigid(points[part == number].expand(len(deformed), -1, -1), deformed[:, part == number])
                         for number in range(int(part.max()) + 1)], 1)  # fmt: skip
    if scans is None:
        turned = (moved[:, part, :3, :3] @ normals.unsqueeze(-1)).squeeze(-1)
        scans = [Target(*frame) for frame in zip(deformed, turned, strict=True)]
    if sparse:
        scans = [Target(scan.points, scan.normals, signed=False) for scan in scans]
    frames = torch.tensor([frame for frame in range(len(deformed)) if frame != reference])
    order = even_order(points, min(len(points), MODEL.samples))
    surfaces = Surfaces.of(points[order], normals[order], [scans[frame] for frame in frames.tolist()])
    motions, label = without_gaps(moved[frames], part[order])
    for _ in range(MODEL.rounds):
        if sparse:
            motions, label = with_grown_links(surfaces, motions, label)
            surfaces = surfaces.with_signs(motions, label)
        motions, label, noise = find_links(surfaces, motions, label)
        motions, label, joints = without_welds(surfaces, motions, label, noise)
        mechanism, label = assembled(surfaces, motions, label, joints, noise)
        mechanism = settled(surfaces, mechanism, label, noise)
        motions = mechanism.motions()
    noise = surfaces.noise(motions, label)
    label = labeled(surfaces, motions, label, noise)
    fit: tuple[Data, Mechanism, Noise, Tensor] = surfaces, mechanism, noise, torch.zeros_like(mechanism.axes)
    if sparse:
        fit = compared_with_each_other(scans, surfaces, mechanism.with_frame(reference), label, reference)
        mechanism = fit[1].without_frame(reference)
        motions = mechanism.motions()
    loose = _loose(surfaces, mechanism, label, noise)
    residuals = torch.zeros(len(deformed), dtype=torch.float64)
    residuals[frames] = surfaces.distances(motions, label)
    link = label[NeighborTree(surfaces.samples).nearest(points)[0]]
    found = _described(mechanism, points, link, frames, residuals, loose)
    axis, origin = axis_stds(*fit, label, found.origins())
    shown = _shown(surfaces, mechanism, label)[1:]
    return replace(found, axis_std=axis[1:].where(shown, torch.inf), origin_std=origin[1:].where(shown, torch.inf))


def with_grown_links(surfaces: Surfaces, motions: Tensor, label: Tensor) -> tuple[Tensor, Tensor]:
    """Return motions (T, K, 4, 4) and labels (n,), those of links found one after another where parts do not fit."""
    motions = surfaces.refined(motions, label, [scale * surfaces.spacing for scale in GROWTH.others])
    state = Growth(surfaces, motions, label).labeled()
    if float((state.label >= 0).double().mean()) >= GROWTH.registered:
        return grown(state)
    found, new = grown(Growth.rooted(surfaces, motions))
    return torch.cat([motions, found], 1), new + motions.shape[1]


def compared_with_each_other(
    scans: Sequence[Target], surfaces: Surfaces, mechanism: Mechanism, label: Tensor, reference: int
) -> tuple[FusedScans, Mechanism, Noise, Tensor]:
    """Return all scans on the links (n,) of samples, and the mechanism fitted to what each scan shows with the others.

    With them come the noise, and the last steps (K, 6) of the axes. The reference is a frame as any other, but stays.
    """
    for _ in range(MODEL.fusions):
        before, motions = mechanism, mechanism.motions()
        fused = FusedScans.of(scans, surfaces, label, motions, reference)
        noise = fused.noise(motions)
        mechanism = fitted(fused, before, label, [scale * noise.sigma for scale in MODEL.kernels])
        old, new = (surfaces.moved(own[:, label])[0] for own in (motions, mechanism.motions()))
        if float((new - old).norm(dim=-1).mean()) < MODEL.still * noise.sigma:
            break
    return fused, mechanism, noise, mechanism.steps_from(before)


def without_welds(
    surfaces: Surfaces, motions: Tensor, label: Tensor, noise: Noise
) -> tuple[Tensor, Tensor, dict[tuple[int, int], Candidate]]:
    """Return motions and labels of which those that hold together are one, and the joints of those that touch."""
    scale = NUMBERS.cut * noise.sigma
    while True:
        blocks = surfaces.blocks(motions, label, scale)
        ends = label[surfaces.edges].sort(-1).values
        pairs = [(low, high) for low, high in ends.unique(dim=0).tolist() if low != high]
        joints = {pair: best_joint(relative(motions, blocks, pair, noise, surfaces.size)) for pair in pairs}
        welds = [pair for pair in pairs if joints[pair].kind == "fixed"]
        if not welds:
            return motions, label, joints
        merged: set[int] = set()
        for pair in sorted(welds, key=lambda pair: joints[pair].length):
            if merged.isdisjoint(pair):
                merged |= set(pair)
                first, second = ((label == link).sum() for link in pair)
                kept, gone = pair if first >= second else pair[::-1]
                label = torch.where(label == gone, kept, label)
        motions, label = without_gaps(motions, label)
        motions = surfaces.refined(motions, label, [scale] * len(pairs))


def assembled(
    surfaces: Surfaces, motions: Tensor, label: Tensor, joints: dict[tuple[int, int], Candidate], noise: Noise
) -> tuple[Mechanism, Tensor]:
    """Return the tree of the joints of most evidence, and the labels by its links.

    The ground is a link too: where the data speak for it, the root stands still, or hangs on a base that does. A round
    base shows by that alone that what stands on it turns.
    """
    count, frames = motions.shape[1], len(motions)
    pairs = torch.tensor(list(joints), dtype=torch.long).reshape(-1, 2)
    lengths = torch.tensor([joint.length for joint in joints.values()], dtype=torch.float64)
    chosen = pairs[minimum_spanning_forest(pairs, lengths - lengths.min() + 1, count).chosen()] if len(pairs) else pairs
    parents, order = rooted(chosen, surfaces.travel(motions, label).argmin().reshape(1), count)
    place = torch.zeros_like(order)
    above, axes, values = [-1], [torch.zeros(6).double()], [torch.zeros(frames).double()]

    def hang(parent: int, joint: Candidate, sign: int) -> int:
        # Seen from the other link, joints in a row come in reverse. Between two of them is a link without samples.
        for twist, value in list(zip(joint.twists, joint.values.mT, strict=True))[::sign]:
            above.append(parent)
            axes.append(twist)
            values.append(sign * value)
            parent = len(above) - 1
        return parent

    blocks = surfaces.blocks(motions, label, NUMBERS.cut * noise.sigma)
    ground = best_joint(from_ground(motions, blocks, order[0], noise, surfaces.size))
    held = ground.length < 0
    if held and ground.kind != "fixed":
        place[order[0]] = hang(0, ground, 1)
    for link in order[1:].tolist():
        parent = int(parents[link])
        joint = joints[min(link, parent), max(link, parent)]
        place[link] = hang(int(place[parent]), joint, 1 if parent < link else -1)
    base = torch.eye(4, dtype=torch.float64).repeat(frames, 1, 1) if held else motions[:, order[0]]
    mechanism = Mechanism(
        parents=tuple(above), axes=torch.stack(axes), base=base, values=torch.stack(values, 1), held=held
    )
    return mechanism, place[label]


def _shown(surfaces: Surfaces, mechanism: Mechanism, label: Tensor) -> Tensor:
    """Return for each link whether the scans show it and its parent where the joints put them.

    Standard deviations hold for links that are right; one that most scans do not show there is not.
    """
    motions, parents = mechanism.motions(), mechanism.parents
    costs = Growth(surfaces, motions, label).costs(motions).gather(1, label.unsqueeze(1))[:, 0]
    count = torch.bincount(label, minlength=len(parents))
    shares = torch.zeros(len(parents)).double().index_add(0, label, (costs > GROWTH.explained).double()) / count
    # A link without samples is as right as the next.
    own = [bool(share <= 0.5) for share in shares]
    for link in reversed(range(1, len(parents))):
        if not count[parents[link]]:
            own[parents[link]] = own[link]
    return torch.tensor([own[link] and own[max(parent, 0)] for link, parent in enumerate(parents)])


def _loose(surfaces: Surfaces, mechanism: Mechanism, label: Tensor, noise: Noise) -> tuple[bool, ...]:
    """Return for each link whether the data speak for a free motion about its parent rather than for any joint."""
    scale = NUMBERS.cut * noise.sigma
    motions = surfaces.refined(mechanism.motions(), label, [scale] * 3)
    blocks = surfaces.blocks(motions, label, scale)
    pairs = [(parent, link) for link, parent in enumerate(mechanism.parents)]
    shown = torch.bincount(label, minlength=len(pairs)) > 0
    return tuple(
        pair[0] >= 0
        and bool(shown[list(pair)].all())
        and best_joint(relative(motions, blocks, pair, noise, surfaces.size)).length > 0
        for pair in pairs
    )


def _described(
    mechanism: Mechanism, points: Tensor, link: Tensor, frames: Tensor, residuals: Tensor, loose: tuple[bool, ...]
) -> RobotModel:
    """Return the record of a mechanism in the frames other than the reference, which has values of zero."""
    count, size = len(residuals), float((points.amax(0) - points.amin(0)).norm())
    values = torch.zeros(count, len(mechanism.parents), dtype=torch.float64)
    base = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    values[frames], base[frames] = mechanism.values, mechanism.base
    joints: list[Joint] = []
    origins: list[Tensor] = []
    middles = _middles(points, link, len(mechanism.parents))
    for number, (parent, twist) in enumerate(zip(mechanism.parents, mechanism.axes, strict=True)):
        origin = _origin(twist, middles[number])
        above = origins[parent] if parent >= 0 else torch.zeros_like(origin)
        origins.append(origin)
        offset = rigid_matrix(torch.eye(3, dtype=torch.float64), origin - above)
        column = values[:, number]
        joints.append(_joint(number, parent, offset, twist, (float(column.min()), float(column.max())), size))
    names = [joint.name for joint, free in zip(joints, loose, strict=True) if free]
    return RobotModel(
        tree=KinematicTree(tuple(joints)),
        part=link,
        joint_values=values[:, 1:],
        base=base,
        residuals=residuals,
        axis_std=torch.zeros(len(joints) - 1, dtype=torch.float64),
        origin_std=torch.zeros(len(joints) - 1, dtype=torch.float64),
        loose=tuple(names),
    )


def _middles(points: Tensor, link: Tensor, count: int) -> list[Tensor]:
    """Return the middles (3,) of the links' points (N, 3); a link that shows none has that of the next."""
    found = [points.mean(0)]
    for number in reversed(range(count)):
        own = points[link == number]
        found.append(own.mean(0) if len(own) else found[-1])
    return found[:0:-1]


def _origin(twist: Tensor, middle: Tensor) -> Tensor:
    """Return where a link's frame begins: at zero for the root, on a hinge's axis, or in the middle of what slides."""
    if not bool(twist.any()):
        return torch.zeros_like(middle)
    if not bool(twist[3:].any()):
        return middle
    point = torch.linalg.cross(twist[3:], twist[:3])
    return point + ((middle - point) @ twist[3:]) * twist[3:]


def _joint(number: int, parent: int, offset: Tensor, twist: Tensor, seen: tuple[float, float], size: float) -> Joint:
    """Return a joint with limits about the values seen and zero."""
    if parent < 0:
        return Joint("base", -1, offset)
    turns = bool(twist[3:].any())
    x, y, z = (twist[3:] if turns else twist[:3]).tolist()
    margin = MODEL.margin * (1.0 if turns else size)
    return Joint(
        f"joint_{number}", parent, offset, kind="revolute" if turns else "prismatic", axis=(x, y, z),
        lower=min(0.0, seen[0]) - margin, upper=max(0.0, seen[1]) + margin,
    )  # fmt: skip


def write_robot(
    path: str | os.PathLike[str],
    found: RobotModel,
    points: Tensor,
    faces: Tensor | None,
    scans: Sequence[Target] | None = None,
) -> None:
    """Write a robot as URDF, each link with a mesh in a frame that begins at its joint."""
    points = points.detach().cpu().double()
    if faces is not None:
        faces = faces.cpu()
        owner = found.part[faces].mode(-1).values
        meshes = [TriangleMesh(points, faces[owner == link]) for link in range(len(found.tree))]
    elif scans is not None:
        meshes = _closed_links(found, points, scans)
    else:
        raise InputError("the scans have no triangles, which the meshes of links need; register scans with faces")
    placed = [
        replace(mesh, vertices=mesh.vertices - origin) for mesh, origin in zip(meshes, found.origins(), strict=True)
    ]
    names = [f"link_{number}" for number in range(len(found.tree))]
    save_urdf(path, Path(path).stem, found.tree, names, placed)


def _closed_links(found: RobotModel, points: Tensor, scans: Sequence[Target]) -> list[TriangleMesh]:
    """Return a closed surface about each link's points in all scans, in the reference; none about a few points."""
    fused, links = [], []
    for scan, moved, motions in zip(scans, found.moved(points), found.motions(), strict=True):
        owners = found.part[NeighborTree(moved).nearest(scan.points)[0]]
        back = invert_rigid(motions)[owners]
        fused.append((back[:, :3, :3] @ scan.points.unsqueeze(-1)).squeeze(-1) + back[:, :3, 3])
        links.append(owners)
    spacing = sum(scan.spacing for scan in scans) / len(scans)
    everything, owner = torch.cat(fused), torch.cat(links)
    meshes = []
    for link in range(len(found.tree)):
        own = everything[owner == link]
        # All scans together may be as dense as their noise is thick.
        own = own[poisson_disk(own, MODEL.thinned * spacing)]
        if len(own) < CLOSING.min_points:
            meshes.append(TriangleMesh(points, torch.zeros(0, 3, dtype=torch.long)))
        else:
            meshes.append(cloud_surface(own).mesh)
    return meshes
