"""How far the confidence in a fit of pose and shape can be trusted, on made-up people and hands of anny.

Each case is a person or hand of `benchmarks/shape_fit.py`, of other seeds, made harder: 800 to 4,000 of its points, in
half of the cases up to 0.3 % of the size more noise, up to 15 % more outliers. A third of the starts are those of
`benchmarks/shape_fit.py`, a third is turned by up to half a turn about the vertical, off by 5 % of the size, and bent
otherwise, and a third of the people are searched without a start. Beside a quarter of them another one stands or lies,
who may touch them. A fit is right if all vertices, hidden ones too, are off by at most 1.5 % of the person's size on
average: 25 mm of 1.7 m. Needs anny.

    python benchmarks/shape_confidence.py                      # 21 bodies and 21 hands
    python benchmarks/shape_confidence.py --calibrate          # fits the model anew, and leaves one out in turn
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, fields
from importlib.util import find_spec

import torch
from confidence import area_under_curve
from shape_fit import MARGIN, Person, error_mm, fit, load_model, make_person, start_pose
from torch import Tensor

import torchreg as tr
from torchreg.alignment.evidence.reliability import SHAPE_CALIBRATION, Evidence
from torchreg.geometry.rotation import compose_rotation_vectors
from torchreg.solvers.calibration import fit_logistic

# Sizes of the mean ones, metres.
SIZES, FIRST_SEED = {"body": 1.9, "hand.R": 0.246}, 1000
STARTS = ("near", "worse", "none")
# One of so many is accompanied; how far apart the middles are, in the sum of both deviations.
ACCOMPANIED, FIRST_OTHER, APART = 4, 500_000, (1.5, 3.0)
FEWEST, MORE_NOISE, MORE_OUTLIERS, OFF, BENT = 800, 0.003, 0.15, 0.05, 0.3
# Of the evidence what clouds and searches tell of.
NAMES = ("beside", "clusters", "off", "unknown", "rival", "rival_share")
TOLD = [[item.name for item in fields(Evidence)].index(name) for name in NAMES]
BINS, BARS = 5, (0.85, 0.9)


@dataclass(frozen=True)
class Case:
    """A fit and its truth: its kind, mean error as a share of the size, evidence (E,), confidence and status."""

    kind: str
    error: float
    evidence: Tensor
    confidence: float
    status: tr.Status


def harder(person: Person, draws: Sequence[float], size: float, generator: torch.Generator) -> Tensor:
    """Return the data of a person with fewer points, more noise and more outliers, as far as draws of [0, 1) say."""
    share, noisy, noise, outliers = draws
    data = person.data[torch.randperm(len(person.data), generator=generator)[: int(FEWEST * 5**share)]]
    spread = MORE_NOISE * size * noise * (noisy < 0.5)
    data = data + spread * torch.randn(data.shape, generator=generator).double()
    low, high = person.vertices.amin(0), person.vertices.amax(0)
    margin = MARGIN * (high - low).norm()
    count = int(MORE_OUTLIERS * outliers**2 * len(data))
    drawn = torch.rand(count, 3, generator=generator).double()
    return torch.cat([data, low - margin + (high - low + 2 * margin) * drawn])


def beside(person: Person, other: Person, count: int, generator: torch.Generator) -> Tensor:
    """Return as many points of another person, who is about as far aside as both are broad."""
    data = other.data[torch.randperm(len(other.data), generator=generator)[:count]]
    aside = person.vertices.mean(0) - data.mean(0)
    angle, apart = torch.rand(2, generator=generator).tolist()
    way = torch.tensor([math.cos(math.tau * angle), math.sin(math.tau * angle), 0.0], dtype=data.dtype)
    broad = ((person.vertices @ way).std() + (data @ way).std()) * (APART[0] + (APART[1] - APART[0]) * apart)
    return data + aside + broad * way


def worse_start(
    shape: tr.ArticulatedShape, start: Tensor, draws: Sequence[float], size: float, generator: torch.Generator
) -> Tensor:
    """Return a start turned about the vertical through its middle, moved, and bent otherwise."""
    turn, side, bent, off = draws
    middle, moved = shape.keypoints(start).mean(0), start.clone()
    about = torch.tensor([0.0, 0.0, math.pi * turn**2 * (1 if side < 0.5 else -1)]).to(start)
    moved[3:6] = compose_rotation_vectors(about, start[3:6])
    moved[6:] += BENT * bent * torch.randn(len(start) - 6, generator=generator).to(start)
    moved = shape.clamp(moved)
    moved[:3] += middle - shape.keypoints(moved).mean(0)
    moved[:3] += OFF * size * off * torch.randn(3, generator=generator).to(start)
    return moved


def collect(kind: str, count: int) -> list[Case]:
    """Return the cases of a kind."""
    model, shape, cases = load_model(kind), tr.ArticulatedShape.from_anny(kind), []
    for seed in range(FIRST_SEED, FIRST_SEED + count):
        person = make_person(model, kind, shape.part_names[0], seed)
        generator = torch.Generator().manual_seed(seed)
        draws = torch.rand(8, generator=generator).tolist()
        data = harder(person, draws[:4], SIZES[kind], generator)
        if seed // len(STARTS) % ACCOMPANIED == 0:
            other = make_person(model, kind, shape.part_names[0], FIRST_OTHER + seed)
            data = torch.cat([data, beside(person, other, len(data), generator)])
        start: Tensor | None = start_pose(model, shape, person)
        if seed % len(STARTS) == STARTS.index("worse"):
            start = worse_start(shape, start, draws[4:], SIZES[kind], generator)
        elif seed % len(STARTS) == STARTS.index("none"):
            start = None
        hard = Person(**{**vars(person), "data": data})
        vertices, result, _ = fit(shape, hard, start)
        rest = shape.vertices(shape.rest_pose(), result.coefficients)
        error = error_mm(vertices, person) / 1e3 / float((rest.amax(0) - rest.amin(0)).norm())
        cases.append(Case(
            kind=kind, error=error, evidence=result.evidence, confidence=float(result.confidence), status=result.status
        ))  # fmt: skip
        told = f"{error:.2%} of the size; confidence {cases[-1].confidence:.2f}"
        print(f"{kind} {seed}, start {STARTS[seed % len(STARTS)]}: {told}", flush=True)
    return cases


def left_out(evidence: Tensor, right: Tensor) -> Tensor:
    """Return the confidence (N,) in each case by a model that was fitted to all others."""
    found = []
    for number in range(len(evidence)):
        others = torch.arange(len(evidence)) != number
        found.append(fit_logistic(evidence[others], right[others]).probability(evidence[number].double()))
    return torch.stack(found)


def render(confidence: Tensor, right: Tensor) -> tuple[str, bool]:
    """Return lines on area, reliability and statuses, and whether the bars are met."""
    area = area_under_curve(confidence, right)
    sure = confidence >= SHAPE_CALIBRATION.doubtful
    trusted = float(right[sure].double().mean()) if bool(sure.any()) else math.nan
    lines = [
        f"{len(right)} cases, {int(right.sum())} right: area under the curve {area:.3f}; {int((sure & right).sum())} "
        f"right and sure, {int((sure & ~right).sum())} wrong and sure"
    ]
    for number in range(BINS):
        chosen = (confidence >= number / BINS) & ((confidence < (number + 1) / BINS) | (number + 1 == BINS))
        if bool(chosen.any()):
            lines.append(
                f"  {number / BINS:.1f} to {(number + 1) / BINS:.1f}: {int(chosen.sum()):3} cases, mean confidence "
                f"{float(confidence[chosen].mean()):.2f}, right {float(right[chosen].double().mean()):.2f}"
            )
    return "\n".join(lines), area >= BARS[0] and trusted >= BARS[1]


def report(cases: Sequence[Case], calibrate: bool) -> bool:
    """Print what the confidence is worth, by the model of the library, or by one that is fitted anew."""
    right = torch.tensor([case.error <= SHAPE_CALIBRATION.right for case in cases])
    confidence = torch.tensor([case.confidence for case in cases])
    if calibrate:
        evidence = torch.stack([case.evidence for case in cases])[:, TOLD].double()
        print(f"{fit_logistic(evidence, right)} of {', '.join(NAMES)}; each by the others' model:")
        confidence = left_out(evidence, right)
    met = True
    for kind in SIZES:
        chosen = torch.tensor([case.kind == kind for case in cases])
        lines, passed = render(confidence[chosen], right[chosen])
        print(f"{kind}: {lines}")
        met &= passed
    return met


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what is asked for; 0 if the bars are met."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=21, help="cases of each kind")
    parser.add_argument("--calibrate", action="store_true", help="fit the model of the confidence anew")
    options = parser.parse_args(arguments)
    if find_spec("anny") is None:
        print("skipped: anny is not installed; pip install 'torchreg-articulated[anny]'")
        return 0
    cases = [case for kind in SIZES for case in collect(kind, options.count)]
    return 0 if report(cases, options.calibrate) else 1


if __name__ == "__main__":
    sys.exit(main())
