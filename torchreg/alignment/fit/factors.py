"""What a problem's poses are judged by beside data and prior: a list of factors, each in a file of its own."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar, Self

from torch import Tensor

from torchreg.shapes.skin import LinearBlendSkin
from torchreg.solvers.levenberg_marquardt import Linearization


class Factor(ABC):
    """Evidence about the poses (B, num_dofs) of a batch, such as keypoints or the free space of a picture.

    A new kind of evidence is a subclass and an entry of `AlignProblem.factors`: fits, searches, rankings, covariances
    sum over that list. Costs are negative log-likelihoods of data with the noise of the fit.
    """

    beside_matches: ClassVar[bool] = True  # False: only the surface fit counts it, not the EM

    @abstractmethod
    def rows(self, index: Tensor) -> Self:
        """Return the factor for some problems, which may repeat."""

    @abstractmethod
    def linearized(self, pose: Tensor, sigma: Tensor, noise: Tensor) -> Linearization:
        """Return cost, gradient and Gauss-Newton Hessian in a fit with kernel widths and noises (B,), metres."""

    @abstractmethod
    def cost(self, pose: Tensor, sigma: Tensor, noise: Tensor) -> Tensor:
        """Return that cost alone (B,)."""

    @abstractmethod
    def score(self, pose: Tensor, width: float) -> Tensor:
        """Return the cost (B, ...) of poses (B, ..., num_dofs) in unexplained data, within a width in metres."""

    def thinned(self, factor: Tensor) -> Self:
        """Return the factor beside data of which each stands for (B,) times as many."""
        return self

    def for_skin(self, skin: LinearBlendSkin) -> Self:
        """Return the factor for other model points that cover the shape as evenly."""
        return self

    def informed(self, covariance: Tensor, pose: Tensor) -> Tensor:
        """Return the covariance (B, num_dofs, num_dofs) of poses that others determine, with what this one adds."""
        return covariance

    def seen_parts(self) -> set[int]:
        """Return the parts of the shape that this factor alone locates in any of the problems."""
        return set()
