"""Links of a robot: which samples of its surface move together, by labels that cost what they must save."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.geometry.neighbors import NeighborTree
from torchreg.registration.robots.surfaces import NUMBERS, Noise, Surfaces
from torchreg.solvers.graph_cut import alpha_expansion


@dataclass(frozen=True)
class LinkNumbers:
    """Of the search for links."""

    rounds: int = 6  # of labels and motions; most end by themselves
    splits: int = 2  # of the rounds, in which pieces of parts are proposals too
    piece: int = 40  # samples of a piece, about: a third of the smallest links of ten to twenty
    near: int = 8  # pieces about a sample, whose motions it may follow at once
    wide: tuple[float, ...] = (0.04, 0.025, 0.015, 0.01)  # of the thing's size: how far a piece may be from its part
    scales: tuple[float, ...] = (4.0, 3.0, 3.0)  # of robust kernels of the motions' steps, standard deviations


LINKS = LinkNumbers()


def labeled(surfaces: Surfaces, motions: Tensor, label: Tensor, noise: Noise, asked: Tensor | None = None) -> Tensor:
    """Return the labels (n,) of least description length under given motions (T, K, 4, 4).

    A sample costs half its squared residual in standard deviations, up to that of an outlier, summed over the frames; a
    border between neighbors costs what its rarity tells (`border_cost`); a label that is used costs the parameters of
    a hinge, its axis and a value a frame, half the logarithm of the number of residuals each: links hang on joints, and
    at the cost of free motions short ones between two hinges would be their neighbors'. Samples that err together count
    once; a motion that a sample is not ``asked`` about (n, K) is wrong for it (Isack and Boykov 2012 (PEARL); Delong et
    al. 2012; Schwarz 1978 for the cost of parameters).
    """
    asked = torch.ones(len(label), motions.shape[1], dtype=torch.bool) if asked is None else asked
    squares = surfaces.squares(motions, NUMBERS.cut * noise.sigma, asked) / noise.sigma**2
    unary = 0.5 * squares.clamp_max(NUMBERS.cut**2).sum(0) / noise.repeats
    count = len(surfaces.targets) * len(surfaces.samples) / noise.repeats
    weights = unary.new_full((len(surfaces.edges),), border_cost(surfaces.edges, label))
    costs = unary.new_full((motions.shape[1],), 0.5 * (len(squares) + 4.0) * math.log(max(count, 2.0)))
    return alpha_expansion(unary, surfaces.edges, weights, label_costs=costs, initial=label).labels


def border_cost(edges: Tensor, label: Tensor) -> float:
    """Return minus the log odds of a border between neighbors, from the share of such edges (Besag 1975)."""
    borders = float((label[edges[:, 0]] != label[edges[:, 1]]).sum())
    share = min(0.5, (borders + 1) / (len(edges) + 2))
    return math.log((1 - share) / share)


def without_gaps(motions: Tensor, label: Tensor) -> tuple[Tensor, Tensor]:
    """Return the motions of labels in use, and the labels numbered from 0 among them."""
    used, label = label.unique(return_inverse=True)
    return motions[:, used], label


def find_links(surfaces: Surfaces, motions: Tensor, label: Tensor) -> tuple[Tensor, Tensor, Noise]:
    """Return motions (T, K, 4, 4) and labels (n,) of links, and the noise: proposals, labels and motions in turn."""
    for number in range(LINKS.rounds):
        before, noise = label, surfaces.noise(motions, label)
        scales = [scale * noise.sigma for scale in LINKS.scales]
        motions = surfaces.refined(motions, label, scales)
        proposals, asked = motions, None
        if number < LINKS.splits:
            pieces, near = _pieces(surfaces, motions, label, scales)
            proposals = torch.cat([motions, pieces], 1)
            asked = torch.cat([torch.ones(len(label), motions.shape[1], dtype=torch.bool), near], 1)
        noise = surfaces.noise(motions, label)
        motions, label = without_gaps(proposals, labeled(surfaces, proposals, label, noise, asked))
        if number >= LINKS.splits and torch.equal(before, label):
            break
    return motions, label, noise


def _pieces(surfaces: Surfaces, motions: Tensor, label: Tensor, scales: list[float]) -> tuple[Tensor, Tensor]:
    """Return the motions (T, G, 4, 4) of pieces of all parts, each fitted by itself, and the samples near them (n, G).

    In each frame that of less cost: from its part's motion, or by a kernel that narrows, for links of their own.
    """
    seeds = surfaces.samples[: max(1, len(surfaces.samples) // LINKS.piece)]
    nearest = NeighborTree(seeds).k_nearest(surfaces.samples, min(LINKS.near, len(seeds)))[0]
    near = torch.zeros(len(label), len(seeds), dtype=torch.bool).scatter(1, nearest, True)
    key, piece = (nearest[:, 0] * motions.shape[1] + label).unique(return_inverse=True)
    start = motions[:, key % motions.shape[1]]
    close = surfaces.refined(start, piece, scales)
    far = surfaces.refined(start, piece, [share * surfaces.size for share in LINKS.wide] + scales)
    better = surfaces.cost(far, piece, scales[0]) < surfaces.cost(close, piece, scales[0])
    return torch.where(better[..., None, None], far, close), near[:, key // motions.shape[1]]
