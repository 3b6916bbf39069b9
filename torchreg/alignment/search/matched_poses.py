"""Start poses of a shape by a learnt matcher: its surface at rest, seen from all around, in windows of the data."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import cast
from weakref import WeakKeyDictionary

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchreg.alignment.fit.annealed_em import ANNEALING
from torchreg.alignment.fit.objectives import registration_objective
from torchreg.alignment.fit.problem import AlignProblem
from torchreg.alignment.search.multi_start import align_rows, take_rows
from torchreg.alignment.search.pose_proposer import Proposals
from torchreg.alignment.search.windows import DataWindows
from torchreg.errors import InputError
from torchreg.geometry.mesh import TriangleMesh, unit_sphere
from torchreg.geometry.range_scan import RangeScan
from torchreg.geometry.rigid import fit_rigid, rigid_matrix, transform_points
from torchreg.geometry.rotation import so3_exp, so3_log
from torchreg.geometry.visibility import sample_visible
from torchreg.registration.dense.scan_matcher import match_probabilities, shared_matcher
from torchreg.registration.dense.scan_tokens import ScanTokens
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.articulation import Articulation
from torchreg.shapes.pose_algebra import BASE_DOFS
from torchreg.solvers.e_step import EStep


@dataclass(frozen=True)
class _Matching:
    """Numbers of views, windows and fits; lengths are shares of the shape's size."""

    camera: float = 3.0  # its distance from the middle of the surface at rest
    samples: int = 2000  # points of a view
    fitted_windows: int = 2  # those with the best matches
    fitted_views: int = 3  # in each, beside the best match of each datum in all views
    fitted: int = 8  # poses of all these
    rigid_starts: int = 24  # neighborhoods of a match, whose matches agree on a motion
    near: float = 0.25  # radius of those
    width: float = 0.1  # by which the matches of a bent shape are off one motion
    rigid_steps: int = 4


@dataclass(frozen=True)
class _Fit:
    """Numbers of the fit; widths are shares of the model's size."""

    kept: int = 2  # most probable proposals where there is no time for all, beside that fitted to matches
    surface_std: float = 0.015  # of where the network says that a datum lies on the shape
    reach: tuple[float, ...] = (0.15, 0.08)  # by which a datum may be off in the rounds after the first
    joint_std: float = 0.35  # of the network's joints, radians: its pose is the prior, of fingers that no datum shows
    matched_steps: int = 2  # in each round


PROPOSAL_FIT = _Fit()
_MATCHING = _Matching()
# Views of the shapes that were searched last, each with the surface that it was made of.
_VIEWS: WeakKeyDictionary[Articulation, tuple[object, tuple[ScanTokens, Tensor]]] = WeakKeyDictionary()


def can_be_matched(problem: AlignProblem) -> bool:
    """Return whether a shape has the surface of a file, and its base is free."""
    free = bool((problem.lower[..., :BASE_DOFS] < problem.upper[..., :BASE_DOFS]).all())
    return free and isinstance(problem.skin.shape, ArticulatedShape) and problem.skin.shape.surface is not None


def matched_poses(windows: DataWindows, problem: AlignProblem, count: int) -> tuple[Tensor, Tensor]:
    """Return aligned poses (B, count, num_dofs) by matches of the surface and the data, and the best windows (B,)."""
    views, places = _views(cast(ArticulatedShape, problem.skin.shape))
    matches = [
        _matches(points[valid], views, places.to(points))
        for points, valid in zip(windows.problem.data, windows.problem.valid, strict=True)
    ]
    support, found = torch.stack([match.support.max() for match in matches]), []
    for row in range(len(problem.data)):
        own = (windows.row == row).nonzero()[:, 0]
        best = own[support[own].argsort(descending=True)[: _MATCHING.fitted_windows]]
        several = [one for window in best.tolist() for one in matches[window].ranked()]
        poses = _poses(problem.rows(torch.tensor([row])), several)
        found.append(poses[torch.arange(_MATCHING.fitted) % len(poses)])
    poses = align_rows(problem, torch.stack(found), count, torch.Generator().manual_seed(0))
    return poses, windows.best(-support)


def _poses(problem: AlignProblem, matches: list[_Matches]) -> Tensor:
    """Return poses (K, num_dofs) of one problem by several matches."""
    points, places, weight = (
        torch.stack([getattr(match, name) for match in matches]) for name in ("points", "places", "weight")
    )
    wide = problem.repeated(len(matches))
    start = wide.clamp(_registered(problem.skin.shape, points, places, weight, problem.size))
    wide = replace(wide, prior=replace(wide.prior, mean=start))
    return matched_pose(wide, Proposals(start.unsqueeze(1), weight[:, :1], points, places, weight))


@dataclass(frozen=True)
class _Matches:
    """Matches of T data (T, 3) of a window with V views: places (V, T, 3) at rest, and probabilities (V, T)."""

    points: Tensor
    places: Tensor
    weight: Tensor

    @property
    def support(self) -> Tensor:
        """(V,) sum of the probabilities."""
        return self.weight.sum(1)

    def ranked(self) -> list[_Matches]:
        """Return the best match of each datum, and those of the views with most support, each relative to sure ones."""
        best = self.weight.argmax(0)
        row = torch.arange(len(best), device=best.device)
        several = [_Matches(self.points, self.places[best, row], self.weight[best, row])]
        views = self.support.topk(min(_MATCHING.fitted_views, len(self.weight))).indices
        several += [_Matches(self.points, self.places[view], self.weight[view]) for view in views]
        return [replace(match, weight=_relative(match.weight)) for match in several]


def _relative(weight: Tensor) -> Tensor:
    sure = weight.topk(max(1, len(weight) // 8)).values.mean()
    return (weight / sure.clamp_min(torch.finfo(weight.dtype).tiny)).clamp_max(1)


def _matches(data: Tensor, views: ScanTokens, places: Tensor) -> _Matches:
    """Return what the matcher says of data (M, 3) in one window; nothing where they lie at a place or two."""
    try:
        scan = ScanTokens.from_scan(RangeScan(data.double()))
    except InputError:
        repeated = data[torch.arange(places.shape[1]) % len(data)]
        return _Matches(repeated, places, torch.zeros_like(places[..., 0]))
    several = ScanTokens.stack([scan] * len(views))
    weight, index = match_probabilities(shared_matcher()(several, views))[0].to(data).max(-1)
    return _Matches(data[scan.token_index[0]], places.gather(1, index.unsqueeze(-1).expand(*index.shape, 3)), weight)


def _registered(shape: Articulation, points: Tensor, places: Tensor, weight: Tensor, size: float) -> Tensor:
    """Return rest poses (K, num_dofs) moved as most matches (K, T) of places to points (K, T, 3) agree."""
    first = weight.topk(min(_MATCHING.rigid_starts, weight.shape[1])).indices
    index = torch.arange(len(first), device=first.device).unsqueeze(1)
    near = torch.cdist(places[index, first], places) / (_MATCHING.near * size)
    weight, places, points = (values.unsqueeze(1) for values in (weight, places, points))
    local = weight * (-near.square()).exp()
    for _ in range(_MATCHING.rigid_steps):
        motion = fit_rigid(places, points, local)
        off = (transform_points(motion, places.expand(-1, first.shape[1], -1, -1)) - points).norm(dim=-1)
        local = weight * (-(off / (_MATCHING.width * size)).square() / 2).exp()
    best = motion[index[:, 0], local.sum(-1).argmax(1)]
    pose = shape.rest_pose().expand(len(best), -1).clone()
    base = best @ rigid_matrix(so3_exp(pose[:, 3:BASE_DOFS]), pose[:, :3])
    pose[:, :3], pose[:, 3:BASE_DOFS] = base[:, :3, 3], so3_log(base[:, :3, :3])
    return pose


def _views(shape: ArticulatedShape) -> tuple[ScanTokens, Tensor]:
    """Return the tokens of views of a shape's surface at rest, and the places (V, T, 3) of those."""
    made = _VIEWS.get(shape)
    if made is None or made[0] is not shape.surface:
        with torch.inference_mode(False), torch.no_grad():
            made = shape.surface, _made_views(shape)
        _VIEWS[shape] = made
    return made[1]


def _made_views(shape: ArticulatedShape) -> tuple[ScanTokens, Tensor]:
    skin, rest = shape.file_skin(), shape.rest_pose()
    mesh = TriangleMesh(skin(rest), cast(Tensor, skin.faces))
    lower, upper = mesh.bounds()
    tokens, places, normals = [], [], mesh.face_normals()
    for direction in unit_sphere(0).vertices.to(rest):
        camera = (lower + upper) / 2 + _MATCHING.camera * (upper - lower).norm() * direction
        try:
            points, face, _ = sample_visible(mesh, camera, _MATCHING.samples, density="pixel")
        except InputError:  # nothing of it is to be seen from there
            continue
        scan = RangeScan(points.double(), normals=normals[face].double())
        tokens.append(ScanTokens.from_scan(scan))
        places.append(points[tokens[-1].token_index[0]])
    return ScanTokens.stack(tokens), torch.stack(places)


def matched_pose(problem: AlignProblem, proposals: Proposals) -> Tensor:
    """Return poses (B, num_dofs) after an EM that matches data to model points near their places at rest.

    Pairs of a datum and a model point that rounding cannot tell from none are left out: few are near each other.
    """
    skin, sigma, pose = problem.skin, ANNEALING.stop * problem.size, problem.prior.mean
    near = torch.cdist(proposals.surface, skin.points).square()
    share = (near / (-2 * (PROPOSAL_FIT.surface_std * problem.size) ** 2)).softmax(-1)
    share, index = share.topk(int((share > torch.finfo(share.dtype).eps).sum(-1).max()), sorted=False)
    told, index, points = share * proposals.inlier.unsqueeze(-1), index.flatten(1), proposals.points.unsqueeze(2)
    for width in (None, *PROPOSAL_FIT.reach):
        weight = told
        if width is not None:
            far = (points - take_rows(skin(pose), index).unflatten(1, told.shape[1:])).square().sum(-1)
            weight = told * (far * (-0.5 / (width * problem.size) ** 2)).exp()
        each = (weight.unsqueeze(-1) * pad(points, (0, 1), value=1.0)).flatten(1, 2)
        sums = each.new_zeros(len(pose), len(skin), 4).scatter_add(1, index.unsqueeze(-1).expand_as(each), each)
        total = sums[..., 3]
        targets = sums[..., :3] / total.clamp_min(1e-9).unsqueeze(-1)
        matches = EStep(total, targets, weight.sum(2), torch.zeros_like(total[:, 0]))
        objective = registration_objective(skin, matches, torch.full_like(pose[:, 0], sigma), problem.prior)
        for _ in range(PROPOSAL_FIT.matched_steps):
            pose = problem.step(objective(pose), pose).state
    return pose
