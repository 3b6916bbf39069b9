"""A batch of alignments as every stage sees it: checked data in centered coordinates, limits, prior, sizes."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_shape
from torchreg.alignment.objectives import PosePrior, RegistrationObjective, SurfaceObjective
from torchreg.errors import InputError, InputTypeError, UnitsWarning
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.articulation import Articulation
from torchreg.shapes.kinematics import stack_sizes
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.shapes.surface import FusedSurface, ShapeSurface, SkinSurface, dense_file_skin
from torchreg.solvers.levenberg_marquardt import (
    Linearization,
    LMResult,
    damped_step,
    held_at_limits,
    levenberg_marquardt,
)
from torchreg.solvers.robust import welsch_loss

# Data nearer to the fitted surface than this share of the model's size are inliers.
INLIER_SHARE = 0.02
# How much the prior weighs in a score, in outliers per squared standard deviation.
PRIOR_SHARE = 0.3
# Damping of the single steps that an EM takes, whose objective changes with every E-step anyway.
_EM_DAMPING = 1e-3
# Data and model that differ more than this in size are in different units, if there are enough data to say so.
_UNITS_RATIO, _MIN_DATA = 30.0, 10
_DENSE_SKIN_POINTS = 2500
_BALL = 3


@dataclass(frozen=True)
class AlignProblem:
    """A batch of alignments of one shape: what every stage works on.

    Args:
        skin: the model points.
        surface: what the surface fit fits.
        data: (B, M, 3), metres.
        valid: (B, M) False where padded.
        size: diagonal of the model in its rest pose, metres: the unit of all thresholds.
        lower: limits of the pose, (num_dofs,) or (B, num_dofs).
        upper: limits of the pose, (num_dofs,) or (B, num_dofs).
        prior: on the joints.
        pose_atol: largest change of a pose that counts as none.
        outlier: "limit" or "volume".
        debias: share of the kernel's own pull that is taken from the targets of the EM.
        correspondence: one of `CORRESPONDENCES`.
    """

    skin: LinearBlendSkin
    surface: ShapeSurface
    data: Tensor
    valid: Tensor
    size: float
    lower: Tensor
    upper: Tensor
    prior: PosePrior
    pose_atol: float
    outlier: str = "limit"
    debias: float = 0.0
    correspondence: str = "em"

    def rows(self, index: Tensor) -> AlignProblem:
        """Return the problems of some rows of the batch, which may repeat."""
        return replace(
            self,
            data=self.data[index],
            valid=self.valid[index],
            lower=_rows(self.lower, index),
            upper=_rows(self.upper, index),
            prior=replace(self.prior, mean=self.prior.mean[index]),
        )

    def draw(self, count: int, generator: torch.Generator) -> AlignProblem:
        """Return the problem with at most ``count`` data, drawn from the valid ones, the same alone and in a batch."""
        draw = torch.rand(self.valid.shape[-1], generator=generator).to(self.data)
        keep = torch.where(self.valid, draw, -1.0).topk(min(count, draw.shape[-1]), dim=-1).indices
        data = self.data.gather(1, keep.unsqueeze(-1).expand(*keep.shape, 3))
        return replace(self, data=data, valid=self.valid.gather(1, keep))

    def solve(
        self,
        objective: RegistrationObjective | SurfaceObjective,
        pose: Tensor,
        max_steps: int,
        around: Linearization,
        damping: Tensor | None = None,
    ) -> LMResult:
        """Return what Levenberg-Marquardt within the joint limits makes of a pose around which all is known."""
        return levenberg_marquardt(
            objective, pose, retract=self.skin.shape.retract, lower=self.lower, upper=self.upper,
            damping=damping, max_steps=max_steps, atol=self.pose_atol * min(1.0, self.size),
            start=around, cost=objective.cost,
        )  # fmt: skip

    def step(self, around: Linearization, pose: Tensor, damping: float = _EM_DAMPING) -> LMResult:
        """Return the result of one damped step, without a test: what a generalized EM needs."""
        shares = torch.full_like(pose[:, 0], damping)
        held = held_at_limits(around.gradient, pose, self.lower, self.upper)
        step, _ = damped_step(around, shares, frozen=held)
        return LMResult(self.clamp(self.skin.shape.retract(pose, step)), around.cost, shares, step, 1)

    def change(self, step: Tensor) -> Tensor:
        """Return the largest change (B,) in a step, radians, or metres as a share of the size."""
        return torch.cat([step[:, :3] / self.size, step[:, 3:]], dim=-1).abs().amax(-1)

    def clamp(self, pose: Tensor) -> Tensor:
        """Return poses (..., B, num_dofs) moved inside the limits."""
        return torch.minimum(torch.maximum(pose, self.lower), self.upper)


def _rows(limits: Tensor, index: Tensor) -> Tensor:
    return limits if limits.ndim == 1 else limits[index]


def check_data(shape: ArticulatedShape, data: Tensor, mask: Tensor | None, nan_policy: str) -> tuple[Tensor, Tensor]:
    """Return the data in the shape's dtype and which of them count (False for padding and points left out).

    Raises:
        InputError: if the data are empty, not finite, or do not fit the mask.
        InputTypeError: if something has the wrong type.
    """
    data = as_float_tensor(data, "data", like=shape.rest)
    if data.ndim not in (2, 3):
        raise InputError(f"data must have shape (M, 3) or (B, M, 3), got {tuple(data.shape)}")
    check_shape(data, "data", ("M", 3), batch=True)
    if data.shape[-2] == 0 or data.shape[0] == 0:
        raise InputError(f"data must hold at least one point, got shape {tuple(data.shape)}")
    valid = torch.ones_like(data[..., 0], dtype=torch.bool)
    if mask is not None:
        if not isinstance(mask, Tensor) or mask.dtype != torch.bool:
            raise InputTypeError("mask must be a tensor of bool, False where data are padding")
        if mask.shape != valid.shape:
            raise InputError(f"mask must have shape {tuple(valid.shape)} like the data, got {tuple(mask.shape)}")
        valid = mask.to(data.device)
    finite = torch.isfinite(data).all(-1)
    bad = int((valid & ~finite).sum())
    if bad and nan_policy == "raise":
        raise InputError(f"data hold {bad} points that are not finite; drop them or set nan_policy='omit'")
    valid = valid & finite
    if not bool(valid.any()):
        raise InputError("data hold no point that is finite and not masked")
    return torch.where(valid.unsqueeze(-1), data, 0.0), valid


def masked_mean(data: Tensor, valid: Tensor) -> Tensor:
    """Return the mean (B, 3) of the valid data of each cloud."""
    return (data * valid.unsqueeze(-1)).sum(-2) / valid.sum(-1, keepdim=True).clamp_min(1)


def shifted(pose: Tensor, offset: Tensor) -> Tensor:
    """Return poses (..., num_dofs) with the base moved by offsets (..., 3)."""
    return torch.cat([pose[..., :3] + offset, pose[..., 3:]], dim=-1)


def centered_problem(
    skin: LinearBlendSkin,
    data: Tensor,
    valid: Tensor,
    pose: Tensor,
    origin: Tensor,
    *,
    prior_std: float | None,
    pose_atol: float,
    outlier: str = "limit",
    debias: float = 0.0,
    correspondence: str = "em",
) -> AlignProblem:
    """Return a batch of alignments in coordinates with the origin, of each cloud, at zero: there float32 is precise.

    Args:
        skin: the model points.
        data: (B, M, 3), metres, in the world.
        valid: (B, M) False where padded.
        pose: (B, num_dofs) mean of the prior, in the world.
        origin: (B, 3), as from `masked_mean`.
        prior_std: see `AlignConfig`, like the others.
        pose_atol: largest change of a pose that counts as none.
        outlier: "limit" or "volume".
        debias: share of the kernel's own pull that is taken from the targets of the EM.
        correspondence: who matches whom.
    """
    shape = skin.shape
    size = float((skin.points.amax(0) - skin.points.amin(0)).norm())
    shift = torch.nn.functional.pad(origin, (0, shape.num_dofs - 3))
    lower, upper = shape.lower, shape.upper
    if not bool(torch.isinf(shape.lower[:3]).all()):
        lower, upper = shape.lower - shift, shape.upper - shift
    precision = torch.zeros_like(shape.rest)
    if prior_std is not None:
        joints = torch.where(shape.is_sliding[6:], prior_std * size, prior_std)
        precision[6:] = joints.square().reciprocal()
        # The three axes of a ball joint share the deviation of its one rotation.
        balls = [6 + dof for dof, size in enumerate(stack_sizes(shape.chain.tree)) if size >= _BALL]
        precision[balls] *= _BALL
    return AlignProblem(
        skin=skin,
        surface=_surface(shape, skin),
        data=torch.where(valid.unsqueeze(-1), data - origin.unsqueeze(1), 0.0),
        valid=valid,
        size=size,
        lower=lower,
        upper=upper,
        prior=PosePrior(pose - shift, precision),
        pose_atol=pose_atol,
        outlier=outlier,
        debias=debias,
        correspondence=correspondence,
    )


def _surface(shape: Articulation, skin: LinearBlendSkin) -> ShapeSurface:
    """Return what is fitted: the file's own surface where there is one, else the fused solids."""
    if shape.surface is None:
        return FusedSurface(shape)
    dense = skin if len(skin) >= _DENSE_SKIN_POINTS and skin.normals is not None else dense_file_skin(shape)
    return SkinSurface(dense)


def alignment_cost(problem: AlignProblem, pose: Tensor, distances: Tensor | None = None) -> Tensor:
    """Return the cost (B,) by which alignments of the same data are ranked: outliers, softly counted, and the prior."""
    distances = problem.surface.distance(problem.data, pose) if distances is None else distances
    lost = welsch_loss((distances / (INLIER_SHARE * problem.size)).square())
    return (lost * problem.valid).sum(-1) + PRIOR_SHARE * problem.prior.cost(pose)


def warn_about_units(problem: AlignProblem, stacklevel: int = 3) -> None:
    """Warn if the spread of the data does not fit the size of the model, as with millimeters for metres."""
    radius = problem.data.norm(dim=-1)
    spread = 2 * torch.where(problem.valid, radius, torch.nan).nanmedian(-1).values
    ratio = float(spread.nanmedian()) / problem.size
    if int(problem.valid.sum(-1).max()) >= _MIN_DATA and not 1 / _UNITS_RATIO < ratio < _UNITS_RATIO:
        warnings.warn(
            f"the data spread over {ratio:.3g} times the model's size of {problem.size:.3g} m: are they in metres? "
            f"Scale them, by 0.001 if they are in millimeters",
            UnitsWarning,
            stacklevel=stacklevel,
        )
