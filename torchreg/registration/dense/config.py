"""What decides how two scans are aligned, and what is reported. Lengths are shares of the source's size."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

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
        give: nodes that disagree by more than this hold each other less, first and last, length.
        normal_weight: exponent lost by normals at right angles, at the end.
        doubt: share of the prior of a match that does not rest on the matcher, first and last.
        outliers: samples that no match explains although the matcher calls them visible, as a share.
        area: over which outliers are spread, squared length.
        density: samples used per squared sigma.
        least_samples: used of each scan, where there are as many.
    """

    num_steps: int = 14
    sigma: tuple[float, float] = (0.35, 0.03)
    stiffness: tuple[float, float] = (6.0, 1.0)
    give: tuple[float, float] = (0.03, 0.02)
    normal_weight: float = 3.0
    doubt: tuple[float, float] = (0.02, 0.3)
    outliers: float = 0.03
    area: float = 0.5
    density: float = 0.3
    least_samples: int = 300

    def __post_init__(self) -> None:
        for name in ("num_steps", "least_samples"):
            check_count(getattr(self, name), name, 1)
        for name in ("sigma", "stiffness", "give", "doubt"):
            check_ends(getattr(self, name), name)
        for name in ("outliers", "area", "density"):
            check_positive(getattr(self, name), name)
        check_positive(self.normal_weight, "normal_weight", allow_zero=True)


@dataclass(frozen=True)
class EMConfig:
    """How the graph is fitted to soft matches, by EM with an annealed sigma.

    Args:
        num_steps: while sigma shrinks.
        final_steps: at the last sigma.
        compared_after: steps after which hypotheses are compared; the rest are for the best alone.
        slow_steps: instead of num_steps when the best of hypotheses that disagree is refined once more, see `slower`; 0
            leaves that out.
        sigma: first and last, length; the first from a rough start, and
        near_sigma: from one that should be near,
        fused_sigma: from motions that have been refined and put together.
        stiffness: of the graph, first and last.
        give: nodes that disagree by more than this hold each other less, length.
        doubt: support at first of a match that the matcher calls impossible, beside one of a sure match; at the last
            sigma, far below what its tokens are apart, all count alike.
        feature_weight: see `ScanEMConfig`, first and last: bending and hidden surroundings change features a little.
        slide: how much misses along the surface count, squared, first and last.
        regions: how much it counts in that, while sigma shrinks, that a sample leaves the wide regions it follows, see
            `WideRegions`; with 0 none follows any.
        unlike: from which median squared difference of the features around it a sample follows wide regions, and from
            which it does wholly.
        surrounding: samples around each of which that is the median.
        fits_per_step: rounds of matching and fitting at each sigma.
        both_ways_above: sigma from which targets choose among sources too, length.
        boundary_above: sigma from which targets on a boundary may be matched, and matches beside what hides the rest of
            the target hold along the surface too, length.
        beyond: how much it counts, beside a match, that a sample is where the target's camera saw nothing.
        beyond_below: sigma below which that counts, length: before, a limb on its way may leave the outline.
        beyond_scale: those farther from the outline than this count ever less, length.
        beyond_margin: spacings of the target's samples up to which that is nothing.
        expected: how much it counts, beside a match, that a sample without one leaves where it was expected, if that is
            known; those farther off count ever less:
        expected_scale: length.
        density: samples used per squared sigma.
        least_samples: used of each scan, where there are as many.
        compatible: see `ScanEMConfig`; its feature weight gives way to the one above.
    """

    num_steps: int = 6
    final_steps: int = 1
    compared_after: int = 5
    slow_steps: int = 12
    sigma: tuple[float, float] = (0.025, 0.006)
    near_sigma: float = 0.02
    fused_sigma: float = 0.012
    stiffness: tuple[float, float] = (0.2, 0.006)
    give: float = 0.01
    doubt: float = 0.05
    feature_weight: tuple[float, float] = (8.0, 1.0)
    slide: tuple[float, float] = (1.0, 0.03)
    regions: float = 0.1
    unlike: tuple[float, float] = (0.6, 1.0)
    surrounding: int = 30
    fits_per_step: int = 2
    both_ways_above: float = 0.012
    boundary_above: float = 0.02
    beyond: float = 1.0
    beyond_below: float = 0.012
    beyond_scale: float = 0.05
    beyond_margin: float = 1.5
    expected: float = 0.002
    expected_scale: float = 0.05
    density: float = 0.3
    least_samples: int = 300
    compatible: ScanEMConfig = field(default_factory=ScanEMConfig)

    def __post_init__(self) -> None:
        for name in ("num_steps", "compared_after", "fits_per_step", "least_samples", "surrounding"):
            check_count(getattr(self, name), name, 1)
        for name in ("final_steps", "slow_steps"):
            check_count(getattr(self, name), name, 0)
        for name in ("sigma", "stiffness", "slide", "feature_weight", "unlike"):
            check_ends(getattr(self, name), name)
        if self.unlike[0] >= self.unlike[1]:
            raise InputError(f"unlike must grow, got {self.unlike[0]:g} and {self.unlike[1]:g}")
        for name in ("near_sigma", "fused_sigma", "give", "doubt", "beyond_scale", "expected_scale"):
            check_positive(getattr(self, name), name)
        weights, limits = ("regions", "beyond", "expected"), ("both_ways_above", "boundary_above")
        for name in (*weights, *limits, "beyond_below", "beyond_margin", "density"):
            check_positive(getattr(self, name), name, allow_zero=True)

    def slower(self) -> EMConfig:
        """Return the settings of a second, slower EM: matches slide along the surface from its beginning.

        Held along the surface, samples go where the first matches were; cloth and round limbs have farther to go.
        """
        return replace(self, num_steps=self.slow_steps, slide=(self.slide[1], self.slide[1]))


@dataclass(frozen=True)
class ChoiceConfig:
    """How the hypotheses are compared.

    Args:
        cap: distances count up to this, length.
        normal_scale: how many caps normals count as that are one apart.
        seen: what it costs that samples are off the target by a cap or more where its camera would have seen them,
        behind: unless a sample of it is nearer to the camera by more than this, length.
        unlike: what it costs that features differ by one, squared, where the moved source lies on the target.
        bend: what it costs that neighboring nodes disagree by one size in the mean,
        slack: of which less than this hardly counts, length.
        strain: what it costs that samples leave the wide regions they are in, see `WideRegions.strain`.
        leap: what it costs that samples are far from where they were expected, if that is known, squared,
        leap_cap: up to this distance, length.
        overlap: what it costs that samples far from each other along the surface come together, facing the same way:
            two limbs cannot be in one place,
        overlap_cap: from this distance on, length.
        same: hypotheses agree where their samples are this near each other, length,
        same_share: for at least this share of the samples,
        lost_share: unless more of the samples of both scans are as far as the cap from the other scan: of one alone
            they may be hidden, of both a limb went elsewhere; or they overlap by more in the mean.
    """

    cap: float = 0.03
    normal_scale: float = 0.5
    seen: float = 2.0
    behind: float = 0.02
    unlike: float = 2.0
    bend: float = 20.0
    slack: float = 1e-3
    strain: float = 2.5
    leap: float = 3.0
    leap_cap: float = 0.1
    overlap: float = 1.0
    overlap_cap: float = 0.02
    same: float = 0.005
    same_share: float = 0.95
    lost_share: float = 0.02

    def __post_init__(self) -> None:
        for name in ("cap", "behind", "leap_cap", "overlap_cap", "same", "same_share"):
            check_positive(getattr(self, name), name)
        for name in ("normal_scale", "seen", "unlike", "bend", "slack", "strain", "leap", "overlap", "lost_share"):
            check_positive(getattr(self, name), name, allow_zero=True)


@dataclass(frozen=True)
class ScanAlignConfig:
    """How two scans are aligned. The size of the source, on which all lengths rest, is about its diagonal.

    Args:
        num_samples: of the source, which hang on the graph.
        num_target_samples: of the target.
        num_nodes: of the graph.
        num_nearest: nodes that each sample hangs on.
        region_samples: of the source, that wide regions hold.
        region_reach: radius of those along the surface, length.
        region_give: samples off a region's rigid motion by more than this are free, length.
        overlap_samples: of the source, that must not come together
        overlap_reach: if they are farther apart than this along the surface, length.
        curvature_radii: of the features, lengths.
        occluder_depth: a surface this much nearer to the camera beside an edge hides what is behind, length.
        occluder_reach: spacings of samples within which of such an edge matches hold across the surface alone.
        most_cut: share of its outline at which a target may face the camera, if what the camera did not see is to count
            as empty: with more, the target lacks data.
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
    region_samples: int = 200
    region_reach: float = 0.5
    region_give: float = 0.05
    overlap_samples: int = 600
    overlap_reach: float = 0.1
    curvature_radii: tuple[float, ...] = (0.02, 0.035, 0.06)
    occluder_depth: float = 0.03
    occluder_reach: float = 2.5
    most_cut: float = 0.125
    coarse: CoarseConfig = field(default_factory=CoarseConfig)
    refine: EMConfig = field(default_factory=EMConfig)
    choice: ChoiceConfig = field(default_factory=ChoiceConfig)

    def __post_init__(self) -> None:
        for name in (
            "num_samples",
            "num_target_samples",
            "num_nodes",
            "num_nearest",
            "region_samples",
            "overlap_samples",
        ):
            check_count(getattr(self, name), name, 1)
        for name in ("region_reach", "region_give", "overlap_reach"):
            check_positive(getattr(self, name), name)
        _check_values(self.curvature_radii, "curvature_radii")
        check_positive(self.occluder_depth, "occluder_depth")
        check_positive(self.most_cut, "most_cut")
        check_positive(self.occluder_reach, "occluder_reach", allow_zero=True)


@dataclass(frozen=True)
class ScanAlignRecord:
    """One step of an alignment, as given to ``on_step``.

    Args:
        hypothesis: name of what is being followed, such as "rest" or "matches".
        stage: "match", "refine" or, once more and slowly, "slide".
        step: number of the step in its stage.
        num_steps: steps planned in the stage.
        width: sigma, in the user's unit.
        misses: weighted mean squared miss of the matches, squared shares of the size.
        gaps: disagreement of neighboring nodes, squared shares of the size.
        stiffness: weight of the latter.
        matched: weight of the matches over the number of samples.
    """

    hypothesis: str
    stage: str
    step: int
    num_steps: int
    width: float
    misses: float
    gaps: float
    stiffness: float
    matched: float

    @property
    def energy(self) -> float:
        """Both terms together."""
        return self.misses + self.stiffness * self.gaps


OnStep = Callable[[ScanAlignRecord], None]


@dataclass(frozen=True)
class Hypothesis:
    """One way in which the source may have moved.

    Args:
        name: what it started from.
        energy: ``forward + seen + backward + unlike + bend + strain + leap + overlap``, by which hypotheses are
            compared; lower is better.
        forward: mean squared distance of moved samples to the target, capped at one.
        seen: weighted mean distance of moved samples to the target, from 0 at a quarter of the cap to one at the cap; 0
            where its camera would not have seen them, and everywhere if it is not known where that was.
        backward: mean squared distance of target samples to the moved source, capped at one.
        unlike: weighted mean squared difference of features of moved samples and the target.
        bend: weighted disagreement of neighboring nodes.
        strain: weighted share by which wide regions do not move rigidly.
        leap: weighted mean squared distance of samples from where they were expected, capped at one; 0 if that is not
            known.
        overlap: weighted mean over samples, from 0 to 1 where another, far from it along the surface, lies in the same
            place and faces the same way.
    """

    name: str
    energy: float
    forward: float
    seen: float
    backward: float
    unlike: float
    bend: float
    strain: float
    leap: float = 0.0
    overlap: float = 0.0


@dataclass(frozen=True, eq=False)
class ScanAlignment:
    """A source scan moved onto a target.

    Args:
        points: (N, 3) all source points where they went, in the unit, frame and dtype of the source.
        confidence: (N,) in [0, 1], posterior mass of each point's match at the last sigma; low where the target shows
            nothing, and where points follow what is around them.
        samples: (S,) source points that hang on the nodes.
        nodes: (J,) source points that are nodes.
        weights: (N, J) of the nodes at all points, rows sum to one.
        transforms: (J, 4, 4) motions of the nodes, in the unit and frame of the scans.
        chosen: the best hypothesis, as it was compared with the others.
        hypotheses: all of them, the best first.
        history: one `ScanAlignRecord` per step.
    """

    points: Tensor
    confidence: Tensor
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
