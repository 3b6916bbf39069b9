"""How far an alignment can be trusted: the evidence for its pose, and a probability calibrated on made-up data."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import takewhile

import torch
from torch import Tensor
from torch.nn.functional import one_hot

from torchreg.alignment.evidence.confidence import (
    EVIDENCE,
    OFF_SURFACE,
    SurfaceResiduals,
    clusters_beside,
    end_spreads,
    end_variances,
    limb_points,
    near_outlier_share,
    overlap,
)
from torchreg.alignment.evidence.coverage import unseen_share
from torchreg.alignment.evidence.curvature import (
    Curvature,
    curvature,
    dof_confidence,
    far_variance,
    plausible_precision,
    told_open,
)
from torchreg.alignment.evidence.picture_agreement import PICTURE_MODEL, PictureEvidence, open_rims, planes_instead
from torchreg.alignment.fit.free_space_term import FreeSpaceTerm
from torchreg.alignment.fit.problem import AlignProblem, free_space_loss
from torchreg.alignment.fit.surface_fit import SURFACE_FIT, surface_noise
from torchreg.capture.depth_frame import DepthFrame
from torchreg.capture.depth_segments import beyond_cut
from torchreg.geometry.rotation import so3_exp, so3_log
from torchreg.result import Status
from torchreg.shapes.limbs import Limb
from torchreg.shapes.pose_algebra import BASE_DOFS
from torchreg.shapes.shaped import ShapedSkin
from torchreg.solvers.calibration import Logistic


@dataclass(frozen=True, eq=False)
class Evidence:
    """Evidence against poses, (B,) each, from 0 (good) to about 1.

    Args:
        noise: of the data about the surface, from the least (0) to the largest (1) that a fit assumes, in logarithms.
        beside: root of the share of near outliers.
        clusters: root of the data in dense clusters off the surface, as a share of those on it.
        off: share of the data that are not on the surface.
        free_space: root of the data that points in free space stand for, as a share of the data.
        unseen: root of the `unseen_share`; zero where pictures tell what is there, and for fits with coefficients.
        overlap: number of limbs that lie in others, the sum of `overlap`; zero for fits with coefficients.
        unknown: probability that the data do not determine the ends of the limbs.
        rival: how near the second-best pose of a search comes, 0 for a given start; `rival_share` relative to the data.
        open_rim: square of `open_rims`; zero for clouds.
        planes: square of `planes_instead`.
        elsewhere: square of the probability by a whole picture that it shows something else, see `PictureModel`.
        misplaced: mean probability by a whole picture that a limb is elsewhere, see `LimbModel`; both else zero.
    """

    noise: Tensor
    beside: Tensor
    clusters: Tensor
    off: Tensor
    free_space: Tensor
    unseen: Tensor
    overlap: Tensor
    unknown: Tensor
    rival: Tensor
    rival_share: Tensor
    open_rim: Tensor
    planes: Tensor
    elsewhere: Tensor
    misplaced: Tensor

    def table(self) -> Tensor:
        """Return the numbers as (B, E)."""
        return torch.stack([getattr(self, name) for name in EVIDENCE_NAMES], dim=-1)


EVIDENCE_NAMES = tuple(item.name for item in fields(Evidence))


@dataclass(frozen=True)
class _Scales:
    """Scales of the evidence."""

    rival_share: float = 0.02  # of the data by which a pose leads: at which a rival counts 1 / e
    surface_error: float = 0.008  # standard error of a surface, share of the size: where half of the fits are wrong
    loose_error: float = 0.03  # the same of a part that is told to be hardly seen


_SCALES = _Scales()


@dataclass(frozen=True)
class Calibration(Logistic):
    """The model of the confidence: ``sigmoid(bias - sum_k weight_k e_k)``, of poses by (1 - unknown) (1 - rival).

    A pose is right if the ends of the shape's limbs are off by at most `right` of its size on average: it is found,
    what no data show is near, and no other pose is as good. Fitted, by what ``benchmarks/calibrate_confidence.py``
    does, to 675 made-up alignments: 328 clouds of rigs of all kinds, hands, arms and a fox that are alone, beside
    another thing, touch it, or are not there (``benchmarks/company.py``), and 347 of hands, arms and foxes alone.
    Wrong ones count twice: what is sure and wrong costs more than a doubt. Each sixth of the clouds in company by a
    model of all others: 190 of 215 right poses sure, 10 wrong ones. Free space and rivals are held, as most of these
    shapes lack a camera and symmetries; weights of open rims and planes are those of 68 made-up rooms.
    """

    bias: float = 7.5
    # As `Evidence` has them.
    weights: tuple[float, ...] = (2.54, 10.98, 0.0, 0.0, 8.53, 7.27, 1.7, 0.0, 0.0, 3.93, 20.44, 3.78, 0.0, 0.0)
    right: float = 0.058  # of the size: 15 mm of a hand
    doubtful: float = 0.5  # confidence below which a result is doubtful
    is_of_poses: bool = True  # else `unknown` and `rival` are evidence as all else

    def probability(self, evidence: Tensor) -> Tensor:
        """Return the probabilities (...) of evidence (..., E)."""
        found = super().probability(evidence)
        if not self.is_of_poses:
            return found
        unknown, rival = (evidence[..., EVIDENCE_NAMES.index(name)] for name in ("unknown", "rival"))
        return found * (1 - unknown) * (1 - rival)

    def status(self, converged: bool, confidence: float) -> Status:
        """Return the status of a fit by what is known of it."""
        if confidence < self.doubtful:
            return Status.DOUBTFUL
        return Status.CONVERGED if converged else Status.MAX_STEPS


CALIBRATION = Calibration()
# Of shapes in whole pictures, where most that is found is something else, or right but for a limb. Fitted by the same
# command to 50 judgements of 54 made-up rooms with hands, held things, arms and none of them, 14 of them right, after
# 183 of crops that were not segmented yet, all of hands. Families differ by less than their errors: hands by .6 (.7),
# arms by -.2 (.6) of the log-odds.
PICTURE_CALIBRATION = Calibration(
    bias=4.53,
    weights=(1.83, 2.85, 1.13, 0.22, 6.96, 0.0, 0.0, 1.87, 0.0, 1.98, 6.08, 1.33, 6.46, 2.8),
    is_of_poses=False,
)
# Of fits of pose and shape together, which are right if all of the surface, hidden parts too, is off by at most that
# share of the size on average: 25 mm of a body of 1.7 m. What is unknown is then the standard error of the surface,
# which no shape's limbs or number of parts enter. Fitted to 59 made-up people and hands, all from starts, as
# `benchmarks/shape_confidence.py --calibrate` fits one to what it draws; its area under the curve on 72 others, a third
# of them searched, is .96. Pictures and rivals were not among the 59: their weights are those of poses.
SHAPE_CALIBRATION = Calibration(
    bias=5.37,
    weights=(0.0, 2.45, 3.1, 2.83, 8.53, 0.0, 0.0, 10.78, 1.03, 3.93, 20.44, 3.78, 4.0, 0.0),
    right=0.015,
    is_of_poses=False,
)


@dataclass(frozen=True)
class SurfaceError:
    """Standard errors (B,) of a surface fitted with its coefficients, of parts (B, P), and its last motion, metres."""

    whole: Tensor
    parts: Tensor
    moved: Tensor

    @classmethod
    def of(cls, skin: ShapedSkin, moves: Tensor, covariance: Tensor, moved: Tensor) -> SurfaceError:
        """Return the errors of a skin with derivatives (B, N, 3, D) in states with covariances (B, D, D)."""
        variances = end_variances(moves, covariance)
        owned = one_hot(skin.weights.argmax(-1), skin.weights.shape[1]).to(variances)
        by_part = variances @ owned / owned.sum(0).clamp_min(1)
        return cls(whole=variances.mean(-1).sqrt(), parts=by_part.sqrt(), moved=moved)

    @property
    def converged(self) -> Tensor:
        """Whether the last step moved the surface by no more than is not known of it, (B,)."""
        return self.moved <= self.whole

    def unknown(self, size: float) -> Tensor:
        """Return the evidence (B,) that the surface is not where it was fitted, from 0 to 1.

        Data do not tell where it is, or the fit stopped while it was moving.
        """
        return (-(_SCALES.surface_error * size / torch.hypot(self.whole, self.moved)).square()).exp()

    def loose(self, limbs: Sequence[Limb], size: float) -> Tensor:
        """Return of which limbs the data leave open where they are, (B, L)."""
        largest = [self.parts[:, limb.parts].amax(-1) for limb in limbs]
        return torch.stack(largest, -1) > _SCALES.loose_error * size if limbs else self.parts[:, :0] > 0


def without_cut(problem: AlignProblem, pose: Tensor, frames: Sequence[DepthFrame]) -> AlignProblem:
    """Return a problem without the data that a crop cuts off, such as a forearm, in fitted poses (B, num_dofs)."""
    if len(frames) != len(pose):
        return problem
    distance = problem.surface.distance(problem.data, pose)
    noise = surface_noise(distance, problem.valid, problem.size)
    off = distance.abs() > OFF_SURFACE.distance(noise, problem.size).unsqueeze(-1)
    valid = problem.valid.clone()
    for row, frame in zip(range(len(frames)), frames, strict=True):
        count = len(frame.points)
        valid[row, :count] &= ~beyond_cut(frame, off[row, :count])
    return replace(problem, valid=torch.where(valid.any(-1, keepdim=True), valid, problem.valid))


@dataclass(frozen=True, eq=False)
class Judgement:
    """Covariance (B, D, D) in tangent coordinates, evidence, confidence (B,) and doubts of fitted poses.

    `dof_confidence` (B, D) is the share of the variance without data that the data removed.
    """

    covariance: Tensor
    dof_confidence: Tensor
    converged: Tensor
    evidence: Evidence
    confidence: Tensor
    doubt: tuple[str, ...]


def judge(
    problem: AlignProblem,
    pose: Tensor,
    lead: Tensor | None,
    person: tuple[SurfaceError, Tensor] | None = None,
    frames: Sequence[DepthFrame] = (),
    rivals: Tensor | None = None,
    in_picture: bool = False,
) -> Judgement:
    """Return covariance, evidence, confidence and doubts of fitted poses (B, num_dofs), see `gather_evidence`.

    ``person``: the errors of the surface and the covariance (B, D, D) of a fit with shape coefficients. ``in_picture``:
    whether the frames are crops of whole pictures, which may show something else; a mask says what is there.
    """
    picture = PictureEvidence.of(problem, pose, frames) if frames else None
    shape, calibration = problem.skin.shape, PICTURE_CALIBRATION if in_picture else CALIBRATION
    if person is None:
        residuals = SurfaceResiduals.of(problem, pose)
        distance, spreads = residuals.distance, end_spreads(problem, pose, residuals)
        evidence = _pose_evidence(problem, pose, lead, residuals, spreads, in_cloud=picture is None)
        loose = spreads > EVIDENCE.tolerance * problem.size
        if picture is not None:
            residuals = replace(residuals, contradicted=picture.contradicted)
            loose = loose | (picture.misplaced > CALIBRATION.doubtful)
        around = curvature(problem, pose, residuals)
        converged, covariance = around.converged, _with_far_poses(problem, pose, residuals, around)
    else:
        (error, covariance), calibration = person, SHAPE_CALIBRATION
        distance = problem.surface.distance(problem.data, pose)
        evidence = gather_evidence(problem, pose, distance, lead, torch.zeros_like(pose[:, :1]))
        evidence, converged = replace(evidence, unknown=error.unknown(problem.size)), error.converged
        loose = error.loose([limb for limb, _ in limb_points(problem.skin)], problem.size)
    if picture is not None:
        rims, planes = open_rims(problem, pose, frames), planes_instead(problem, distance)
        evidence = replace(evidence, open_rim=rims.square(), planes=planes.square())
        if in_picture:
            evidence = replace(evidence, elsewhere=picture.elsewhere.square(), misplaced=picture.misplaced.mean(-1))
    left_open = [told_open(shape, row, problem.size) for row in covariance]
    return Judgement(
        covariance=covariance,
        dof_confidence=dof_confidence(shape, covariance, problem.size),
        converged=converged,
        evidence=evidence,
        confidence=calibration.probability(evidence.table()),
        doubt=tuple(
            "; ".join(filter(None, row))
            for row in zip(doubt_messages(problem, evidence, loose, _turns(pose, rivals)), left_open, strict=True)
        ),
    )


def pose_confidence(problem: AlignProblem, pose: Tensor, lead: Tensor | None, *, determined: bool = False) -> Tensor:
    """Return the confidence (B,) in fitted poses (B, num_dofs) with a lead (B,) over rivals, see `Calibration`.

    ``determined``: as if the data determined all limbs, which no search would improve.
    """
    residuals, in_cloud = SurfaceResiduals.of(problem, pose), problem.factor(FreeSpaceTerm) is None
    spreads = torch.zeros_like(pose[:, :1]) if determined else end_spreads(problem, pose, residuals)
    return CALIBRATION.probability(_pose_evidence(problem, pose, lead, residuals, spreads, in_cloud=in_cloud).table())


def _pose_evidence(
    problem: AlignProblem, pose: Tensor, lead: Tensor | None, residuals: SurfaceResiduals, spreads: Tensor, *,
    in_cloud: bool,
) -> Evidence:  # fmt: skip
    """Return the evidence for poses (B, num_dofs) without that of pictures, with `end_spreads` (B, L)."""
    evidence = gather_evidence(problem, pose, residuals.distance, lead, spreads)
    evidence = replace(evidence, overlap=overlap(problem, pose).sum(-1))
    if in_cloud:
        unseen = unseen_share(problem, pose, residuals.distance, residuals.jacobian)
        evidence = replace(evidence, unseen=unseen.sqrt())
    return evidence


def _with_far_poses(problem: AlignProblem, pose: Tensor, residuals: SurfaceResiduals, around: Curvature) -> Tensor:
    """Return the covariance (B, D, D) about poses with the variance of `far_variance` where that is larger."""
    precision = plausible_precision(problem, pose)
    far = far_variance(problem, pose, residuals, noise=around.noise, shared=around.shared, precision=precision)
    diagonal = around.covariance.diagonal(dim1=-2, dim2=-1)
    return around.covariance + torch.diag_embed((far - diagonal).clamp_min(0))


def gather_evidence(
    problem: AlignProblem, pose: Tensor, distance: Tensor, lead: Tensor | None, spreads: Tensor
) -> Evidence:
    """Return the evidence for poses (B, num_dofs), with distances (B, M) of the data and `end_spreads` (B, L)."""
    clustered, on_surface = clusters_beside(problem, distance)
    share, intruding = clustered.to(pose) / on_surface.clamp_min(1), free_space_loss(problem, pose)
    return weigh(problem, distance, clustered=share, spread=spreads.mean(-1), intruding=intruding, lead=lead)


def rival_margin(count: Tensor) -> Tensor:
    """Return the cost (B,) by which another pose of a search may be worse and still count, for numbers (B,) of data."""
    return (_SCALES.rival_share * count).clamp_min(EVIDENCE.lead)


def weigh(
    problem: AlignProblem, distance: Tensor, *, clustered: Tensor, spread: Tensor, intruding: Tensor,
    lead: Tensor | None = None,
) -> Evidence:  # fmt: skip
    """Return the evidence for poses from precomputed distances (B, M), shares (B,) and spreads (B,).

    ``lead`` (B,) is the cost by which the second-best pose of a search was worse; None for given starts.
    """
    noise = surface_noise(distance, problem.valid, problem.size)
    count = problem.valid.sum(-1).clamp_min(1).to(distance)
    near = ((distance.abs() < SURFACE_FIT.max_width * problem.size) & problem.valid).sum(-1).to(distance)
    lead = torch.full_like(noise, torch.inf) if lead is None else lead.clamp_min(0)
    unasked = dict.fromkeys(
        ("open_rim", "planes", "elsewhere", "misplaced", "unseen", "overlap"), torch.zeros_like(noise)
    )
    return Evidence(
        noise=SURFACE_FIT.relative_noise(noise, problem.size),
        beside=near_outlier_share(problem, distance).sqrt(),
        clusters=clustered.sqrt().clamp_max(1),
        off=1 - near / count,
        free_space=(intruding / count).sqrt().clamp_max(1),
        unknown=(-(EVIDENCE.tolerance * problem.size / spread).square()).exp(),
        rival=(-lead / EVIDENCE.lead).exp(),
        rival_share=(-lead / (_SCALES.rival_share * count)).exp(),
        **unasked,
    )


def shown_probability(evidence: Tensor) -> Tensor:
    """Return the probability (...) that a whole picture shows the shape about where a pose of evidence (..., E) is."""
    return 1 - evidence[..., EVIDENCE_NAMES.index("elsewhere")].sqrt()


def _turns(pose: Tensor, rivals: Tensor | None) -> list[str]:
    """Return by how much the base of rivals (B, R, num_dofs) is turned from that of poses, in words for each pose."""
    if rivals is None:
        return [""] * len(pose)
    turn = so3_exp(rivals[..., 3:BASE_DOFS].nan_to_num()) @ so3_exp(pose[:, None, 3:BASE_DOFS]).mT
    angles = so3_log(turn.flatten(0, 1)).norm(dim=-1).rad2deg().unflatten(0, turn.shape[:2])
    words = [
        ", ".join(f"{angle:.0f}" for angle in row[kept].tolist())
        for row, kept in zip(angles, rivals.isfinite().all(-1), strict=True)
    ]
    return [f", its base turned by {row} deg" if row else "" for row in words]


def doubt_messages(problem: AlignProblem, evidence: Evidence, loose: Tensor, rivals: Sequence[str]) -> tuple[str, ...]:
    """Return the doubts about poses, a sentence each, empty where there is none; loose (B, L) limbs are named."""
    limbs = [limb for limb, _ in limb_points(problem.skin)]
    sentences = []
    for row, loose_limbs in enumerate(loose.tolist()):
        reasons = []
        unseen = [_limb_name(problem, limb) for limb, is_loose in zip(limbs, loose_limbs, strict=False) if is_loose]
        if unseen:
            reasons.append(f"hardly any data show where {', '.join(unseen)} end{'s' * (len(unseen) == 1)}")
        reasons += [
            text.format(getattr(evidence, name)[row].item() ** 2) + rivals[row] * (name == "rival")
            for name, limit, text in _REASONS
            if float(getattr(evidence, name)[row]) > limit
        ]
        sentences.append("; ".join(reasons))
    return tuple(sentences)


# Evidence from which on a reason is told, and its words; {} is the square of the evidence.
_REASONS = (
    ("rival", 0.37, "another pose explains nearly as much"),
    ("clusters", 0.2, "data in clusters off the shape are {:.0%} of those on it"),
    ("beside", 0.3, "{:.0%} of the data lie beside the shape's surface"),
    ("overlap", 0.8, "limbs lie in each other"),
    ("free_space", 0.2, "parts of the shape lie where the picture shows nothing"),
    ("open_rim", 0.25, "the surface goes on where the shape ends, as a wall or a table does"),
    ("planes", 0.2, "flat faces explain the data better than the shape"),
    ("elsewhere", PICTURE_MODEL.told**2, "the picture more probably shows something else"),
)


def _limb_name(problem: AlignProblem, limb: Limb) -> str:
    """Return the name of a limb: what its parts' names begin with, and its side, or that of its last part."""
    names = [problem.skin.shape.part_names[part] for part in limb.parts]
    letters = takewhile(lambda column: len(set(column)) == 1, zip(*names, strict=False))
    common = "".join(column[0] for column in letters).rstrip("_-. 0")
    side = re.search(r"[._](?:l|r|left|right)$", names[-1], re.IGNORECASE)
    return common + (side[0] if side else "") if len(names) > 1 and common else names[-1]
