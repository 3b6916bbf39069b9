"""Fitting bones, labels and weights to a scan in several frames at once: the loop of scan registration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from torchreg.geometry.range_scan import RangeScan
from torchreg.registration.annealing import geometric_at
from torchreg.registration.bones.closest_compatible import CompatibleMatcher, CompatibleMatches
from torchreg.registration.bones.config import BoneConfig, OnRegisterStep
from torchreg.registration.bones.correspondences import Correspondences
from torchreg.registration.bones.grid_lbs import GridLBS
from torchreg.registration.bones.joint_moments import JointMoments
from torchreg.registration.bones.joint_prior import joint_weights, with_stiffness
from torchreg.registration.bones.joints import REGULARIZATION, Joints, find_joints
from torchreg.registration.bones.labels import CellData, LabelCosts, first_labels, relabel
from torchreg.registration.bones.motion_problem import BoneProblem
from torchreg.registration.bones.motions import BoneFit, fit_bones
from torchreg.registration.bones.motions_and_joints import JointFit, fit_bones_and_joints
from torchreg.registration.bones.registration_energy import EnergyState
from torchreg.registration.bones.step_record import cut_edges, reported_weights, step_record
from torchreg.registration.bones.weights import refine_weights
from torchreg.registration.results import RegisterRecord


@dataclass(frozen=True, eq=False)
class Samples:
    """Source points (n, 3) with normals, their positions (F, n, 3) in F frames by an alignment, and confidences > 0."""

    # Weight of points of no confidence, which follow the alignment of their surroundings.
    LEAST_CONFIDENCE: ClassVar[float] = 0.1

    points: Tensor
    normals: Tensor
    moved: Tensor
    confidence: Tensor

    @classmethod
    def from_alignment(cls, scan: RangeScan, index: Tensor, moved: Tensor, confidence: Tensor) -> Samples:
        """Return samples (n,) of a scan of N points, moved to (F, N, 3) with confidence (F, N)."""
        confidence = confidence[:, index].double().clamp(min=cls.LEAST_CONFIDENCE)
        return cls(scan.points[index], scan.normals[index], moved[:, index], confidence)


class ReducedFit:
    """A registration under way: F frames of one source, in units of the source's diagonal.

    Args:
        labels: (C,) bones of the cells to start from, 0 without gaps; by default parts that move rigidly.
        Attributes: ``labels`` (C,), ``model`` (its poses the F frames), ``correspondences``, ``history``, and
            ``moments`` of the regions that bones share by their labels: continuous weights spread too far for joints.
    """

    labels: Tensor
    model: GridLBS
    moments: JointMoments
    _label_weights: Tensor
    _shared: JointMoments

    def __init__(
        self,
        data: CellData,
        samples: Samples,
        targets: Sequence[RangeScan],
        config: BoneConfig,
        *,
        num_bones: int,
        labels: Tensor | None = None,
        on_step: OnRegisterStep | None = None,
    ) -> None:
        self.data, self.samples, self.config = data, samples, config
        self._on_step = on_step
        self.history: list[RegisterRecord] = []
        self._edges = data.grid.edges()
        self._term_weights = reported_weights(config)
        self.matchers = [CompatibleMatcher(target, config.normal_scale) for target in targets]
        self._matches: list[CompatibleMatches] = []
        self._costs = LabelCosts(
            smoothness=config.smoothness,
            label=data.grid.num_cells * (config.label_cost / data.grid.spacing) ** 2,
            seam=config.seam,
        )
        # Before the first T-step samples correspond to their positions in the alignment, which also gives the motions.
        self.correspondences = Correspondences(samples.moved, None, samples.confidence)
        if labels is None:
            labels = first_labels(data, samples.moved, samples.confidence, num_bones, self._costs)
        self._set_labels(labels, self._motions_of(labels))
        self._progress = 0.0

    def fit_labels(self) -> bool:
        """Alternate T-steps, correspondences and W-step, and return whether the energy converged.

        References: Chang and Zwicker 2009, algorithm 1, lines 3 to 8, but that correspondences stay after the W-step.
        """
        lowest, steps = float("inf"), self.config.label_steps
        for step in range(steps):
            self._progress = step / max(1, steps - 1)
            for _ in range(self.config.match_steps):
                self.solve_motions()  # line 4
                self.update_correspondences(0.5 * self._progress)  # line 5
            energy = self.solve_labels()  # line 6
            converged = energy >= (1 - self.config.rtol) * lowest
            self._report("align", step, steps)
            if converged:
                return True
            lowest = min(lowest, energy)
        return False

    def refine(self) -> bool:
        """Alternate continuous weights, T-steps and correspondences, and return whether the energy converged."""
        self._progress = 1.0
        steps = self.config.refine_steps
        energy = self.solve_motions()
        for step in range(steps):
            transforms = self.model.transforms.detach()
            labeled = GridLBS(self.data.grid, self._label_weights, transforms)
            weights = refine_weights(labeled, self.samples.points, self.correspondences, self.config.refine).weights
            self.model = GridLBS(self.data.grid, weights, transforms, blend=self.config.blend)
            self._shared = self.model.joint_moments()
            before, energy = energy, self.solve_motions()
            self.update_correspondences(0.5 + 0.5 * (step + 1) / steps)
            self._report("refine", step, steps)
            if energy >= (1 - self.config.rtol) * before:
                return True
        return steps == 0

    def solve_motions(self) -> float:
        """Fit the bones' motions and joints to the correspondences: the T-step, eq. 5; return the mean energy."""
        points, transforms, joints = self.samples.points, self.model.transforms.detach(), self._joints()
        weights, blend = self.model.weights_at(points).detach(), self.config.blend
        problem = BoneProblem.of_weights(
            points, weights, self.correspondences, joint_weight=self._joint_weight, blend=blend
        )
        fit: BoneFit | JointFit
        if joints is None:
            fit = fit_bones(problem, transforms, max_steps=self.config.motion_steps)
        else:
            rotations, scale = transforms[..., :3, :3], geometric_at(self.config.max_distance, self._progress)
            problem = replace(
                problem,
                moments=with_stiffness(self.moments, rotations, self.config, self._joint_weight),
                pair_weights=joint_weights(joints.gaps, scale),
            )
            fit = fit_bones_and_joints(problem, transforms, joints.centers, max_steps=self.config.motion_steps)
        self.model.set_transforms_(fit.transforms)
        return float(fit.energy.mean())

    def update_correspondences(self, progress: float) -> None:
        """Match the moved samples anew, with thresholds that tighten as ``progress`` goes from 0 to 1."""
        moved, normals = self.moved(self.samples.points, self.samples.normals)
        max_distance = geometric_at(self.config.max_distance, progress)
        max_angle = geometric_at(self.config.max_angle, progress)
        self._matches = [
            matcher.match(points, directions, max_distance=max_distance, max_angle=max_angle)
            for matcher, points, directions in zip(self.matchers, moved, normals, strict=True)
        ]
        targets, target_normals, kept = (
            torch.stack([getattr(matches, name) for matches in self._matches])
            for name in ("targets", "normals", "kept")
        )
        aligned, matched = self.samples.moved, kept.unsqueeze(-1)
        to_plane = ((targets - aligned) * target_normals).sum(-1, keepdim=True) * target_normals
        self.correspondences = Correspondences(
            targets=torch.where(matched, aligned + to_plane, aligned),
            normals=torch.where(matched, target_normals, normals),
            weights=torch.where(kept, 1.0, self.samples.confidence),
            point_to_point=self.config.point_to_point,
        )

    def solve_labels(self) -> float:
        """Label the cells anew: the W-step, eq. 11; drop bones without a cell, and return the energy."""
        transforms = self.model.transforms.detach()
        labels, energy = relabel(self.data, self.correspondences, transforms, self.labels, self._costs)
        used, labels = labels.unique(return_inverse=True)
        self._set_labels(labels, transforms[:, used])
        return energy

    def moved(self, points: Tensor, normals: Tensor) -> tuple[Tensor, Tensor]:
        """Return points (N, 3) and their unit normals moved in every frame, (F, N, 3) each."""
        return moved_surface(self.model, points, normals)

    @property
    def _joint_weight(self) -> float:
        return self.config.joint_weight_at(self._progress)

    def _motions_of(self, labels: Tensor) -> Tensor:
        """Return the rigid motions (F, B, 4, 4) of labels (C,) that fit the alignment; no patch has two labels."""
        patches = self.data.patches
        part = torch.zeros(self.data.patch_count, dtype=torch.int64, device=patches.device).scatter(0, patches, labels)
        moments = self.data.moments(self.samples.moved, self.samples.confidence)
        return moments.joined(part, int(labels.max()) + 1).motions()

    def _set_labels(self, labels: Tensor, transforms: Tensor) -> None:
        """Follow labels (C,) from 0 without gaps, with motions (F, B, 4, 4)."""
        self.labels, count = labels, transforms.shape[-3]
        self.model = GridLBS.from_labels(self.data.grid, labels, count, transforms, blend=self.config.blend)
        self.moments = self._shared = self.model.joint_moments()
        self._label_weights = self.model.weights.detach()

    def _joints(self) -> Joints | None:
        """Return the joints of the motions, or None where there are none or they do not count."""
        if self._joint_weight == 0 or not len(self.moments.pairs):
            return None
        return find_joints(self.moments, self.model.transforms.detach(), regularization=REGULARIZATION.fitted)

    def _energy_state(self) -> EnergyState:
        """Return what the terms of the energy depend on."""
        return EnergyState(
            model=self.model,
            transforms=self.model.transforms,
            points=self.samples.points,
            correspondences=self.correspondences,
            edges=self._edges,
            label_weights=self._label_weights,
            known_moments=self._shared,
        )

    @torch.no_grad()
    def _report(self, stage: str, step: int, num_steps: int) -> None:
        joints = self._joints()
        record = step_record(
            self._energy_state(),
            self._term_weights,
            cut_edges=cut_edges(self.labels, self.data),
            joint=0.0 if joints is None else float(joints.gaps.square().sum(-1).mean()),
            matches=self._matches,
            at=(stage, step, num_steps),
        )
        self.history.append(record)
        if self._on_step is not None:
            self._on_step(record)


@torch.no_grad()
def moved_surface(model: GridLBS, points: Tensor, normals: Tensor) -> tuple[Tensor, Tensor]:
    """Return points (N, 3) and their unit normals moved by all F poses of a model, (F, N, 3) each."""
    weights, transforms = model.weights_at(points), model.transforms
    return model.move(points, weights), turned_normals(normals, weights, transforms)


def turned_normals(normals: Tensor, weights: Tensor, transforms: Tensor) -> Tensor:
    """Return unit normals (..., N, 3) of points (N,) with weights (N, B), turned by motions (..., B, 4, 4)."""
    turned = torch.einsum("nb,...bij,nj->...ni", weights, transforms[..., :3, :3], normals)
    return torch.nn.functional.normalize(turned, dim=-1)
