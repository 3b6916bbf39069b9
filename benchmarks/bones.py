"""How long the steps of scan registration take that move bones and weigh them.

    python benchmarks/bones.py            # the table below, a minute
    python benchmarks/bones.py --smoke    # one small case, to see that it runs

Data: a tube of as many bones as stated, bent at every joint, 6,000 points, grid resolution 50. Every row is the median
of repeated calls, and the fastest in brackets: on a busy machine the two differ.

- grid, moments: building the grid from the points; what bones share, in closed form.
- deform: 10,000 points moved.
- T-step: one Gauss-Newton step of all bones with joints, 2,000 matches point to plane, weights binary or blended at the
  borders.
- refine: weights from labels, 1,500 matches.
- pose: four handles; "far": the tube bent on by 40 degrees; "drag": warm-started, by 2 degrees.
"""

from __future__ import annotations

import argparse
import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

import torchreg as tr
from torchreg.geometry.rigid import rigid_matrix
from torchreg.geometry.rotation import so3_exp
from torchreg.registration.bones.correspondences import Correspondences
from torchreg.registration.bones.motion_problem import BoneProblem
from torchreg.registration.bones.motions import fit_bones
from torchreg.registration.bones.sparse_grid import SparseGrid
from torchreg.registration.bones.weights import refine_weights
from torchreg.registration.solve_pose import PoseSolver


@dataclass(frozen=True)
class Tube:
    """A tube of bones of unit length along x.

    Args:
        points: (N, 3) in a straight pose.
        normals: (N, 3) there.
        model: bones labeled as they are, at rest.
    """

    points: Tensor
    normals: Tensor
    model: tr.GridLBS

    def pose(self, angle: float) -> Tensor:
        """Return motions (B, 4, 4) that bend every second joint by ``angle`` up, the others sideways."""
        motions = [torch.eye(4)]
        for joint in range(1, self.model.num_bones):
            axis = torch.tensor([0.0, angle, 0.0] if joint % 2 else [0.0, 0.0, -angle])
            turn, pivot = so3_exp(axis), torch.tensor([float(joint), 0.0, 0.0])
            motions.append(motions[-1] @ rigid_matrix(turn, pivot - turn @ pivot))
        return torch.stack(motions).to(self.points)


def make_tube(bones: int, count: int, resolution: int, dtype: torch.dtype) -> Tube:
    generator = torch.Generator().manual_seed(0)
    along, around = torch.rand(2, count, generator=generator)
    ring = torch.stack([torch.zeros(count), (2 * math.pi * around).cos(), (2 * math.pi * around).sin()], dim=-1)
    # As thick as a tenth of its length, so that cells count alike for all numbers of bones.
    points = 0.05 * bones * ring + torch.stack([bones * along, torch.zeros(count), torch.zeros(count)], dim=-1)
    grid = SparseGrid.from_points(points.to(dtype), resolution)
    labels = grid.cell_centers()[:, 0].long().clamp(0, bones - 1)
    return Tube(points.to(dtype), ring.to(dtype), tr.GridLBS.from_labels(grid, labels, bones))


def milliseconds(call: Callable[[], object], repeats: int) -> str:
    call()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(1000 * (time.perf_counter() - start))
    return f"{statistics.median(times):7.2f} ms  ({min(times):.2f})"


def measure(bones: int, dtype: torch.dtype, scale: float, repeats: int) -> list[tuple[str, str]]:
    """Return name and figure of every row for a number of bones."""
    tube = make_tube(bones, int(6000 * scale), max(8, int(50 * scale**0.5)), dtype)
    model, points = tube.model, tube.points
    generator = torch.Generator().manual_seed(1)
    few = torch.randperm(len(points), generator=generator)[: int(2000 * scale)]
    many = points[torch.randint(len(points), (int(10000 * scale),), generator=generator)]
    bent = tube.pose(0.2)
    rows = []
    with torch.no_grad():
        rows.append(("grid", milliseconds(lambda: SparseGrid.from_points(points, 50).cell_corners, repeats)))
        rows.append(("moments", milliseconds(model.joint_moments, repeats)))
        rows.append(("deform", milliseconds(lambda: model(many), repeats)))
        weights, moments = model.weights_at(points[few]), model.joint_moments()
        targets = model(points[few], bent) + 0.01 * torch.randn(len(few), 3, generator=generator).to(points)
        binary = torch.nn.functional.one_hot(weights.argmax(-1), bones).to(points)
        pairs = Correspondences(targets, tube.normals[few], torch.ones_like(targets[:, 0]), 0.0)
        for name, shares in (("binary", binary), ("blended", weights)):
            problem = BoneProblem.of_weights(points[few], shares, pairs, moments=moments)
            rows.append((f"T-step, {name}", milliseconds(lambda p=problem: fit_bones(p, bent, max_steps=1), repeats)))
    rows += refinement_rows(tube, few[: int(1500 * scale)], max(1, repeats // 10))
    return rows + pose_rows(tube, repeats)


def refinement_scene(tube: Tube, few: Tensor) -> tuple[tr.GridLBS, Tensor, Correspondences]:
    """Return the bent tube labeled in parts, some of its points, and where smooth weights would take them."""
    model = tr.GridLBS(tube.model.grid, tube.model.weights, tube.pose(0.3))
    points = tube.points[few]
    share = torch.sigmoid(6 * (points[:, :1] - torch.arange(1, model.num_bones).to(points)))
    smooth = torch.cat([torch.ones_like(share[:, :1]), share], dim=-1)
    smooth = smooth - torch.cat([share, torch.zeros_like(share[:, :1])], dim=-1)
    moved = points @ model.transforms[:, :3, :3].mT + model.transforms[:, None, :3, 3]
    targets = (smooth.mT.unsqueeze(-1) * moved).sum(0).detach()
    return model, points, Correspondences(targets, tube.normals[few], torch.ones_like(targets[:, 0]), 0.0)


def refinement_rows(tube: Tube, few: Tensor, repeats: int) -> list[tuple[str, str]]:
    model, points, pairs = refinement_scene(tube, few)
    return [("refine", milliseconds(lambda: refine_weights(model, points, pairs).objective, repeats))]


def pose_rows(tube: Tube, repeats: int) -> list[tuple[str, str]]:
    start = tube.pose(0.2)
    model = tr.GridLBS(tube.model.grid, tube.model.weights, start)
    length = model.num_bones
    at = torch.tensor([0.05, 0.3, 0.7, 0.95]).unsqueeze(-1)
    handles = (at * torch.tensor([float(length), 0, 0]) + torch.tensor([0, 0.05 * length, 0])).to(tube.points)
    solver = PoseSolver(model)
    rows = [("pose, finding joints", milliseconds(lambda: PoseSolver(model), repeats))]
    for name, angle in (("far", math.radians(40.0)), ("drag", math.radians(2.0))):
        targets = model(handles, tube.pose(0.2 + angle / max(1, length - 1))).detach()
        solution = solver.solve(handles, targets)
        figure = milliseconds(lambda t=targets: solver.solve(handles, t), repeats)
        miss = float(solution.residuals.max()) / length
        rows.append((f"pose, {name}", f"{figure}, {solution.num_steps} steps, off by {100 * miss:.2f} % of the length"))
    return rows


def main(arguments: Sequence[str] | None = None) -> dict[str, list[tuple[str, str]]]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="one small case")
    parser.add_argument("--threads", type=int, default=1, help="of torch")
    parser.add_argument("--repeats", type=int, default=30, help="calls per row")
    options = parser.parse_args(arguments)
    torch.set_num_threads(options.threads)
    cases = (
        [(3, torch.float32)] if options.smoke else [(b, t) for b in (10, 40) for t in (torch.float32, torch.float64)]
    )
    tables = {}
    for bones, dtype in cases:
        title = f"{bones} bones, {str(dtype).removeprefix('torch.')}"
        print(f"\n{title}")
        tables[title] = measure(bones, dtype, 0.05 if options.smoke else 1.0, 1 if options.smoke else options.repeats)
        for name, figure in tables[title]:
            print(f"  {name:<24}{figure}")
    return tables


if __name__ == "__main__":
    main()
