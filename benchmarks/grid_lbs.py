"""Weights of bones on a grid learnt by autograd, their projection, and the energy of a registration as it falls.

    python benchmarks/grid_lbs.py            # under a minute on one core
    python benchmarks/grid_lbs.py --smoke    # small cases, to see that it runs

- projection: the largest deviation of `GridLBS.project_` from the exact projection on the simplex, found by bisection,
  for random, zero, negative and large rows.
- weights: a bent tube labeled in parts; its weights by Adam with `project_` after every step, and by the direct
  non-negative least squares, within the reach of the labels that registrations have and at all corners: the ratio of
  their objectives, eqs. 8 and 13.
- energy: what registrations of a jointed toy and of a walking figure report: the energy after every step, its terms at
  both ends, and the share of the time that reporting takes.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import torch
from bones import make_tube, refinement_scene
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torchreg as tr
from experiments.made_up.walks import walking_figure
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.datasets.scan_sequences import jointed_toy
from torchreg.registration.bones import step_record
from torchreg.registration.bones.sparse_grid import SparseGrid
from torchreg.registration.bones.weights import WeightsConfig, refine_weights


def exact_projection(rows: Tensor) -> Tensor:
    """Return the projection of rows (K, B) on the simplex, by bisection of the amount that is taken off."""
    rows = rows.double()
    low, high = rows.amax(-1, keepdim=True) - 1, rows.amax(-1, keepdim=True)
    for _ in range(200):
        middle = (low + high) / 2
        over = (rows - middle).clamp_min(0).sum(-1, keepdim=True) > 1
        low, high = torch.where(over, middle, low), torch.where(over, high, middle)
    return (rows - low).clamp_min(0)


def projection_rows(num_bones: int) -> dict[str, float]:
    """Return the largest deviation of `project_` for rows of several kinds, float32."""
    generator = torch.Generator().manual_seed(0)
    grid = SparseGrid.from_points(torch.rand(2000, 3, generator=generator), 8)
    drawn = torch.randn(grid.num_corners, num_bones, generator=generator)
    kinds = {"random": drawn, "zero": 0 * drawn, "negative": -drawn.abs() - 0.1, "large": 1e6 * drawn}
    found = {}
    for kind, rows in kinds.items():
        model = tr.GridLBS(grid, torch.ones_like(rows))
        with torch.no_grad():
            model.weights.copy_(rows)
        found[kind] = float((model.project_().weights.detach() - exact_projection(rows)).abs().max())
    return found


def weight_ratios(num_bones: int, scale: float, steps: int) -> dict[str, float]:
    """Return the objective of learnt weights over those of direct solves, and the seconds of each."""
    tube = make_tube(num_bones, int(6000 * scale), max(8, int(50 * scale**0.5)), torch.float32)
    model, points, pairs = refinement_scene(tube, torch.arange(int(1500 * scale)))
    energy = tr.RegistrationEnergy(model, joint=0.0, discontinuity=WeightsConfig().closeness)
    matches = points, pairs.targets, pairs.normals
    found = {}
    for name, reach in (("within reach", WeightsConfig().reach), ("all corners", grid_diameter(model))):
        start = time.perf_counter()
        found[name] = refine_weights(model, points, pairs, WeightsConfig(reach=reach)).objective
        found[f"seconds, {name}"] = time.perf_counter() - start
    start, optimizer = time.perf_counter(), torch.optim.Adam([model.weights], lr=0.01)
    for _ in range(steps):
        optimizer.zero_grad()
        energy(*matches).backward()
        optimizer.step()
        model.project_()
    found["seconds, learnt"] = time.perf_counter() - start
    learnt = energy(*matches).item()
    return found | {name: learnt / found[name] for name in ("within reach", "all corners")}


def grid_diameter(model: tr.GridLBS) -> int:
    """Return a number of edges within which all corners of a piece of the grid lie."""
    return sum(model.grid.shape) + 3


def reported_energies(pair: object, num_bones: int, resolution: int) -> tuple[tr.ScanRegistration, float]:
    """Return a registration, and the share of its time that the energies of its records took."""
    spent, evaluate = [0.0], step_record.energy_terms

    def timed(state: object, weights: dict[str, float]) -> dict[str, Tensor]:
        start = time.perf_counter()
        # Not known without the records: what continuous weights share, and the edges.
        state.model.joint_moments()
        state.model.grid.edges()
        terms = evaluate(state, weights)
        spent[0] += time.perf_counter() - start
        return terms

    step_record.energy_terms = timed
    try:
        start = time.perf_counter()
        found = tr.register(pair.source, pair.target, num_bones, resolution)
        total = time.perf_counter() - start
    finally:
        step_record.energy_terms = evaluate
    return found, spent[0] / total


def print_energies(smoke: bool) -> dict[str, list[float]]:
    """Print the energies of registrations; return their sums over the steps."""
    sums, scenes = {}, {"toy": jointed_toy, "figure": walking_figure}
    for name, make in list(scenes.items())[: 1 if smoke else 2]:
        pair = make(2, seed=2, scanner=DepthScanner(num_points=900 if smoke else 8000)).pair(0, 1)
        found, share = reported_energies(pair, 10 if smoke else 20, 30 if smoke else 50)
        sums[name] = [sum(record.energies.values()) for record in found.history]
        print(f"energy, {name}: {' '.join(f'{value:.3f}' for value in sums[name])}; {100 * share:.1f} % of the time")
        for record in (found.history[0], found.history[-1]):
            terms = ", ".join(f"{term} {value:.3f}" for term, value in record.energies.items())
            print(f"  {record.stage} {record.step}: {terms}")
    return sums


def main(arguments: Sequence[str] | None = None) -> dict[str, dict[str, object]]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="small cases")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    deviations = projection_rows(num_bones=20)
    for kind, deviation in deviations.items():
        print(f"projection, {kind:<9}{deviation:9.1e}")
    ratios = weight_ratios(*((3, 0.05, 100) if options.smoke else (10, 1.0, 150)))
    for name in ("within reach", "all corners"):
        print(f"learnt over direct, {name:<13}{ratios[name]:8.4f}  ({ratios[f'seconds, {name}']:.1f} s direct)")
    print(f"learnt in {ratios['seconds, learnt']:.1f} s")
    return {"projection": deviations, "weights": ratios, "energy": print_energies(options.smoke)}


if __name__ == "__main__":
    main()
