"""Finding the pose of an articulated shape without a start: rough poses from all sources, then a search that prunes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchreg._checks import check_choice, check_count, check_direction, check_positive, warn_about_rounding
from torchreg._threads import one_thread
from torchreg.alignment.config import AlignConfig
from torchreg.alignment.evidence.confidence import is_misfit
from torchreg.alignment.evidence.reliability import CALIBRATION, pose_confidence, rival_margin, without_cut
from torchreg.alignment.fit.problem import BROAD_PRIOR, AlignProblem, alignment_cost, centered_problem, masked_mean
from torchreg.alignment.inputs import (
    Task,
    check_clouds,
    check_skin,
    warn_about_degenerate,
    warn_about_units,
)
from torchreg.alignment.known_dofs import KnownDofs
from torchreg.alignment.results import PoseStarts
from torchreg.alignment.search.in_picture import surest_crop
from torchreg.alignment.search.landmark_fit import KeypointRows, find_keypoints
from torchreg.alignment.search.multi_start import SEARCH_BUDGET, Candidates, align_rows
from torchreg.alignment.search.pose_proposer import HoldsProposer, PoseProposer
from torchreg.alignment.search.pose_search import PoseSearch
from torchreg.alignment.search.rough_poses import PoseSource, typical_poses
from torchreg.alignment.search.start_source import Proposed, StartSource
from torchreg.capture.depth_frame import DepthFrame
from torchreg.geometry.camera import Camera
from torchreg.geometry.far_origin import to_world
from torchreg.geometry.upright import Direction
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.pose_algebra import shifted
from torchreg.shapes.skin import LinearBlendSkin
from torchreg.shapes.surface import SkinSurface


@dataclass(frozen=True)
class FindPoseConfig:
    """Settings of `find_pose`.

    Args:
        num_candidates: rough poses, after rigid registration, that are fitted to the surface.
        num_placed: of those, the best, whose limbs are placed coarsely; of a skinned rig, those that are aligned.
        num_searched: of those, the best, whose limbs are placed thoroughly; of a skinned rig, those fitted to all data.
        search_rounds: of the thorough search, at most.
        num_retries: searches with other draws, at most, where the best pose leaves many data beside the surface.
        prior_std: standard deviation of a weak prior that draws joints to a typical pose, radians; None for none.
        num_model_points: points sampled on the shape.
        nan_policy: "raise", or "omit" to leave out non-finite data.
        upright: of the sources by default, see `AlignConfig`.
        seed: of everything that is drawn.
    """

    num_candidates: int = 64
    num_placed: int = 16
    num_searched: int = 4
    search_rounds: int = AlignConfig.search_rounds
    num_retries: int = 0
    prior_std: float | None = BROAD_PRIOR.typical
    num_model_points: int = AlignConfig.num_model_points
    nan_policy: str = "raise"
    upright: Direction | None = None
    seed: int = AlignConfig.seed

    def __post_init__(self) -> None:
        for name in ("num_candidates", "num_placed", "num_searched", "search_rounds", "num_model_points"):
            check_count(getattr(self, name), name, 1)
        check_count(self.num_retries, "num_retries", 0)
        if self.prior_std is not None:
            check_positive(self.prior_std, "prior_std")
        check_choice(self.nan_policy, "nan_policy", ("raise", "omit"))
        if self.upright is not None:
            check_direction(self.upright, "upright")


def find_pose(
    shape: ArticulatedShape,
    data: Tensor | DepthFrame | Sequence[DepthFrame] | Camera | None,
    *,
    num_starts: int = 4,
    mask: Tensor | None = None,
    sources: Sequence[PoseSource] | None = None,
    initializer: PoseProposer | HoldsProposer | None = None,
    model_points: LinearBlendSkin | None = None,
    locked: Sequence[str] | Tensor = (),
    prior: tuple[Any, Any] | None = None,
    keypoints: Tensor | None = None,
    keypoint_std: Tensor | float | None = None,
    config: FindPoseConfig | None = None,
) -> PoseStarts:
    """Return the poses in which an articulated shape may lie on 3-D data, best first, and the confidence in the first.

    Where a network proposes poses of the shape, these are fitted first; of other shapes with a mesh, poses to which the
    matches of a `ScanMatcher` lead, between the mesh at rest and the data. Both look into windows as large as the shape
    where the data are larger, as they may show other things. Where nothing is proposed, or the best is
    doubtful, rough poses from all sources are registered rigidly in one batch; the best are fitted to the surface, and
    their limbs placed on the data by beam search, first coarsely, then thoroughly. A skinned rig's are aligned by
    annealed EM instead. All are ranked by the data that they leave unexplained, and
    those that are missing on the surface that a camera would see.

    Args:
        shape: the articulated shape, in metres; where its base is bolted down, only its joints are sought.
        data: (M, 3), metres, or (B, M, 3) for a batch of clouds; or a `DepthFrame`, whose free space counts too, or a
            sequence of B of them. In a single frame without a mask the shape may be anywhere. None, or a `Camera`, for
            keypoints alone, see `align`.
        num_starts: poses returned, at most `FindPoseConfig.num_searched`; fewer where they fall together.
        mask: (M,) or (B, M), False where data are padding.
        sources: of rough poses, see `PoseSource`; all rotations and the principal axes by default.
        initializer: a network that proposes poses, as from `train_initializer`, or a `PoseInitializer` that has one; by
            default, where no sources are given, the one that comes with torchreg for the built-in hand.
        model_points: a skin of the shape to reuse; sampled on the surface by default.
        locked: what is held, see `align`: at the prior's mean where it has one, else as at rest.
        prior: what is known of the pose, see `align`.
        keypoints: see `align`.
        keypoint_std: see `align`.
        config: see `FindPoseConfig`.

    Returns:
        a `PoseStarts`; with a batch of clouds its tensors have a leading dimension B. The confidence falls with every
        limb of which no data tell where it ends.

    Raises:
        InputError: if the data are empty or not finite, or there is no source.
        InputTypeError: if an argument has the wrong type.

    Warns:
        DegenerateDataWarning: if the data lie at one place, on a line or on a plane; the confidence is zero.
        UnitsWarning: if the data are more than thirty times larger or smaller than the shape.

    Differentiable: no.

    Cost: .3 s for a hand on one CPU core, whatever the number of data; 1 to 2 s where it is searched for. Rigs of 50
    bones, which have no network, take 3 to 5 s. Of a cloud of more than 10,000 data, 4,000 are
    looked at, see `align`.
    """
    check_count(num_starts, "num_starts", 1)
    config = config or FindPoseConfig()
    source, known = StartSource.of(shape, sources, initializer, config.upright), KnownDofs.of(shape, locked, prior)
    model = AlignConfig(num_model_points=config.num_model_points)
    skin = None if model_points is None else check_skin(shape, model_points)
    task = Task(shape=shape, model_points=skin, known=known, source=source, config=model)

    def found(data: Any, mask: Tensor | None = None) -> PoseStarts:
        asked = task.observed(data, mask, keypoints, keypoint_std)
        if asked.seen.points is None:
            return find_keypoints(KeypointRows.of(task.skin(), asked.seen.keypoints, None, known), num_starts)
        starts = search_everywhere(asked, num_starts, config).starts
        return replace(starts, poses=to_world(starts.poses, asked.seen.origin), shape=shape)

    if isinstance(data, DepthFrame) and data.mask is None:
        skin = task.skin()
        task = replace(task, model_points=skin)
        return surest_crop(data, skin, lambda crop: found(crop.frame), source.with_known(known))[0]
    return found(data, mask)


def search_everywhere(task: Task, num_starts: int, config: FindPoseConfig) -> FoundStarts:
    """Return what `find_pose` finds in data near the origin."""
    shape, known = task.shape, task.known
    seen = task.seen.drawn(shape, config.nan_policy, config.seed, to_search=True)
    with torch.no_grad():
        clouds, valid = check_clouds(shape, seen.points, seen.mask, config.nan_policy)
        batch, batch_valid = (clouds, valid) if clouds.ndim == 3 else (clouds[None], valid[None])
        origin = masked_mean(batch, batch_valid)
        typical = shifted(typical_poses(shape).mean(0).expand(len(batch), -1), origin)
        problem = centered_problem(
            task.skin(), batch, batch_valid, typical, origin, prior_std=config.prior_std,
            pose_atol=0.0, free_space=seen.free_space, keypoints=seen.keypoints,
        )  # fmt: skip
        if known is not None:
            problem = known.with_prior(problem, shifted(known.start(shape).expand_as(typical), -origin))
        warn_about_rounding(clouds, "data", problem.size, stacklevel=4)
        warn_about_units(problem.data, problem.valid, problem.size, stacklevel=4)
        degenerate = warn_about_degenerate(problem.data, problem.valid, problem.size, stacklevel=4)
        with one_thread():
            found = _find(problem, seen.frames, task.source.with_known(known), config)
        lead = found.lead()
        confidence = torch.where(degenerate, 0.0, pose_confidence(problem, found.poses[:, 0], lead))
        best = found.distinct(SEARCH_BUDGET.same, num_starts)
        poses = shifted(best.poses, origin.unsqueeze(1))
        # What they miss ranks them, too.
        left = alignment_cost(problem.repeated(best.poses.shape[1]), best.poses.flatten(0, 1)).view_as(best.costs)
        starts = PoseStarts(poses=poses, costs=left, confidence=confidence)
        rivals = torch.where(_are_rivals(best).unsqueeze(-1), poses, torch.nan)[:, 1:]
    if seen.everything is not None:
        # In data of the whole clouds, each of those drawn stands for several.
        lead = lead * (seen.everything[1].sum(-1) / valid.sum(-1).clamp_min(1)).to(lead)
    return FoundStarts(starts if clouds.ndim == 3 else starts.row(0), lead, rivals)


@dataclass(frozen=True, eq=False)
class FoundStarts:
    """Starts, best first, the cost (B,) by which the best of different poses is worse, or infinity, and rivals.

    Rivals (B, S - 1, num_dofs) are those of the starts that explain nearly as much as the first; NaN elsewhere.
    """

    starts: PoseStarts
    lead: Tensor
    rivals: Tensor


def _find(
    problem: AlignProblem, frames: Sequence[DepthFrame], source: StartSource, config: FindPoseConfig
) -> Candidates:
    """Return candidates (B, H): a network's, and a search's if in doubt."""
    proposed = source.proposed(problem, config.num_searched)
    if proposed.poses.shape[1] == 0:
        return _search_with_retries(proposed, source, config)
    found = Candidates.fitted(proposed.problem, proposed.poses)
    uncropped = without_cut(proposed.window, found.poses[:, 0], frames)
    confidence = pose_confidence(uncropped, found.poses[:, 0], found.lead(), determined=True)
    rows = (confidence < CALIBRATION.doubtful).nonzero()[:, 0]
    # The best one again is a duplicate that takes no place.
    count = min(config.num_searched, config.num_placed)
    poses, costs = found.poses[:, :1].repeat(1, count, 1), found.costs[:, :1].repeat(1, count)
    if len(rows):
        searched = _search_with_retries(replace(proposed, poses=found.poses).rows(rows), source, config)
        poses[rows], costs[rows] = searched.poses, searched.costs
    return found.joined(Candidates(proposed.problem, poses, costs))


def _search_with_retries(proposed: Proposed, source: StartSource, config: FindPoseConfig) -> Candidates:
    """Return candidates (B, H) after as many searches as each cloud needs."""
    found = _search(proposed, source, config)
    poses, costs = found.poses, found.costs
    active = is_misfit(proposed.problem, poses[:, 0]).nonzero()[:, 0]
    for number in range(1, config.num_retries + 1):
        if len(active) == 0:
            break
        part = proposed.rows(active)
        retried = _search(part, source, replace(config, seed=config.seed + number))
        merged = Candidates(part.problem, poses[active], costs[active]).joined(retried).take(slice(poses.shape[1]))
        poses[active], costs[active] = merged.poses, merged.costs
        active = active[is_misfit(part.problem, poses[active, 0])]
    return Candidates(proposed.problem, poses, costs)


def _search(proposed: Proposed, source: StartSource, config: FindPoseConfig) -> Candidates:
    """Return candidates (B, H) after one search."""
    problem, generator = proposed.problem, torch.Generator().manual_seed(config.seed)
    search = PoseSearch(problem, generator)
    ranked = search.registered(source.rough(proposed.window, generator), generator)
    if isinstance(problem.surface, SkinSurface):
        rough = ranked.distinct(SEARCH_BUDGET.same, config.num_placed).poses
        return Candidates.fitted(problem, align_rows(problem, rough, config.num_searched, generator))
    rough = ranked.distinct(SEARCH_BUDGET.same, config.num_candidates).poses
    pool = torch.cat([proposed.poses, search.fit_coarsely(rough)], dim=1)[:, : config.num_placed]
    poses, _ = search.refine(search.prune(pool, config.num_searched), config.search_rounds)
    return Candidates.fitted(problem, poses)


def _are_rivals(best: Candidates) -> Tensor:
    """Return which candidates (B, S) after the first differ from all before them and explain nearly as much."""
    apart = best.apart(SEARCH_BUDGET.same)
    is_later = torch.ones_like(apart[0]).triu()
    behind = best.costs - best.costs[:, :1]
    margin = rival_margin(best.problem.valid.sum(-1)).unsqueeze(-1)
    return (apart | is_later).all(-1) & (behind < margin)
