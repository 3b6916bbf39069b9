"""What a network reads of a range scan: few tokens spread over it, the points around each, and ways between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Self

import torch
from torch import Tensor

from torchreg.geometry.graphs import Graph
from torchreg.geometry.range_scan import RangeScan
from torchreg.geometry.sampling import even_order
from torchreg.registration.normalization import Normalization


@dataclass(frozen=True)
class TokenSizes:
    """How a scan is cut into tokens, which weights are learnt for; lengths are shares of its size (`Normalization`)."""

    num_points: int = 1536  # that are looked at, spread evenly over the scan
    num_tokens: int = 256  # 4 % of a person apart
    num_neighbors: int = 32  # points drawn around a token, in each radius
    radii: tuple[float, float] = (0.05, 0.14)  # a wrist, a chest
    longest_edge: float = 0.12  # between tokens that are neighbors on the surface
    detour: float = 1.5  # a point between two neighbors lies on a way at most so many times the straight one
    farthest: float = 2.0  # distance of tokens that no way joins


SIZES = TokenSizes()


@dataclass(frozen=True, eq=False)
class ScanTokens:
    """Scans as a network reads them, B of them; their own size and middle are taken out.

    Args:
        points: (B, P, 3) looked at; those that a small scan lacks are zeros.
        normals: (B, P, 3) unit vectors.
        boundary: (B, P) bool, where the scan ends.
        tokens: (B, T) int64 points that are tokens; a small scan repeats some.
        neighbors: (B, T, 2 K) int64 points around each token, K in each radius; the token where there are none.
        geodesic: (B, T, T) distances along the surface.
        index: (B, P) int64 points of the scan, -1 where it lacks them.
        center: (B, 3) middle, in the scan's unit.
        scale: (B,) size, in the scan's unit.
    """

    points: Tensor
    normals: Tensor
    boundary: Tensor
    tokens: Tensor
    neighbors: Tensor
    geodesic: Tensor
    index: Tensor
    center: Tensor
    scale: Tensor

    @classmethod
    def from_scan(cls, scan: RangeScan, generator: torch.Generator | None = None) -> Self:
        """Return one scan's tokens, float32 on the CPU, B = 1.

        ``generator``: draws the points and neighbors; None draws points evenly spread, the same at every call.
        """
        if generator is None:
            index = scan.uniform_subsample(min(SIZES.num_points, len(scan))).cpu()
        else:
            index = torch.randperm(len(scan), generator=generator)[: SIZES.num_points]
        index = index[even_order(scan.points.detach().cpu()[index])]
        points, normals = (values.detach().cpu()[index] for values in (scan.points, scan.normals))
        return cls.from_even(points, normals, scan.boundary.cpu()[index], index, generator)

    @classmethod
    def from_even(
        cls,
        points: Tensor,
        normals: Tensor,
        boundary: Tensor,
        index: Tensor | None = None,
        generator: torch.Generator | None = None,
    ) -> Self:
        """Return the tokens of samples of one scan: the first of them, B = 1.

        ``points``: (S, 3) samples, every first few of which cover the scan evenly, see `even_order`. ``index``: (S,)
        points of the scan; the samples' own numbers by default.
        """
        count = min(SIZES.num_points, len(points))
        index = torch.arange(count) if index is None else index[:count]
        draws = torch.Generator().manual_seed(0) if generator is None else generator
        unit = Normalization.from_points(points[:count])
        points = unit.normalize(points[:count])
        tokens = torch.arange(SIZES.num_tokens) % count
        distances = torch.cdist(points[tokens], points)
        pad = SIZES.num_points - count
        return cls(
            points=torch.nn.functional.pad(points.float(), (0, 0, 0, pad))[None],
            normals=torch.nn.functional.pad(normals[:count].float(), (0, 0, 0, pad))[None],
            boundary=torch.nn.functional.pad(boundary[:count], (0, pad))[None],
            tokens=tokens[None],
            neighbors=torch.cat([_drawn_around(distances, tokens, radius, draws) for radius in SIZES.radii], 1)[None],
            geodesic=_geodesics(distances, points[tokens]).float()[None],
            index=torch.nn.functional.pad(index, (0, pad), value=-1)[None],
            center=unit.center[None],
            scale=torch.tensor([unit.scale], dtype=torch.float64),
        )

    @classmethod
    def stack(cls, scans: Sequence[ScanTokens]) -> Self:
        """Return the tokens of several scans in one batch."""
        return cls(*(torch.cat([getattr(scan, field.name) for scan in scans]) for field in fields(cls)))

    def to(self, device: torch.device | str) -> Self:
        """Return the tokens on another device."""
        return type(self)(*(getattr(self, field.name).to(device) for field in fields(self)))

    def __len__(self) -> int:
        return len(self.points)

    def at_tokens(self, values: Tensor) -> Tensor:
        """Return values (B, P, ...) of the points at the tokens, (B, T, ...)."""
        return values[torch.arange(len(self), device=values.device)[:, None], self.tokens]

    @property
    def token_index(self) -> Tensor:
        """(B, T) int64 points of the scan that are tokens."""
        return self.at_tokens(self.index)


def _drawn_around(distances: Tensor, tokens: Tensor, radius: float, generator: torch.Generator) -> Tensor:
    """Return K points (T, K) drawn within a radius of each token, at distances (T, P); the token for want of more."""
    count = min(SIZES.num_neighbors, distances.shape[1])
    draw = torch.rand(distances.shape, generator=generator, dtype=torch.float32).masked_fill_(distances > radius, 2.0)
    found, index = draw.topk(count, dim=1, largest=False)
    index = torch.where(found > 1, tokens.unsqueeze(1), index)
    missing = tokens.unsqueeze(1).expand(-1, SIZES.num_neighbors - count)
    return torch.cat((index, missing), dim=1)


def _geodesics(distances: Tensor, tokens: Tensor) -> Tensor:
    """Return distances along the surface (T, T) of tokens (T, 3), from those to all points (T, P).

    Two tokens are neighbors if both are among the three nearest ones of a point between them: over empty space there is
    none.
    """
    apart, nearest = distances.topk(3, dim=0, largest=False)
    first, second = (torch.cat([nearest[end] for end in ends]) for ends in ((0, 0, 1), (1, 2, 2)))
    way = torch.cat([apart[one] + apart[two] for one, two in ((0, 1), (0, 2), (1, 2))])
    length = (tokens[first] - tokens[second]).norm(dim=-1)
    joined = (first != second) & (length < SIZES.longest_edge) & (way < SIZES.detour * length + 1e-6)
    edges = torch.stack((first[joined], second[joined]), dim=1)
    return Graph.from_edges(edges, length[joined], len(tokens)).distances().clamp(max=SIZES.farthest)
