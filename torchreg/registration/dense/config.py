"""What decides how two scans are aligned, and what is reported. Lengths are shares of the source's size."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from functools import partial

import torch
from torch import Tensor

from torchreg._checks import check_count, check_positive
from torchreg.registration.annealing import check_ends


@dataclass(frozen=True)
class EMConfig:
    """An EM that fits the graph to soft matches, while its sigma shrinks and the graph softens.

    Args:
        num_steps: of matching and fitting.
        sigma: first and last, length.
        stiffness: of the graph, first and last.
    """

    num_steps: int
    sigma: tuple[float, float]
    stiffness: tuple[float, float]

    def __post_init__(self) -> None:
        check_count(self.num_steps, "num_steps", 1)
        for name in ("sigma", "stiffness"):
            check_ends(getattr(self, name), name)


@dataclass(frozen=True)
class ScanAlignConfig:
    """How two scans are aligned. The size of the source, on which all lengths rest, is about its diagonal.

    Args:
        num_samples: of the source, which hang on the graph; twice as many of the target, that samples lie between.
        num_nodes: of the graph.
        coarse: the EM that begins with the matches of the matcher: sigma from the motion of a limb to what tokens are
            apart.
        refine: the EM that ends every hypothesis: sigma from how far a start may be off.
        edge_scale: nodes that disagree by more than this hold each other less, length.
        normal_weight: concentration of the normal kernel: exponent lost by normals at right angles.
        tangential_weight: how much residuals along the surface count, squared, at sigmas far below what tokens are
            apart: cloth and round limbs have far to go.
        outliers: expected outliers, as a share of what a sample in the middle of its matches gets.
        doubt: support of a match that the matcher calls impossible, beside one of a sure match.
        cap: distances from the target count up to this in the choice among the hypotheses, length.
        smoothness: what it costs there that neighboring nodes disagree by one size in the mean.
    """

    num_samples: int = 1200
    num_nodes: int = 60
    coarse: EMConfig = field(default_factory=partial(EMConfig, 14, (0.35, 0.03), (2.0, 2.0)))
    refine: EMConfig = field(default_factory=partial(EMConfig, 20, (0.02, 0.006), (0.2, 0.006)))
    edge_scale: float = 0.01
    normal_weight: float = 5.0
    tangential_weight: float = 0.1
    outliers: float = 0.3
    doubt: float = 0.1
    cap: float = 0.03
    smoothness: float = 20.0

    def __post_init__(self) -> None:
        for name in ("num_samples", "num_nodes"):
            check_count(getattr(self, name), name, 1)
        for name in ("edge_scale", "tangential_weight", "outliers", "doubt", "cap"):
            check_positive(getattr(self, name), name)
        for name in ("normal_weight", "smoothness"):
            check_positive(getattr(self, name), name, allow_zero=True)


@dataclass(frozen=True)
class ScanAlignRecord:
    """One step of an alignment, as given to ``on_step``.

    Args:
        hypothesis: name of what is being followed, such as "rest" or "matches".
        stage: "match" or "refine".
        step: number of the step in its stage.
        num_steps: steps planned in the stage.
        width: sigma, in the user's unit.
        residual: weighted mean squared residual of the matches, squared shares of the size.
        smoothness: disagreement of neighboring nodes, squared shares of the size.
        stiffness: weight of the latter.
        matched: weight of the matches over the number of samples.
    """

    hypothesis: str
    stage: str
    step: int
    num_steps: int
    width: float
    residual: float
    smoothness: float
    stiffness: float
    matched: float

    @property
    def energy(self) -> float:
        """Both terms together."""
        return self.residual + self.stiffness * self.smoothness


OnStep = Callable[[ScanAlignRecord], None]


@dataclass(frozen=True)
class ScanEvidence:
    """Evidence against an alignment.

    Args:
        forward: mean cost of moved samples that the matcher calls visible, see `mismatch`.
        backward: mean squared distance of visible target samples from the moved source, in caps, capped at one.
        smoothness: weighted disagreement of neighboring nodes of the graph.
        unsupported: mean of minus the logarithm of the matcher's support of where visible samples ended.
        hidden: share of samples that the matcher calls hidden.
    """

    forward: float
    backward: float
    smoothness: float
    unsupported: float
    hidden: float

    def table(self) -> Tensor:
        """Return the numbers (E,), float64."""
        return torch.tensor([getattr(self, item.name) for item in fields(self)], dtype=torch.float64)


@dataclass(frozen=True)
class Hypothesis:
    """One way in which the source may have moved.

    Args:
        name: what it started from.
        energy: minus the log-odds that it is right, by which hypotheses are compared, see `ScanCalibration`; lower is
            better.
        evidence: against it.
        deviation: mean squared distance of samples from where they were expected, capped at one; 0 if that is not
            known.
    """

    name: str
    energy: float
    evidence: ScanEvidence
    deviation: float = 0.0


@dataclass(frozen=True, eq=False)
class ScanAlignment:
    """A source scan moved onto a target.

    Args:
        points: (N, 3) all source points where they went, in the unit, frame and dtype of the source.
        confidence: probability, from 0 to 1, that the alignment is right, see `ScanCalibration`.
        point_confidence: (N,) in [0, 1], posterior mass of each point's match at the last sigma; low where the target
            shows nothing, and where points follow what is around them.
        samples: (S,) source points that hang on the nodes.
        nodes: (J,) source points that are nodes.
        weights: (N, J) of the nodes at all points, rows sum to one.
        transforms: (J, 4, 4) motions of the nodes, in the unit and frame of the scans.
        chosen: the best hypothesis, as it was compared with the others.
        hypotheses: all of them, the best first.
        history: one `ScanAlignRecord` per step.
    """

    points: Tensor
    confidence: float
    point_confidence: Tensor
    samples: Tensor
    nodes: Tensor
    weights: Tensor
    transforms: Tensor
    chosen: Hypothesis
    hypotheses: tuple[Hypothesis, ...]
    history: tuple[ScanAlignRecord, ...]
