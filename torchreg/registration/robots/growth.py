"""Links of a robot whose scans are far apart, found one after another from the one that moved least outward."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg.geometry.graphs import connected_components
from torchreg.geometry.neighbors import NeighborTree
from torchreg.geometry.rigid import invert_rigid, rigid_matrix, transform_points
from torchreg.registration.robots.pieces import Piece, rotations_and_hinge
from torchreg.registration.robots.surfaces import Surfaces


@dataclass(frozen=True)
class GrowthNumbers:
    """Of the search for one link after another; lengths in distances between points of a scan."""

    reach: float = 2.5  # 99 of 100 points of a surface are as near to one of another sample of it
    along: float = 2.0  # as far along a plane nothing is an error
    explained: float = 0.45  # of an outlier's cost, from which a sample is one: right motions cost .15, wrong ones .8
    taken: float = 3.75  # from a link: nearer points of a scan are the link's
    pieces: tuple[int, ...] = (40, 100, 250)  # samples: a piece may be one small link, or must be a large one
    free: float = 0.95  # of what a free motion explains, counts beside a hinge
    enough: float = 0.8  # of what is open, from which larger pieces are not tried
    registered: float = 0.9  # of the samples, from which what registration left needs no search
    least: int = 12  # samples of a link
    most: int = 40  # links
    root: tuple[float, ...] = (8.0, 6.0, 4.0, 3.0, 2.0, 1.0, 1.0)  # kernels by which the first link is fitted
    others: tuple[float, ...] = (2.0, 1.0, 1.0)  # and all others
    fits: int = 2  # of each to what it explains


GROWTH = GrowthNumbers()


@dataclass(frozen=True, eq=False)
class Front:
    """Samples (k,) that no link explains, and those (b,) at the border of these and of a link."""

    link: int
    open: Tensor
    border: Tensor

    @property
    def key(self) -> tuple[int, ...]:
        """What a front that led to nothing is known by."""
        return self.link, len(self.open), int(self.open[0])


@dataclass(frozen=True, eq=False)
class Growth:
    """Links found so far: their motions (T, K, 4, 4), and the labels (n,) of samples, -1 where none explains them."""

    surfaces: Surfaces
    motions: Tensor
    label: Tensor

    @classmethod
    def rooted(cls, surfaces: Surfaces, start: Tensor) -> Growth:
        """Return the first link, by the best of the motions (T, K, 4, 4) and of none."""
        everything, still = torch.arange(len(surfaces.samples)), torch.eye(4).double().expand(len(start), 1, 4, 4)
        found = cls(surfaces, torch.cat([still, start], 1), torch.full_like(everything, -1))
        best = found.motions[:, [found.costs(found.motions).mean(0).argmin()]]
        # Kernels that are wide for a link that moved a little may leave one that did not.
        tried = torch.cat([best, *(found._fitted(best, everything, at) for at in (GROWTH.root, GROWTH.others))], 1)
        return replace(found, motions=tried[:, [found.costs(tried).mean(0).argmin()]]).labeled()

    def costs(self, motions: Tensor, which: Tensor | slice = slice(None)) -> Tensor:
        """Return the costs (k, K) of samples under motions (T, K, 4, 4), means over the scans; one of outliers."""
        return self._frame_costs(motions, which).mean(0).mT

    def _frame_costs(self, motions: Tensor, which: Tensor | slice) -> Tensor:
        """Return the costs (T, K, k) of samples in each scan."""
        spacing, found = self.surfaces.spacing, []
        for target, frame in zip(self.surfaces.targets, motions, strict=True):
            moved = transform_points(frame, self.surfaces.samples[which])
            index, distance = target.tree.nearest_within(moved.reshape(-1, 3), GROWTH.reach * spacing)
            index, distance = (values.reshape(moved.shape[:-1]) for values in (index, distance))
            offset = moved - target.points[index]
            # Signs of normals are estimates, too: either side will do.
            across = (offset * target.normals[index]).sum(-1).square()
            along = ((offset.square().sum(-1) - across).clamp_min(0).sqrt() / spacing - GROWTH.along).clamp_min(0)
            square = across / spacing**2 + along.square()
            found.append(torch.where(distance.isfinite(), square, 1.0).clamp_max(1))
        return torch.stack(found)

    def _fitted(self, motions: Tensor, which: Tensor, scales: Sequence[float]) -> Tensor:
        """Return the motions (T, 1, 4, 4) fitted to samples (k,)."""
        own = replace(self.surfaces, samples=self.surfaces.samples[which], normals=self.surfaces.normals[which])
        kernels = [scale * self.surfaces.spacing for scale in scales]
        return own.refined(motions, torch.zeros_like(which), kernels)

    def labeled(self) -> Growth:
        """Return the links with the samples that each explains, by the costs of samples and of their neighbors."""
        costs, (first, second) = self.costs(self.motions), self.surfaces.edges.mT
        around = torch.zeros_like(costs).index_add(0, first, costs[second]).index_add(0, second, costs[first])
        degree = torch.bincount(self.surfaces.edges.flatten(), minlength=len(costs)).clamp_min(1)
        best, label = (0.5 * (costs + around / degree.unsqueeze(1))).min(-1)
        return replace(self, label=torch.where(best < GROWTH.explained, label, -1))

    def with_link(self, motion: Tensor) -> Growth:
        """Return the links and one more, by its motions (T, 4, 4), unless it explains next to nothing."""
        grown, number, new = self, self.motions.shape[1], motion.unsqueeze(1)
        for _ in range(GROWTH.fits):
            grown = replace(self, motions=torch.cat([self.motions, new], 1)).labeled()
            own = (grown.label == number).nonzero()[:, 0]
            if len(own) < GROWTH.least:
                return self
            motions = torch.cat([new, grown._fitted(new, own, GROWTH.others)], 1)
            best = grown._frame_costs(motions, own).mean(-1).argmin(1)
            new = motions[torch.arange(len(motions)), best].unsqueeze(1)
        return replace(self, motions=torch.cat([self.motions, new], 1)).labeled()

    def fronts(self) -> list[Front]:
        """Return the borders of links and of connected samples that none explains."""
        label, edges = self.label, torch.cat([self.surfaces.edges, self.surfaces.edges.flip(1)])
        component = connected_components(edges[(label[edges] < 0).all(1)], len(label))
        found = []
        for number in component[label < 0].unique().tolist():
            own = component == number
            ends = edges[own[edges[:, 0]] & ~own[edges[:, 1]]]
            if int(own.sum()) >= GROWTH.least:
                beside = label[ends[:, 1]]
                found += [
                    Front(link, own.nonzero()[:, 0], ends[beside == link].unique()) for link in beside.unique().tolist()
                ]
        return found

    def open_clouds(self) -> list[tuple[Tensor, Tensor]]:
        """Return the points and normals of each scan that are no link's."""
        known = self.label >= 0
        chosen = self.motions[:, self.label[known]]
        placed = (chosen[..., :3, :3] @ self.surfaces.samples[known].unsqueeze(-1)).squeeze(-1) + chosen[..., :3, 3]
        reach, clouds = GROWTH.taken * self.surfaces.spacing, []
        for target, own in zip(self.surfaces.targets, placed, strict=True):
            free = NeighborTree(own).nearest_within(target.points, reach)[1].isinf()
            clouds.append((target.points[free], target.normals[free]))
        return clouds

    def searched(self, front: Front, clouds: Sequence[tuple[Tensor, Tensor]]) -> tuple[float, Tensor]:
        """Return about how many samples a link at a front explains, and its motions (T, 4, 4)."""
        center, parent = self.surfaces.samples[front.border].mean(0), self.motions[:, front.link]
        shift = rigid_matrix(torch.eye(3).double(), center)
        own = ((self.surfaces.samples[front.open] - center).float(), self.surfaces.normals[front.open].float())
        # Scans as seen from the link, about its border.
        back = invert_rigid(parent @ shift)
        seen = [
            (transform_points(motion, points).float(), (normals @ motion[:3, :3].mT).float())
            for motion, (points, normals) in zip(back, clouds, strict=True)
        ]
        distances, best = own[0].norm(dim=-1).sort().values, (0.0, parent)
        for size in GROWTH.pieces:
            radius = float(distances[min(size, len(distances)) - 1]) + self.surfaces.spacing
            # Free motions have many more parameters than a hinge.
            for share, local in zip(
                (1.0, GROWTH.free),
                rotations_and_hinge(Piece.of(own, seen, radius, self.surfaces.spacing)),
                strict=False,
            ):
                motion = parent @ shift @ local.double() @ invert_rigid(shift)
                costs = self.costs(motion.unsqueeze(1), front.open)[:, 0]
                gain = share * float((1 - costs / GROWTH.explained).clamp_min(0).sum())
                best = max(best, (gain, motion), key=lambda row: row[0])
            if size >= len(distances) or best[0] > GROWTH.enough * len(distances):
                break
        return best


def grown(state: Growth) -> tuple[Tensor, Tensor]:
    """Return the motions (T, K, 4, 4) of links, and the labels (n,) of the samples, from links found so far.

    Where samples that these do not explain begin, the next link turns about a point: its rotation in each scan is one
    of all, and about one axis in all scans, if these data agree with that. What it explains is its own, and its end is
    where the next one begins.
    """
    failed = set[tuple[int, ...]]()
    while state.motions.shape[1] < GROWTH.most:
        clouds, best = state.open_clouds(), dict[int, tuple[float, Tensor]]()
        for front in state.fronts():
            if front.key in failed:
                continue
            found = state.searched(front, clouds)
            if found[0] < GROWTH.least:
                failed.add(front.key)
            else:
                piece = int(front.open[0])
                best[piece] = max(best.get(piece, found), found, key=lambda row: row[0])
        before = state.motions.shape[1]
        for _, motion in best.values():
            state = state.with_link(motion)
        if state.motions.shape[1] == before:
            break
    known = state.label >= 0
    samples = state.surfaces.samples
    nearest = NeighborTree(samples[known]).nearest(samples)[0]
    return state.motions, state.label[known][nearest]
