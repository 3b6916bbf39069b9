"""Which parts of a whole picture may show a shape: windows in which a network proposes poses, or pieces of surfaces."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchreg._threads import one_thread
from torchreg.alignment.evidence.picture_agreement import picture_views
from torchreg.alignment.fit.problem import AlignProblem, centered_problem, model_size
from torchreg.alignment.search.multi_start import SEARCH_BUDGET
from torchreg.alignment.search.pose_proposer import PoseProposer, Proposals
from torchreg.alignment.search.pose_search import PoseSearch
from torchreg.alignment.search.segmenter import shipped_segmenter
from torchreg.alignment.search.start_source import (
    PROPOSAL_FIT,
    StartSource,
    fitted_proposals,
    with_proposed_prior,
)
from torchreg.capture.depth_frame import DepthFrame
from torchreg.capture.depth_segments import SurfaceGrid, candidate_crops
from torchreg.capture.free_space import FreeSpace
from torchreg.geometry.sampling import farthest_points
from torchreg.shapes.pose_algebra import shifted
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.solvers.calibration import Logistic


@dataclass(frozen=True)
class _Windows:
    """Numbers of the windows of a picture; lengths are shares of the shape's size."""

    radius: float = 0.55  # of a window: half the shape, and as much as a network may be off
    apart: float = 0.2  # windows nearer to one another show the same
    most: int = 48  # that a network looks into
    fitted: int = 12  # of those, the likeliest, to which its poses are fitted
    least: int = 30  # points of a window
    pose_error: float = 0.03  # standard deviation of data about a fitted proposal
    rough: int = 64  # poses that are fitted coarsely without a network, as by a search


_WINDOWS = _Windows()


@dataclass(frozen=True)
class WindowModel(Logistic):
    """The logistic model of whether a window shows the shape about where a network's fitted pose is, at even odds.

    By the table of `PictureAgreement`, and by the share of the window's data that the network takes for something else.
    Fitted to 277 windows of 26 made-up rooms, of which 31 show a hand.
    """

    bias: float = 9.75
    weights: tuple[float, ...] = (2.96, 0.0, 6.35, 2.43, 1.24, 3.01)


WINDOW_MODEL = WindowModel()


@dataclass(frozen=True)
class CropModel(Logistic):
    """The same of crops of surfaces and poses fitted coarsely, by the table of `PictureAgreement` alone.

    Fitted to 139 crops of 30 made-up rooms, of which 18 show an arm.
    """

    bias: float = 9.94
    weights: tuple[float, ...] = (0.0, 0.0, 4.8, 4.36, 6.88)


CROP_MODEL = CropModel()


@dataclass(frozen=True, eq=False)
class LikelyCrop:
    """A crop of a picture, the Bayes factor that it shows the shape, and a network's pose (num_dofs,) in it."""

    frame: DepthFrame
    odds: float = 1.0
    start: Tensor | None = None

    @property
    def is_quick(self) -> bool:
        """Whether a quick alignment tells enough at first: from a network's pose, or of what hardly shows the shape."""
        return self.start is not None or self.odds < 1


@torch.no_grad()
def likely_crops(frame: DepthFrame, skin: LinearBlendSkin, source: StartSource) -> list[LikelyCrop]:
    """Return the crops of a frame that may show a shape, likeliest first.

    With a network: what belongs to the shape of windows in which its fitted poses agree best with the picture. Without:
    pieces of surfaces to which coarsely fitted poses agree best, all with even odds where some of the pose is known.
    """
    with one_thread():
        grid = _grid(frame, skin)
        if len(grid.points) < _WINDOWS.least:
            return []
        if source.proposer is not None:
            return _proposed_crops(grid, skin, source.proposer)
        kept = [nodes for nodes in candidate_crops(grid, model_size(skin)) if int(nodes.sum()) >= _WINDOWS.least]
        crops = [LikelyCrop(frame.cropped(grid.mask(nodes))) for nodes in kept]
        if source.known is not None or len(crops) < 2:
            return crops
        odds = _coarse_odds(_Windowed.of(grid.points.to(skin.shape.rest), torch.stack(kept)), crops, skin, source)
        rated = [replace(crop, odds=odd) for crop, odd in zip(crops, odds, strict=True)]
        return sorted(rated, key=lambda crop: crop.odds, reverse=True)


@torch.no_grad()
def crop_about(frame: DepthFrame, skin: LinearBlendSkin, proposer: PoseProposer, pose: Tensor) -> DepthFrame | None:
    """Return the crop of what belongs to a shape in a pose (num_dofs,) about right; None where nothing does."""
    with one_thread():
        grid, center = _grid(frame, skin), skin.shape.keypoints(pose).mean(0, keepdim=True)
        windows = _Windowed.about(grid.points.to(center), center, model_size(skin))
        if not len(windows.centers):
            return None
        problem = windows.problem(skin, [frame.near(center[0].double())])
        proposals, told = windows.proposed(proposer), windows.segmented(problem)
        mask = grid.mask(windows.belonging(0, problem, shifted(pose[None], -center), proposals, told))
        return frame.cropped(mask) if int(mask.sum()) >= _WINDOWS.least else None


def _grid(frame: DepthFrame, skin: LinearBlendSkin) -> SurfaceGrid:
    size = model_size(skin)
    return SurfaceGrid.of(frame, size).without_planes(size)


def _coarse_odds(
    windows: _Windowed, crops: Sequence[LikelyCrop], skin: LinearBlendSkin, source: StartSource
) -> list[float]:
    """Return the odds that crops, with their points, show a shape, by poses of a search before limbs are placed."""
    frames = [crop.frame.near(center.double()) for crop, center in zip(crops, windows.centers, strict=True)]
    generator = torch.Generator().manual_seed(0)
    problem = windows.problem(skin, frames)
    search = PoseSearch(problem, generator)
    rough = search.registered(source.rough(search.problem, generator), generator)
    poses = search.fit_coarsely(rough.distinct(SEARCH_BUDGET.same, _WINDOWS.rough).poses)[:, 0]
    return CROP_MODEL.log_odds(_tables(problem, poses, frames)).exp().tolist()


def _tables(problem: AlignProblem, poses: Tensor, frames: Sequence[DepthFrame]) -> Tensor:
    """Return how frames agree with poses (B, num_dofs), see `PictureAgreement`."""
    return torch.stack([whole.table() for whole, _ in picture_views(problem, poses, frames)])


def _proposed_crops(grid: SurfaceGrid, skin: LinearBlendSkin, proposer: PoseProposer) -> list[LikelyCrop]:
    """Return crops of the windows of a grid, likeliest first."""
    points, size = grid.points.to(skin.shape.rest), model_size(skin)
    centers = points[farthest_points(points, min(_WINDOWS.most, len(points)))]
    windows = _Windowed.about(points, _distinct(centers, _WINDOWS.radius / 2 * size), size)
    # The network's poses are better where it sees the shape in the middle.
    likely = windows.proposed(proposer)
    middle = skin.shape.keypoints(likely.poses[:, 0]).mean(1) + windows.centers
    order = likely.inlier.sum(-1).argsort(descending=True)
    windows = _Windowed.about(points, _distinct(middle[order], _WINDOWS.apart * size)[: _WINDOWS.fitted], size)
    if not len(windows.centers):
        return []
    proposals = windows.proposed(proposer)
    frames = [grid.frame.near(center.double()) for center in windows.centers]
    problem = windows.problem(skin, frames)
    fitted = fitted_proposals(with_proposed_prior(problem, proposals), proposals, PROPOSAL_FIT.kept)
    poses = fitted.poses[:, 0]
    views = _tables(problem, poses, frames)
    elsewhere = 1 - proposals.inlier.sum(-1) / windows.valid.sum(-1).clamp_max(proposals.inlier.shape[-1])
    odds = WINDOW_MODEL.log_odds(torch.cat([views, elsewhere.unsqueeze(-1)], dim=-1)).exp()
    told = windows.segmented(problem)
    starts = shifted(poses, windows.centers)
    return [
        LikelyCrop(grid.frame.cropped(mask), float(odds[row]), starts[row])
        for row in odds.argsort(descending=True).tolist()
        if int((mask := grid.mask(windows.belonging(row, problem, poses, proposals, told))).sum()) >= _WINDOWS.least
    ]


@dataclass(frozen=True, eq=False)
class _Windowed:
    """Points (V, 3) of a grid, metres, and those in balls about centers (B, 3): their numbers and a mask (B, M)."""

    everything: Tensor
    centers: Tensor
    index: Tensor
    valid: Tensor

    @classmethod
    def about(cls, points: Tensor, centers: Tensor, size: float) -> _Windowed:
        """Return the windows about centers that hold enough points."""
        inside = torch.cdist(centers, points) < _WINDOWS.radius * size
        enough = inside.sum(1) >= _WINDOWS.least
        return cls.of(points, inside[enough], centers[enough])

    @classmethod
    def of(cls, points: Tensor, inside: Tensor, centers: Tensor | None = None) -> _Windowed:
        """Return the windows of the points (V, 3) inside (B, V), about their means by default."""
        if centers is None:
            centers = inside.to(points) @ points / inside.sum(1, keepdim=True)
        count = int(inside.sum(1).max()) if len(inside) else 0
        valid, index = inside.float().topk(count, dim=1)
        return cls(points, centers, index, valid > 0)

    @property
    def points(self) -> Tensor:
        """The points (B, M, 3) about the centers, metres."""
        return torch.where(self.valid.unsqueeze(-1), self.everything[self.index] - self.centers.unsqueeze(1), 0.0)

    def proposed(self, proposer: PoseProposer) -> Proposals:
        """Return the poses of a network about the centers."""
        return proposer.propose(self.points, self.valid)

    def problem(self, skin: LinearBlendSkin, frames: list[DepthFrame]) -> AlignProblem:
        """Return the problems of fitting a shape to the windows, each about its center."""
        count = len(self.centers)
        return centered_problem(
            skin, self.points, self.valid, skin.shape.rest.expand(count, -1), torch.zeros_like(self.centers),
            prior_std=None, pose_atol=0.0, free_space=FreeSpace.stacked([each.free_space for each in frames]),
        )  # fmt: skip

    def segmented(self, problem: AlignProblem) -> Tensor | None:
        """Return the log-odds (B, M) that points belong to the shape by a network for that; None without one."""
        segmenter = shipped_segmenter(problem.skin.shape)
        if segmenter is None:
            return None
        return segmenter.log_odds(problem.skin.shape, self.points, self.valid, problem.size)

    def belonging(
        self, row: int, problem: AlignProblem, poses: Tensor, proposals: Proposals, told: Tensor | None
    ) -> Tensor:
        """Return the points (V,) that belong to the shape in a window rather than to something else.

        By log-odds that are ``told`` (B, M), else by the network of the poses; and by the distance from its fitted
        pose: normal for the shape, uniform for something else.
        """
        valid = self.valid[row]
        points = self.points[row, valid]
        if told is None:
            nearest = torch.cdist(points, proposals.points[row]).argmin(-1)
            odds = proposals.inlier[row, nearest].clamp(0.02, 0.98).logit()
        else:
            odds = told[row, valid]
        distance = problem.surface.distance(points[None], poses[row, None])[0] / problem.size
        on_shape = -0.5 * (distance / _WINDOWS.pose_error).square()
        level = math.log(2 / math.sqrt(2 * math.pi) / _WINDOWS.pose_error * _WINDOWS.radius)
        kept = torch.zeros(len(self.everything), dtype=torch.bool, device=points.device)
        kept[self.index[row, valid]] = odds + on_shape + level > 0
        return kept


def _distinct(centers: Tensor, apart: float) -> Tensor:
    """Return the centers (B, 3) that are not near one kept before them."""
    near = torch.cdist(centers, centers) < apart
    kept: list[int] = []
    for number in range(len(centers)):
        if not kept or not bool(near[number, kept].any()):
            kept.append(number)
    return centers[kept]
