"""Where a robot's base may be in a camera's coordinates: a search over clouds with known joints, without a start."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.alignment.base.fit import BASE_FIT
from torchreg.alignment.base.frames import BaseFrame, carrier
from torchreg.alignment.fit.annealed_em import narrowing
from torchreg.alignment.search.multi_start import SEARCH_BUDGET
from torchreg.geometry.neighbors import NeighborTree
from torchreg.geometry.rigid import fit_rigid, invert_rigid, rigid_matrix, transform_points
from torchreg.geometry.rotation import spread_rotations
from torchreg.geometry.sampling import farthest_points
from torchreg.shapes.pose_algebra import BASE_DOFS
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.solvers.robust import welsch_loss, welsch_weight


@dataclass(frozen=True)
class _BaseSearch:
    """Numbers of the search; widths are shares of the model's size."""

    num_rotations: int = 300  # tried, 30 degrees apart
    start: float = 0.3  # first kernel; after each, the better half of the candidates go on
    num_shifts: int = 3  # of each rotation, as many frames each ask for theirs
    steps: int = 2  # with each kernel
    num_data: int = 450  # of all frames together
    num_kept: int = 8  # candidates returned, at most
    score_width: float = BASE_FIT.stop  # of the last kernel, by which candidates are ranked
    gap: float = 4.0  # typical angles between data, beyond which a model point is beside all that was seen
    same_turn: float = 0.2  # candidates whose bases differ by less are one, radians


_SEARCH = _BaseSearch()


@dataclass(frozen=True, eq=False)
class PosedModel:
    """The robot in the joints of a frame, in coordinates of its base, or of the link that carries the camera.

    Points and outward normals (N, 3).
    """

    points: Tensor
    normals: Tensor
    tree: NeighborTree

    @classmethod
    def of_skin(cls, skin: LinearBlendSkin, joints: Tensor, camera_part: int | None = None) -> PosedModel:
        """Return the points of a skin with normals at joints (J,)."""
        pose = torch.nn.functional.pad(joints, (BASE_DOFS, 0)).to(skin.shape.rest)
        points, normals = skin(pose).detach().cpu().double(), skin.posed_normals(pose).detach().cpu().double()
        to_carrier = invert_rigid(carrier(skin.shape, joints[None], camera_part))[0]
        points, normals = transform_points(to_carrier, points), normals @ to_carrier[:3, :3].mT
        return cls(points, normals, NeighborTree(points))


def search_base(frames: Sequence[BaseFrame], models: Sequence[PosedModel], size: float) -> tuple[Tensor, Tensor]:
    """Return different candidates (K, 4, 4) ``T_camera_base``, best first, and their costs (K,).

    Iterated closest points with a narrowing kernel from rotations all around. Costs count data far from the model, and
    model points that face the camera where nothing was measured.
    """
    data = _drawn(frames)
    candidates = _starts(data, models)
    for width in narrowing(_SEARCH.start, _SEARCH.score_width):
        count = -(-len(candidates) // 2)
        for _ in range(_SEARCH.steps):
            candidates, cost = _step(candidates, data, models, width * size)
            candidates = candidates[cost.argsort()[:count]]
    return rank_bases(candidates, frames, models, size)


def rank_bases(
    candidates: Tensor, frames: Sequence[BaseFrame], models: Sequence[PosedModel], size: float
) -> tuple[Tensor, Tensor]:
    """Return the candidates (K, 4, 4) that differ from better ones, best first, and their costs, as `search_base`."""
    cost = _cost(candidates, _drawn(frames), frames, models, size)
    order = cost.argsort()
    return _distinct(candidates[order], cost[order], size)


def seen_shares(base: Tensor, frames: Sequence[BaseFrame], models: Sequence[PosedModel], size: float) -> Tensor:
    """Return the share (T,) of the model's side towards the camera that has data near, for each frame."""
    shares = []
    for frame, model in zip(frames, models, strict=True):
        posed, normals = transform_points(base, model.points), model.normals @ base[:3, :3].mT
        shown = (posed * normals).sum(-1) < 0
        near = NeighborTree(frame.points).nearest(posed[shown])[1] < _SEARCH.score_width * size
        shares.append(near.double().sum() / shown.sum().clamp_min(1))
    return torch.stack(shares)


def _drawn(frames: Sequence[BaseFrame]) -> Tensor:
    """Return equally many data (T, M, 3) of each frame, spread over it."""
    count = min(min(len(frame.points) for frame in frames), max(1, _SEARCH.num_data // len(frames)))
    return torch.stack([frame.points[farthest_points(frame.points, count)] for frame in frames])


def _starts(data: Tensor, models: Sequence[PosedModel]) -> Tensor:
    """Return candidates (K, 4, 4), the middle of the data on that of the model's side towards the camera.

    The middle is that of all frames, and of some alone: of a part of the robot it is off.
    """
    rotations = spread_rotations(_SEARCH.num_rotations)
    shifts = []
    for points, model in zip(data, models, strict=True):
        middle = points.median(0).values
        view = rotations.mT @ torch.nn.functional.normalize(middle, dim=0)
        shown = (-(view @ model.normals.mT)).clamp_min(0)
        seen = shown @ model.points / shown.sum(-1, keepdim=True).clamp_min(1e-12)
        shifts.append(middle - (rotations @ seen.unsqueeze(-1)).squeeze(-1))
    tried = [torch.stack(shifts).median(0).values, *(shifts[: _SEARCH.num_shifts] if len(shifts) > 1 else ())]
    return rigid_matrix(rotations.repeat(len(tried), 1, 1), torch.cat(tried))


def _step(candidates: Tensor, data: Tensor, models: Sequence[PosedModel], width: float) -> tuple[Tensor, Tensor]:
    """Return candidates (K, 4, 4) after a step of iterated closest points, and their costs (K,) before it."""
    local = transform_points(invert_rigid(candidates).unsqueeze(1), data)
    eye = invert_rigid(candidates)[:, None, None, :3, 3]
    targets, normals = torch.empty_like(local), torch.empty_like(local)
    for number, model in enumerate(models):
        index = model.tree.nearest(local[:, number].flatten(0, 1))[0].reshape(local[:, number].shape[:-1])
        targets[:, number], normals[:, number] = model.points[index], model.normals[index]
    squared = (local - targets).square().sum(-1) / width**2
    facing = ((eye - targets) * normals).sum(-1) > 0
    weights = welsch_weight(squared) * facing
    cost = (1 - weights).mean((-2, -1))
    everything = data.flatten(0, 1).expand(len(candidates), -1, -1)
    return fit_rigid(targets.flatten(1, 2), everything, weights.flatten(1)), cost


def _cost(
    candidates: Tensor, data: Tensor, frames: Sequence[BaseFrame], models: Sequence[PosedModel], size: float
) -> Tensor:
    """Return the costs (K,) of candidates: of data far from the model, and of the model where nothing was measured."""
    width = _SEARCH.score_width * size
    far = _step(candidates, data, models, width)[1]
    beside = torch.zeros_like(far)
    for frame, model in zip(frames, models, strict=True):
        posed = transform_points(candidates, model.points)
        normals = (candidates[:, :3, :3] @ model.normals.mT).mT
        shown = (posed * normals).sum(-1) < 0
        intrusion = _before_data(frame.points, posed)
        loss = welsch_loss((intrusion / width).square()) * shown
        beside += loss.sum(-1) / shown.sum(-1).clamp_min(1) / len(frames)
    return far + beside


def _before_data(points: Tensor, posed: Tensor) -> Tensor:
    """Return how far posed points (K, N, 3) lie before the data (M, 3) in their direction, or off all of them."""
    plane = points[:, :2] / points[:, 2:].clamp_min(1e-6)
    tree = NeighborTree(plane)
    typical = tree.k_nearest(plane, min(2, len(plane)))[1][:, -1].median()
    depth = posed[..., 2]
    looked = posed[..., :2] / depth.clamp_min(1e-6).unsqueeze(-1)
    index, angle = tree.nearest(looked.flatten(0, 1))
    angle = angle.reshape(depth.shape)
    ahead = (points[index, 2].reshape(depth.shape) - depth).clamp_min(0)
    return torch.where(angle > _SEARCH.gap * typical, angle * depth.abs(), ahead)


def _distinct(candidates: Tensor, cost: Tensor, size: float) -> tuple[Tensor, Tensor]:
    """Return the candidates that differ from better ones, at most a few."""
    kept: list[int] = []
    for number in range(len(candidates)):
        others = candidates[kept]
        traces = (others[:, :3, :3] * candidates[number, :3, :3]).sum((-2, -1))
        turn = ((traces - 1) / 2).clamp(-1, 1).arccos()
        shift = (others[:, :3, 3] - candidates[number, :3, 3]).norm(dim=-1)
        if not bool(((turn < _SEARCH.same_turn) & (shift < SEARCH_BUDGET.same * size)).any()):
            kept.append(number)
    kept = kept[: _SEARCH.num_kept]
    return candidates[kept], cost[kept]
