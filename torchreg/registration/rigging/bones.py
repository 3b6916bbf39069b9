"""The tree of bones that a registered sequence shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg.geometry.graphs import Graph, component_links, connected_components
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.neighbors import nearest_neighbor
from torchreg.geometry.range_scan import RangeScan
from torchreg.geometry.rigid import transform_points
from torchreg.geometry.upright import Y_UP, Direction
from torchreg.registration.bones.alternation import Samples
from torchreg.registration.bones.correspondences import Correspondences
from torchreg.registration.bones.grid_lbs import GridLBS
from torchreg.registration.bones.joint_moments import gaps_at, motion_differences
from torchreg.registration.bones.joints import Joints, bone_tree
from torchreg.registration.bones.sparse_grid import SparseGrid
from torchreg.registration.bones.weights import refine_weights
from torchreg.registration.rigging.config import RigConfig
from torchreg.registration.rigging.parts import moving_parts
from torchreg.shapes.articulated import ArticulatedShape


@dataclass(frozen=True)
class _Format:
    """What files keep."""

    most_weights: int = 4  # of a vertex


_FORMAT = _Format()


@dataclass(frozen=True)
class _Joining:
    """What makes a connected part of a bone's surface a bone, and two of them neighbors."""

    share: float = 0.005  # of all points
    relative: float = 0.2  # of the points of the largest part of the bone
    reach: float = 0.1  # diagonals from its own points, to which a bone is blended
    rounds: int = 4  # of a joint and of how well the motions of its bones locate it


_JOINING = _Joining()


@dataclass(frozen=True)
class BoneTree:
    """A tree of B bones of a surface's vertices (V, 3): weights (V, B), motions (T, B, 4, 4) from rest, joints (B, 3).

    Parents stand before their children, the root first.
    """

    vertices: Tensor
    weights: Tensor
    motions: Tensor
    joints: Tensor
    parents: tuple[int, ...]

    @classmethod
    def of_alignment(
        cls, moved: Tensor, confidence: Tensor, mesh: TriangleMesh, scan: RangeScan, most: int, config: RigConfig
    ) -> BoneTree:
        """Return the bones of the template, a mesh and its coarse scan aligned to (T, N, 3), as one tree.

        Limbs that move alike, as the two legs of a jump, have a bone and a joint each: connected parts do.
        """
        edges, confidence = _linked(scan), confidence.double().clamp(min=Samples.LEAST_CONFIDENCE)
        cost = config.register.label_cost * float(scan.diagonal)
        owner, motions = moving_parts(scan.points, edges, moved, confidence, most=most, cost=cost)
        grid = SparseGrid.from_points(scan.points, config.cells)
        cells = owner[nearest_neighbor(grid.cell_centers(), scan.points)[0]]
        labeled = GridLBS.from_labels(grid, cells, motions.shape[1], motions)
        correspondences = Correspondences(moved, None, confidence)
        model = GridLBS(grid, refine_weights(labeled, scan.points, correspondences, config.register.refine).weights)
        parts = _Parts.of_owners(owner, edges, scan)
        part, motions = parts.part, motions[:, parts.bone]
        sizes = torch.bincount(part).double()
        middles = scan.points.new_zeros(len(sizes), 3).index_add(0, part, scan.points) / sizes[:, None]
        blended = parts.weights(scan.points, model.vertex_weights(scan.points).detach())
        tree = bone_tree(_joints(scan.points, blended, edges, part, motions), middles, sizes)
        bones = cls(
            vertices=mesh.vertices,
            weights=parts.weights(mesh.vertices, model.vertex_weights(mesh.vertices).detach()),
            motions=motions,
            joints=tree.origins,
            parents=tree.parents,
        )
        return bones._chosen(_parents_first(tree.parents))

    def __len__(self) -> int:
        return len(self.parents)

    @property
    def names(self) -> list[str]:
        """Names for files."""
        return [f"bone_{number}" for number in range(len(self))]

    def without(self, bone: int) -> BoneTree:
        """Return the tree in which a bone, not the root, moves with its parent."""
        target = self.parents[bone]
        parents = tuple(target if parent == bone else parent for parent in self.parents)
        weights = self.weights.clone()
        weights[:, target] += weights[:, bone]
        order = [other for other in _parents_first(parents) if other != bone]
        return replace(self, weights=weights, parents=parents)._chosen(order)

    def _chosen(self, order: Sequence[int]) -> BoneTree:
        place = {bone: number for number, bone in enumerate(order)} | {-1: -1}
        return replace(
            self,
            weights=self.weights[:, order],
            motions=self.motions[:, order],
            joints=self.joints[order],
            parents=tuple(place[self.parents[bone]] for bone in order),
        )

    def pruned(self, alike: float, most: int) -> BoneTree:
        """Return the tree without bones that never move their vertices farther than that from where parents would.

        The mean over the vertices counts. Of more bones than ``most`` those that move least are left out, too.
        """
        bones = self
        while len(bones) > 1:
            owner = bones.weights.argmax(1)
            apart = torch.zeros(len(bones) - 1).to(bones.weights)
            for bone, parent in list(enumerate(bones.parents))[1:]:
                own = bones.vertices[owner == bone]
                one, other = (transform_points(bones.motions[:, each], own) for each in (bone, parent))
                apart[bone - 1] = (one - other).norm(dim=-1).mean(-1).amax() if len(own) else 0.0
            if float(apart.min()) > alike and len(bones) <= most:
                break
            bones = bones.without(int(apart.argmin()) + 1)
        return bones

    def shape(self, faces: Tensor, up: Direction | None = None) -> ArticulatedShape:
        """Return the rig of ball joints, in double precision, with as many weights as files keep."""
        values, index = self.weights.topk(min(_FORMAT.most_weights, len(self)), dim=1)
        kept = torch.zeros_like(self.weights).scatter(1, index, values)
        return ArticulatedShape.from_skinned_mesh(
            self.vertices, faces, kept / kept.sum(1, keepdim=True), self.joints, self.parents,
            joint_names=self.names, up=Y_UP if up is None else up, dtype=torch.float64,
        )  # fmt: skip


def _linked(scan: RangeScan) -> Tensor:
    """Return the edges (E, 2) of a scan's triangles, and short links between loose pieces."""
    faces = torch.zeros(0, 3, dtype=torch.long) if scan.faces is None else scan.faces
    edges = torch.cat((faces[:, :2], faces[:, 1:], faces[:, ::2])).sort(dim=1).values.unique(dim=0)
    return torch.cat((edges, component_links(scan.points, connected_components(edges, len(scan)))[0]))


@dataclass(frozen=True)
class _Parts:
    """Connected parts of bones: the part (N,) of each point of a coarse scan, and the bone (P,) of each part."""

    scan: RangeScan
    part: Tensor
    bone: Tensor

    @classmethod
    def of_owners(cls, owner: Tensor, edges: Tensor, scan: RangeScan) -> _Parts:
        """Return the parts of bones that own points (N,); points of small parts belong to the part around them."""
        region = connected_components(edges[owner[edges[:, 0]] == owner[edges[:, 1]]], len(owner))
        size = torch.bincount(region)[region]
        largest = torch.zeros(int(owner.max()) + 1).scatter_reduce(0, owner, size.float(), "amax")
        least = (_JOINING.relative * largest).clamp_min(_JOINING.share * len(owner)).minimum(largest)
        kept = (size >= least[owner]).nonzero()[:, 0]
        numbers, part = region[kept].unique(return_inverse=True)
        nearest = Graph.from_edges(edges, torch.ones(len(edges)), len(owner)).nearest(kept)[1]
        return cls(scan, part[nearest], torch.zeros_like(numbers).index_copy(0, part, owner[kept]))

    def weights(self, points: Tensor, weights: Tensor) -> Tensor:
        """Return weights (V, P) of points (V, 3) for those of bones (V, B): what a bone weighs is of its nearest part.

        Where a bone has no part near, the part around the point moves what it moved.
        """
        around = self.part[nearest_neighbor(points, self.scan.points)[0]]
        found = weights.new_zeros(len(points), len(self.bone))
        for bone in self.bone.unique().tolist():
            own = (self.bone[self.part] == bone).nonzero()[:, 0]
            index, distance = nearest_neighbor(points, self.scan.points[own])
            near = distance < _JOINING.reach * self.scan.diagonal
            found.scatter_add_(1, self.part[own[index]][:, None], (weights[:, bone] * near)[:, None])
        rest = weights.sum(1) - found.sum(1)
        return found.scatter_add(1, around[:, None], rest.clamp_min(0)[:, None])


def _joints(points: Tensor, weights: Tensor, edges: Tensor, part: Tensor, motions: Tensor) -> Joints:
    """Return the joints of parts with a common border, by edges (E, 2); mass tells how likely two are joined.

    Joined parts have a long border, whose middle both move alike: limbs that touch have a short one, which tears.
    ``weights`` (N, P) say where parts blend.
    """
    edges = edges[part[edges[:, 0]] != part[edges[:, 1]]]
    pairs, pair = part[edges].sort(dim=1).values.unique(dim=0, return_inverse=True)
    border, ends = torch.bincount(pair, minlength=len(pairs)).to(points), points[edges]
    middles, shared = ends.mean(1), weights[:, pairs[:, 0]] * weights[:, pairs[:, 1]]
    center = (shared.mT @ points).index_add(0, pair, middles) / (shared.sum(0) + border)[:, None]
    length = torch.full_like(border, torch.inf).scatter_reduce(0, pair, (ends[:, 0] - ends[:, 1]).norm(dim=-1), "amin")
    spread = (middles - center[pair]).square().sum(-1)
    spread = torch.zeros_like(border).index_add(0, pair, spread) / border
    centers, gaps = _located(center, spread, motion_differences(motions, pairs))
    off = gaps.mean(0) + (centers - center).norm(dim=-1) + length
    return Joints(pairs, centers, border / off, gaps)


def _located(center: Tensor, spread: Tensor, differences: Tensor) -> tuple[Tensor, Tensor]:
    """Return joints (P, 3) and their gaps (T, P) in all frames, by differences (T, P, 3, 4) of their bones' motions.

    ``argmin_c mean |(R_i - R_j) c + t_i - t_j|^2 / g^2 + |c - m|^2 / s^2``: m is the center (P, 3) of the border, s^2
    the squared spread (P,) of its points, and g^2 the mean squared gap that is left, estimated in turn. Errors of
    motions last, so that frames do not count as independent.
    """
    turn, offsets = differences[..., :3], gaps_at(differences, center)
    normal, right = (turn.mT @ turn).mean(0), (turn.mT @ offsets.unsqueeze(-1)).squeeze(-1).mean(0)
    identity, ratio = torch.eye(3).to(center), torch.ones_like(spread)
    least = torch.finfo(center.dtype).eps ** 0.5
    for _ in range(_JOINING.rounds):
        centers = center - torch.linalg.solve(normal + ratio[:, None, None] * identity, right)
        gaps = torch.linalg.vector_norm(gaps_at(differences, centers), dim=-1)
        ratio = (gaps.square().mean(0) / spread.clamp_min(torch.finfo(center.dtype).tiny)).clamp_min(least)
    return centers, gaps


def _parents_first(parents: Sequence[int]) -> list[int]:
    order = [bone for bone, parent in enumerate(parents) if parent < 0]
    for bone in order:
        order += [child for child, parent in enumerate(parents) if parent == bone]
    return order
