"""The surface that all scans of a mechanism show together, with which each scan is compared anew."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.geometry.neighbors import NeighborTree, k_nearest_others
from torchreg.geometry.normals import fit_normals
from torchreg.geometry.rigid import invert_rigid
from torchreg.registration.robots.surfaces import NUMBERS, Blocks, Noise, Surfaces, Target, frame_sums


@dataclass(frozen=True)
class FusionNumbers:
    """Of the surface of all scans."""

    neighbors: int = 24  # of a point, to which a plane is fitted: in ten scans as far as two or three of one scan
    apart: float = 10.0  # of the thing's size, between links as a coordinate: more than any distance in space


FUSION = FusionNumbers()


@dataclass(frozen=True, eq=False)
class FusedScans:
    """The points of T scans in the pose of a reference, each compared with those of the other scans on its own link.

    One scan's points lie far apart, so that planes through them miss round and small parts by as much as their noise;
    all scans together are dense. Neighbors are nearest in place, normal and link at once.

    Args:
        scans: of the T frames.
        pieces: T tensors of the pieces of links that their points belong to.
        owner: (P,) link of each piece.
        trees: T trees of the points of the other frames.
        points: T tensors of those points, in the reference.
        normals: T tensors of their normals.
        centers: (K, 3) of the links in the reference.
        size: diagonal of the samples, the unit of angles.
        reference: number of the frame that does not move.
    """

    scans: Sequence[Target]
    pieces: Sequence[Tensor]
    owner: Tensor
    trees: Sequence[NeighborTree]
    points: Sequence[Tensor]
    normals: Sequence[Tensor]
    centers: Tensor
    size: float
    reference: int

    @classmethod
    def of(
        cls, scans: Sequence[Target], surfaces: Surfaces, label: Tensor, motions: Tensor, reference: int
    ) -> FusedScans:
        """Return the scans of all frames, each to compare with the others.

        A point belongs to the link of the nearest of the samples (n,) under the motions (F, K, 4, 4) of their links,
        whose normal has the right sign; it moves into the reference by the inverse of that motion.
        """
        piece, owner = surfaces.pieces(label)
        size, nearest, known = surfaces.size, [], []
        for scan, moved, facing in zip(scans, *surfaces.moved(motions[:, label]), strict=True):
            sample = NeighborTree(moved).nearest(scan.points)[0]
            against = (facing[sample] * scan.normals).sum(-1, keepdim=True) < 0
            known.append(scan.facing(torch.where(against, -scan.normals, scan.normals)))
            nearest.append(sample)
        scans, pieces = known, [piece[sample] for sample in nearest]
        links = [owner[own] for own in pieces]
        placed = [_in_reference(*row) for row in zip(scans, links, motions, strict=True)]
        points, normals, link = (
            torch.cat([row[0] for row in placed]),
            torch.cat([row[1] for row in placed]),
            torch.cat(links),
        )
        frame = torch.arange(len(scans)).repeat_interleave(torch.tensor([len(own) for own in links]))
        spacing = sum(scan.spacing for scan in scans) / len(scans)
        fitted = fit_normals(
            points, k_nearest_others(_place(points, normals, link, spacing, size), FUSION.neighbors)[0]
        )
        normals = torch.where((fitted * normals).sum(-1, keepdim=True) < 0, -fitted, fitted)
        place = _place(points, normals, link, spacing, size)
        member = torch.nn.functional.one_hot(link, motions.shape[1]).to(points)
        others = [frame != number for number in range(len(scans))]
        return cls(
            scans=scans,
            pieces=pieces,
            owner=owner,
            trees=[NeighborTree(place[other]) for other in others],
            points=[points[other] for other in others],
            normals=[normals[other] for other in others],
            centers=(member.mT @ points) / member.sum(0).clamp_min(1).unsqueeze(-1),
            size=size,
            reference=reference,
        )

    def blocks(self, motions: Tensor, label: Tensor, scale: float) -> Blocks:
        """Return the normal equations of robust residuals at the motions (T, K, 4, 4); see `Surfaces.blocks`."""
        return self.piecewise(motions, label, scale)[0].joined(self.owner, self._centers(motions))

    def piecewise(self, motions: Tensor, label: Tensor, scale: float) -> tuple[Blocks, Tensor]:
        """Return the normal equations of pieces of links, about the links' centers, and the link (P,) of each."""
        centers, rows = self._centers(motions)[:, self.owner], []
        for frame, (motion, center) in enumerate(zip(motions, centers, strict=True)):
            points, facing, across, square = self._residuals(frame, motion)
            piece = self.pieces[frame]
            rows.append(frame_sums(points - center[piece], facing, across, square / scale**2, piece, len(self.owner)))
        return Blocks.of(torch.stack(rows), centers), self.owner

    def _centers(self, motions: Tensor) -> Tensor:
        return (motions[..., :3, :3] @ self.centers.unsqueeze(-1)).squeeze(-1) + motions[..., :3, 3]

    def noise(self, motions: Tensor) -> Noise:
        """Return the noise of the residuals under the motions (T, K, 4, 4)."""
        squares = torch.cat([self._residuals(frame, motion)[3] for frame, motion in enumerate(motions)])
        least = NUMBERS.roughness * sum(scan.spacing for scan in self.scans) / len(self.scans)
        return Noise(max(NUMBERS.to_deviation * float(squares.sqrt().median()), least), 1.0)

    def _residuals(self, frame: int, motions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the moved points of the surface nearest to a frame's points, their normals, and residuals of both.

        As of `Target.residuals`: across the plane, and squared with what is along it beyond the spacing.
        """
        scan, link = self.scans[frame], self.owner[self.pieces[frame]]
        points, normals = _in_reference(scan, link, motions)
        nearest = self.trees[frame].nearest(_place(points, normals, link, scan.spacing, self.size))[0]
        turn = motions[link]
        moved = (turn[:, :3, :3] @ self.points[frame][nearest].unsqueeze(-1)).squeeze(-1) + turn[:, :3, 3]
        facing = (turn[:, :3, :3] @ self.normals[frame][nearest].unsqueeze(-1)).squeeze(-1)
        offset = moved - scan.points
        across = (offset * facing).sum(-1)
        along = (offset.square().sum(-1) - across.square()).clamp_min(0).sqrt()
        return moved, facing, across, across.square() + (along - scan.spacing).clamp_min(0).square()


def _in_reference(scan: Target, link: Tensor, motions: Tensor) -> tuple[Tensor, Tensor]:
    """Return the points and normals (M, 3) of a scan in the reference, by the motions (K, 4, 4) of their links (M,)."""
    back = invert_rigid(motions)[link]
    turned = (back[:, :3, :3] @ scan.normals.unsqueeze(-1)).squeeze(-1)
    return (back[:, :3, :3] @ scan.points.unsqueeze(-1)).squeeze(-1) + back[:, :3, 3], turned


def _place(points: Tensor, normals: Tensor, link: Tensor, spacing: float, size: float) -> Tensor:
    """Return coordinates (N, 7) in which points of opposite sides are a spacing apart, and links very far."""
    return torch.cat([points, spacing * normals, FUSION.apart * size * link.to(points).unsqueeze(-1)], -1)
