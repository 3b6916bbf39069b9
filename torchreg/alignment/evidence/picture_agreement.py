"""Whether a picture shows a posed shape: its surface, normals and relief, and what else may explain the data."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import partial

import torch
from torch import Tensor

from torchreg.alignment.evidence.confidence import limb_points
from torchreg.alignment.evidence.coverage import shape_normals, visible_skin
from torchreg.alignment.fit.problem import AlignProblem
from torchreg.alignment.fit.surface_fit import SURFACE_FIT, surface_noise
from torchreg.capture.depth_frame import DepthFrame
from torchreg.capture.depth_segments import open_rim
from torchreg.geometry.neighbors import k_nearest_others
from torchreg.geometry.normals import fit_normals
from torchreg.geometry.planes import distance_to_plane
from torchreg.shapes.limbs import Limb
from torchreg.solvers.calibration import Logistic


@dataclass(frozen=True)
class _Look:
    """How surfaces are compared; lengths are shares of the shape's size."""

    on_shape: float = 0.03  # distance of data on the shape: a fit of another hand errs by .02
    num_data: int = 800  # whose normals are compared
    around: int = 16  # neighbors that give a normal
    detail: float = 0.12  # radius within which normals are compared with their mean
    neighbors: int = 24  # that give the mean
    smoothest: float = 1.5  # logarithm of the shape's details over the data's: planes have none


_LOOK = _Look()


@dataclass(frozen=True)
class PictureModel(Logistic):
    """The logistic model of whether a picture shows a shape about where a pose is: ``bias - sum_k weight_k e_k``.

    That is the logarithm of the Bayes factor, the odds in favor where as many poses are as are not. ``e`` is the table
    of `PictureAgreement`. Fitted to 213 alignments in crops of made-up rooms, of which 75 lie on a hand, also of other
    proportions and with things in it, or an arm: answers of the search, and fits from the truth and from poses off it.
    ``benchmarks/calibrate_confidence.py`` draws such a mixture anew, not these very ones.
    """

    bias: float = 5.16
    weights: tuple[float, ...] = (0.86, 0.97, 4.59, 1.47, 1.74)  # as `PictureAgreement` has them
    told: float = 0.76  # probability of something else, from which on the evidence is substantial: Jeffreys


PICTURE_MODEL = PictureModel()


@dataclass(frozen=True)
class LimbModel(Logistic):
    """The logistic model of whether a limb is where it was fitted, by the table of `LimbViews`.

    It is not if its end is off by more than a tenth of the shape's size. Fitted by
    ``benchmarks/calibrate_confidence.py`` to 127 fingers of hands in made-up rooms.
    """

    bias: float = 3.1
    weights: tuple[float, ...] = (5.31, 3.65)  # as `LimbViews` has them
    level: float = 0.05  # probability of being elsewhere that the usual level of an ellipsoid leaves out


LIMB_MODEL = LimbModel()


@dataclass(frozen=True, eq=False)
class LimbViews:
    """How a picture speaks against the limbs of a pose, (..., L) each, as shares of a limb's visible surface.

    Args:
        behind: through which the picture shows something farther.
        hidden: that is not confirmed for another reason: something nearer, or no depth.
    """

    behind: Tensor
    hidden: Tensor

    def table(self) -> Tensor:
        """Return the numbers as (..., L, E)."""
        return torch.stack([getattr(self, item.name) for item in fields(self)], dim=-1)


@dataclass(frozen=True, eq=False)
class PictureAgreement:
    """How a whole picture speaks against a pose, () each: from 0 (agrees) to 1, and so on for `smooth`.

    Args:
        behind: share of the shape's visible surface through which the picture shows something farther.
        normals: one less the mean cosine between the normals of data and shape.
        relief: one less the correlation of the details of these normals: a ball has none.
        smooth: logarithm of the shape's details over the data's, at least zero.
        uncovered: share of the surface that a camera might see that the picture does not confirm.
    """

    behind: Tensor
    normals: Tensor
    relief: Tensor
    smooth: Tensor
    uncovered: Tensor

    def table(self) -> Tensor:
        """Return the numbers as (E,)."""
        return torch.stack([getattr(self, item.name) for item in fields(self)])


@torch.no_grad()
def picture_views(
    problem: AlignProblem, pose: Tensor, frames: Sequence[DepthFrame]
) -> list[tuple[PictureAgreement, LimbViews]]:
    """Return how frames, each a crop of its picture, agree with poses (B, num_dofs); nothing without a frame a pose."""
    if len(frames) != len(pose):
        return []
    return [
        _agreement(
            problem.rows(torch.tensor([row], device=pose.device)),
            pose[row, None],
            frame.near(problem.origin[row].double()),
        )
        for row, frame in enumerate(frames)
    ]


def _agreement(problem: AlignProblem, pose: Tensor, frame: DepthFrame) -> tuple[PictureAgreement, LimbViews]:
    """Return how a frame agrees with a pose (1, num_dofs), whole and by limbs, in the problem's coordinates."""
    look = _Surface.of(problem, pose, frame)
    normals, relief, smooth = _normal_agreement(problem, pose, frame)
    whole = PictureAgreement(
        behind=look.share(look.gap > _LOOK.on_shape),
        normals=1 - normals,
        relief=1 - relief,
        smooth=smooth.clamp(0, _LOOK.smoothest),
        uncovered=1 - look.confirmed.sum() / look.visible.sum().clamp_min(1),
    )
    return whole, look.limb_views(limb_points(problem.skin))


@dataclass(frozen=True, eq=False)
class PictureEvidence:
    """Probabilities by pictures that they show something else (B,), and that limbs are elsewhere (B, L)."""

    elsewhere: Tensor
    misplaced: Tensor

    @classmethod
    def of(cls, problem: AlignProblem, pose: Tensor, frames: Sequence[DepthFrame]) -> PictureEvidence | None:
        """Return the evidence of frames about poses (B, num_dofs), None without a frame a pose."""
        views = picture_views(problem, pose, frames)
        if not views:
            return None
        return cls(
            elsewhere=1 - PICTURE_MODEL.probability(torch.stack([whole.table() for whole, _ in views])),
            misplaced=1 - LIMB_MODEL.probability(torch.stack([limbs.table() for _, limbs in views])),
        )

    @property
    def contradicted(self) -> Tensor:
        """The probability (B, L) that limbs are elsewhere, beyond the level that an ellipsoid leaves out anyway."""
        return (self.misplaced - LIMB_MODEL.level).clamp_min(0) / (1 - LIMB_MODEL.level)


@dataclass(frozen=True, eq=False)
class _Surface:
    """Points (N,) of a posed skin: those visible, those of which a depth was measured, and how far behind it is.

    `gap` is a share of the shape's size.
    """

    visible: Tensor
    known: Tensor
    gap: Tensor

    @classmethod
    def of(cls, problem: AlignProblem, pose: Tensor, frame: DepthFrame) -> _Surface:
        """Return what a picture shows where the surface of a pose (1, num_dofs) would be."""
        posed = problem.skin(pose)[0]
        toward = torch.nn.functional.normalize(frame.camera.position.to(posed) - posed, dim=-1)
        visible = visible_skin(problem, pose, toward[None])[0]
        pixels, depth = frame.camera.project(posed)
        column, row = pixels.nan_to_num(-1).round().long().unbind(-1)
        height, width = frame.depth.shape
        framed = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        measured = frame.depth[row.clamp(0, height - 1), column.clamp(0, width - 1)].to(depth)
        return cls(visible, visible & framed & (measured > 0), (measured - depth) / problem.size)

    @property
    def confirmed(self) -> Tensor:
        """Which points lie where the picture has a surface, (N,)."""
        return self.known & (self.gap.abs() <= _LOOK.on_shape)

    def limb_views(self, limbs: Sequence[tuple[Limb, Tensor]]) -> LimbViews:
        """Return how the picture speaks against limbs, with the indices of their points; one of zeros without limbs."""
        if not limbs:
            return LimbViews(*self.gap.new_zeros(2, 1))
        behind = self.known & (self.gap > _LOOK.on_shape)
        hidden = self.visible & ~behind & ~self.confirmed
        counts = torch.stack([
            torch.stack([which[index].sum() for which in (behind, hidden, self.visible)]) for _, index in limbs
        ]).to(self.gap)  # fmt: skip
        return LimbViews(*(counts[:, :2] / counts[:, 2:].clamp_min(1)).unbind(-1))

    def share(self, which: Tensor) -> Tensor:
        """Return the share () of the measured points that are some (N,)."""
        return ((which & self.known).sum() / self.known.sum().clamp_min(1)).to(self.gap)


def _normal_agreement(problem: AlignProblem, pose: Tensor, frame: DepthFrame) -> tuple[Tensor, Tensor, Tensor]:
    """Return the mean cosine between normals of data and shape, and the correlation and log ratio of their details.

    Details are differences of normals from their mean nearby.
    """
    data = problem.data[0][problem.valid[0]]
    data = data[problem.surface.distance(data[None], pose)[0].abs() < _LOOK.on_shape * problem.size]
    if len(data) <= _LOOK.neighbors:
        nothing = data.new_zeros(())
        return nothing, nothing, nothing
    stride = -(-len(data) // _LOOK.num_data)
    normals = fit_normals(data.double(), k_nearest_others(data.double(), _LOOK.around)[0]).to(data)
    data, normals = data[::stride], normals[::stride]
    toward = frame.camera.position.to(data) - data
    normals = torch.where((toward * normals).sum(-1, keepdim=True) < 0, -normals, normals)
    expected = shape_normals(problem, pose, data[None])[0]
    index, apart = k_nearest_others(data, min(_LOOK.neighbors, len(data) - 1))
    near = (apart < _LOOK.detail * problem.size).to(data).unsqueeze(-1)
    measured, wanted = (n - (n + (n[index] * near).sum(1)) / (1 + near.sum(1)) for n in (normals, expected))
    energy = [detail.square().sum().clamp_min(1e-9) for detail in (measured, wanted)]
    relief = (measured * wanted).sum() / (energy[0] * energy[1]).sqrt()
    return (normals * expected).sum(-1).mean(), relief, 0.5 * (energy[1] / energy[0]).log()


@dataclass(frozen=True)
class _Alternatives:
    """Numbers of the other explanations."""

    num_planes: int = 2  # faces that a box shows; more of them follow any surface
    num_data: int = 600  # that planes are fitted to


_ALTERNATIVES = _Alternatives()


def open_rims(problem: AlignProblem, pose: Tensor, frames: Sequence[DepthFrame]) -> Tensor:
    """Return the share (B,) of the rim of the data on the shape where the surface continues; zero without frames."""
    shares = torch.zeros_like(pose[:, 0])
    for row, frame in enumerate(frames if len(frames) == len(pose) else ()):
        shares[row] = open_rim(frame, partial(_lies_on, problem, pose, row))
    return shares


def _lies_on(problem: AlignProblem, pose: Tensor, row: int, points: Tensor) -> Tensor:
    """Return which points (M, 3) of the world lie on the shape of one row, (M,) bool."""
    local = (points - problem.origin[row].to(points)).to(pose)
    lies_on = local.norm(dim=-1) < 2 * problem.size  # what is farther cannot
    distance = problem.surface.distance(local[lies_on][None], pose[row, None])[0]
    lies_on[lies_on.clone()] = distance.abs() < _LOOK.on_shape * problem.size
    return lies_on


def planes_instead(problem: AlignProblem, distance: Tensor) -> Tensor:
    """Return by how much better a few planes explain the data on the shape, (B,), from 0 (not at all) to 1."""
    stride = -(-problem.data.shape[1] // _ALTERNATIVES.num_data)
    data, distance, valid = (values[:, ::stride] for values in (problem.data, distance, problem.valid))
    on_shape = valid & (distance.abs() < _LOOK.on_shape * problem.size)
    least = SURFACE_FIT.min_noise(problem.size)
    band = SURFACE_FIT.max_noise(problem.size)
    from_plane = torch.full_like(distance, torch.inf)
    generator = torch.Generator().manual_seed(0)
    for _ in range(_ALTERNATIVES.num_planes):
        left = on_shape & (from_plane > band)
        from_plane = torch.minimum(from_plane, distance_to_plane(data, left, band, generator))
    ratio = surface_noise(distance, on_shape, problem.size) / surface_noise(from_plane, on_shape, problem.size)
    return (ratio.log() / math.log(band / least)).clamp(0, 1)
