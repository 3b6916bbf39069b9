"""Junctions, tips and curves placed inside a body, if level sets leave them off the axis or outside."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.geometry.mesh import TriangleMesh
from torchreg.spines.labeled_tree import Tips
from torchreg.spines.skeleton.clearance import Clearance, Inside
from torchreg.spines.skeleton.limb_curves import JunctionBall, Rings
from torchreg.spines.skeleton.tip_trees import TipTree, estimate_junction


@dataclass(frozen=True)
class Placement:
    """How junctions, the ends of limbs and points outside are moved into the body."""

    distance_weight: float = 0.25  # clearance that a junction must gain per distance from where the trees place it
    max_candidates: int = 8  # positions from which the clearance of a junction is climbed
    min_distance: float = 1.5  # from the tip to the center of a ring that goes around the limb, in ring widths
    max_skipped: float = 0.4  # share of the limb's rings before the first that goes around it
    extensions: tuple[float, ...] = (0.9, 0.8, 0.7, 0.5)  # from that ring to the height of the tip, first one inside
    cap_rings: int = 6  # nearest the tip, towards which a limb without such an extension ends
    cap_shares: tuple[float, ...] = (0.5, 0.75, 0.9)  # of the path from the tip to their centers, first one inside
    depths: tuple[float, ...] = (0.1, 0.3, 0.6, 1.0)  # behind the surface for points outside, in steps of the curve


_PLACEMENT = Placement()


class Interior:
    """The inside of a closed surface, and the parts of a skeleton that are placed in it."""

    def __init__(self, mesh: TriangleMesh) -> None:
        self.inside, self.clearance = Inside(mesh), Clearance(mesh)

    def junction_ball(self, junction: tuple[Tips, ...], trees: Sequence[TipTree]) -> JunctionBall:
        """Return the largest ball in the middle of the body near where the trees place a junction."""
        position, width = estimate_junction(junction, trees)
        # Between the legs, below a skirt, the position is outside; the centers of rings around it are not.
        centers = torch.cat([tree.sets.centers[branch.rings] for tree in trees for branch in tree.branches])
        near = torch.cat((position[None], centers[(centers - position).norm(dim=-1) <= width]))
        inside = self.inside(near)
        near = near[inside] if inside.any() else near
        middles = self.clearance.ascend(self._widest(near, position)[: _PLACEMENT.max_candidates], float(width))
        center = self._widest(middles, position)[0]
        return JunctionBall(center, float(self.clearance(center[None])[0]))

    def _widest(self, points: Tensor, position: Tensor) -> Tensor:
        """Return points (N, 3) sorted: those first that have a large clearance and are near a position (3,)."""
        score = self.clearance(points) - _PLACEMENT.distance_weight * (points - position).norm(dim=-1)
        return points[score.argsort(descending=True, stable=True)]

    def cap_limb(self, tip: Tensor, rings: Rings) -> tuple[Tensor, Rings]:
        """Return the last point (3,) of a limb, straight on to its tip, and its rings but those near the tip."""
        around = ((rings.centers - tip).norm(dim=-1) > _PLACEMENT.min_distance * rings.widths).nonzero()[:, 0]
        if len(around) and around[0] <= _PLACEMENT.max_skipped * len(rings):
            limb = rings[int(around[0]) :]
            end = self._extension(tip, limb)
            if end is not None:
                return end, limb
        near = rings.centers[: _PLACEMENT.cap_rings]
        if len(near) == 0:
            return tip, rings
        points = tip + torch.tensor(_PLACEMENT.cap_shares, dtype=torch.float64)[:, None] * (near - tip)[:, None]
        valid = self.inside(points) & self.inside(near)[:, None]
        ring, share = valid.nonzero()[0].tolist() if valid.any() else (0, 0)
        return points[ring, share], rings[ring:]

    def _extension(self, tip: Tensor, rings: Rings) -> Tensor | None:
        """Return the end (3,) of a limb extended straight from its first ring towards its tip (3,), None if outside."""
        distance = (rings.centers - rings.centers[0]).norm(dim=-1)
        behind = int((distance >= torch.minimum(rings.widths[0], distance.max())).nonzero()[0, 0])
        direction = torch.nn.functional.normalize(rings.centers[0] - rings.centers[behind], dim=0)
        height = ((tip - rings.centers[0]) @ direction).clamp(min=0)
        shares = torch.tensor(_PLACEMENT.extensions, dtype=torch.float64)
        points = rings.centers[0] + shares[:, None] * height * direction
        inside = self.inside(points)
        return points[int(inside.nonzero()[0, 0])] if height > 0 and inside[-1] else None

    def keep_inside(self, original: Tensor, points: Tensor, spacing: float) -> Tensor:
        """Return a curve's points (n, 3) with those outside moved inside; those that centering moved out go back."""
        points = torch.where((self.inside(original) & ~self.inside(points))[:, None], original, points)
        for depth in _PLACEMENT.depths:
            outside = (~self.inside(points)).nonzero()[:, 0]
            if len(outside) == 0:
                break
            candidates = self.clearance.behind_surface(points[outside], depth * spacing)
            valid = self.inside(candidates)
            points[outside[valid]] = self.clearance.ascend(candidates[valid], spacing)
        return points
