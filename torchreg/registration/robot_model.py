"""The robot in registered scans: which parts turn, slide or hold together, about which axes, and how far."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from torchreg.errors import InputError
from torchreg.geometry.graphs import minimum_spanning_forest, rooted
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.neighbors import NeighborTree
from torchreg.geometry.rigid import fit_rigid, invert_rigid, rigid_matrix, transform_points
from torchreg.geometry.rotation import so3_exp, so3_log
from torchreg.io.urdf_write import save_urdf
from torchreg.shapes.pose_algebra import BASE_DOFS
from torchreg.shapes.posed_tree import PosedTree
from torchreg.solvers.levenberg_marquardt import Linearization, levenberg_marquardt


@dataclass(frozen=True)
class _Kinematics:
    """Numbers of the search for joints; lengths are shares of the thing's diagonal."""

    weld: float = 2.0  # residual of parts held together, in that of the parts' own rigid motions: below, they hold
    simpler: float = 1.3  # by how much the residual of a slider may exceed a hinge's, which has a point more
    least_share: float = 0.04  # of the points, of a part: where parts meet, slivers move like neither; they join one
    least_turn: float = 0.02  # of a hinge over the frames, radians: less is noise
    contact_weight: float = 1.0  # of the gap between two parts, beside the residual of their joint
    floor: float = 0.002  # residual below which all is noise
    num_fitted: int = 3000  # points of that fit
    steps: int = 20  # of the fit of all joint values
    prior: float = 1e-6  # of the joint values' curvature, where a joint moves few points
    margin: float = 0.05  # beyond the motions seen, that limits allow, radians, or shares of the diagonal


_NUMBERS = _Kinematics()


@dataclass(frozen=True, eq=False)
class RobotModel:
    """A robot found in scans: its joints, and how they stood in every frame.

    Args:
        tree: one frame a link, the zero pose that of the reference.
        part: (N,) link of each point of the reference.
        joint_values: (T, J) radians, or the scans' unit.
        base: (T, 4, 4) motions of the root link from the reference.
        residuals: (T,) root mean square of the points' distances from where they were registered.
    """

    tree: KinematicTree
    part: Tensor
    joint_values: Tensor
    base: Tensor
    residuals: Tensor


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A joint between two parts: its kind, axis (3,), a point on it (3,) and root mean square residual."""

    kind: str
    axis: Tensor
    point: Tensor
    residual: float


def find_robot(points: Tensor, deformed: Tensor, part: Tensor) -> RobotModel:
    """Return the robot of points (N, 3) that were registered to (T, N, 3), given their parts (N,).

    For each two parts the motion of one as seen from the other is taken for none, for a slide and for a turn about an
    axis, the simplest whose residual is not larger than that of the parts' own rigid motions. The joints of least
    residual between the nearest parts make a tree, and all joint values are fitted to all points.

    Args:
        points: of the reference.
        deformed: the same in all frames.
        part: labels from 0.
    """
    points, deformed = points.detach().cpu().double(), deformed.detach().cpu().double()
    size = float((points.amax(0) - points.amin(0)).norm())
    part = _without_crumbs(points, part.cpu())
    count = int(part.max()) + 1
    motions = torch.stack([fit_rigid(points[part == p].expand(len(deformed), -1, -1), deformed[:, part == p])
                           for p in range(count)], dim=1)  # fmt: skip
    rigid = [transform_points(motions[:, p], points[part == p]) - deformed[:, part == p] for p in range(count)]
    noise = max(_NUMBERS.floor * size, float(torch.cat(rigid, 1).square().sum(-1).mean().sqrt()))
    pairs = torch.combinations(torch.arange(count))
    joints = [_joint(points, part, motions, int(a), int(b), noise) for a, b in pairs]
    gaps = [_gap(points[part == a], points[part == b]) for a, b in pairs]
    lengths = torch.tensor([j.residual + _NUMBERS.contact_weight * g for j, g in zip(joints, gaps, strict=True)])
    found = _tree(points, part, pairs, joints, lengths)
    return _fitted(points, deformed, *found, size)


def _without_crumbs(points: Tensor, part: Tensor) -> Tensor:
    """Return parts numbered from 0, those of few points with the nearest other part."""
    counts = torch.bincount(part)
    small = counts[part] < _NUMBERS.least_share * len(part)
    if bool(small.any()) and not bool(small.all()):
        nearest = NeighborTree(points[~small]).nearest(points[small])[0]
        part = part.clone()
        part[small] = part[~small][nearest]
    return part.unique(return_inverse=True)[1]


def _gap(first: Tensor, second: Tensor) -> float:
    return float(NeighborTree(first).nearest(second)[1].min())


def _joint(points: Tensor, part: Tensor, motions: Tensor, first: int, second: int, noise: float) -> _Candidate:
    """Return the simplest joint between two parts that explains their motions, by the test on residuals."""
    relative = invert_rigid(motions[:, first]) @ motions[:, second]
    moved = points[part == second]
    seen = transform_points(relative, moved)
    middle = 0.5 * (moved.mean(0) + points[part == first].mean(0))
    weld = _root_mean_square(seen - moved)
    turns = so3_log(relative[:, :3, :3])
    axis = _principal(turns)
    slide = _principal((seen - moved).mean(1))
    shifts = ((seen - moved).mean(1) @ slide).unsqueeze(-1) * slide
    slider = _root_mean_square(seen - moved - shifts.unsqueeze(1))
    angles = turns @ axis
    rotations = so3_exp(angles.unsqueeze(-1) * axis)
    # The point that stays, nearest to the middle of both parts: (R - I) c + t = 0 across the axis.
    matrix, right = relative[:, :3, :3] - torch.eye(3).double(), -relative[:, :3, 3]
    normal = (matrix.mT @ matrix).sum(0)
    regular = 1e-3 * normal.diagonal().sum().clamp_min(1e-9)
    gradient = ((right - matrix @ middle).unsqueeze(-2) @ matrix).sum(0)[0]
    point = middle + torch.linalg.solve(normal + regular * torch.outer(axis, axis) + 1e-12 * torch.eye(3), gradient)
    posed = (moved - point) @ rotations.mT + point
    hinge = _root_mean_square(seen - posed)
    if weld < _NUMBERS.weld * noise:
        return _Candidate("fixed", axis, middle, weld)
    if slider < _NUMBERS.simpler * hinge or float(angles.abs().max()) < _NUMBERS.least_turn:
        return _Candidate("prismatic", slide, middle, slider)
    return _Candidate("revolute", axis, point, hinge)


def _root_mean_square(offsets: Tensor) -> float:
    """Return the largest over the frames, as one frame without a joint's motion hides nothing of another."""
    return float(offsets.square().sum(-1).mean(-1).sqrt().max())


def _principal(vectors: Tensor) -> Tensor:
    """Return the unit direction (3,) of most of vectors (T, 3)."""
    return torch.linalg.eigh(vectors.mT @ vectors).eigenvectors[:, -1]


def _tree(
    points: Tensor, part: Tensor, pairs: Tensor, joints: list[_Candidate], lengths: Tensor
) -> tuple[KinematicTree, Tensor]:
    """Return the tree of the shortest joints, and the link (N,) of each point: parts that hold together are one."""
    count = int(part.max()) + 1
    if count == 1:
        return KinematicTree((Joint("link_0", -1, torch.eye(4, dtype=torch.float64)),)), part
    chosen = minimum_spanning_forest(pairs, lengths, count).chosen().tolist()
    sizes = torch.bincount(part, minlength=count)
    parents, order = rooted(pairs[chosen], sizes.argmax().reshape(1), count)
    edge_of = {tuple(sorted(pairs[k].tolist())): joints[k] for k in chosen}
    link: dict[int, int] = {}
    frames: list[Joint] = []
    origins: list[Tensor] = []
    for number in order.tolist():
        above = int(parents[number])
        joint = edge_of.get((min(number, above), max(number, above)))
        if joint is not None and joint.kind == "fixed":
            link[number] = link[above]
            continue
        link[number] = len(frames)
        origin = torch.zeros(3, dtype=torch.float64) if joint is None else joint.point
        parent = -1 if joint is None else link[above]
        offset = rigid_matrix(torch.eye(3, dtype=torch.float64), origin - (origins[parent] if parent >= 0 else 0))
        x, y, z = (0.0, 0.0, 1.0) if joint is None else joint.axis.tolist()
        kind = "fixed" if joint is None else joint.kind
        frames.append(Joint(f"joint_{len(frames)}" if frames else "base", parent, offset, kind=kind, axis=(x, y, z)))
        origins.append(origin)
    return KinematicTree(tuple(frames)), torch.tensor([link[int(p)] for p in range(count)])[part]


def _fitted(points: Tensor, deformed: Tensor, tree: KinematicTree, link: Tensor, size: float) -> RobotModel:
    """Return the robot with the base and joint values of all frames fitted to all points, and limits about them."""
    posed = PosedTree(tree, [joint.name for joint in tree.joints], None, True).double()
    local = points - posed.part_transforms(posed.rest)[link, :3, 3]

    def place(transforms: Tensor, index: Tensor) -> Tensor:
        chosen = transforms[:, link[index]]
        return (chosen[..., :3, :3] @ local[index].unsqueeze(-1)).squeeze(-1) + chosen[..., :3, 3]

    everything = torch.arange(len(points))
    few = everything[:: -(-len(points) // _NUMBERS.num_fitted)]

    def linearize(state: Tensor) -> Linearization:
        transforms, twists = posed.part_twists(state, chart="tangent")
        moved = place(transforms, few)
        residual, chosen = moved - deformed[:, few], twists[:, link[few]]
        jacobian = chosen[..., :3] + torch.linalg.cross(chosen[..., 3:], moved.unsqueeze(-2).expand_as(chosen[..., 3:]))
        hessian = torch.einsum("tnki,tnli->tkl", jacobian, jacobian)
        ridge = _NUMBERS.prior * hessian.diagonal(dim1=-2, dim2=-1).amax(-1)
        hessian = hessian + torch.diag_embed(ridge.unsqueeze(-1).expand(-1, hessian.shape[-1]))
        gradient = torch.einsum("tnki,tni->tk", jacobian, residual)
        return Linearization(0.5 * residual.square().sum((-2, -1)), gradient, hessian)

    start = posed.rest.expand(len(deformed), -1)
    state = levenberg_marquardt(linearize, start, retract=posed.retract, max_steps=_NUMBERS.steps).state
    moved = place(posed.part_transforms(state), everything)
    values, base = state[:, BASE_DOFS:], rigid_matrix(so3_exp(state[:, 3:BASE_DOFS]), state[:, :3])
    return RobotModel(
        tree=_limited(tree, values, size),
        part=link,
        joint_values=values,
        base=base,
        residuals=(moved - deformed).square().sum(-1).mean(-1).sqrt(),
    )


def _limited(tree: KinematicTree, values: Tensor, size: float) -> KinematicTree:
    """Return the tree with limits about the joint values (T, J) of all frames and zero."""
    joints, number = [], 0
    for joint in tree.joints:
        if joint.kind != "fixed":
            margin = _NUMBERS.margin * (size if joint.kind == "prismatic" else 1.0)
            column = values[:, number]
            lower, upper = min(0.0, float(column.min())) - margin, max(0.0, float(column.max())) + margin
            joint = replace(joint, lower=lower, upper=upper)
            number += 1
        joints.append(joint)
    return KinematicTree(tuple(joints))


def write_robot(path: str | os.PathLike[str], found: RobotModel, points: Tensor, faces: Tensor | None) -> None:
    """Write a robot as URDF with the faces of each link, whose frame begins at its joint.

    Raises:
        InputError: if there are no faces.
    """
    if faces is None:
        raise InputError("the scans have no triangles, which the meshes of links need; register scans with faces")
    posed = PosedTree(found.tree, [joint.name for joint in found.tree.joints], None, True).double()
    origins = posed.part_transforms(posed.rest)[:, :3, 3]
    owner = found.part[faces.cpu()].mode(-1).values
    meshes = [
        TriangleMesh(points.detach().cpu().double() - origins[link], faces.cpu()[owner == link])
        for link in range(len(found.tree))
    ]
    names = [f"link_{number}" for number in range(len(found.tree))]
    save_urdf(path, Path(path).stem, found.tree, names, meshes)
