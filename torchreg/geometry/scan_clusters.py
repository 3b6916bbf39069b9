"""Scans reduced to cluster points."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchreg.geometry.mesh import distinct_faces
from torchreg.geometry.neighbors import sampling_distance
from torchreg.geometry.range_scan import RangeScan


def clustered_scan(scan: RangeScan, count: int) -> tuple[RangeScan, Tensor, Tensor]:
    """Return a scan of about ``count`` cluster points, their indices (M,), and the cluster (N,) of each point."""
    total, every = len(scan), torch.arange(len(scan), device=scan.points.device)
    if total <= 2 * count:
        return scan, every, every
    points, size = scan.points.detach().double(), scan.spacing * math.sqrt(total / count)
    # The front and the back of what is thinner than a cell stay apart.
    axis = scan.normals.abs().argmax(dim=1, keepdim=True)
    side = (2 * axis + (scan.normals.gather(1, axis) > 0))[:, 0]
    while True:
        cells = ((points - points.amin(dim=0)) / size).long()
        width, depth = (cells.amax(dim=0) + 1)[1:]
        keys = ((cells[:, 0] * width + cells[:, 1]) * depth + cells[:, 2]) * 6 + side
        distinct, cluster = keys.unique(return_inverse=True)
        if len(distinct) <= 2 * count:
            break
        size *= math.sqrt(len(distinct) / count)
    # The point of each cluster that is nearest to its middle, those on the boundary before all others.
    middle = points.new_zeros(len(distinct), 3).index_add(0, cluster, points) / torch.bincount(cluster)[:, None]
    apart = (points - middle[cluster]).norm(dim=1) + torch.where(scan.boundary, 0.0, 2 * size)
    least = torch.full_like(middle[:, 0], torch.inf).scatter_reduce(0, cluster, apart, "amin")
    first = torch.where(apart <= least[cluster], every, total)
    index = torch.full_like(distinct, total).scatter_reduce(0, cluster, first, "amin")
    faces = None if scan.faces is None else distinct_faces(cluster[scan.faces])
    coarse = scan.replaced(
        points=scan.points[index],
        faces=faces if faces is not None and len(faces) else None,
        normals=scan.normals[index],
        boundary=scan.boundary[index],
        spacing=sampling_distance(points[index]),
    )
    return coarse, index, cluster
