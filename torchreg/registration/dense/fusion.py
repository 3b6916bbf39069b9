"""One motion from several hypotheses: each part of the source as in the hypothesis that suits it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.geometry.neighbors import k_nearest
from torchreg.geometry.rigid import transform_points
from torchreg.registration.dense.deformation_graph import DeformationGraph
from torchreg.registration.dense.problem import ScanAlignProblem
from torchreg.registration.dense.stages import deviations, mismatch

# Target samples looked at, and for each of them moved samples that may cover it.
_NUM_TARGETS, _NUM_COVERS = 400, 2
# Patches are the nodes within so many edges of a node; so many rounds at most, in each of which one changes hands.
_RINGS, _MAX_ROUNDS = 4, 30
# A move must save this much.
_LEAST_GAIN = 1e-4


def fuse_motions(problem: ScanAlignProblem, options: Tensor) -> Tensor:
    """Return motions of the nodes, each as in one of several hypotheses.

    The energy is what samples of both scans are off, what the graph bends and how far samples are from where they are
    expected, every sample moved by the node that it hangs on most. Starting from the first hypothesis, the patch and
    hypothesis that lower it most change hands, until none does.

    References: Lempitsky, Rother, Roth, Blake 2010, on fusing proposals into one labeling.
    """
    energy = _Energy.of(problem, options)
    patches, count = _patches(problem.graph), len(options)
    patches, offers = patches.repeat(count, 1), torch.arange(count).to(patches.device).repeat_interleave(len(patches))
    labels = torch.zeros_like(options[0, :, 0, 0], dtype=torch.long)
    least = energy(labels.unsqueeze(0))[0]
    # Moves that have not paid are tried again only when no other pays any more.
    everywhere = worthwhile = torch.arange(len(offers), device=labels.device)
    for _ in range(_MAX_ROUNDS):
        moves = torch.where(patches[worthwhile], offers[worthwhile, None], labels)
        changes = (moves != labels).any(1)
        energies = torch.full_like(moves[:, 0], torch.inf, dtype=least.dtype)
        energies[changes] = energy(moves[changes])
        pays = energies < least - _LEAST_GAIN
        if pays.any():
            best = energies.argmin()
            labels, least, worthwhile = moves[best], energies[best], worthwhile[pays]
        elif len(worthwhile) < len(everywhere):
            worthwhile = everywhere
        else:
            break
    return options[labels, torch.arange(len(labels), device=labels.device)]


@dataclass(frozen=True)
class _Energy:
    """The energy of labelings (C, J), from tables over samples, targets and edges.

    Args:
        own: (J, H) what samples that hang on a node cost.
        cover: (T, H K) what a target costs when a sample covers it,
        by: (T, H K) if that sample's node
        under: (H K,) has this label.
        shown: (T,) probability that the source shows each target.
        smoothness: (E, H, H) what an edge costs under the labels of its ends.
        edges: (E, 2).
    """

    own: Tensor
    cover: Tensor
    by: Tensor
    under: Tensor
    shown: Tensor
    smoothness: Tensor
    edges: Tensor

    @classmethod
    def of(cls, problem: ScanAlignProblem, options: Tensor) -> _Energy:
        """Return the energy of mosaics of motions (H, J, 4, 4)."""
        graph, targets = problem.graph, problem.target.first(_NUM_TARGETS)
        owner = graph.dense_weights.argmax(1)
        costs, covers, by = [], [], []
        for option in options:
            moved = problem.moved(option)
            costs.append(mismatch(problem, moved)[0] + deviations(problem, moved.points))
            index, apart = k_nearest(targets.points, moved.points, min(_NUM_COVERS, len(owner)))
            covers.append((apart / problem.config.cap).clamp(max=1).square())
            by.append(owner[index])
        own = torch.zeros(graph.num_nodes, len(options)).to(options)
        own.index_add_(0, owner, torch.stack(costs, dim=1) / len(owner))
        under = torch.arange(len(options), dtype=torch.uint8, device=owner.device)
        under = under.repeat_interleave(covers[0].shape[1])
        smoothness = problem.config.smoothness * _edge_smoothness(graph, options)
        shown = problem.prior.target_visible[: len(targets)]
        return cls(own, torch.cat(covers, dim=1), torch.cat(by, dim=1), under, shown, smoothness, graph.edges)

    def __call__(self, labels: Tensor) -> Tensor:
        """Return energies (C,)."""
        own = self.own.gather(1, labels.mT).sum(0)
        # Labels are few: as bytes they are gathered in half the time.
        covered = torch.where(labels.to(torch.uint8)[:, self.by] == self.under, self.cover, 1.0).amin(-1)
        covered = (self.shown * covered).mean(-1)
        one, other = labels[:, self.edges].unbind(-1)
        return own + covered + self.smoothness[torch.arange(len(self.edges)), one, other].sum(-1)


def _edge_smoothness(graph: DeformationGraph, options: Tensor) -> Tensor:
    """Return (E, H, H): the share of `DeformationGraph.smoothness` of each edge, under two of motions (H, J, 4, 4)."""
    both = graph.centers[graph.edges]
    one, other = (transform_points(options[:, ends], both) for ends in graph.edges.unbind(-1))
    lengths = (one.unsqueeze(1) - other).norm(dim=-1).sum(-1)
    return (lengths * graph.edge_weights / max(1, len(graph.edges))).movedim(-1, 0)


def _patches(graph: DeformationGraph) -> Tensor:
    """Return (P, J) which nodes each patch holds, no two alike."""
    return torch.cat([graph.within(rings) for rings in range(_RINGS + 1)]).unique(dim=0)
