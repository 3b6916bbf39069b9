"""Level sets as printed: vertices sorted into bins of distance, a node for each connected part of a bin."""

from __future__ import annotations

import torch
from torch import Tensor

from torchreg.geometry.graphs import connected_components
from torchreg.spines.skeleton.level_sets import LevelSets, MeshEdges

# Share of the edges that are shorter than a bin is wide.
_MOST_EDGES = 0.95


def vertex_level_sets(mesh: MeshEdges, values: Tensor, spacing: float) -> LevelSets:
    """Return the parts of bins of vertices as bands, and the rings between them (Brostow et al. 2004, figure 2)."""
    edges, vertices = torch.from_numpy(mesh.edges), torch.from_numpy(mesh.vertices)
    lengths = (vertices[edges[:, 0]] - vertices[edges[:, 1]]).norm(dim=-1)
    bins = (values / max(spacing, float(lengths.quantile(_MOST_EDGES)))).floor().long()
    inside = bins[edges[:, 0]] == bins[edges[:, 1]]
    band = connected_components(edges[inside], len(vertices))
    count = int(band.max()) + 1
    across = edges[~inside]
    # From the bin nearer to the tip to the farther one.
    across = torch.where((bins[across[:, 0]] > bins[across[:, 1]])[:, None], across.flip(1), across)
    lower, upper = band[across].unique(dim=0).unbind(1)
    centers, covariances, sizes = _moments(vertices, band, count)
    bin_of_band = torch.zeros(count, dtype=torch.int64).scatter(0, band, bins)
    none = torch.zeros(0, dtype=torch.int64)
    return LevelSets(
        centers=centers[upper],
        covariances=covariances[upper],
        lengths=sizes[upper],
        levels=bin_of_band[upper],
        lower=lower,
        upper=upper,
        vertex_bands=band,
        num_bands=count,
        faces=none,
        face_rings=none,
    )


def _moments(vertices: Tensor, band: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return the centroids (B, 3), covariances (B, 3, 3) and numbers (B,) of the vertices (V, 3) of bands (V,)."""
    sizes = torch.bincount(band, minlength=count).to(vertices)
    centers = vertices.new_zeros(count, 3).index_add(0, band, vertices) / sizes[:, None]
    offsets = vertices - centers[band]
    products = offsets.unsqueeze(-1) * offsets.unsqueeze(-2)
    return centers, vertices.new_zeros(count, 3, 3).index_add(0, band, products) / sizes[:, None, None], sizes
