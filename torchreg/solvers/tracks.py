"""Tracks through detections over time: the most probable set of disjoint paths, by one sparse assignment."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from scipy.sparse import csr_array
from scipy.sparse.csgraph import min_weight_full_bipartite_matching
from torch import Tensor

_NUM_SCALINGS = 200  # of rows and columns, towards sums of one: what is sure converges slowly, and is as good as sure


@dataclass(frozen=True, eq=False)
class TrackGraph:
    """N detections, and the log-odds of their links, starts and stops."""

    links: Tensor  # (E, 2) an earlier detection and a later one, each pair once
    gains: Tensor  # (E,) log-odds that the second continues the first, against chance
    real: Tensor  # (N,) log-odds that a detection is not clutter
    starts: Tensor  # (N,) log-probability that a track starts with it
    stops: Tensor  # (N,) log-probability that a track stops with it

    def best_tracks(self) -> tuple[Tensor, Tensor, float]:
        """Return the links (E,) of the most probable tracks, bool, which detections (N,) are real, and the score."""
        count = len(self.real)
        numbers, (first, second) = torch.arange(count), self.links.unbind(1)
        rows = torch.cat((numbers, first, numbers, count + numbers, count + numbers, count + second))
        columns = torch.cat((numbers, second, count + numbers, numbers, count + numbers, count + first))
        zero = torch.zeros(count, dtype=torch.float64)
        link, start, stop = self._weights()
        gains = torch.cat((zero, link, stop, start, zero, torch.zeros_like(link)))
        costs = (1 + gains.max() - gains).numpy()  # positive: an entry of zero would be none
        # The indices that scipy's matching takes in all its releases.
        places = rows.int().numpy(), columns.int().numpy()
        matrix = csr_array((costs, places), shape=(2 * count, 2 * count))
        chosen = torch.from_numpy(min_weight_full_bipartite_matching(matrix)[1]).long()
        used, real = chosen[first] == second, chosen[:count] != numbers
        ends, begins = chosen[:count] == count + numbers, chosen[count:] == numbers
        score = link[used].sum() + stop[ends].sum() + start[begins].sum()
        return used, real, float(score)

    def link_probabilities(self) -> tuple[Tensor, Tensor]:
        """Return the probabilities of links (E,) and of starts (N,), those of the soft assignment of most entropy.

        References: Sinkhorn 1964; Chertkov et al. 2010 for such probabilities of tracks.
        """
        count, (first, second) = len(self.real), self.links.unbind(1)
        link, start, stop = (weights.exp() for weights in self._weights())
        left, right = torch.ones(count, dtype=torch.float64), torch.ones(count, dtype=torch.float64)
        for _ in range(_NUM_SCALINGS):
            left = 1 / (stop + right + torch.zeros_like(left).index_add(0, first, link * right[second]))
            right = 1 / (start + left + torch.zeros_like(left).index_add(0, second, link * left[first]))
        return left[first] * link * right[second], start * right

    def _weights(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return the gains of links, starts and stops, each with half of those of the detections that it touches."""
        half = self.real / 2
        return self.gains + half[self.links].sum(1), self.starts + half, self.stops + half
