"""A prior of poses: a Gaussian by the mean and principal components of known poses, within the joint limits."""

from __future__ import annotations

import math
import os
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from torchreg._checks import as_float_tensor, check_count, check_positive, check_shape
from torchreg.errors import FormatError, InputError, InputTypeError
from torchreg.geometry.rotation import compose_rotation_vectors
from torchreg.geometry.rotation_representations import quaternion_from_rotation_vector, rotation_vector_from_quaternion
from torchreg.io.limits import DEFAULT_LIMITS, FileLimits
from torchreg.io.tensors import load_tensors, save_tensors
from torchreg.shapes.pose_algebra import BASE_DOFS, difference, retract
from torchreg.shapes.pose_head import PoseHead

if TYPE_CHECKING:
    from torchreg.shapes.articulated import ArticulatedShape

_KIND = "PosePrior"
# Steps to the mean rotation, quadratically convergent from the chordal mean.
_MEAN_STEPS = 20
# Standard deviation of the excess of a joint over its limits, radians or metres.
_LIMIT_STD = 0.05


class PosePrior(nn.Module):
    """A Gaussian on poses around a mean one, ``C = sum_k s_k^2 c_k c_k^T + r^2 I``, with soft joint limits.

    It is defined in the tangent space of the mean pose: the base's rotation differs from the mean by composition,
    ``exp(step) exp(mean)``, so that no rotation is singular. Base and joints have separate components, so that metres
    and radians do not mix. A prior with a free base is uniform over the base's pose.

    Args:
        mean: (num_dofs,), metres and radians.
        components: (K, num_dofs) orthonormal directions in the tangent space; those of the base, if any, come first,
            all six.
        deviations: (K,) standard deviations along them.
        residual: standard deviation of the joints in all other directions.
        lower: (num_dofs,) limits.
        upper: (num_dofs,) limits.
        has_base: whether the first six components are the base's.

    Raises:
        InputError: if sizes do not fit, or a deviation is not positive.

    References: Tipping and Bishop 1999, Probabilistic principal component analysis.
    """

    mean: Tensor
    components: Tensor
    deviations: Tensor
    lower: Tensor
    upper: Tensor

    def __init__(
        self,
        mean: Tensor,
        components: Tensor,
        deviations: Tensor,
        residual: float,
        *,
        lower: Tensor,
        upper: Tensor,
        has_base: bool,
    ) -> None:
        super().__init__()
        check_shape(mean, "mean", ("num_dofs",))
        check_shape(components, "components", ("K", len(mean)))
        check_shape(deviations, "deviations", (len(components),))
        check_shape(lower, "lower", (len(mean),))
        check_shape(upper, "upper", (len(mean),))
        check_positive(residual, "residual")
        if not bool((deviations > 0).all()):
            raise InputError("deviations must be positive")
        self.residual, self.has_base = float(residual), bool(has_base)
        for name, value in zip(
            ("mean", "components", "deviations", "lower", "upper"),
            (mean, components, deviations, lower, upper),
            strict=True,
        ):
            self.register_buffer(name, value.detach().clone())

    @classmethod
    def fit(
        cls,
        shape: ArticulatedShape,
        poses: Tensor,
        *,
        num_components: int | None = None,
        explained: float = 0.98,
        base: bool = True,
        min_deviation: float = 1e-3,
    ) -> PosePrior:
        """Return the prior of given poses, such as tracked ones; those that are not finite (lost frames) are left out.

        Args:
            shape: the shape whose poses they are.
            poses: (T, num_dofs), at least two of them finite.
            num_components: of the joints; by default as many as explain the share ``explained``.
            explained: share of the joints' variance to explain.
            base: whether the base has a prior too.
            min_deviation: least standard deviation along any direction, radians and metres.

        Returns:
            The prior, in the shape's dtype and on its device.

        Raises:
            InputError: if fewer than two poses are finite, or a number is out of range.
        """
        check_positive(min_deviation, "min_deviation")
        check_positive(explained, "explained")
        num_joints = shape.num_dofs - BASE_DOFS
        if num_components is not None:
            check_count(num_components, "num_components", 0)
        poses = as_float_tensor(poses, "poses", like=shape.rest).detach().double()
        check_shape(poses, "poses", ("T", shape.num_dofs))
        poses = poses[poses.isfinite().all(-1)]
        if len(poses) < 2:
            raise InputError(f"poses must hold at least two finite poses, got {len(poses)}")
        mean = torch.cat([poses[:, :3].mean(0), _mean_rotation(poses[:, 3:BASE_DOFS]), poses[:, BASE_DOFS:].mean(0)])
        tangent = difference(mean, poses)
        values, vectors = _principal(tangent[:, BASE_DOFS:])
        share = values.cumsum(0) / values.sum().clamp_min(1e-300)
        count = int((share < min(explained, 1.0)).sum()) + 1 if num_components is None else num_components
        count = min(count, num_joints)
        rows = [nn.functional.pad(vectors[:count], (BASE_DOFS, 0))]
        deviations = [values[:count].sqrt()]
        if base:
            base_values, base_vectors = _principal(tangent[:, :BASE_DOFS])
            rows.insert(0, nn.functional.pad(base_vectors, (0, num_joints)))
            deviations.insert(0, base_values.sqrt())
        unexplained = values[count:]
        residual = math.sqrt(float(unexplained.mean())) if len(unexplained) else 0.0
        prior = cls(
            mean, torch.cat(rows), torch.cat(deviations).clamp_min(min_deviation), max(residual, min_deviation),
            lower=shape.lower, upper=shape.upper, has_base=base,
        )  # fmt: skip
        return prior.to(shape.rest)

    @property
    def num_components(self) -> int:
        """Number of components, those of the base included."""
        return len(self.components)

    def forward(self, coefficients: Tensor) -> Tensor:
        """Return the poses of coefficients, in standard deviations along the components; joint limits are not applied.

        Args:
            coefficients: (..., K).

        Returns:
            (..., num_dofs).

        Raises:
            InputError: if the last size is not K.

        Differentiable: in ``coefficients``.
        """
        check_shape(coefficients, "coefficients", (self.num_components,), batch=True)
        return retract(self.mean, (coefficients * self.deviations) @ self.components)

    def coefficients(self, pose: Tensor) -> Tensor:
        """Return the coefficients (..., K) of poses (..., num_dofs), the inverse of `forward` up to the residual.

        Raises:
            InputError: if the pose has the wrong size.

        Differentiable: in ``pose``, where its base is not a half turn from the mean's.
        """
        check_shape(pose, "pose", (len(self.mean),), batch=True)
        return difference(self.mean, pose) @ self.components.mT / self.deviations

    def log_prob(self, pose: Tensor) -> Tensor:
        """Return the log density of poses in tangent coordinates, less half the squared excess over the joint limits.

        The excess is in twentieths of a radian (of a metre for sliding joints), and the density is not renormalized for
        the limits. A free base does not count.

        Args:
            pose: (..., num_dofs).

        Returns:
            (...).

        Raises:
            InputError: if the pose has the wrong size.

        Differentiable: in ``pose``, where its base is not a half turn from the mean's.
        """
        check_shape(pose, "pose", (len(self.mean),), batch=True)
        tangent = difference(self.mean, pose)
        along = tangent @ self.components.mT
        joints = self.components[BASE_DOFS:] if self.has_base else self.components
        beyond = tangent[..., BASE_DOFS:] - (tangent @ joints.mT) @ joints[:, BASE_DOFS:]
        squared = (along / self.deviations).square().sum(-1) + (beyond / self.residual).square().sum(-1)
        num_residual = beyond.shape[-1] - len(joints)
        volume = self.deviations.log().sum() + num_residual * math.log(self.residual)
        volume = volume + 0.5 * (self.num_components + num_residual) * math.log(2 * math.pi)
        low, high = self.lower[BASE_DOFS:], self.upper[BASE_DOFS:]
        excess = (low - pose[..., BASE_DOFS:]).clamp_min(0) + (pose[..., BASE_DOFS:] - high).clamp_min(0)
        return -0.5 * squared - volume - 0.5 * (excess / _LIMIT_STD).square().sum(-1)

    @torch.no_grad()
    def sample(self, count: int, generator: torch.Generator | None = None) -> Tensor:
        """Return poses (count, num_dofs) drawn from the Gaussian and clamped to the limits; a free base at the mean.

        Args:
            count: number of poses.
            generator: on the CPU; one with seed 0 by default.

        Raises:
            InputError: if ``count`` is negative.
        """
        check_count(count, "count", 0)
        generator = generator or torch.Generator().manual_seed(0)
        draw = torch.randn(count, self.num_components, generator=generator, dtype=torch.float32).to(self.mean)
        noise = self.residual * torch.randn(
            count, len(self.mean) - BASE_DOFS, generator=generator, dtype=torch.float32
        ).to(self.mean)
        joints = self.components[BASE_DOFS:, BASE_DOFS:] if self.has_base else self.components[:, BASE_DOFS:]
        noise = noise - (noise @ joints.mT) @ joints
        step = (draw * self.deviations) @ self.components
        pose = retract(self.mean, step + nn.functional.pad(noise, (BASE_DOFS, 0)))
        return torch.minimum(torch.maximum(pose, self.lower), self.upper)

    @torch.no_grad()
    def init_head_(self, linear: nn.Linear, head: PoseHead | None = None) -> nn.Linear:
        """Return a regressor's last layer after setting it to the mean pose plus likely deviations.

        The bias becomes the mean pose; uncorrelated features of zero mean and unit variance give the covariance of the
        prior. Components are spread over all features by rows of the discrete cosine transform: each row sums to zero,
        so that a common offset of the features, as after a ReLU, moves no pose.

        Args:
            linear: from features to poses, or to the inputs of ``head``; with a bias.
            head: that follows the layer, if any; then components are mapped to its inputs to first order.

        Raises:
            InputTypeError: if ``linear`` is no linear layer with a bias.
            InputError: if its output is not as large as a pose, or as the head's input.

        References: Saxe et al. 2014 for orthogonal initial weights.
        """
        if not isinstance(linear, nn.Linear) or linear.bias is None:
            raise InputTypeError("linear must be a torch.nn.Linear with a bias")
        size = len(self.mean) if head is None else head.num_features
        if linear.out_features != size:
            raise InputError(f"linear must have {size} outputs, got {linear.out_features}")

        def outputs(coefficients: Tensor) -> Tensor:
            pose = self(coefficients)
            return pose if head is None else head.features(pose)

        zero = torch.zeros_like(self.deviations)
        with torch.enable_grad():
            basis = torch.autograd.functional.jacobian(outputs, zero)
        count = min(self.num_components, linear.in_features - 1)
        strongest = basis.norm(dim=0).argsort(descending=True)[:count]
        weight = basis[:, strongest] @ _cosine_rows(count, linear.in_features).to(basis)
        linear.weight.copy_(weight)
        linear.bias.copy_(outputs(zero))
        return linear

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the prior to ``path``, which ends in .safetensors, and a JSON file next to it; see `load`."""
        tensors = dict(self.named_buffers())
        save_tensors(path, tensors, {"kind": _KIND, "residual": self.residual, "has_base": self.has_base})

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, limits: FileLimits = DEFAULT_LIMITS) -> PosePrior:
        """Return the prior that `save` wrote, on the CPU.

        Raises:
            FileNotFoundError: if there is no such file.
            FormatError: if the file is damaged or holds no prior.
        """
        tensors, record = load_tensors(path, limits=limits)
        if record.get("kind") != _KIND:
            raise FormatError(f"{path}: holds no {_KIND} but a {record.get('kind')!r}")
        try:
            return cls(**tensors, residual=record["residual"], has_base=record["has_base"])
        except (KeyError, TypeError, InputError) as error:
            raise FormatError(f"{path}: is no complete {_KIND} ({error})") from error


def _mean_rotation(vectors: Tensor) -> Tensor:
    """Return the rotation vector (3,) of least squared angles to all given ones (T, 3)."""
    quaternions = quaternion_from_rotation_vector(vectors)
    mean = rotation_vector_from_quaternion(torch.linalg.eigh(quaternions.mT @ quaternions).eigenvectors[:, -1])
    for _ in range(_MEAN_STEPS):
        mean = compose_rotation_vectors(compose_rotation_vectors(vectors, -mean.expand_as(vectors)).mean(0), mean)
    return mean


def _principal(steps: Tensor) -> tuple[Tensor, Tensor]:
    """Return the variances along the principal directions, largest first, and these directions as rows."""
    covariance = steps.mT @ steps / max(1, len(steps) - 1)
    values, vectors = torch.linalg.eigh(covariance)
    return values.flip(0).clamp_min(0), vectors.mT.flip(0)


def _cosine_rows(count: int, size: int) -> Tensor:
    """Return orthonormal rows (count, size) of the discrete cosine transform, without the constant one."""
    phase = (torch.arange(size, dtype=torch.float64) + 0.5) * math.pi / size
    frequency = torch.arange(1, count + 1, dtype=torch.float64)
    return math.sqrt(2 / size) * (frequency.unsqueeze(-1) * phase).cos()
