"""Algorithm 1 of Chang and Zwicker 2009 as printed: random segmentation, spin images, T-steps and W-steps in turn."""

from __future__ import annotations

import torch
from torch import Tensor

from torchreg.geometry.range_scan import RangeScan
from torchreg.registration.annealing import geometric_at
from torchreg.registration.bones.alternation import moved_surface
from torchreg.registration.bones.closest_compatible import CompatibleMatcher, CompatibleMatches
from torchreg.registration.bones.config import BoneConfig, OnRegisterStep
from torchreg.registration.bones.correspondences import Correspondences
from torchreg.registration.bones.grid_lbs import GridLBS
from torchreg.registration.bones.grid_losses import JointEnergy
from torchreg.registration.bones.joint_moments import NEGLIGIBLE, JointMoments
from torchreg.registration.bones.labels import CellData, LabelCosts, relabel
from torchreg.registration.bones.motion_problem import BoneProblem
from torchreg.registration.bones.motions import fit_bones
from torchreg.registration.bones.registration_energy import EnergyState
from torchreg.registration.bones.step_record import cut_edges, reported_weights, step_record
from torchreg.registration.bones.weights import refine_weights
from torchreg.registration.paper.config import PaperConfig
from torchreg.registration.paper.segmentation import best_candidates, nearest_seed, reuse_labels
from torchreg.registration.paper.spin_matches import spin_matches
from torchreg.registration.results import RegisterRecord


class PaperFit:
    """A registration under way, in units of the source's diagonal; ``labels`` (C,) are bones of cells, without gaps."""

    def __init__(
        self,
        data: CellData,
        source: RangeScan,
        index: Tensor,
        target: RangeScan,
        config: BoneConfig,
        paper: PaperConfig,
        *,
        num_bones: int,
        generator: torch.Generator | None = None,
        on_step: OnRegisterStep | None = None,
    ) -> None:
        self.data, self.config, self._paper = data, config, paper
        self._source, self._index = source, index
        self._generator = torch.Generator().manual_seed(0) if generator is None else generator
        self._num_bones, self._on_step = num_bones, on_step
        self.matchers = [CompatibleMatcher(target, config.normal_scale)]
        self.history: list[RegisterRecord] = []
        self._matches: list[CompatibleMatches] = []
        self._progress = 0.0
        self._edges = data.grid.edges()
        self._term_weights = reported_weights(config)
        self._start()

    def _start(self) -> None:
        """Segment the grid at random and match spin images, or closest points: lines 1 and 2."""
        grid, points = self.data.grid, self._source.points
        seeds = points[best_candidates(points, self._num_bones, self._generator)]
        used, labels = nearest_seed(grid.cell_centers(), seeds).unique(return_inverse=True)
        corners = nearest_seed(grid.corner_points(), seeds[used])
        self.labels = labels
        self.model = GridLBS(grid, torch.nn.functional.one_hot(corners, len(used)).to(points))
        if self._paper.first_matches == "closest":
            self.model.set_transforms_(self.model.transforms.detach()[None])
            self.update_correspondences()
            return
        matches = spin_matches(
            self._source, self._index, self.matchers[0].target, labels[self.data.cell], len(used), self._paper,
            bin_size=grid.spacing, generator=self._generator,
        )  # fmt: skip
        self.model.set_transforms_(matches.motions[None])
        self.correspondences = Correspondences(
            matches.targets[None], matches.normals[None], matches.kept.to(points)[None], point_to_point=0.0
        )

    def fit_labels(self) -> bool:
        """Alternate T-steps and W-steps, each followed by new correspondences, and return whether they converged.

        References: Chang and Zwicker 2009, algorithm 1, lines 3 to 8.
        """
        paper, lowest = self._paper, float("inf")
        for step in range(paper.max_rounds):
            self._progress = min(step / paper.annealing_rounds, 1.0)
            self.solve_motions()  # line 4
            self.update_correspondences()  # line 5
            energy = self.solve_labels()  # line 6
            self.update_correspondences()  # line 7
            self._report("align", step, paper.max_rounds)
            if step >= paper.annealing_rounds and energy >= (1 - paper.rtol) * lowest:
                return True
            if step + 1 < paper.max_rounds:
                self._reuse_labels()
            lowest = min(lowest, energy) if step >= paper.annealing_rounds else lowest
        return False

    def refine(self) -> bool:
        """Solve for continuous weights, eqs. 8 and 13, the optional line 9; return whether the solver converged."""
        if self.config.refine_steps == 0:
            return True
        found = refine_weights(self.model, self._samples, self.correspondences, self.config.refine)
        self.model = GridLBS(self.data.grid, found.weights, self.model.transforms.detach())
        self.update_correspondences()
        self._report("refine", 0, 1)
        return found.converged

    def solve_motions(self) -> None:
        """Fit the bones' motions to the correspondences while the joint integrals hold them together: eqs. 4 and 5."""
        weights = self.model.weights_at(self._samples).detach()
        moments = self.model.joint_moments()
        problem = BoneProblem.of_weights(
            self._samples,
            weights,
            self.correspondences,
            moments=moments,
            joint_weight=self._stiffness,
            pair_weights=self._shared_cells(moments),
        )
        fit = fit_bones(problem, self.model.transforms.detach(), max_steps=self.config.motion_steps)
        self.model.set_transforms_(fit.transforms)

    def update_correspondences(self) -> None:
        """Match the moved samples with the closest compatible points of the target, under the angle of the round."""
        (moved,), (normals,) = self.moved(self._samples, self._source.normals[self._index])
        (matcher,) = self.matchers
        found = matcher.match(
            moved,
            normals,
            max_distance=self._paper.max_distance * self._source.spacing,
            max_angle=geometric_at(self.config.max_angle, self._progress),
        )
        self._matches = [found]
        self.correspondences = Correspondences(
            found.targets[None], found.normals[None], found.kept.to(moved)[None], point_to_point=0.0
        )

    def solve_labels(self) -> float:
        """Label the cells anew: eqs. 11 and 12; drop bones without a cell, and return the energy."""
        transforms = self.model.transforms.detach()
        labels, energy = relabel(self.data, self.correspondences, transforms, self.labels, self._costs)
        used, self.labels = labels.unique(return_inverse=True)
        self.model = GridLBS.from_labels(self.data.grid, self.labels, len(used), transforms[:, used])
        return energy

    def _reuse_labels(self) -> None:
        """Give unused labels to halves of the worst regions, which start from the motion of the whole."""
        before, weights = self.labels, self.correspondences.weights[0]
        squares = weights * self.correspondences.squared_residuals(self.model(self._samples))[0]
        self.labels = reuse_labels(
            self.data, squares, before, self._num_bones,
            least_error=self._paper.reuse_error * self._source.spacing, generator=self._generator,
        )  # fmt: skip
        origin = torch.stack([before[self.labels == label][0] for label in range(int(self.labels.max()) + 1)])
        transforms = self.model.transforms.detach()[:, origin]
        self.model = GridLBS.from_labels(self.data.grid, self.labels, len(origin), transforms)

    def moved(self, points: Tensor, normals: Tensor) -> tuple[Tensor, Tensor]:
        """Return points (N, 3) and their unit normals moved, (1, N, 3) each."""
        return moved_surface(self.model, points, normals)

    @property
    def _samples(self) -> Tensor:
        return self.data.points

    @property
    def _stiffness(self) -> float:
        """Beta over alpha n: the distance is a sum over correspondences as printed, and a mean in `BoneProblem`."""
        return self.config.joint_weight_at(self._progress) / max(1.0, float(self.correspondences.weights.sum()))

    def _shared_cells(self, moments: JointMoments) -> Tensor:
        """Return the number (P,) of cells that both bones of each pair reach: each cell has a joint term of its own."""
        reached = (self.model.weights.detach() > NEGLIGIBLE.weight)[self.data.grid.cell_corners].any(1)
        first, second = (reached[:, bones].to(moments.mass) for bones in moments.pairs.unbind(-1))
        return (first * second).sum(0)

    @property
    def _costs(self) -> LabelCosts:
        cells = self._paper.max_distance * self._source.spacing / self.data.grid.spacing
        return LabelCosts(smoothness=self.config.smoothness, label=0.0, truncation=cells)

    @torch.no_grad()
    def _report(self, stage: str, step: int, num_steps: int) -> None:
        labeled = GridLBS.from_labels(self.data.grid, self.labels, self.model.num_bones)
        state = EnergyState(
            model=self.model,
            transforms=self.model.transforms,
            points=self._samples,
            correspondences=self.correspondences,
            edges=self._edges,
            label_weights=labeled.weights,
        )
        record = step_record(
            state,
            self._term_weights,
            cut_edges=cut_edges(self.labels, self.data),
            joint=float(JointEnergy()(self.model.transforms[0], state.moments)),
            matches=self._matches,
            at=(stage, step, num_steps),
        )
        self.history.append(record)
        if self._on_step is not None:
            self._on_step(record)
