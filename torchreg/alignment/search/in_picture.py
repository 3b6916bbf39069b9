"""A shape in a whole picture: the crops that may show it are tried, and the most probable answer is kept."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeVar

from torchreg.alignment.config import AlignConfig
from torchreg.alignment.evidence.picture_agreement import PICTURE_MODEL
from torchreg.alignment.evidence.reliability import CALIBRATION, shown_probability
from torchreg.alignment.fit.problem import model_size
from torchreg.alignment.results import AlignResult, PoseStarts
from torchreg.capture.depth_frame import DepthFrame
from torchreg.capture.depth_segments import candidate_crops
from torchreg.result import Status
from torchreg.shapes.skin import LinearBlendSkin


@dataclass(frozen=True)
class Choice:
    """How the crops of a picture are tried."""

    shown: float = PICTURE_MODEL.told  # probability that a crop shows the shape from which on no other crop is tried
    enough: float = CALIBRATION.doubtful  # confidence from which on no surface farther away is, nor other poses near
    not_found: float = 0.05  # below which the best pose is rejected, at the usual level of a test


CHOICE = Choice()
Answer = TypeVar("Answer", AlignResult, PoseStarts)


class Aligner(Protocol):
    """What aligns a shape to a crop with given settings."""

    def __call__(self, crop: DepthFrame, *, config: AlignConfig) -> AlignResult: ...  # noqa: D102


def align_in_picture(
    frame: DepthFrame,
    skin: LinearBlendSkin,
    aligned: Aligner,
    config: AlignConfig,
    crop_score: Callable[[DepthFrame], float],
) -> AlignResult:
    """Return the most probable alignment to crops of a frame, and its crop.

    All crops are aligned without a search around the result; then the most probable one with it, if it is in doubt.
    NOT_FOUND where even the most probable pose is hardly right.
    """
    quick = replace(config, search="never")
    found, crop = surest_crop(frame, model_size(skin), lambda crop: aligned(crop, config=quick), crop_score)
    if _confidence(found) < CHOICE.enough and config.search != "never" and found.coefficients is None:
        found = aligned(crop, config=config)
    return replace(_not_found_if_improbable(found), crop=crop.mask)


def surest_crop(
    frame: DepthFrame, size: float, answer: Callable[[DepthFrame], Answer], crop_score: Callable[[DepthFrame], float]
) -> tuple[Answer, DepthFrame]:
    """Return the answer of highest confidence for the crops of a frame, and that crop; near ones are tried first."""
    best: tuple[Answer, DepthFrame] | None = None
    for crops in candidate_crops(frame, size):
        for crop, is_likely in _likely_first(crops, crop_score):
            # What needs a search is tried where no other crop is believed.
            if best is not None and not is_likely and _confidence(best[0]) >= CHOICE.enough:
                break
            found = answer(crop)
            if best is None or _confidence(found) > _confidence(best[0]):
                best = found, crop
            if _shown(found) >= CHOICE.shown:
                return best
        # Farther surfaces are tried where no end of a nearer one may be the shape.
        if best is not None and _confidence(best[0]) >= CHOICE.enough:
            return best
    if best is not None:
        return best
    everything = frame.cropped(frame.measured)
    return answer(everything), everything


def _not_found_if_improbable(found: AlignResult) -> AlignResult:
    """Return the result of a whole picture, NOT_FOUND where even the most probable pose is hardly right."""
    confidence = _confidence(found)
    if found.statuses[0].usable or confidence >= CHOICE.not_found:
        return found
    reason = f"not found in the picture: the best pose is wrong with a probability of {1 - confidence:.1%}"
    doubts = [reason, found.doubt] if isinstance(found.doubt, str) and found.doubt else [reason]
    return replace(found, status=Status.NOT_FOUND, doubt="; ".join(doubts))


def _likely_first(
    crops: Iterable[DepthFrame], crop_score: Callable[[DepthFrame], float]
) -> list[tuple[DepthFrame, bool]]:
    """Return crops, the likeliest first, and whether they are likely to show anything without a search."""
    seen = sorted(((crop_score(crop), crop) for crop in crops), key=lambda pair: -pair[0])
    return [(crop, likely >= CHOICE.enough) for likely, crop in seen]


def _confidence(found: Any) -> float:
    return float(found.confidence)


def _shown(found: Any) -> float:
    """Return the probability that a crop shows the shape about where a pose is, or that a start is right."""
    if isinstance(found, AlignResult) and found.evidence is not None:
        return float(shown_probability(found.evidence))
    return _confidence(found)
