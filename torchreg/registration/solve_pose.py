"""Posing what was registered by dragging points: inverse kinematics with the T-step."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor, nn

from torchreg._checks import (
    as_float_tensor,
    check_choice,
    check_count,
    check_finite,
    check_points,
    check_positive,
    check_shape,
)
from torchreg._threads import one_thread
from torchreg.errors import InputError
from torchreg.geometry.rigid import transform_points
from torchreg.registration.blend import check_rigid_motions, turn_about
from torchreg.registration.bones.correspondences import Correspondences
from torchreg.registration.bones.grid_lbs import GridLBS
from torchreg.registration.bones.joint_moments import gaps_at, motion_differences
from torchreg.registration.bones.joints import BoneTree, bone_tree
from torchreg.registration.bones.motion_problem import Binding, BoneBodies, BoneProblem
from torchreg.registration.bones.motions import BoneFit, fit_bones
from torchreg.registration.results import PoseSolution
from torchreg.result import Status

HELD_JOINTS = ("tree", "all")


@dataclass(frozen=True)
class SolvePoseConfig:
    """Settings by which a pose is solved.

    Args:
        hold: weight of the joints against the handles; where a target is out of reach, joints open by about its inverse
            as a share of the residual.
        bend: weight of turns at the joints, which draw bones back to the unmoved pose, as a share of ``hold``; the
            joint energy of eq. 4 has 1.
        stay: weight of the bones' mean squared displacement from the start against that of the handles.
        joints: "tree" holds those of the skeleton, "all" wherever two bones share weight, so that touching parts hold.
        max_steps: most linear systems.
        rtol: relative change of the energy by a step below which the pose is found.
        atol: root of the energy, as a share of the model's size (root mean square), below which the pose is found.

    Raises:
        InputError: if a value is out of range.
    """

    hold: float = 100.0
    bend: float = 0.0
    stay: float = 1e-3
    joints: str = "tree"
    max_steps: int = 20
    rtol: float = 0.05
    atol: float = 2e-3

    def __post_init__(self) -> None:
        check_positive(self.hold, "hold")
        check_positive(self.bend, "bend", allow_zero=True)
        check_positive(self.stay, "stay")
        check_choice(self.joints, "joints", HELD_JOINTS)
        check_count(self.max_steps, "max_steps", 1)
        check_positive(self.rtol, "rtol", allow_zero=True)
        check_positive(self.atol, "atol", allow_zero=True)


@dataclass(frozen=True)
class _FirstDamping:
    """Damping of the first step, which grows with the squared distance of the handles from their targets."""

    # root mean squared distance, as a share of the model's size, at which displacements cost like residuals
    far: float = 0.2
    least: float = 1e-3
    most: float = 1.0


_DAMPING = _FirstDamping()


def solve_pose(
    model: GridLBS,
    handles: Tensor,
    targets: Tensor,
    *,
    start: Tensor | None = None,
    handle_weights: Tensor | None = None,
    fixed: Tensor | None = None,
    config: SolvePoseConfig | None = None,
) -> PoseSolution:
    """Return the pose by inverse kinematics: handles at targets, joints as constraints, and a prior at the rest pose.

    ``argmin_T mean_h |D(x_h; T) - y_h|^2 + hold sum_joints |T_i c - T_j c|^2 + ...``, a joint being the point c on
    which the model's own motions agree. Pieces of a scan that hidden joints cut apart hold together as well, see
    `GridLBS.joints`.

    To solve many poses of one model, as when dragging, use a `PoseSolver`, which finds the joints once.

    Args:
        model: the model to pose, which is not changed.
        handles: (H, 3) points of the space before it is moved, such as points of the source scan.
        targets: (..., H, 3) of the handles; a batch solves several poses at once.
        start: (..., B, 4, 4) to start from and to stay near, the last solution when dragging; the model's by default.
        handle_weights: (..., H) not negative; ones by default.
        fixed: (B,) bool, bones to hold at the start.
        config: see `SolvePoseConfig`.

    Returns:
        a `PoseSolution`.

    Raises:
        InputError: if a shape does not fit, a number is not finite, a start is not rigid, or the model holds a batch of
            poses and no start is given.

    Differentiable: no.

    Cost: 3 ms, and a step 1 ms, for 10 bones and 4 handles on one core; 2 to 4 steps when dragging, 9 for wide motions.

    References: Chang and Zwicker 2009, section 5, "Creating Novel Poses".
    """
    return PoseSolver(model, config=config).solve(
        handles, targets, start=start, handle_weights=handle_weights, fixed=fixed
    )


class PoseSolver:
    """Poses of one model, its joints found once; later changes of the model are not noticed."""

    @torch.no_grad()
    def __init__(self, model: GridLBS, *, config: SolvePoseConfig | None = None) -> None:
        self.model = model
        self.config = SolvePoseConfig() if config is None else config
        corners, weights = model.grid.corner_points(), model.corner_weights()
        self._bodies = BoneBodies.from_weights(corners.double(), weights.double())
        self._size = float((corners - corners.mean(0)).square().sum(-1).mean().sqrt())
        moments = model.bridged_moments()
        joints = model.joints_of(moments)
        self._tree = _JointTree(bone_tree(joints, model.middles, weights.sum(0)), self._bodies.center)
        moments = replace(moments, center=joints.centers, spread=self.config.bend * moments.spread)
        if self.config.joints == "tree":
            moments = moments.select(self._tree.holds(moments.pairs))
        self._held = moments.to(torch.float64)

    @torch.no_grad()
    @one_thread()
    def solve(
        self,
        handles: Tensor,
        targets: Tensor,
        *,
        start: Tensor | None = None,
        handle_weights: Tensor | None = None,
        fixed: Tensor | None = None,
    ) -> PoseSolution:
        """Return the pose of some handles; see `solve_pose`."""
        model, config = self.model, self.config
        handles = as_float_tensor(handles, "handles", like=model.weights)
        check_points(handles, "handles", batch=False)
        targets = as_float_tensor(targets, "targets", like=model.weights)
        check_shape(targets, "targets", (len(handles), 3), batch=True)
        check_finite(targets, "targets")
        start = self._checked_start(start)
        if fixed is not None:
            check_shape(fixed, "fixed", (model.num_bones,))
        weights = torch.ones_like(targets[..., 0]) if handle_weights is None else handle_weights
        problem = BoneProblem(
            points=handles.double(),
            binding=Binding.from_weights(model.weights_at(handles).double()),
            correspondences=Correspondences(targets.double(), None, _checked_weights(weights, start, len(handles))),
            bodies=self._bodies,
            moments=self._held,
            joint_weight=config.hold,
            anchors=start,
            anchor_weights=config.stay / model.num_bones,
            blend=model.blend,
        )
        fit = fit_bones(
            problem,
            start,
            fixed=fixed,
            max_steps=config.max_steps,
            rtol=config.rtol,
            atol=config.atol * self._size,
            damping=self._damping(problem, start),
            retract=partial(self._tree.retract, fixed=fixed),
        )
        return self._solution(problem, targets, fit)

    def _damping(self, problem: BoneProblem, start: Tensor) -> Tensor:
        """Return the damping (...) of the first step."""
        moved = self.model.move(problem.points, problem.binding.weights, start)
        square = (moved - problem.correspondences.targets).square().sum(-1).mean(-1)
        return (square / (_DAMPING.far * self._size) ** 2).clamp(_DAMPING.least, _DAMPING.most)

    def _checked_start(self, start: Tensor | None) -> Tensor:
        model = self.model
        if start is None:
            start = model.transforms
            if start.ndim > 3:
                raise InputError(f"start must be given for a model with {tuple(start.shape[:-3])} poses; choose one")
        start = as_float_tensor(start, "start", like=model.weights).detach()
        check_shape(start, "start", (model.num_bones, 4, 4), batch=True)
        check_rigid_motions(start, "start")
        return start.double()

    def _solution(self, problem: BoneProblem, targets: Tensor, fit: BoneFit) -> PoseSolution:
        placed = self.model.move(problem.points, problem.binding.weights, fit.transforms).to(targets)
        gaps = gaps_at(motion_differences(fit.transforms, self._held.pairs), self._held.center)
        status = [Status.CONVERGED if done else Status.MAX_STEPS for done in fit.converged.reshape(-1).tolist()]
        return PoseSolution(
            transforms=fit.transforms.to(targets),
            placed=placed,
            residuals=torch.linalg.vector_norm(placed - targets, dim=-1),
            gaps=torch.linalg.vector_norm(gaps, dim=-1).to(targets),
            num_steps=fit.num_steps,
            status=status[0] if fit.converged.ndim == 0 else tuple(status),
        )


def _checked_weights(weights: Tensor, like: Tensor, count: int) -> Tensor:
    weights = as_float_tensor(weights, "handle_weights", like=like)
    check_shape(weights, "handle_weights", (count,), batch=True)
    check_finite(weights, "handle_weights")
    if bool((weights < 0).any()):
        raise InputError(f"handle_weights must not be negative, got {float(weights.min()):g}")
    return weights


class _JointTree:
    """The tree of B bones, which turn about centers (B, 3), and the J joints between bones and their parents."""

    def __init__(self, tree: BoneTree, centers: Tensor) -> None:
        self._centers, self._parents = centers, torch.tensor(tree.parents, device=centers.device)
        self._child = (self._parents >= 0).nonzero()[:, 0]
        self._parent = self._parents[self._child]
        self._joint = tree.origins[self._child].double().unsqueeze(-1)
        # Which joints (B, J) lie between a bone and its root.
        above = torch.zeros(len(centers), len(centers), dtype=centers.dtype, device=centers.device)
        for bone in range(len(centers)):
            ancestor = bone
            while ancestor >= 0:
                above[bone, ancestor] = 1.0
                ancestor = tree.parents[ancestor]
        self._above = above[:, self._child]

    def holds(self, pairs: Tensor) -> Tensor:
        """Return a mask (P,) of the pairs of bones that are parent and child."""
        first, second = pairs.unbind(-1)
        return (self._parents[first] == second) | (self._parents[second] == first)

    def retract(self, transforms: Tensor, twists: Tensor, fixed: Tensor | None = None) -> Tensor:
        """Return motions updated by twists about the bones' centers, shifted so that joints open as to first order."""
        centers = transform_points(transforms, self._centers.unsqueeze(-2)).squeeze(-2)
        moved = turn_about(transforms, twists, centers)
        # The end of every joint on each of its bones, and how far the update takes it from its first-order motion.
        ends = torch.cat([self._child, self._parent])
        before = self._joint_positions(transforms, ends)
        twist, arms = twists.index_select(-2, ends), before - centers.index_select(-2, ends)
        linear = before + twist[..., :3] + torch.linalg.cross(twist[..., 3:], arms)
        child, parent = (self._joint_positions(moved, ends) - linear).chunk(2, dim=-2)
        shift = self._above @ (parent - child)
        if fixed is not None and bool(fixed.any()):
            # What hangs on a held bone comes to it, not the other way round.
            shift = (shift - shift[..., fixed, :].mean(-2, keepdim=True)).masked_fill(fixed.unsqueeze(-1), 0.0)
        return torch.cat([moved[..., :3], moved[..., 3:] + nn.functional.pad(shift, (0, 1)).unsqueeze(-1)], dim=-1)

    def _joint_positions(self, transforms: Tensor, bones: Tensor) -> Tensor:
        """Return the images (..., 2 J, 3) of the joints under the motions of the bones at their ends."""
        rows = transforms[..., :3, :].index_select(-3, bones)
        return (rows[..., :3] @ torch.cat([self._joint, self._joint])).squeeze(-1) + rows[..., 3]
