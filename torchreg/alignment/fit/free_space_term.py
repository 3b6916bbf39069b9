"""What a depth picture says against a pose: posed skin points that lie where it saw nothing."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

from torch import Tensor

from torchreg.alignment.fit.objectives import Factor
from torchreg.capture.free_space import FreeSpace
from torchreg.geometry.neighbors import sampling_distance
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.solvers.levenberg_marquardt import Linearization
from torchreg.solvers.robust import welsch_cost, welsch_loss, welsch_system


@dataclass(frozen=True)
class Intrusion:
    """Numbers of what lies in free space."""

    tolerance: float = 0.012  # of the model's size that solids and skins are not exact: nearer is on the surface
    shown: float = 0.25  # of its area that a surface shows from a direction, on average (Cauchy)


INTRUSION = Intrusion()


@dataclass(frozen=True, eq=False)
class FreeSpaceTerm(Factor):
    """The cost of skin points of some area, square metres, in free space, beyond a tolerance, metres."""

    beside_matches: ClassVar[bool] = False
    free_space: FreeSpace
    skin: LinearBlendSkin
    area: float
    tolerance: float

    @classmethod
    def of_skin(cls, free_space: FreeSpace, skin: LinearBlendSkin, size: float) -> FreeSpaceTerm:
        """Return the term for a skin that covers a shape of some size evenly."""
        return cls(free_space, skin, sampling_distance(skin.points) ** 2, INTRUSION.tolerance * size)

    def for_skin(self, skin: LinearBlendSkin) -> FreeSpaceTerm:
        """Return the term for another skin of the shape."""
        return replace(self, skin=skin, area=sampling_distance(skin.points) ** 2)

    def rows(self, index: Tensor) -> FreeSpaceTerm:
        """Return the term for some problems, which may repeat."""
        return replace(self, free_space=self.free_space.rows(index))

    def thinned(self, factor: Tensor) -> FreeSpaceTerm:
        """Return the term for data of which each stands for (B,) times as many."""
        return replace(self, free_space=self.free_space.thinned(factor))

    def weight(self) -> Tensor:
        """Return how many data a skin point stands for, (B,)."""
        space = self.free_space
        # In the problems' coordinates the data lie around the origin.
        depth = space.depths(space.datum_area.new_zeros(len(space.picture), 1, 3))[:, 0]
        return INTRUSION.shown * self.area / (space.datum_area * depth.square()).clamp_min(1e-12)

    def intrusion(self, points: Tensor) -> Tensor:
        """Return by how much points (B, ..., 3) are farther in free space than is tolerated, (B, ...), metres."""
        return (self.free_space.intrusion(points) - self.tolerance).clamp_min(0)

    def score(self, pose: Tensor, width: float) -> Tensor:
        """Return the number of data (B, ...), softly counted, that skin points in free space stand for."""
        counted = welsch_loss((self.intrusion(self.skin(pose)) / width).square()).sum(-1)
        return counted * self.weight().reshape(-1, *[1] * (counted.ndim - 1))

    def cost(self, pose: Tensor, sigma: Tensor, noise: Tensor) -> Tensor:
        """Return the cost (B,) of poses in the units of a surface fit of widths and noises (B,)."""
        return welsch_cost(self.intrusion(self.skin(pose)), self.weight().unsqueeze(-1), sigma, noise)

    def linearized(self, pose: Tensor, sigma: Tensor, noise: Tensor) -> Linearization:
        """Return cost, gradient and Gauss-Newton Hessian at poses (B, num_dofs)."""
        rows, derivative = self.skin.shape.transform_jacobian(pose, chart="tangent")
        points = self.skin.place(rows)
        # Where points do not intrude, and few do, cost and derivatives are zero.
        index, intrusion, slope = self.free_space.intruding(points, self.tolerance)
        residual = (intrusion - self.tolerance).clamp_min(0)
        along = (self.skin.basis[index].unsqueeze(-1) * slope.unsqueeze(-2)).flatten(-2)
        jacobian = (along @ derivative.flatten(-3, -2)) * (residual > 0).unsqueeze(-1)
        return welsch_system(residual, jacobian, self.weight().unsqueeze(-1), sigma, noise)
