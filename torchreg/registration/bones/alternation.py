"""Fitting bones, labels and weights to a scan in several frames at once: the steps of scan registration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg.geometry.range_scan import RangeScan
from torchreg.registration.annealing import geometric_at
from torchreg.registration.bones.closest_compatible import CompatibleMatcher
from torchreg.registration.bones.config import BoneConfig, OnRegisterStep
from torchreg.registration.bones.grid_lbs import GridLBS
from torchreg.registration.bones.joint_moments import JointMoments
from torchreg.registration.bones.joints import Joints, find_joints
from torchreg.registration.bones.labels import CellData, LabelCosts, Pull, first_labels, relabel, reuse_labels
from torchreg.registration.bones.motion_problem import BoneProblem, bind
from torchreg.registration.bones.motions import BoneFit, fit_bones
from torchreg.registration.bones.motions_and_joints import JOINT_REGULARIZATION, JointFit, fit_bones_and_joints
from torchreg.registration.bones.weights import refine_weights
from torchreg.registration.results import RegisterRecord
from torchreg.solvers.robust import cauchy_weight, geman_mcclure_weight

# Sampling distances of the target below which the threshold for matches never falls.
_LEAST_REACH = 2.0
# A T-step ends when it changes the energy by less than this share.
_RTOL = 1e-3
# Between two frames everything turns about one axis, and none is clear where bones turn by less than that, radians.
_LEAST_FRAMES, _CLEAR_TURN = 3, 0.03


@dataclass(frozen=True, eq=False)
class Samples:
    """Source points that are matched, and where a dense alignment takes them.

    Args:
        points: (n, 3) before they are moved.
        normals: (n, 3) there.
        moved: (F, n, 3) in every frame.
        confidence: (F, n) how far that can be trusted, positive.
    """

    points: Tensor
    normals: Tensor
    moved: Tensor
    confidence: Tensor


def turned_normals(normals: Tensor, weights: Tensor, transforms: Tensor) -> Tensor:
    """Return unit normals (..., N, 3) of points (N,) of weights (N, B) moved by bones (..., B, 4, 4)."""
    turned = torch.einsum("nb,...bij,nj->...ni", weights, transforms[..., :3, :3], normals)
    return torch.nn.functional.normalize(turned, dim=-1)


class ReducedFit:
    """A registration under way: F frames of one source.

    Args:
        data: the grid and the samples in it.
        samples: the samples.
        targets: F scans.
        num_bones: most bones.
        config: see `BoneConfig`; the source's diagonal is the unit of all lengths here.
        on_step: called with a `RegisterRecord` after each step.

    Attributes:
        labels: (C,) bone of each cell, from 0 without gaps.
        model: the bones and weights, its poses the F frames.
        meetings: where bones of the labels meet.
        pull: where the samples should go.
        history: records so far.
    """

    labels: Tensor
    model: GridLBS
    meetings: JointMoments

    def __init__(
        self,
        data: CellData,
        samples: Samples,
        targets: Sequence[RangeScan],
        num_bones: int,
        config: BoneConfig,
        on_step: OnRegisterStep | None = None,
        labels: Tensor | None = None,
    ) -> None:
        self.data, self.samples, self.targets = data, samples, targets
        self.num_bones, self.config, self._on_step = num_bones, config, on_step
        self.history: list[RegisterRecord] = []
        self.matchers = [CompatibleMatcher(target, config.normal_scale) for target in targets]
        self.pull = Pull(samples.moved, None, samples.confidence)
        per_label = data.grid.num_cells * (config.label_cost / data.grid.spacing) ** 2
        self._costs = LabelCosts(config.smoothness, per_label, config.truncation, config.seam, config.seam_cap)
        if labels is None:
            labels = first_labels(data, samples.moved, samples.confidence, num_bones, self._costs)
        self._label(labels, data.moments(samples.moved, samples.confidence).joined(*self._parts(labels)).motions())
        self._counts = (0, 0, 0, 0)
        self._progress = 0.0

    def fit_labels(self) -> bool:
        """Alternate T-steps, correspondences and W-step, and return whether the energy settled."""
        energy, steps = float("inf"), self.config.label_steps
        for step in range(steps):
            self._progress = step / max(1, steps - 1)
            for _ in range(self.config.match_steps):
                self.solve_motions()
                self.update_matches(0.5 * self._progress)
            labels, found = relabel(self.data, self.pull, self.model.transforms.detach(), self.labels, self._costs)
            self._use(labels)
            settled = found >= (1 - self.config.rtol) * energy
            if self.config.reuse and not settled and step + 1 < steps:
                self._reuse()
            self._report("align", step, steps)
            if settled:
                return True
            energy = min(energy, found)
        return False

    def refine(self) -> bool:
        """Make weights continuous, alternating with motions and correspondences; return whether the fit settled.

        In some more rounds weights stay, and motions and joints come to terms.
        """
        self._progress = 1.0
        rounds = self.config.refine_steps + self.config.settle_steps
        settled = self._refine_weights(rounds)
        for step in range(self.config.refine_steps, rounds):
            self.solve_motions()
            self.update_matches(1.0)
            self._report("refine", step, rounds)
        return settled

    def _refine_weights(self, rounds: int) -> bool:
        """Refine weights, the first of some rounds, and return whether the energy settled."""
        base, steps = self.model.weights.detach(), self.config.refine_steps
        settings = replace(self.config.refine, point_to_point=self.pull.point_to_point)
        energy = self.solve_motions()
        for step in range(steps):
            labeled = GridLBS(self.data.grid, base, self.model.transforms.detach())
            pull = self.pull
            found = refine_weights(
                labeled, self.samples.points, pull.targets, pull.normals, pull.weights, config=settings
            )
            self.model = self._weighted(found.weights, self.model.transforms.detach())
            last, energy = energy, self.solve_motions()
            self.update_matches(0.5 + 0.5 * (step + 1) / steps)
            self._report("refine", step, rounds)
            if energy >= (1 - self.config.rtol) * last:
                return True
        return steps == 0

    def solve_motions(self) -> float:
        """Fit the bones' motions and joints to the samples' targets: the T-step, eq. 5; return the mean energy."""
        pull, joints, transforms = self.pull, self._joints(), self.model.transforms.detach()
        problem = BoneProblem(
            self.samples.points,
            bind(self.model.weights_at(self.samples.points).detach()),
            pull.targets,
            pull.normals,
            pull.weights,
            pull.point_to_point,
            moments=None if joints is None else self._turning(),
            joint_weight=self._joint_weight,
            pair_weights=None if joints is None else self._holding(joints),
            blend=self.config.blend,
        )
        fit: BoneFit | JointFit
        if joints is None:
            fit = fit_bones(problem, transforms, max_steps=self.config.motion_steps, rtol=_RTOL)
        else:
            fit = fit_bones_and_joints(
                problem, transforms, joints.centers, max_steps=self.config.motion_steps, rtol=_RTOL
            )
        self.model.set_transforms_(fit.transforms)
        return float(fit.energy.mean())

    def update_matches(self, progress: float) -> None:
        """Match the moved samples anew, with thresholds that tighten as ``progress`` goes from 0 to 1.

        A matched sample is pulled to the target's surface along its normal, and weakly to where the dense alignment
        takes it along the surface; others to the latter alone.
        """
        moved, normals = self.moved(self.samples.points, self.samples.normals)
        share = self.config.point_to_point
        pulls, counts = [], torch.zeros(4, dtype=torch.int64)
        for frame, (target, matcher) in enumerate(zip(self.targets, self.matchers, strict=True)):
            found = matcher.match(
                moved[frame],
                normals[frame],
                max_distance=max(geometric_at(self.config.max_distance, progress), _LEAST_REACH * target.spacing),
                max_angle=geometric_at(self.config.max_angle, progress),
            )
            kept, base = found.kept.unsqueeze(-1), self.samples.moved[frame]
            drop = ((found.targets - base) * found.normals).sum(-1, keepdim=True) * found.normals
            weight = torch.where(found.kept, 1.0, self.config.unmatched * self.samples.confidence[frame])
            normal = torch.where(kept, found.normals, normals[frame])
            pulls.append((torch.where(kept, base + drop, base), normal, weight))
            counts += torch.tensor([found.counts.kept, found.counts.boundary, found.counts.far, found.counts.turned])
        targets, there, weights = (torch.stack(part) for part in zip(*pulls, strict=True))
        self.pull = Pull(targets, there, weights, share)
        kept_count, boundary, far, turned = counts.tolist()
        self._counts = (kept_count, boundary, far, turned)

    def moved(self, points: Tensor, normals: Tensor) -> tuple[Tensor, Tensor]:
        """Return where points (N, 3) and their unit normals go in every frame, (F, N, 3) each."""
        with torch.no_grad():
            weights, transforms = self.model.weights_at(points), self.model.transforms
            return self.model.move(points, weights), turned_normals(normals, weights, transforms)

    @property
    def _joint_weight(self) -> float:
        return self.config.joint_weight_at(self._progress)

    def _parts(self, labels: Tensor) -> tuple[Tensor, int]:
        """Return the label of each patch, and the number of labels, where labels (C,) do not cut patches."""
        patches = self.data.patches
        part = torch.zeros(int(patches.max()) + 1, dtype=torch.int64, device=patches.device)
        return part.scatter(0, patches, labels), int(labels.max()) + 1

    def _label(self, labels: Tensor, transforms: Tensor) -> None:
        """Take over labels (C,) from 0 without gaps, and their motions."""
        self.labels, count = labels, transforms.shape[-3]
        self.model = GridLBS.from_labels(self.data.grid, labels, count, transforms, blend=self.config.blend)
        # Continuous weights spread far: bones share some of them that no joint holds together.
        self.meetings = self.model.joint_moments()

    def _weighted(self, weights: Tensor, transforms: Tensor) -> GridLBS:
        return GridLBS(self.data.grid, weights, transforms, blend=self.config.blend)

    def _use(self, labels: Tensor) -> None:
        """Take over labels (C,), dropping bones without a cell."""
        kept, labels = labels.unique(return_inverse=True)
        self._label(labels, self.model.transforms.detach()[:, kept])

    def _reuse(self) -> None:
        """Bring lost labels back; a bone that takes over half of another's region starts from that one's motion."""
        before = self.labels
        labels = reuse_labels(self.data, self.pull, before, self.num_bones, self._costs)
        origin = torch.stack([before[labels == label][0] for label in range(int(labels.max()) + 1)])
        self._label(labels, self.model.transforms.detach()[:, origin])

    def _joints(self) -> Joints | None:
        """Return where the bones meet, as their motions tell, if that counts."""
        if self._joint_weight == 0 or not len(self.meetings.pairs):
            return None
        return find_joints(self.meetings, self.model.transforms.detach(), regularization=JOINT_REGULARIZATION)

    def _holding(self, joints: Joints) -> Tensor:
        """Return how much each joint counts (P,): less, the farther motions take it apart (Geman and McClure 1987)."""
        square = joints.gaps.square().reshape(-1, len(joints.pairs)).mean(0)
        return geman_mcclure_weight(square / geometric_at(self.config.joint_scale, self._progress) ** 2)

    def _turning(self) -> JointMoments:
        """Return the joints as points, with a spread that makes bones pay a little for turning against each other."""
        joints = self.meetings
        first, second = self.model.transforms.detach()[..., :3, :3][..., joints.pairs.mT, :, :].unbind(-4)
        # |R_i - R_j|^2 is about twice the squared angle between them; a spread s I costs s times as much.
        apart = first - second
        squares = (apart.mT @ apart).mean(0)
        turns = 0.5 * squares.diagonal(dim1=-2, dim2=-1).sum(-1)
        weight = 0.5 * self.config.turn_weight * cauchy_weight(turns / self.config.turn_scale**2)
        spread = weight[:, None, None] * torch.eye(3, dtype=weight.dtype, device=weight.device)
        if len(apart) >= _LEAST_FRAMES:
            spread = spread + self._hinges(squares)
        return replace(joints, spread=spread / self._joint_weight)

    def _hinges(self, squares: Tensor) -> Tensor:
        """Return spreads (P, 3, 3) along the axes about which bones mostly turn, of mean squares of R_i - R_j.

        As if each joint were a pin along its axis, which both bones must keep to; less, the more they turn otherwise or
        the less they tell the axis.
        """
        off, axes = torch.linalg.eigh(squares)
        axis, (least, second, _) = axes[..., 0], off.clamp(min=0).unbind(-1)
        told = (second - least) / (second + _CLEAR_TURN**2)
        hold = told * geman_mcclure_weight(least / self.config.hinge_scale**2)
        return (self.config.hinge_weight * hold)[:, None, None] * axis.unsqueeze(-1) * axis.unsqueeze(-2)

    def _report(self, stage: str, step: int, num_steps: int) -> None:
        with torch.no_grad():
            transforms, points = self.model.transforms, self.samples.points
            squares = self.pull.squares(self.model(points))
            weights, neighbors = self.pull.weights, self.data.neighbors
            joints = self._joints()
            gap = 0.0 if joints is None else float(joints.gaps.square().sum(-1).mean())
            record = RegisterRecord(
                stage,
                step,
                num_steps,
                float((weights * squares).sum() / weights.sum().clamp_min(1e-300)),
                gap,
                int((self.labels[neighbors[:, 0]] != self.labels[neighbors[:, 1]]).sum()),
                transforms.shape[-3],
                *self._counts,
            )
        self.history.append(record)
        if self._on_step is not None:
            self._on_step(record)
