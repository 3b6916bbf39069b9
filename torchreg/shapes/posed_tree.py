"""Parts on a kinematic tree in any pose: transforms, keypoints, twists, and steps between poses."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from torchreg._checks import as_float_tensor, check_choice, check_shape
from torchreg.errors import InputError, ModelError
from torchreg.geometry.kinematic_tree import KinematicTree
from torchreg.geometry.rigid import rigid_matrix
from torchreg.geometry.rotation import left_jacobian, so3_exp, wrap_rotation_vector
from torchreg.shapes.kinematics import ForwardKinematics, build_chain, neighbor_matrix, offset_owners, part_parents
from torchreg.shapes.pose_algebra import BASE_DOF_NAMES, BASE_DOFS, difference, retract

if TYPE_CHECKING:
    from torchreg.shapes.kinematics import Chain


class PosedTree(nn.Module):
    """Parts on a kinematic tree with a moving base; `ArticulatedShape` explains conventions and arguments."""

    adjacency: Tensor
    part_index: Tensor
    rest: Tensor
    lower: Tensor
    upper: Tensor
    is_sliding: Tensor
    _owners: Tensor
    _part_moves: Tensor
    _row_moves: Tensor
    _couplings: Tensor

    def __init__(
        self, tree: KinematicTree, part_frames: Sequence[str], part_names: Sequence[str] | None, free_base: bool
    ) -> None:
        super().__init__()
        if len(set(part_frames)) != len(part_frames):
            raise ModelError("two parts share a frame; give each part a frame of its own (a fixed joint will do)")
        names = tuple(part_frames if part_names is None else part_names)
        if len(names) != len(part_frames) or len(set(names)) != len(names):
            raise ModelError(f"{len(part_frames)} parts need {len(part_frames)} different names, got {len(set(names))}")
        self.kinematics = ForwardKinematics(tree)
        self.part_names = names
        frames = [tree.index(name) for name in part_frames]
        self.part_parents = tuple(part_parents(tree, frames))
        moves = nn.functional.pad(self.kinematics.moves[frames], (BASE_DOFS, 0), value=1.0)
        slides = self.kinematics.couplings.abs().mT @ (1 - self.kinematics.is_revolute) > 0
        limit = torch.full((BASE_DOFS,), math.inf if free_base else 0.0, dtype=torch.float64)
        lower, upper = torch.cat([-limit, self.kinematics.lower]), torch.cat([limit, self.kinematics.upper])
        buffers = {
            "part_index": torch.tensor(frames),
            "adjacency": neighbor_matrix(self.part_parents),
            "_owners": torch.tensor(offset_owners(tree, frames)),
            "_part_moves": moves,
            "_row_moves": moves.repeat_interleave(4, 0).unsqueeze(-2),
            "_couplings": torch.block_diag(torch.eye(BASE_DOFS, dtype=torch.float64), self.kinematics.couplings),
            "is_sliding": torch.cat([torch.arange(BASE_DOFS) < 3, slides]),
            "lower": lower,
            "upper": upper,
            "rest": torch.zeros(self.num_dofs, dtype=torch.float64).clamp(lower, upper),
        }
        for name, value in buffers.items():
            self.register_buffer(name, value, persistent=False)
        self.log_length_scales = frozen(torch.zeros(len(frames), dtype=torch.float64))

    @property
    def num_dofs(self) -> int:
        """Number of degrees of freedom: 6 of the base, then the joints."""
        return BASE_DOFS + self.kinematics.num_dofs

    @property
    def num_parts(self) -> int:
        """Number of parts."""
        return len(self.part_names)

    @property
    def dof_names(self) -> tuple[str, ...]:
        """Names of the degrees of freedom, in the order of a pose."""
        return BASE_DOF_NAMES + self.kinematics.dof_names

    @property
    def chain(self) -> Chain:
        """A new `pytorch_kinematics.Chain` of the tree with its present bone lengths, in the module's dtype and device.

        ``chain.forward_kinematics(values)[part]`` is ``T_root_part``, in the coordinates that the base moves. Frames
        that carry a part are called like the part, others as in the tree (with "_" where a part has that name). Joints
        are called like the degrees of freedom, but come depth first: pass ``dict(zip(shape.dof_names[6:], pose[6:]))``.
        A joint that mimics another moves by itself there and needs a value of its own.
        """
        tree = self.kinematics.tree
        names = dict(zip(self.part_index.tolist(), self.part_names, strict=True))
        for index, joint in enumerate(tree.joints):
            names.setdefault(index, f"{joint.name}_" if joint.name in self.part_names else joint.name)
        offsets = torch.stack([joint.offset for joint in tree.joints]).to(self.rest)
        offsets[:, :3, 3] *= self._offset_scales().detach().unsqueeze(-1)
        return build_chain(tree, [names[index] for index in range(len(tree))], offsets)

    def __repr__(self) -> str:
        """Return three lines: what it is, its degrees of freedom, its size at rest."""
        joints = self.num_dofs - BASE_DOFS
        ends = self.keypoints(self.rest_pose()).detach()
        size = float((ends.amax(0) - ends.amin(0)).norm())
        first = ", ".join(self.dof_names[BASE_DOFS : BASE_DOFS + 3])
        kind = f"{str(self.rest.dtype).removeprefix('torch.')} on {self.rest.device}"
        return (
            f"{type(self).__name__}: {self.num_parts} parts, {self.num_dofs} degrees of freedom\n"
            f"  {BASE_DOFS} of the base, {joints} of joints{f': {first}, ...' if first else ''}\n"
            f"  {size:.3g} m across at rest, {kind}"
        )

    def rest_pose(self) -> Tensor:
        """Return the pose (num_dofs,) with every joint at zero, or at the limit nearest to zero."""
        return self.rest.clone()

    def check_pose(self, pose: Tensor, name: str = "pose") -> Tensor:
        """Return ``pose`` as a tensor of this module's dtype and device; raise InputError if its size is wrong."""
        pose = as_float_tensor(pose, name, like=self.rest)
        check_shape(pose, name, (self.num_dofs,), batch=True)
        return pose

    def pose_to_dict(self, pose: Tensor) -> dict[str, Any]:
        """Return a pose (num_dofs,) as numbers by name of degree of freedom, metres and radians.

        Of poses (..., num_dofs) a dictionary of tensors (...).
        """
        pose = as_float_tensor(pose, "pose")  # in its own precision: far from the origin that matters
        check_shape(pose, "pose", (self.num_dofs,), batch=True)
        columns = pose.tolist() if pose.ndim == 1 else pose.unbind(-1)
        return dict(zip(self.dof_names, columns, strict=True))

    def pose_from_dict(self, values: Mapping[str, Tensor | float]) -> Tensor:
        """Return the pose (..., num_dofs) of values by name of degree of freedom; what is not named stays at rest.

        Args:
            values: numbers or tensors (...) that broadcast, metres and radians.
        """
        for name in values:
            if name not in self.dof_names:
                near = difflib.get_close_matches(str(name), self.dof_names, 1)
                hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(self.dof_names)}"
                raise InputError(f"the shape has no degree of freedom {name!r}; {hint}")
        given = {name: as_float_tensor(value, name, like=self.rest) for name, value in values.items()}
        rest = self.rest_pose().unbind()
        columns = [given.get(name, rest[index]) for index, name in enumerate(self.dof_names)]
        return torch.stack(torch.broadcast_tensors(*columns), dim=-1)

    def clamp(self, pose: Tensor) -> Tensor:
        """Return the pose with joints moved to their nearest limit and the base rotation wrapped to at most pi."""
        pose = torch.cat([pose[..., :3], wrap_rotation_vector(pose[..., 3:6]), pose[..., 6:]], dim=-1)
        return torch.minimum(torch.maximum(pose, self.lower), self.upper)

    def retract(self, pose: Tensor, step: Tensor) -> Tensor:
        """Return the pose moved by a tangent step; the base rotation is updated by composition, ``exp(step) exp(w)``.

        Args:
            pose: (..., num_dofs).
            step: (..., num_dofs), in the coordinates of `part_twists` with ``chart="tangent"``.

        Returns:
            (..., num_dofs).
        """
        return retract(pose, step)

    def difference(self, start: Tensor, end: Tensor) -> Tensor:
        """Return the tangent step that `retract` takes from one pose to another.

        Args:
            start: (..., num_dofs).
            end: (..., num_dofs), with batch dimensions that broadcast with the start's.

        Returns:
            (..., num_dofs); the base's rotation by an angle of at most pi.
        """
        return difference(start, end)

    def frame_transforms(self, pose: Tensor) -> Tensor:
        """Return ``T_world_frame`` (..., F, 4, 4) of every frame of the tree in poses (..., num_dofs)."""
        check_shape(pose, "pose", (self.num_dofs,), batch=True)
        base = rigid_matrix(so3_exp(pose[..., 3:6]), pose[..., :3])
        return base.unsqueeze(-3) @ self.kinematics(pose[..., 6:], self._offset_scales())

    def part_transforms(self, pose: Tensor) -> Tensor:
        """Return ``T_world_part`` of every part, ``p_world = T_world_part @ p_part``.

        Args:
            pose: (..., num_dofs).

        Returns:
            (..., P, 4, 4).
        """
        return self.frame_transforms(pose).index_select(-3, self.part_index)

    def keypoints(self, pose: Tensor) -> Tensor:
        """Return the keypoints of the shape: the origins of the parts.

        Args:
            pose: (..., num_dofs).

        Returns:
            (..., P, 3), metres.
        """
        return self.placed_keypoints(self.part_transforms(pose))

    def placed_keypoints(self, transforms: Tensor) -> Tensor:
        """Return the keypoints (..., K, 3) for part transforms (..., P, 4, 4) ``T_world_part``, as `keypoints`."""
        return transforms[..., :3, 3]

    def part_twists(self, pose: Tensor, *, chart: str = "pose") -> tuple[Tensor, Tensor]:
        """Return part transforms (..., P, 4, 4) and the twists (..., P, num_dofs, 6) by each degree of freedom.

        A point x of part p moves by ``twist[p, k, :3] + twist[p, k, 3:] x x`` per unit of degree of freedom k: of the
        pose vector, or with the chart "tangent" of steps taken with `retract`.
        """
        transforms, linear, angular = self._twists(pose, chart)
        twists = torch.cat([linear, angular], dim=-1).unsqueeze(-3) * self._part_moves.unsqueeze(-1)
        return transforms, self._couplings.mT @ twists if self.kinematics.has_mimics else twists

    def _twists(self, pose: Tensor, chart: str) -> tuple[Tensor, Tensor, Tensor]:
        """Return part transforms and the twists of base and moving joints: linear and angular (..., 6 + J, 3)."""
        frames = self.frame_transforms(pose)
        return frames.index_select(-3, self.part_index), *self.frame_twists(pose, frames, chart)

    def frame_twists(self, pose: Tensor, frames: Tensor, chart: str) -> tuple[Tensor, Tensor]:
        """Return the twists of base and moving joints for given frames (..., F, 4, 4): both (..., 6 + J, 3)."""
        joints = self.kinematics.joint_twists(frames)[0]
        linear, angular = _base_twists(pose, chart)
        linear = torch.cat([linear, joints[..., :3]], dim=-2)
        return linear, torch.cat([angular, joints[..., 3:]], dim=-2)

    def transform_jacobian(self, pose: Tensor, *, chart: str = "pose") -> tuple[Tensor, Tensor]:
        """Return rows (..., 4 P, 3), for each part the transposed ``[R | t]``, and their derivatives (..., num_dofs).

        Skins are linear in the rows; ``chart`` as in `part_twists`.
        """
        transforms, linear, angular = self._twists(pose, chart)
        rows = transforms.mT
        # An axis e turns by ``angular x e``; the row of a translation, whose fourth entry is one, also moves.
        identity = torch.eye(3, dtype=pose.dtype, device=pose.device).unsqueeze(-2)
        angular = angular.unsqueeze(-3)
        turns = torch.linalg.cross(angular, identity.expand(*angular.shape[:-3], 3, 1, 3))
        motions = torch.cat([turns, linear.unsqueeze(-3)], dim=-3).mT.flatten(-2)
        derivative = (rows.flatten(-3, -2) @ motions).unflatten(-1, (3, -1)) * self._row_moves
        derivative = derivative @ self._couplings if self.kinematics.has_mimics else derivative
        return rows[..., :3].flatten(-3, -2), derivative

    def part_moves(self) -> Tensor:
        """Return a matrix (P, 6 + J) of zeros and ones: which parts the base and every moving joint move."""
        return self._part_moves

    def offset_owners(self) -> Tensor:
        """Return, per frame (F,), 1 + the part whose length scales its offset from its parent, or 0."""
        return self._owners

    def length_motions(self, frames: Tensor) -> Tensor:
        """Return how far frames (..., F, 4, 4) move as log lengths of parts grow: (..., F, 3, P), metres."""
        above = frames[..., [max(joint.parent, 0) for joint in self.kinematics.tree.joints], :3, :3]
        offsets = self.kinematics.lengths.unflatten(-1, (4, 4))[:, :3, 3] * self._offset_scales().unsqueeze(-1)
        offsets = above @ offsets.to(frames).unsqueeze(-1)
        owners = nn.functional.one_hot(self._owners, self.num_parts + 1)[:, 1:].to(frames)
        # What hangs on a bone moves along it.
        along = (offsets * owners.unsqueeze(-2)).flatten(-2)
        return (self.kinematics.ancestors().to(frames) @ along).unflatten(-1, (3, -1))

    def couplings(self) -> Tensor:
        """Return the matrix (6 + J, num_dofs) from degrees of freedom to base and moving joints."""
        return self._couplings

    def _offset_scales(self) -> Tensor:
        """Return the factors (F,) on the length of each frame's offset from its parent."""
        return nn.functional.pad(self.log_length_scales, (1, 0)).index_select(0, self._owners).exp()


def named_pose(shape: PosedTree | None, pose: Tensor) -> dict[str, Any]:
    """Return poses (..., num_dofs) of a result by name of degree of freedom; InputError where it keeps no shape."""
    if shape is None:
        raise InputError("this result keeps no shape; name its poses with shape.pose_to_dict(...)")
    return shape.pose_to_dict(pose)


def frozen(value: Tensor) -> nn.Parameter:
    """Return a parameter that takes no gradients until they are required."""
    return nn.Parameter(value, requires_grad=False)


def _base_twists(pose: Tensor, chart: str) -> tuple[Tensor, Tensor]:
    """Return the twists of the base's degrees of freedom: linear and angular (..., 6, 3)."""
    check_choice(chart, "chart", ("pose", "tangent"))
    identity = torch.eye(3, dtype=pose.dtype, device=pose.device).expand(*pose.shape[:-1], 3, 3)
    angular = identity if chart == "tangent" else left_jacobian(pose[..., 3:6]).mT
    linear = torch.linalg.cross(pose[..., None, :3].expand_as(angular), angular)
    return torch.cat([identity, linear], dim=-2), torch.cat([torch.zeros_like(identity), angular], dim=-2)
