"""Few points of many, as evenly spread as their surface allows: Poisson-disk subsets."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_count, check_points, check_positive
from torchreg.geometry.neighbors import k_nearest_others, pairs_within, weld

# Radii of successive thinnings grow by this; more neighbors in reach cost more than they save.
_GROWTH = 3.0
# How far a subset may exceed the wanted count before the surplus is dropped, and how often its radius is tried.
_SURPLUS, _MAX_TRIES = 1.03, 10


def poisson_disk(points: Tensor, radius: float, generator: torch.Generator | None = None) -> Tensor:
    """Return the indices of points that are all farther than ``radius`` apart, and near which all others are.

    Points come in random order, each kept if no kept one is within the radius. What is far denser than the radius is
    thinned in steps of growing radii first, so that dense and sparse regions end alike; no point is then farther than
    one and a half radii from a kept one, and without such steps than one.

    Args:
        points: (N, 3), at least one; points at one place are fine.
        radius: in the unit of the points.
        generator: source of the order; None draws from a fresh generator with seed 0, the same at every call.

    Returns:
        (M,) int64, ascending, on the device of the points.

    Raises:
        InputError: if a number is not finite or the radius is not positive.

    Cost: O(N log N); 0.1 s for 20,000 points.

    References: Cook, "Stochastic sampling in computer graphics", 1986 (dart throwing).
    """
    check_positive(radius, "radius")
    points, places, index = _prepare(points, generator)
    few = _thin(places, np.arange(len(places)), radius, _typical_distance(places))
    return torch.from_numpy(np.sort(index[few])).to(points.device)


def poisson_disk_count(points: Tensor, count: int, generator: torch.Generator | None = None) -> Tensor:
    """Return the indices of ``count`` points that lie about as far apart as that many can.

    Args:
        points: (N, 3), at least one; points at one place are fine.
        count: how many; all points where there are no more.
        generator: see `poisson_disk`.

    Returns:
        (min(count, N),) int64, ascending, on the device of the points.

    Raises:
        InputError: if a number is not finite or the count is not positive.

    Cost: O(N log N), a few times that of `poisson_disk`.
    """
    check_count(count, "count", 1)
    points, places, index = _prepare(points, generator)
    if count >= len(points):
        return torch.arange(len(points), device=points.device)
    if count >= len(places):
        others = np.setdiff1d(np.arange(len(points)), index)
        return torch.from_numpy(np.sort(np.concatenate((index, others[: count - len(places)])))).to(points.device)
    few = _search(places, count)
    few = _drop_surplus(places, few, len(few) - count)
    return torch.from_numpy(np.sort(index[few])).to(points.device)


def _prepare(points: Tensor, generator: torch.Generator | None) -> tuple[Tensor, Tensor, np.ndarray]:
    """Return the points, their different places in random order, and one index into the points for each."""
    points = as_float_tensor(points, "points")
    check_points(points, "points", batch=False)
    if generator is None:
        generator = torch.Generator().manual_seed(0)
    order = torch.randperm(len(points), generator=generator, device=generator.device).cpu()
    _, first = np.unique(weld(points)[order].numpy(), return_index=True)
    index = order.numpy()[np.sort(first)]
    return points, points.detach().cpu().double()[index], index


def _typical_distance(places: Tensor) -> float:
    """Return the median distance of a place to the nearest other one, the mean of the two middle ones."""
    return float(np.median(k_nearest_others(places, 1)[1].numpy())) if len(places) > 1 else np.inf


def _thin(places: Tensor, few: np.ndarray, radius: float, step: float) -> np.ndarray:
    """Return those of the indices ``few``, ascending, that stay, thinned by radii growing from their ``step``."""
    steps = int(np.log(max(radius / step, 1.0)) / np.log(_GROWTH))
    for power in range(steps, -1, -1):
        few = few[_undisputed(places[few], radius / _GROWTH**power)]
    return few


def _undisputed(places: Tensor, radius: float) -> np.ndarray:
    """Return a mask of the places that a walk in order keeps; each is out of reach of those kept before."""
    pairs = pairs_within(places, radius).numpy()
    first, second = np.concatenate((pairs, pairs[:, ::-1])).T
    kept, undecided = np.zeros(len(places), dtype=bool), np.ones(len(places), dtype=bool)
    while undecided.any():
        best = np.full(len(places), len(places))
        np.minimum.at(best, first, second)
        chosen = undecided & (np.arange(len(places)) < best)
        kept |= chosen
        undecided[chosen] = False
        undecided[first[chosen[second]]] = False
        alive = undecided[first] & undecided[second]
        first, second = first[alive], second[alive]
    return kept


def _search(places: Tensor, count: int) -> np.ndarray:
    """Return a thinned subset of ``count`` places or more, hardly more if a radius was found that leaves as many."""
    step = _typical_distance(places)
    radius = step * np.sqrt(len(places) / count)
    start = best = np.arange(len(places))
    lower, upper = 0.0, np.inf
    if radius > _GROWTH * step:
        # Shared by all tries below.
        thinned = _thin(places, start, radius / _GROWTH, step)
        if len(thinned) >= count:
            start, step = thinned, _typical_distance(places[thinned])
    for _ in range(_MAX_TRIES):
        few = _thin(places, start, radius, step)
        if count <= len(few) < len(best):
            best = few
        if count <= len(few) <= _SURPLUS * count + 1:
            break
        lower, upper = (radius, upper) if len(few) > count else (lower, radius)
        guess = radius * np.sqrt(len(few) / (0.5 * (1 + _SURPLUS) * count))
        radius = guess if lower < guess < upper else 0.5 * (lower + upper)
    return best


def _drop_surplus(places: Tensor, few: np.ndarray, surplus: int) -> np.ndarray:
    """Return the indices without as many of those with the nearest neighbors, one of a pair at a time."""
    while surplus > 0:
        near, distance = (found[:, 0].numpy() for found in k_nearest_others(places[few], 1))
        loser = np.maximum(np.arange(len(few)), near)
        order = loser[np.argsort(distance, kind="stable")]
        out = order[np.sort(np.unique(order, return_index=True)[1])]
        out = out[: min(surplus, 1 + len(few) // 8)]
        few = np.delete(few, out)
        surplus -= len(out)
    return few
