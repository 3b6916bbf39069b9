"""Poses for networks: a module from batches of clouds to poses, fast without gradients, differentiable with them."""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor, nn

from torchreg._checks import check_choice, check_count, check_positive, check_shape
from torchreg.alignment.config import AlignConfig
from torchreg.alignment.evidence.confidence import EVIDENCE, clustered_data
from torchreg.alignment.evidence.reliability import CALIBRATION, pose_confidence
from torchreg.alignment.find_pose import FindPoseConfig, find_pose
from torchreg.alignment.fit.annealed_em import ANNEALING, anneal
from torchreg.alignment.fit.implicit_gradient import FixedPoint, attach_gradients
from torchreg.alignment.fit.objectives import GaussianPosePrior
from torchreg.alignment.fit.problem import BROAD_PRIOR, AlignProblem, centered_problem, masked_mean, soft_inliers
from torchreg.alignment.fit.surface_fit import SURFACE_FIT, fit_surface, surface_noise, surface_objective
from torchreg.alignment.inputs import are_degenerate, check_clouds, check_skin
from torchreg.alignment.search.pose_proposer import PoseProposer, shipped_proposer
from torchreg.alignment.search.rough_poses import DEFAULT_SOURCES, typical_poses
from torchreg.alignment.search.start_source import PROPOSAL_FIT, fitted_proposals, with_proposed_prior
from torchreg.errors import InputError
from torchreg.io.limits import DEFAULT_LIMITS, FileLimits
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.pose_algebra import BASE_DOFS, shifted
from torchreg.shapes.skin import LinearBlendSkin, sample_skin
from torchreg.shapes.surface import FusedSurface


@dataclass(frozen=True)
class _Batching:
    """Number of clouds in one batch."""

    cpu_proposed: int = 32  # of a network and the fits of its poses on a CPU
    cpu_searched: int = 1  # of a search on a CPU, whose caches hold no more
    searched: int = 256  # of a search on other devices, which these keep busy
    cpu_fitted: int = 64  # of fits without gradients on a CPU, where more are no faster
    fitted: int = 4096  # of fits without gradients on other devices, into whose memory these fit


_BATCHING = _Batching()


@dataclass(frozen=True)
class PoseInitializerConfig:
    """Settings of a `PoseInitializer`. Lengths default to shares of the shape's size.

    Args:
        sigma_steps: widths of the annealed EM from a start, from 8 % to 2 % of the size; 0 leaves the EM out.
        em_steps: EM iterations per width.
        surface_steps: steps at each width of the surface fit; 0 leaves the widths above the last out.
        fit_steps: steps, at most, of the last fit, whose stationary point is the pose.
        newton_steps: exact Newton steps after it where gradients are wanted, which make them exact; num_dofs + 1
            backward passes each.
        prior_std: standard deviation of the prior that holds joints near the start, radians; from scratch it draws
            them to what the network proposed, or to a typical pose.
        noise: standard deviation of the data about the surface, metres; by default estimated, cloud by cloud, and then
            held when gradients are taken.
        num_model_points: points sampled on the shape for the EM.
        search: for poses from scratch: "never", the default where a network proposes them, tells by the confidence
            which are doubtful; "doubtful" searches where it is below one half, in seconds; "always", the only way
            without a network.
        find_pose: settings of the search.
        chunk: clouds that are searched at a time; by default one on a CPU, whose caches hold no more, else 256.
        nan_policy: "raise", or "omit" to leave out non-finite data.
    """

    sigma_steps: int = 3
    em_steps: int = AlignConfig.em_steps
    surface_steps: int = AlignConfig.surface_steps
    fit_steps: int = 6
    newton_steps: int = 2
    prior_std: float = 0.3
    noise: float | None = None
    num_model_points: int = 300
    search: str | None = None
    find_pose: FindPoseConfig = field(default_factory=lambda: FindPoseConfig(num_retries=3))
    chunk: int | None = None
    nan_policy: str = "raise"

    def __post_init__(self) -> None:
        check_choice(self.nan_policy, "nan_policy", ("raise", "omit"))
        if self.search is not None:
            check_choice(self.search, "search", ("never", "doubtful", "always"))
        for name in ("sigma_steps", "em_steps", "surface_steps", "newton_steps"):
            check_count(getattr(self, name), name, int(name == "em_steps"))
        for name in ("fit_steps", "num_model_points"):
            check_count(getattr(self, name), name, 1)
        if self.chunk is not None:
            check_count(self.chunk, "chunk", 1)
        check_positive(self.prior_std, "prior_std")
        if self.noise is not None:
            check_positive(self.noise, "noise")


@dataclass(frozen=True)
class InitialPose:
    """Poses found by `PoseInitializer`; without a batch of clouds the dimension B is absent.

    Args:
        pose: (B, num_dofs), metres and radians.
        confidence: (B,) from 0 to 1, without gradients: the share of the data that the pose explains; from scratch
            times the confidence of the search, which falls with limbs of which no data tell where they end.
        keypoints: (B, K, 3) of the shape in the pose, metres.
        registered: (B, N, 3) model points in the pose, metres.
    """

    pose: Tensor
    confidence: Tensor
    keypoints: Tensor
    registered: Tensor


class PoseInitializer(nn.Module):
    """Finds the poses in which a shape lies on a batch of clouds; also a layer, with exact gradients.

    With starts, as from a network or the frame before, an annealed EM and a surface fit take all clouds to their poses
    together; without, a network proposes poses, the best of which is fitted, or `find_pose` searches. Under
    ``torch.no_grad`` that is all. Otherwise the pose, a stationary point of the last fit, takes its gradients from the
    implicit function: in the points, the starts, and the shape's parameters that require them, in memory that does not
    grow with the iterations.

    The last fit is to the shape's solids, also where its file has a mesh: `align` then fits more closely.

    All is computed in the shape's dtype, whatever autocast says; the solve of the backward pass in float64.

    Args:
        shape: the articulated shape, in metres; its parameters get gradients where they require them.
        config: see `PoseInitializerConfig`.
        model_points: a skin of the shape to reuse; sampled on the surface by default.
        proposer: a network that proposes its poses, see `train_initializer`; of the built-in hand one comes with
            torchreg.

    Raises:
        InputError: if ``model_points`` is a skin of another shape, or a search that needs a network has none.

    References: Dewaele et al. 2006, section 3.
    """

    def __init__(
        self,
        shape: ArticulatedShape,
        config: PoseInitializerConfig | None = None,
        *,
        model_points: LinearBlendSkin | None = None,
        proposer: PoseProposer | None = None,
    ) -> None:
        super().__init__()
        self.config = config or PoseInitializerConfig()
        self.shape = shape
        self.proposer = shipped_proposer(shape) if proposer is None else proposer
        if self.proposer is None and self.config.search in ("never", "doubtful"):
            raise InputError(
                f"search={self.config.search!r} needs a network for this shape; train one with tr.train_initializer or "
                "torchreg train-initializer, and give it as proposer="
            )
        count = self.config.num_model_points
        self.skin = check_skin(shape, sample_skin(shape, count) if model_points is None else model_points)

    @classmethod
    def load(
        cls,
        path: str | os.PathLike[str],
        shape: ArticulatedShape,
        config: PoseInitializerConfig | None = None,
        *,
        limits: FileLimits = DEFAULT_LIMITS,
    ) -> PoseInitializer:
        """Return an initializer with the network of a file, as `train_initializer` writes it.

        Args:
            path: weights, ``.safetensors``.
            shape: for which it was trained; it may be larger or smaller.
            config: see `PoseInitializerConfig`.
            limits: of what is read, see `FileLimits`.

        Raises:
            FileNotFoundError: if there is no such file.
            FormatError: if the file is damaged, holds no network, or one for another shape.
        """
        return cls(shape, config, proposer=PoseProposer.load(path, shape, limits=limits))

    def forward(self, points: Tensor, mask: Tensor | None = None, start: Tensor | None = None) -> InitialPose:
        """Return the poses of the shape in clouds.

        Args:
            points: (B, M, 3) or (M, 3), metres; of any floating dtype.
            mask: (B, M) or (M,), False where points are padding. A cloud without points stays at its start.
            start: (B, num_dofs) or (num_dofs,) pose per cloud; searched for if None.

        Returns:
            an `InitialPose`.

        Raises:
            InputError: if a shape does not fit, a number is not finite, or no cloud has a point.
            InputTypeError: if the mask is not of bool.

        Differentiable: in ``points``, ``start`` and the shape's parameters, once; not in which points are outliers to
            be ignored, nor in the estimated noise.

        Cost: of the forward pass O(B M) per step; from scratch .04 s per hand on one CPU core in batches, and seconds
            where it is searched for.
        """
        with torch.autocast(device_type=self.shape.rest.device.type, enabled=False):
            clouds, valid = check_clouds(self.shape, points, mask, self.config.nan_policy, name="points")
            batch, batch_valid = (clouds, valid) if clouds.ndim == 3 else (clouds.unsqueeze(0), valid.unsqueeze(0))
            origin = masked_mean(batch, batch_valid).detach()
            start = None if start is None else self._check_start(start, len(batch))
            if torch.is_grad_enabled():
                pose, confidence = self._poses(batch, batch_valid, start, origin)
            else:
                size = _BATCHING.cpu_fitted if batch.device.type == "cpu" else _BATCHING.fitted
                rows = torch.arange(len(batch), device=batch.device).split(size)
                parts = [
                    self._poses(batch[r], batch_valid[r], None if start is None else start[r], origin[r]) for r in rows
                ]
                pose, confidence = (torch.cat(part) for part in zip(*parts, strict=True))
            keypoints, registered = self.shape.keypoints(pose), self.skin(pose)
        if clouds.ndim == 2:
            pose, confidence, keypoints, registered = pose[0], confidence[0], keypoints[0], registered[0]
        return InitialPose(pose=pose, confidence=confidence, keypoints=keypoints, registered=registered)

    def _check_start(self, start: Tensor, count: int) -> Tensor:
        start = self.shape.check_pose(start, "start")
        if not bool(start.isfinite().all()):
            raise InputError("start must be finite")
        start = start.expand(count, -1) if start.ndim == 1 else start
        check_shape(start, "start", (count, self.shape.num_dofs))
        return start

    def _poses(self, data: Tensor, valid: Tensor, start: Tensor | None, origin: Tensor) -> tuple[Tensor, Tensor]:
        """Return poses (B, num_dofs) and confidences (B,)."""
        if start is None:
            found, mean, confidence = self._find(data.detach(), valid)
        else:
            mean, confidence = start, torch.ones_like(start[:, 0]).detach()
        with torch.no_grad():
            problem = centered_problem(
                self.skin, data, valid, mean, origin, prior_std=self.config.prior_std, pose_atol=0.0,
                debias=AlignConfig.debias,
            )  # fmt: skip
            if start is None:
                pose = self._fit_surface(problem, problem.clamp(shifted(found, -origin)))
            else:
                pose = self._fit_surface(problem, self._anneal(problem, problem.clamp(problem.prior.mean)))
            # The mesh of a file, whose nearest points jump, has no smooth fixed point: the solids have.
            problem = replace(problem, surface=FusedSurface(self.shape))
            fixed, pose = self._last_fit(problem, pose, holds_base=start is not None)
            confidence = confidence * _explained_share(problem, pose)
            confidence = confidence * ~are_degenerate(problem.data, valid, problem.size)
        mean = shifted(mean, -origin)
        if torch.is_grad_enabled() and (data.requires_grad or mean.requires_grad or fixed.parameters):
            centered = torch.where(valid.unsqueeze(-1), data - origin.unsqueeze(1), 0.0)
            pose = fixed.newton_steps(pose, centered, mean, self.config.newton_steps)
            pose = attach_gradients(fixed, pose, centered, mean)
        return shifted(pose, origin), confidence

    def _find(self, data: Tensor, valid: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return poses (B, num_dofs) from scratch, the prior's means, and confidences (B,), zero without points."""
        if self.proposer is None or self.config.search == "always":
            return self._search(data, valid)
        pose, mean, confidence = self._propose(self.proposer, data, valid)
        if self.config.search != "doubtful":
            return pose, mean, confidence
        doubtful = valid & (confidence < CALIBRATION.doubtful).unsqueeze(-1)
        searched, typical, sureness = self._search(data, doubtful)
        surer = (sureness > confidence).unsqueeze(-1)
        poses, means = torch.where(surer, searched, pose), torch.where(surer, typical, mean)
        return poses, means, torch.maximum(confidence, sureness)

    @torch.no_grad()
    def _propose(self, proposer: PoseProposer, data: Tensor, valid: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return pose, prior mean and confidence from a network's proposals."""
        size = _BATCHING.cpu_proposed if data.device.type == "cpu" else _BATCHING.fitted
        typical = typical_poses(self.shape).mean(0)
        parts = []
        for rows in torch.arange(len(data), device=data.device).split(size):
            cloud, known = data[rows], valid[rows]
            origin = masked_mean(cloud, known)
            problem = centered_problem(
                self.skin, cloud, known, shifted(typical.expand(len(rows), -1), origin), origin,
                prior_std=self.config.find_pose.prior_std, pose_atol=0.0,
            )  # fmt: skip
            proposals = proposer.propose(problem.data, known)
            informed = with_proposed_prior(problem, proposals)
            found = fitted_proposals(informed, proposals, PROPOSAL_FIT.kept)
            best = found.poses[:, 0]
            mean = torch.cat([best[:, :BASE_DOFS], informed.prior.mean[:, BASE_DOFS:]], dim=-1)
            confidence = torch.where(known.any(-1), pose_confidence(problem, best, found.lead()), 0.0)
            parts.append((shifted(best, origin), shifted(mean, origin), confidence))
        poses, means, confidences = zip(*parts, strict=True)
        return torch.cat(poses), torch.cat(means), torch.cat(confidences)

    @torch.no_grad()
    def _search(self, data: Tensor, valid: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return what `_find` does of a search; its prior draws joints to a typical pose."""
        pose = typical_poses(self.shape).mean(0).repeat(len(data), 1)
        confidence = torch.zeros_like(pose[:, 0])
        size = _BATCHING.cpu_searched if data.device.type == "cpu" else _BATCHING.searched
        proposer = None if self.config.search == "always" else self.proposer
        found = valid.any(-1).nonzero()[:, 0]
        for rows in found.split(self.config.chunk or size) if len(found) else ():
            starts = find_pose(
                self.shape, data[rows], mask=valid[rows], num_starts=1, sources=DEFAULT_SOURCES, initializer=proposer,
                model_points=self.skin, config=self.config.find_pose,
            )  # fmt: skip
            pose[rows], confidence[rows] = starts.poses[:, 0], starts.confidence
        joints = typical_poses(self.shape).mean(0)[BASE_DOFS:].expand(len(pose), -1)
        return pose, torch.cat([pose[:, :BASE_DOFS], joints], dim=-1), confidence

    def _anneal(self, problem: AlignProblem, pose: Tensor) -> Tensor:
        if not self.config.sigma_steps:
            return pose
        schedule = ANNEALING.schedule(problem.size, self.config.sigma_steps)
        return anneal(problem, pose, schedule, em_steps=self.config.em_steps, m_steps=1).pose

    def _fit_surface(self, problem: AlignProblem, pose: Tensor) -> Tensor:
        if not self.config.surface_steps:
            return pose
        return fit_surface(problem, pose, steps=self.config.surface_steps).pose

    def _last_fit(self, problem: AlignProblem, pose: Tensor, *, holds_base: bool) -> tuple[FixedPoint, Tensor]:
        """Return the energy of the last fit and its stationary pose (B, num_dofs)."""
        noise = surface_noise(problem.surface.distance(problem.data, pose), problem.valid, problem.size)
        if self.config.noise is not None:
            noise = torch.full_like(noise, self.config.noise)
        sigma = SURFACE_FIT.width_per_noise * noise
        precision = problem.prior.precision.clone()
        if holds_base:
            # So weakly that data rule, but a cloud without data leaves the base at its start.
            precision[:BASE_DOFS] = BROAD_PRIOR.precision(self.shape, problem.size)[:BASE_DOFS]
        fixed = FixedPoint(
            shape=self.shape,
            surface=problem.surface,
            valid=problem.valid,
            sigma=sigma,
            noise=noise,
            precision=precision,
            lower=problem.lower,
            upper=problem.upper,
        )
        prior = GaussianPosePrior(problem.prior.mean, precision, holds_base=holds_base)
        objective = surface_objective(problem, sigma, noise, prior)
        return fixed, problem.solve(objective, pose, self.config.fit_steps, objective(pose)).state


def _explained_share(problem: AlignProblem, pose: Tensor) -> Tensor:
    """Return the share (B,) of data near the surface, from 0 to 1, lowered where those off it lie in clusters."""
    near = soft_inliers(problem, problem.surface.distance(problem.data, pose))
    share = near.sum(-1).to(problem.data) / problem.valid.sum(-1).clamp_min(1)
    clustered, on_surface = clustered_data(problem, pose)
    return share * (-clustered.to(share) / on_surface.clamp_min(1) / EVIDENCE.left_over).exp()
