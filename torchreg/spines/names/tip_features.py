"""Measurements of the tips of a frame, and the features of a frame with named tips."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import torch
from torch import Tensor

from torchreg.geometry.skeleton import Skeleton
from torchreg.spines.curves import arc_lengths, points_along
from torchreg.spines.labeled_tree import path_lengths
from torchreg.spines.names.student_t import FeatureGroup
from torchreg.spines.skeleton.tip_relations import TipRelations


@dataclass(frozen=True)
class TipSampling:
    """Where limbs are sampled: from the tip towards the middle of the body."""

    num_points: int = 8
    reach: float = 0.95  # of the median path from a tip to the middle
    radius_points: tuple[int, ...] = (2, 4)  # at which the radius is compared: past the tip, before the root
    min_radius: float = 1e-4  # in sizes of the body, below which its logarithm says nothing


SAMPLING = TipSampling()


@dataclass(frozen=True, eq=False)
class TipObservations:
    """Measurements of the M tips of a frame, lengths in sizes of the body, float64."""

    curves: Tensor  # (M, S, 3) points of the limbs, from the tips towards the middle of the body
    geodesics: Tensor
    volumes: Tensor
    limbs: Tensor  # (M, F) of each limb: the length to the middle, logarithms of radii

    def __len__(self) -> int:
        return len(self.curves)

    def mirrored(self) -> TipObservations:
        """Return the relations of the mirror image, not the curves."""
        return replace(self, volumes=-self.volumes)


def observe_tips(skeletons: Sequence[Skeleton], relations: Sequence[TipRelations]) -> list[TipObservations]:
    """Return the observations of frames; the size of a body is the mean distance between tips in a median frame."""
    sizes = torch.stack([_mean_distance(relation.geodesics) for relation in relations])
    size = float(sizes.nanmedian().clamp_min(1e-300))
    paths = [path_lengths(skeleton, skeleton.tips) for skeleton in skeletons]
    reach = float(torch.stack([rows.mean(0).amin() for rows in paths]).median())
    rows = zip(skeletons, relations, paths, strict=True)
    return [_observed(skeleton, relation, lengths, size, reach) for skeleton, relation, lengths in rows]


def _mean_distance(distances: Tensor) -> Tensor:
    count = len(distances)
    return distances.sum() / (count * (count - 1)) if count > 1 else distances.new_tensor(torch.nan)


def _observed(
    skeleton: Skeleton, relations: TipRelations, lengths: Tensor, size: float, reach: float
) -> TipObservations:
    """Return the observations of a frame, given path lengths (M, N), the body's size and the path to its middle."""
    nodes, radii = skeleton.nodes.detach().cpu().double(), skeleton.radii.detach().cpu().double()
    wanted = torch.linspace(0, SAMPLING.reach * reach, SAMPLING.num_points, dtype=torch.float64)
    middle = int(lengths.mean(0).argmin())
    curves, limbs = [], []
    for tip in skeleton.tips.tolist():
        path = skeleton.path(tip, middle).cpu()
        along = arc_lengths(nodes[path])
        curves.append(points_along(nodes[path], wanted))
        places = torch.searchsorted(along, wanted[list(SAMPLING.radius_points)]).clamp_max(len(path) - 1)
        thickness = (radii[path][places] / size).clamp_min(SAMPLING.min_radius).log()
        limbs.append(torch.cat((along[-1:] / size, thickness)))
    return TipObservations(
        curves=torch.stack(curves) / size,
        geodesics=relations.geodesics / size,
        volumes=relations.volumes / size**3,
        limbs=torch.stack(limbs),
    )


class TipFeatures:
    """Features of a frame whose tips have names, which are the same in all frames if the names are right."""

    def __init__(self, num_names: int, num_limb_features: int, *, with_volumes: bool) -> None:
        self.num_names, self.num_limb_features = num_names, num_limb_features
        self.pairs = torch.tensor(list(combinations(range(num_names), 2))).T
        triples = list(combinations(range(num_names), 3)) if with_volumes else []
        self.triples = torch.tensor(triples, dtype=torch.int64).reshape(-1, 3)
        count, rows = self.pairs.shape[1], torch.arange(self.pairs.shape[1])
        incidence = torch.zeros(count, num_names, dtype=torch.float64)
        incidence[rows, self.pairs[0]] = incidence[rows, self.pairs[1]] = 1
        self._tip_terms = torch.linalg.pinv(incidence).mT
        self._left_over = torch.eye(count, dtype=torch.float64) - self._tip_terms @ incidence.mT
        sizes = (num_names, count, len(self.triples), num_names * num_limb_features)
        ranks = (min(num_names, count), max(count - num_names, 0), len(self.triples), num_names * num_limb_features)
        columns = torch.arange(sum(sizes)).split(sizes)
        kinds = zip(columns, ranks, range(len(sizes)), strict=True)
        self.groups = [FeatureGroup(index, rank, number) for index, rank, number in kinds if rank]

    def distances(self, frame: TipObservations, maps: Tensor) -> Tensor:
        """Return the distances (P, K (K - 1) / 2) between named tips, NaN where one is missing."""
        first, second = maps[:, self.pairs[0]], maps[:, self.pairs[1]]
        values = frame.geodesics[first.clamp_min(0), second.clamp_min(0)]
        return torch.where((first >= 0) & (second >= 0), values, torch.nan)

    def __call__(self, frame: TipObservations, maps: Tensor, median_distances: Tensor) -> Tensor:
        """Return the features (P, n) of a frame under mappings (P, K) of names to tips, NaN for missing tips."""
        index, found = maps.clamp_min(0), maps >= 0
        distances = self.distances(frame, maps)
        complete = torch.where(distances.isnan(), median_distances, distances)
        tips = torch.where(found, complete @ self._tip_terms, torch.nan)
        sides = torch.where(distances.isnan(), torch.nan, complete @ self._left_over)
        a, b, c = (index[:, column] for column in self.triples.unbind(1))
        volumes = torch.where(found[:, self.triples].all(-1), frame.volumes[a, b, c], torch.nan)
        limbs = torch.where(found.unsqueeze(-1), frame.limbs[index], torch.nan)
        return torch.cat((tips, sides, volumes, limbs.flatten(1)), dim=1)
