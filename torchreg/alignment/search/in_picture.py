"""A shape in a whole picture: the crops that may show it are tried, and the most probable answer is kept."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeVar

import torch
from torch import Tensor

from torchreg.alignment.config import AlignConfig
from torchreg.alignment.evidence.picture_agreement import PICTURE_MODEL
from torchreg.alignment.evidence.reliability import shown_probability
from torchreg.alignment.results import AlignResult, PoseStarts
from torchreg.alignment.search.crops import LikelyCrop, crop_about, likely_crops
from torchreg.alignment.search.start_source import StartSource
from torchreg.capture.depth_frame import DepthFrame
from torchreg.result import Status
from torchreg.shapes.skin import LinearBlendSkin


@dataclass(frozen=True)
class Choice:
    """How the crops of a picture are tried."""

    shown: float = PICTURE_MODEL.told  # probability that a crop shows the shape from which on no other crop is tried
    missed: float = 0.05  # the same of all crops that are left, below which none of them is tried: the level of a test
    not_found: float = 0.05  # below which the best pose is rejected, at the usual level of a test


CHOICE = Choice()
Answer = TypeVar("Answer", AlignResult, PoseStarts)


class Aligner(Protocol):
    """What aligns a shape to a crop with given settings, from a start or without."""

    def __call__(  # noqa: D102
        self, crop: DepthFrame, *, config: AlignConfig, start: Tensor | None = None
    ) -> AlignResult: ...


def align_in_picture(
    frame: DepthFrame, skin: LinearBlendSkin, aligned: Aligner, config: AlignConfig, source: StartSource
) -> AlignResult:
    """Return the most probable alignment to crops of a frame, and its crop.

    Crops with a network's pose are aligned from it, unlikely ones without a search around the result; then the most
    probable one with a search that knows rivals, if it may show the shape. NOT_FOUND where its pose is hardly right.
    """
    quick = replace(config, search="never")

    def answer(crop: LikelyCrop) -> AlignResult:
        return aligned(crop.frame, config=quick if crop.is_quick else config, start=crop.start)

    found, crop = surest_crop(frame, skin, answer, source)
    if crop.is_quick and (_odds(found, crop) >= 1 or _confidence(found) >= CHOICE.not_found):
        if source.proposer is not None:
            crop = replace(crop, frame=crop_about(frame, skin, source.proposer, found.pose) or crop.frame)
        found = aligned(crop.frame, config=config)
    return replace(_not_found_if_improbable(found), crop=crop.frame.mask)


def surest_crop(
    frame: DepthFrame,
    skin: LinearBlendSkin,
    answer: Callable[[LikelyCrop], Answer],
    source: StartSource,
) -> tuple[Answer, LikelyCrop]:
    """Return the answer to the crop of a frame that most probably shows a shape, and that crop.

    Half of all pictures show the shape, in any of their crops: others are tried while they may do so.
    """
    best: tuple[Answer, LikelyCrop] | None = None
    crops = likely_crops(frame, skin, source)
    left = sum(crop.odds for crop in crops)
    total = len(crops) + left
    for crop in crops:
        found = answer(crop)
        if best is None or _worth(found, crop) > _worth(*best):
            best = found, crop
        left -= crop.odds
        if _shown(found) >= CHOICE.shown or left < CHOICE.missed * total:
            break
    if best is not None:
        return best
    everything = LikelyCrop(frame.cropped(frame.measured))
    return answer(everything), everything


def _not_found_if_improbable(found: AlignResult) -> AlignResult:
    """Return the result of a whole picture, NOT_FOUND where even the most probable pose is hardly right."""
    confidence = _confidence(found)
    if found.statuses[0].usable or confidence >= CHOICE.not_found:
        return found
    reason = f"not found in the picture: the best pose is wrong with a probability of {1 - confidence:.1%}"
    doubts = [reason, found.doubt] if isinstance(found.doubt, str) and found.doubt else [reason]
    return replace(found, status=Status.NOT_FOUND, doubt="; ".join(doubts))


def _worth(found: Any, crop: LikelyCrop) -> float:
    """Return by what crops are compared: the odds of the better pose in a network's window, or the confidence."""
    return _confidence(found) if crop.start is None or not isinstance(found, AlignResult) else _odds(found, crop)


def _odds(found: Any, crop: LikelyCrop) -> float:
    """Return the odds that a crop shows the shape, by its own pose or the one found, whichever is better."""
    shown = min(_shown(found), 1 - torch.finfo(torch.float32).eps)
    return max(crop.odds, shown / (1 - shown))


def _confidence(found: Any) -> float:
    return float(found.confidence)


def _shown(found: Any) -> float:
    """Return the probability that a crop shows the shape about where a pose is, or that a start is right."""
    if isinstance(found, AlignResult) and found.evidence is not None:
        return float(shown_probability(found.evidence))
    return _confidence(found)
