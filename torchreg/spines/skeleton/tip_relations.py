"""Relations between tips that do not depend on pose: geodesic distances and signed volumes."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.geometry.mesh import TriangleMesh


@dataclass(frozen=True, eq=False)
class TipRelations:
    """Relations between the K tips of a surface that bending does not change, float64."""

    geodesics: Tensor  # (K, K) distances along the surface
    # (K, K, K) ``1/6 integral of d_a dd_b ^ dd_c`` over the surface: the signed volume enclosed by the map that takes
    # each point to its distances from tips a, b and c. A body has +v, its mirror image -v.
    volumes: Tensor

    def of_tips(self, order: Tensor) -> TipRelations:
        """Return the relations of tips (K,) in another order."""
        volumes = self.volumes[order][:, order][:, :, order]
        return TipRelations(geodesics=self.geodesics[order][:, order], volumes=volumes)


def surface_relations(mesh: TriangleMesh, distances: Tensor, vertices: Tensor) -> TipRelations:
    """Return the relations of the tips of a closed surface, from geodesic distances (K, V) of the tips."""
    corners = distances[:, mesh.faces]
    volumes = torch.stack(
        [torch.einsum("bfi,cfi->bc", torch.linalg.cross(row.expand_as(corners), corners, dim=-1), corners)
         for row in corners]
    )  # fmt: skip
    places = mesh.vertices[mesh.faces]
    outwards = torch.linalg.det(places - places.mean((0, 1))).sum().sign()
    return TipRelations(geodesics=distances[:, vertices], volumes=outwards * volumes / 6)
