"""What decides how two scans are aligned, and what is reported. Lengths are shares of the source's size."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from torch import Tensor

from torchreg._checks import check_count, check_positive
from torchreg.errors import InputError
from torchreg.registration.annealing import check_ends
from torchreg.registration.dense.e_step import ScanEMConfig


@dataclass(frozen=True)
class CoarseConfig:
    """How the graph is first fitted to the matches of a learnt matcher, by EM with an annealed sigma.

    Args:
        num_steps: while sigma shrinks.
        sigma: first and last, length: from the motion of a limb to what tokens are apart.
        stiffness: of the graph, first and last: parts hardly bend.
        edge_scale: nodes that disagree by more than this hold each other less, first and last, length.
        normal_weight: exponent lost by normals at right angles, at the end.
        doubt: share of the prior of a match that does not rest on the matcher, first and last.
        outliers: samples that no match explains although the matcher calls them visible, as a share.
        area: over which outliers are spread, squared length.
    """

    num_steps: int = 14
    sigma: tuple[float, float] = (0.35, 0.03)
    stiffness: tuple[float, float] = (6.0, 1.0)
    edge_scale: tuple[float, float] = (0.03, 0.02)
    normal_weight: float = 3.0
    doubt: tuple[float, float] = (0.02, 0.3)
    outliers: float = 0.03
    area: float = 0.5

    def __post_init__(self) -> None:
        check_count(self.num_steps, "num_steps", 1)
        for name in ("sigma", "stiffness", "edge_scale", "doubt"):
            check_ends(getattr(self, name), name)
        for name in ("outliers", "area"):
            check_positive(getattr(self, name), name)
        check_positive(self.normal_weight, "normal_weight", allow_zero=True)


@dataclass(frozen=True)
class EMConfig:
    """How the graph is fitted to soft matches, by EM with an annealed sigma.

    Args:
        num_steps: in which sigma shrinks; the last is at the last sigma.
        sigma: first and last, length; the first as far as a start may be off,
        fused_sigma: and from motions that have been refined and put together.
        stiffness: of the graph, first and last.
        edge_scale: nodes that disagree by more than this hold each other less, length.
        doubt: support at first of a match that the matcher calls impossible, beside one of a sure match; at the last
            sigma, far below what its tokens are apart, all count alike.
        feature_weight: see `ScanEMConfig`, first and last: bending and hidden surroundings change features a little.
        tangential_weight: how much residuals along the surface count, squared, first and last: cloth and round
            limbs have far to go.
        fits_per_step: rounds of matching and fitting at each sigma.
        expected: how much it counts, beside a match, that a sample without one leaves where it was expected, if that is
            known; those farther off count ever less:
        expected_scale: length.
        compatible: see `ScanEMConfig`; its feature weight gives way to the one above.
    """

    num_steps: int = 10
    sigma: tuple[float, float] = (0.02, 0.006)
    fused_sigma: float = 0.012
    stiffness: tuple[float, float] = (0.2, 0.006)
    edge_scale: float = 0.01
    doubt: float = 0.05
    feature_weight: tuple[float, float] = (8.0, 1.0)
    tangential_weight: tuple[float, float] = (0.2, 0.03)
    fits_per_step: int = 2
    expected: float = 0.002
    expected_scale: float = 0.05
    compatible: ScanEMConfig = field(default_factory=ScanEMConfig)

    def __post_init__(self) -> None:
        for name in ("num_steps", "fits_per_step"):
            check_count(getattr(self, name), name, 1)
        for name in ("sigma", "stiffness", "tangential_weight", "feature_weight"):
            check_ends(getattr(self, name), name)
        for name in ("fused_sigma", "edge_scale", "doubt", "expected_scale"):
            check_positive(getattr(self, name), name)
        check_positive(self.expected, "expected", allow_zero=True)


@dataclass(frozen=True)
class ChoiceConfig:
    """How the hypotheses are compared.

    Args:
        cap: distances count up to this, length.
        normal_scale: how many caps normals count as that are one apart.
        feature_distance: what it costs that features differ by one, squared, where the moved source lies on the target.
        smoothness: what it costs that neighboring nodes disagree by one size in the mean,
        slack: of which less than this hardly counts, length.
        deviation: what it costs that samples are far from where they were expected, if that is known, squared, at
            most as much as one off the target:
        deviation_cap: up to this distance, length.
        same: hypotheses agree where their samples are this near each other, length,
        same_share: for at least this share of the samples.
    """

    cap: float = 0.03
    normal_scale: float = 0.5
    feature_distance: float = 2.0
    smoothness: float = 20.0
    slack: float = 1e-3
    deviation: float = 1.0
    deviation_cap: float = 0.1
    same: float = 0.005
    same_share: float = 0.95

    def __post_init__(self) -> None:
        for name in ("cap", "deviation_cap", "same", "same_share"):
            check_positive(getattr(self, name), name)
        for name in ("normal_scale", "feature_distance", "smoothness", "slack", "deviation"):
            check_positive(getattr(self, name), name, allow_zero=True)


@dataclass(frozen=True)
class ScanAlignConfig:
    """How two scans are aligned. The size of the source, on which all lengths rest, is about its diagonal.

    Args:
        num_samples: of the source, which hang on the graph.
        num_target_samples: of the target.
        num_nodes: of the graph.
        num_nearest: nodes that each sample hangs on.
        curvature_radii: of the features, lengths.
        density: samples used per squared sigma.
        least_samples: used of each scan, where there are as many.
        coarse: the EM that begins with the matches of the matcher.
        refine: the EM that ends every hypothesis.
        choice: among the hypotheses.

    Raises:
        InputError: if a value is out of range.
    """

    num_samples: int = 1200
    num_target_samples: int = 2500
    num_nodes: int = 60
    num_nearest: int = 4
    curvature_radii: tuple[float, ...] = (0.02, 0.035, 0.06)
    density: float = 0.3
    least_samples: int = 300
    coarse: CoarseConfig = field(default_factory=CoarseConfig)
    refine: EMConfig = field(default_factory=EMConfig)
    choice: ChoiceConfig = field(default_factory=ChoiceConfig)

    def __post_init__(self) -> None:
        for name in ("num_samples", "num_target_samples", "num_nodes", "num_nearest", "least_samples"):
            check_count(getattr(self, name), name, 1)
        check_positive(self.density, "density")
        _check_values(self.curvature_radii, "curvature_radii")


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
class Hypothesis:
    """One way in which the source may have moved.

    Args:
        name: what it started from.
        energy: ``forward + backward + smoothness + deviation``, by which hypotheses are compared; lower is better.
        forward: mean of what moved samples cost, by squared distance from the target and by unlike features there, each
            at most as much as an outlier.
        backward: mean squared distance of target samples to the moved source, capped at one.
        smoothness: weighted disagreement of neighboring nodes.
        deviation: weighted mean squared distance of samples from where they were expected, capped at one; 0 if that is
            not known.
    """

    name: str
    energy: float
    forward: float
    backward: float
    smoothness: float
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


def _check_values(values: tuple[float, ...], name: str) -> None:
    if not values:
        raise InputError(f"{name} must hold at least one number, got none")
    for value in values:
        check_positive(value, name)
