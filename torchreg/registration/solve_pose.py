"""Posing what was registered by dragging points: inverse kinematics with the T-step."""

from __future__ import annotations

from dataclasses import dataclass
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
from torchreg.registration.blend import turn_about
from torchreg.registration.bones.grid_lbs import GridLBS, check_rigid
from torchreg.registration.bones.joint_moments import JointMoments
from torchreg.registration.bones.joints import BoneTree, bone_tree
from torchreg.registration.bones.motion_problem import BoneProblem, bind, bone_bodies
from torchreg.registration.bones.motions import BoneFit, fit_bones
from torchreg.registration.results import PoseSolution
from torchreg.result import Status

HELD_JOINTS = ("tree", "all")
# Where handles are this share of the model's size off, steps pay at first about as much as handles pull; less, nearer.
_FAR = 0.2


@dataclass(frozen=True)
class PoseConfig:
    """How a pose is solved.

    Args:
        hold: how much the joints count against the handles: where a target is out of reach, joints open by a share of
            the miss that is about the inverse.
        bend: how much joints pull bones back to the unmoved pose, as a share of ``hold``; the energy of eq. 4 has 1.
        stay: how much the mean squared shift of what the bones carry counts against that of the handles.
        joints: "tree", those of the skeleton; "all", wherever two bones share weight, touching parts too.
        max_steps: most linear systems.
        rtol: the pose is found when a step changes the energy by less than this share,
        atol: or when it is below the square of this share of the model's size (root mean square).

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


def solve_pose(
    model: GridLBS,
    handles: Tensor,
    targets: Tensor,
    *,
    start: Tensor | None = None,
    handle_weights: Tensor | None = None,
    fixed: Tensor | None = None,
    config: PoseConfig | None = None,
) -> PoseSolution:
    """Return the pose in which points of the space come to lie at targets, joints hold, and the rest moves little.

    ``argmin_T mean_h |D(x_h; T) - y_h|^2 + hold sum_joints |T_i c - T_j c|^2 + ...``, a joint being the point c that
    the model's own motions move alike. Pieces of a scan that hidden joints cut apart hold together as well, see
    `GridLBS.joints`.

    Whoever drags handles solves many poses of one model: a `PoseSolver` finds the joints once.

    Args:
        model: what to pose; it is not changed.
        handles: (H, 3) points of the space before it is moved, such as points of the source scan.
        targets: (..., H, 3) where they should go; a batch solves several poses at once.
        start: (..., B, 4, 4) to start from and to stay near, the last solution when dragging; the model's by default.
        handle_weights: (..., H) how much each handle counts; ones by default.
        fixed: (B,) bool, bones to hold at the start.
        config: see `PoseConfig`.

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
    """Poses of one model, its joints found once.

    Args:
        model: what to pose; later changes of it go unnoticed.
        config: see `PoseConfig`.
    """

    @torch.no_grad()
    def __init__(self, model: GridLBS, *, config: PoseConfig | None = None) -> None:
        self.model = model
        self.config = PoseConfig() if config is None else config
        grid = model.grid
        weights = model.corner_weights()
        self._bodies = bone_bodies(grid.corner_points().double(), weights.double())
        corners = grid.corner_points()
        self._size = float((corners - corners.mean(0)).square().sum(-1).mean().sqrt())
        moments = model.bridged_moments()
        joints = model.joints_of(moments)
        tree = bone_tree(joints, model.middles, weights.sum(0))
        self._chains = _Chains(tree, self._bodies.middle)
        kept = self._chains.uses(joints.pairs) if self.config.joints == "tree" else slice(None)
        spread = self.config.bend * moments.spread[kept]
        self._held = JointMoments(joints.pairs[kept], joints.mass[kept], joints.centers[kept], spread).to(torch.float64)

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
        """Return the pose for some handles; see `solve_pose`."""
        model, config = self.model, self.config
        handles = as_float_tensor(handles, "handles", like=model.weights)
        check_points(handles, "handles", batch=False)
        targets = as_float_tensor(targets, "targets", like=model.weights)
        check_shape(targets, "targets", (len(handles), 3), batch=True)
        check_finite(targets, "targets")
        start = self._start(start)
        if handle_weights is not None:
            handle_weights = as_float_tensor(handle_weights, "handle_weights", like=start)
            check_shape(handle_weights, "handle_weights", (len(handles),), batch=True)
            check_finite(handle_weights, "handle_weights")
            if bool((handle_weights < 0).any()):
                raise InputError(f"handle_weights must not be negative, got {float(handle_weights.min()):g}")
        problem = BoneProblem(
            handles.double(),
            bind(model.weights_at(handles).double()),
            targets.double(),
            match_weights=handle_weights,
            point_to_point=1.0,
            moments=self._held,
            joint_weight=config.hold,
            bodies=self._bodies,
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
            retract=partial(self._chains.move, fixed=fixed),
        )
        return self._solution(problem, targets, fit)

    def _damping(self, problem: BoneProblem, start: Tensor) -> Tensor:
        """Return the damping (...) of the first step."""
        moved = self.model.move(problem.points, problem.binding.weights, start)
        square = (moved - problem.targets).square().sum(-1).mean(-1)
        return (square / (_FAR * self._size) ** 2).clamp(1e-3, 1.0)

    def _start(self, start: Tensor | None) -> Tensor:
        model = self.model
        if start is None:
            start = model.transforms
            if start.ndim > 3:
                raise InputError(f"start must be given for a model with {tuple(start.shape[:-3])} poses; choose one")
        start = as_float_tensor(start, "start", like=model.weights).detach()
        check_shape(start, "start", (model.num_bones, 4, 4), batch=True)
        check_rigid(start, "start")
        return start.double()

    def _solution(self, problem: BoneProblem, targets: Tensor, fit: BoneFit) -> PoseSolution:
        placed = self.model.move(problem.points, problem.binding.weights, fit.transforms).to(targets)
        one, two = (fit.transforms[..., bones, :, :] for bones in self._held.pairs.unbind(-1))
        apart = ((one - two)[..., :3, :3] @ self._held.center.unsqueeze(-1)).squeeze(-1) + (one - two)[..., :3, 3]
        done = [Status.CONVERGED if ok else Status.MAX_STEPS for ok in fit.converged.reshape(-1).tolist()]
        return PoseSolution(
            fit.transforms.to(targets),
            placed,
            torch.linalg.vector_norm(placed - targets, dim=-1),
            torch.linalg.vector_norm(apart, dim=-1).to(targets),
            fit.num_steps,
            done[0] if fit.converged.ndim == 0 else tuple(done),
        )


class _Chains:
    """Bones that hang on each other at joints."""

    def __init__(self, tree: BoneTree, middles: Tensor) -> None:
        parents = torch.tensor(tree.parents, device=middles.device)
        self.parents, self.middles = parents, middles
        self.child = (parents >= 0).nonzero()[:, 0]
        self.parent = parents[self.child]
        self.joint = tree.origins[self.child].double().unsqueeze(-1)
        # Which joints lie between a bone and its root.
        above = torch.zeros(len(parents), len(parents), dtype=middles.dtype, device=middles.device)
        for bone in range(len(parents)):
            at = bone
            while at >= 0:
                above[bone, at] = 1.0
                at = tree.parents[at]
        self.above = above[:, self.child]

    def uses(self, pairs: Tensor) -> Tensor:
        """Return which pairs of bones (P,) bool hang on each other."""
        first, second = pairs.unbind(-1)
        return (self.parents[first] == second) | (self.parents[second] == first)

    def move(self, transforms: Tensor, twists: Tensor, fixed: Tensor | None = None) -> Tensor:
        """Return motions moved on by twists about the bones' middles, shifted so that joints open as to first order.

        Bones that turn far leave their joints along tangents: without the shift, stiff joints allow small turns alone.
        """
        centers = transform_points(transforms, self.middles.unsqueeze(-2)).squeeze(-2)
        moved = turn_about(transforms, twists, centers)
        # Of both ends of every joint: where it ends, less where its first-order motion takes it.
        ends = torch.cat([self.child, self.parent])
        place = self._places(transforms, ends)
        arms = place - centers.index_select(-2, ends)
        twist = twists.index_select(-2, ends)
        slide = place + twist[..., :3] + torch.linalg.cross(twist[..., 3:], arms)
        child, parent = (self._places(moved, ends) - slide).chunk(2, dim=-2)
        shift = self.above @ (parent - child)
        if fixed is not None and bool(fixed.any()):
            # What hangs on a held bone comes to it, not the other way round.
            shift = (shift - shift[..., fixed, :].mean(-2, keepdim=True)).masked_fill(fixed.unsqueeze(-1), 0.0)
        return torch.cat([moved[..., :3], moved[..., 3:] + nn.functional.pad(shift, (0, 1)).unsqueeze(-1)], dim=-1)

    def _places(self, transforms: Tensor, bones: Tensor) -> Tensor:
        """Return where the joints (..., 2 J, 3) are, as the bones at their ends see it."""
        rows = transforms[..., :3, :].index_select(-3, bones)
        return (rows[..., :3] @ torch.cat([self.joint, self.joint])).squeeze(-1) + rows[..., 3]
