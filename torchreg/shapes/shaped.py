"""A rig whose last degrees of freedom are shape coefficients: its frames, skins and surface in any state.

A state is a pose, then coefficients. Coefficients move vertices and frames at rest; a pose turns and moves them:
``x(pose, c) = sum_p w_p (S_p (x(c) - j_p(c)) + t_p(pose, c))``, where S_p turns part p from rest, and j_p and t_p are
the positions of its frame at rest and in the pose.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import torch
from torch import Tensor, nn

from torchreg.geometry.rotation import so3_exp
from torchreg.shapes.articulation import Articulation
from torchreg.shapes.pose_algebra import difference, retract
from torchreg.shapes.shape_space import ShapeSpace


class LazyJacobian(Protocol):
    """Takes an index (M,) of points, and directions (B, M, 3), to derivatives (B, M, D + K) along these or normals."""

    def __call__(self, index: Tensor, direction: Tensor | None = None) -> Tensor:
        """Return the derivatives."""


class _Posed(NamedTuple):
    """A rig in states: ``above`` (..., F, 3, 3) turns what carries each frame, ``turns`` S_p and ``t_p - S_p j_p``."""

    pose: Tensor
    coefficients: Tensor
    vertices: Tensor
    frames: Tensor
    above: Tensor
    turns: Tensor
    offsets: Tensor


class ShapedTree(nn.Module):
    """The degrees of freedom of a rig, followed by its coefficients."""

    parents: Tensor
    ancestors: Tensor
    rest_rotations: Tensor
    rest_positions: Tensor
    part_moves: Tensor
    lower: Tensor
    upper: Tensor
    rest: Tensor

    def __init__(self, rig: Articulation, space: ShapeSpace) -> None:
        super().__init__()
        self.rig, self.space = rig, space
        tree = rig.kinematics.tree
        frames = rig.frame_transforms(torch.zeros_like(rig.rest)).detach()
        buffers = {
            "parents": torch.tensor([joint.parent for joint in tree.joints], device=frames.device),
            "ancestors": rig.kinematics.ancestors().to(frames),
            "rest_rotations": frames[:, :3, :3],
            "rest_positions": frames[:, :3, 3],
            "part_moves": rig.part_moves(),
            "lower": torch.cat([rig.lower, space.lower]),
            "upper": torch.cat([rig.upper, space.upper]),
            "rest": torch.cat([rig.rest, space.mean]),
        }
        for name, value in buffers.items():
            self.register_buffer(name, value, persistent=False)

    @property
    def num_dofs(self) -> int:
        """Number of degrees of freedom, coefficients included."""
        return int(self.rig.num_dofs) + len(self.space)

    def split(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return the pose (..., num_dofs of the rig) and the coefficients (..., K) of a state."""
        pose, coefficients = state.tensor_split([self.rig.num_dofs], dim=-1)
        return pose, coefficients

    def retract(self, state: Tensor, step: Tensor) -> Tensor:
        """Return states moved by tangent steps, see `ArticulatedShape.retract`."""
        return retract(state, step)

    def difference(self, start: Tensor, end: Tensor) -> Tensor:
        """Return the tangent steps between states, see `ArticulatedShape.difference`."""
        return difference(start, end)

    def posed(self, state: Tensor, space: ShapeSpace) -> _Posed:
        """Return the rig in states (..., D + K), with the vertices of a restricted space."""
        pose, coefficients = self.split(state)
        vertices, positions = space.rest(coefficients)
        frames = self.rig.frame_transforms(pose)
        turned = frames[..., :3, :3] @ self.rest_rotations.mT
        base = so3_exp(pose[..., 3:6]).unsqueeze(-3)
        above = torch.where(self._is_root(), base, turned.index_select(-3, self.parents.clamp_min(0)))
        moved = self.shifts(above, (positions - self.rest_positions).unsqueeze(-1)).squeeze(-1)
        frames = frames + nn.functional.pad(moved.unsqueeze(-1), (3, 0, 0, 1))
        index = self.rig.part_index
        turns, held = turned.index_select(-3, index), positions.index_select(-2, index)
        offsets = frames.index_select(-3, index)[..., :3, 3] - (turns @ held.unsqueeze(-1)).squeeze(-1)
        return _Posed(
            pose=pose, coefficients=coefficients, vertices=vertices, frames=frames, above=above, turns=turns,
            offsets=offsets,
        )  # fmt: skip

    def shifts(self, above: Tensor, displacements: Tensor) -> Tensor:
        """Return how far frames move (..., F, 3, K) in a pose by displacements (..., F, 3, K) of them all at rest."""
        carrier = torch.where(self._is_root(), 0.0, displacements.index_select(-3, self.parents.clamp_min(0)))
        steps = above @ (displacements - carrier)
        return (self.ancestors @ steps.flatten(-2)).unflatten(-1, steps.shape[-2:])

    def _is_root(self) -> Tensor:
        return (self.parents < 0)[:, None, None]


def blended(posed: _Posed, weights: Tensor, rest: Tensor) -> tuple[Tensor, Tensor]:
    """Return rest points (..., N, 3) with weights (N, P) in a state, and the blended turns (..., N, 3, 3)."""
    rows = torch.cat([posed.turns, posed.offsets.unsqueeze(-1)], dim=-1)
    blend = (weights @ rows.flatten(-2)).unflatten(-1, (3, 4))
    return (blend[..., :3] @ rest.unsqueeze(-1)).squeeze(-1) + blend[..., 3], blend[..., :3]


class ShapedSkin(nn.Module):
    """Points of a rig's surface that move with its pose and its coefficients: at shares (N, C) of its corners.

    Like a `LinearBlendSkin` it is linear in rows; these are the points themselves, followed by their normals.
    """

    corners: Tensor
    shares: Tensor
    weights: Tensor
    subtree: Tensor
    _used: Tensor

    def __init__(self, tree: ShapedTree, corners: Tensor, shares: Tensor, weights: Tensor) -> None:
        super().__init__()
        self.shape = tree
        used, inverse = corners.unique(return_inverse=True)
        self.space = tree.space.restricted(used)
        weights = weights / weights.sum(-1, keepdim=True)
        subtree = weights @ tree.part_moves
        buffers = {"corners": inverse, "shares": shares, "weights": weights, "subtree": subtree, "_used": used}
        for name, value in buffers.items():
            self.register_buffer(name, value, persistent=False)
        with torch.no_grad():
            self.points = self._between(self.space.rest(tree.space.mean)[0])

    def __len__(self) -> int:
        return len(self.weights)

    @property
    def basis(self) -> None:
        """None: rows are the points themselves."""
        return None

    def vertex_index(self, index: Tensor) -> Tensor:
        """Return the vertices (M, C) of the rig between which some points (M,) lie."""
        return self._used[self.corners[index]]

    def subset(self, index: Tensor) -> ShapedSkin:
        """Return the skin of some of the points (M,)."""
        return ShapedSkin(self.shape, self.vertex_index(index), self.shares[index], self.weights[index])

    def forward(self, state: Tensor) -> Tensor:
        """Return the points (..., N, 3) in states (..., D + K), metres."""
        return self._placed(self.shape.posed(state, self.space))[0]

    def place(self, rows: Tensor) -> Tensor:
        """Return the points (..., N, 3) of rows, see `row_jacobian`."""
        return rows[..., : len(self), :]

    def turn_normals(self, rows: Tensor) -> Tensor:
        """Return the unit normals (..., N, 3) of rows, see `row_jacobian`."""
        return rows[..., len(self) :, :]

    def oriented(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return the points and their unit normals in states, both (..., N, 3)."""
        posed = self.shape.posed(state, self.space)
        points, blend = self._placed(posed)
        return points, self._normals(posed, blend)

    def row_jacobian(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return the rows, points then normals (B, 2 N, 3), and the points' derivatives (B, N, 3, D + K)."""
        posed = self.shape.posed(state, self.space)
        points, blend = self._placed(posed)
        every = torch.arange(len(self), device=points.device)
        linear, angular, by_part = self._motions(posed, every)
        moments = torch.einsum("...pcn,pk->...nkc", by_part, self.shape.part_moves)
        turned = torch.linalg.cross(angular.unsqueeze(-3).expand_as(moments), moments)
        by_pose = self._coupled((linear.unsqueeze(-3) * self.subtree.unsqueeze(-1) + turned).mT)
        rows = torch.cat([points, self._normals(posed, blend)], dim=-2)
        return rows, torch.cat([by_pose, self._by_coefficients(posed, blend, every)], dim=-1)

    def normal_jacobian(self, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return points and normals (B, N, 3), and the derivatives (B, N, D + K) of the points along their normals."""
        points, normals, jacobian_of = self.lazy_normal_jacobian(state)
        return points, normals, jacobian_of(torch.arange(len(self), device=points.device))

    def lazy_normal_jacobian(self, state: Tensor) -> tuple[Tensor, Tensor, LazyJacobian]:
        """Return points and normals (B, N, 3), and what takes an index (M,) to the derivatives (B, M, D + K).

        They are along the normals, or along other directions (B, M, 3) that are given.
        """
        posed = self.shape.posed(state, self.space)
        points, blend = self._placed(posed)
        normals = self._normals(posed, blend)

        def along(index: Tensor, direction: Tensor | None = None) -> Tensor:
            normal = normals[..., index, :] if direction is None else direction
            linear, angular, by_part = self._motions(posed, index)
            # n . (angular x m) = angular . (m x n), summed over the parts that each degree of freedom moves.
            levers = torch.linalg.cross(by_part, normal.mT.unsqueeze(-3).expand_as(by_part), dim=-2)
            turning = (self.shape.part_moves.unsqueeze(-2) * angular.mT.unsqueeze(-3)).flatten(-3, -2)
            by_pose = (normal @ linear.mT) * self.subtree[index] + levers.flatten(-3, -2).mT @ turning
            by_coefficients = (normal.unsqueeze(-2) @ self._by_coefficients(posed, blend, index)).squeeze(-2)
            return torch.cat([self._coupled(by_pose), by_coefficients], dim=-1)

        return points, normals, along

    def _between(self, vertices: Tensor, index: Tensor | None = None) -> Tensor:
        """Return what vertices (..., U, 3) give at the points, or some of them, (..., N, 3)."""
        corners, shares = (self.corners, self.shares) if index is None else (self.corners[index], self.shares[index])
        return (vertices[..., corners, :] * shares.unsqueeze(-1)).sum(-2)

    def _placed(self, posed: _Posed) -> tuple[Tensor, Tensor]:
        """Return the points (..., N, 3) and the blended turns (..., N, 3, 3)."""
        return blended(posed, self.weights, self._between(posed.vertices))

    def _normals(self, posed: _Posed, blend: Tensor) -> Tensor:
        corners = posed.vertices[..., self.corners, :]
        first = corners[..., :1, :]
        across, along = (corners[..., 1:, :] - first).unbind(-2)
        rest = torch.linalg.cross(across, along).unsqueeze(-1)
        return nn.functional.normalize((blend @ rest).squeeze(-1), dim=-1)

    def _motions(self, posed: _Posed, index: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return twists (..., 6 + J, 3) of the pose, and some points by part (..., P, 3, M), times their weights."""
        linear, angular = self.shape.rig.frame_twists(posed.pose, posed.frames, "tangent")
        rest = self._between(posed.vertices, index).mT
        by_part = (posed.turns.flatten(-3, -2) @ rest).unflatten(-2, (-1, 3)) + posed.offsets.unsqueeze(-1)
        return linear, angular, by_part * self.weights[index].mT.unsqueeze(-2)

    def _coupled(self, by_joint: Tensor) -> Tensor:
        rig = self.shape.rig
        return by_joint @ rig.couplings() if rig.kinematics.has_mimics else by_joint

    def _by_coefficients(self, posed: _Posed, blend: Tensor, index: Tensor) -> Tensor:
        """Return the derivatives (B, M, 3, K) of some points by the coefficients."""
        by_vertex, by_frame = self.space.rest_jacobian(posed.coefficients)
        rest = (by_vertex[..., self.corners[index], :, :] * self.shares[index][..., None, None]).sum(-3)
        carriers = self.shape.rig.part_index
        shifts = self.shape.shifts(posed.above, by_frame).index_select(-3, carriers)
        offsets = shifts - posed.turns @ by_frame.index_select(-3, carriers)
        moved = (self.weights[index] @ offsets.flatten(-2)).unflatten(-1, offsets.shape[-2:])
        return blend[..., index, :, :] @ rest + moved
