"""The limbs of a thing that grows in all frames: as they are shown, between frames that show them, or not yet there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.geometry.graphs import Graph
from torchreg.geometry.skeleton import Skeleton
from torchreg.spines.curves import curve_lengths
from torchreg.spines.growth.organ_graph import LimbChain, limbs_between, shown_graph
from torchreg.spines.growth.organ_tracks import OrganTracks
from torchreg.spines.labeled_tree import LimbGraph
from torchreg.spines.limbs.observed_limbs import observe_limbs


@dataclass(frozen=True, eq=False)
class GrowingLimbs:
    """The L limbs of a growing thing in T frames."""

    curves: Tensor  # (T, L, S, 3), without length where the limb does not exist
    radii: Tensor
    observed: Tensor  # (T, L) True where the frame's own skeleton has the limb
    present: Tensor


def growing_limbs(
    skeletons: Sequence[Skeleton], tracks: OrganTracks, graph: LimbGraph, num_samples: int
) -> GrowingLimbs:
    """Return the limbs of a graph of all organs in all frames."""
    whole = [
        _shown_limbs(skeleton, row, graph, num_samples) for skeleton, row in zip(skeletons, tracks.labels, strict=True)
    ]
    lengths = _nearest_in_time(torch.stack([_single_lengths(rows, len(graph.edges)) for rows in whole]))
    values = torch.stack([_cut(rows, row, num_samples) for rows, row in zip(whole, lengths, strict=True)])
    observed, present = ~values[..., 0, 0].isnan(), limbs_between(graph, tracks.alive)
    observed &= present
    values[~observed] = torch.nan
    values = _over_time(values)
    curves = _joined(values[..., :3], observed, present, graph)
    radii = torch.where(present[..., None], values[..., 3], 0.0).clamp_min(0)
    return GrowingLimbs(curves=curves, radii=radii, observed=observed, present=present)


@dataclass(frozen=True, eq=False)
class _ShownLimbs:
    """Limbs between the organs of a frame: values (C, S, 4), points and radii, NaN where unknown, of C chains."""

    values: Tensor
    chains: Sequence[LimbChain]


def _shown_limbs(skeleton: Skeleton, labels: Tensor, graph: LimbGraph, num_samples: int) -> _ShownLimbs:
    organs = (labels >= 0).nonzero()[:, 0].tolist()
    if len(organs) < 2:
        return _ShownLimbs(torch.zeros(0, num_samples, 4, dtype=torch.float64), [])
    part, chains = shown_graph(graph, frozenset(organs))
    limbs = observe_limbs(skeleton, labels[organs].tolist(), part, num_samples)
    values = torch.cat((limbs.curves, limbs.radii[..., None]), dim=-1)
    return _ShownLimbs(torch.where(limbs.observed[:, None, None], values, torch.nan), chains)


def _single_lengths(rows: _ShownLimbs, num_limbs: int) -> Tensor:
    """Return the lengths (L,) of the limbs that a frame shows by themselves, NaN elsewhere."""
    lengths = torch.full((num_limbs,), torch.nan, dtype=torch.float64)
    for values, chain in zip(rows.values, rows.chains, strict=True):
        if len(chain.limbs) == 1:
            lengths[chain.limbs[0]] = curve_lengths(values[:, :3]) if not bool(values.isnan().any()) else torch.nan
    return lengths


def _nearest_in_time(values: Tensor) -> Tensor:
    """Return values (T, L) with NaN replaced by those of the nearest frame; one where no frame has any."""
    numbers = torch.arange(len(values)).double()
    apart = (numbers[:, None] - numbers).abs()[:, :, None] + torch.where(values.isnan(), torch.inf, 0.0)
    least, frame = apart.min(1)
    return torch.where(least.isfinite(), values.gather(0, frame), 1.0)


def _cut(rows: _ShownLimbs, lengths: Tensor, num_samples: int) -> Tensor:
    """Return the values (L, S, 4) of all limbs in a frame, NaN where unknown: chains cut by their lengths (L,)."""
    cut = torch.full((len(lengths), num_samples, 4), torch.nan, dtype=torch.float64)
    share = torch.linspace(0, 1, num_samples, dtype=torch.float64)
    for values, chain in zip(rows.values, rows.chains, strict=True):
        if bool(values.isnan().any()):
            continue
        parts = lengths[list(chain.limbs)]
        ends = torch.cat((parts.new_zeros(1), parts.cumsum(0))) / parts.sum()
        # Samples are evenly spaced along the chain.
        place = (num_samples - 1) * (ends[:-1, None] + share * (ends[1:] - ends[:-1])[:, None])
        before = place.floor().long().clamp_max(num_samples - 2)
        part = (place - before)[..., None]
        pieces = values[before] + part * (values[before + 1] - values[before])
        for piece, limb, forward in zip(pieces, chain.limbs, chain.forward, strict=True):
            cut[limb] = piece if forward else piece.flip(0)
    return cut


def _over_time(values: Tensor) -> Tensor:
    """Return values (T, L, ...) with rows of NaN interpolated in time, unless NaN in all frames."""
    filled, numbers = values.clone(), torch.arange(len(values))
    for limb, known in enumerate(~values.flatten(2).isnan().any(-1).mT):
        frames = known.nonzero()[:, 0]
        if not len(frames):
            continue
        after = torch.searchsorted(frames, numbers).clamp_max(len(frames) - 1)
        following = frames[after]
        previous = torch.where(numbers < following, frames[(after - 1).clamp_min(0)], frames[after])
        share = ((numbers - previous) / (following - previous).clamp_min(1)).clamp(0, 1).double()
        share = share.reshape(-1, *(1,) * (values.ndim - 2))
        filled[:, limb] = values[previous, limb] + share * (values[following, limb] - values[previous, limb])
    return filled


def _joined(curves: Tensor, observed: Tensor, present: Tensor, graph: LimbGraph) -> Tensor:
    """Return curves (T, L, S, 3) that meet in the nodes of a graph; those that are not present have no length."""
    nodes = _over_time(_node_positions(curves, observed, graph))
    guessed = _over_time(_node_positions(curves, present, graph))
    nodes = torch.where(nodes.isnan(), guessed, nodes)
    nodes = torch.stack([_contracted(row, flags, graph) for row, flags in zip(nodes, present, strict=True)])
    start, end = (nodes[:, graph.edges[:, side]].unsqueeze(2) for side in (0, 1))
    share = torch.linspace(0, 1, curves.shape[2], dtype=curves.dtype)[:, None]
    straight = start + share * (end - start)
    bent = curves + (1 - share) * (start - curves[:, :, :1]) + share * (end - curves[:, :, -1:])
    known = present[..., None, None] & ~curves.isnan().any(-1, keepdim=True).any(-2, keepdim=True)
    return torch.where(known, bent, straight)


def _node_positions(curves: Tensor, known: Tensor, graph: LimbGraph) -> Tensor:
    """Return the mean positions (T, N, 3) of the nodes in which known (T, L) limbs end, NaN for others."""
    total = curves.new_zeros(len(curves), len(graph.edges) + 1, 3)
    count = curves.new_zeros(total.shape[:2])
    weights = known.to(curves)
    for side, sample in ((0, 0), (1, -1)):
        ends = graph.edges[:, side]
        total.index_add_(1, ends, torch.where(known[..., None], curves[:, :, sample], 0.0))
        count.index_add_(1, ends, weights)
    return torch.where(count[..., None] > 0, total / count[..., None], torch.nan)


def _contracted(nodes: Tensor, present: Tensor, graph: LimbGraph) -> Tensor:
    """Return the nodes (N, 3) of a frame: those in which no present limb (L,) ends lie on the nearest that is."""
    count = len(nodes)
    held = torch.zeros(count, dtype=torch.bool)
    held[graph.edges[present].reshape(-1)] = True
    held &= ~nodes.isnan().any(-1)
    if not bool(held.any()):
        return nodes.nan_to_num() if bool(nodes.isnan().all()) else torch.where(nodes.isnan(), nodes.nanmean(0), nodes)
    steps = Graph.from_edges(graph.edges, torch.ones(len(graph.edges), dtype=torch.float64), count)
    sources = held.nonzero()[:, 0]
    nearest = sources[steps.distances(sources).argmin(0)]
    return nodes[nearest]
