"""A shape in a whole picture: the crops that may show it are tried, and the most probable answer is kept."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeVar

import torch
from torch import Tensor

from torchreg.alignment.config import AlignConfig
from torchreg.alignment.evidence.picture_agreement import PICTURE_MODEL
from torchreg.alignment.evidence.reliability import CALIBRATION, shown_probability
from torchreg.alignment.results import AlignResult, PoseStarts
from torchreg.alignment.search.crops import LikelyCrop, crop_about, likely_crops
from torchreg.alignment.search.pose_proposer import PoseProposer
from torchreg.capture.depth_frame import DepthFrame
from torchreg.result import Status
from torchreg.shapes.skin import LinearBlendSkin


@dataclass(frozen=True)
class Choice:
    """How the crops of a picture are tried."""

    shown: float = PICTURE_MODEL.told  # probability that a crop shows the shape from which on no other crop is tried
    missed: float = 0.05  # the same of all crops that are left, below which none of them is tried: the level of a test
    enough: float = CALIBRATION.doubtful  # confidence from which on other poses near are not sought
    not_found: float = 0.05  # below which the best pose is rejected, at the usual level of a test


CHOICE = Choice()
Answer = TypeVar("Answer", AlignResult, PoseStarts)


class Aligner(Protocol):
    """What aligns a shape to a crop with given settings, from a start or without."""

    def __call__(  # noqa: D102
        self, crop: DepthFrame, *, config: AlignConfig, start: Tensor | None = None
    ) -> AlignResult: ...


def align_in_picture(
    frame: DepthFrame, skin: LinearBlendSkin, aligned: Aligner, config: AlignConfig, proposer: PoseProposer | None
) -> AlignResult:
    """Return the most probable alignment to crops of a frame, and its crop.

    Crops are aligned from a network's pose, or without a search around the result; then the most probable one with a
    search that knows rivals, unless it had one that leaves no doubt. NOT_FOUND where even its pose is hardly right.
    """
    quick = replace(config, search="never")

    def answer(crop: LikelyCrop) -> AlignResult:
        return aligned(crop.frame, config=quick, start=crop.start)

    found, crop = surest_crop(frame, skin, answer, proposer)
    if proposer is not None and crop.start is not None:
        crop = replace(crop, frame=crop_about(frame, skin, proposer, found.pose) or crop.frame)
    is_sure = _confidence(found) >= CHOICE.enough or config.search == "never" or found.coefficients is not None
    if crop.start is not None or not is_sure:
        found = aligned(crop.frame, config=config)
    return replace(_not_found_if_improbable(found), crop=crop.frame.mask)


def surest_crop(
    frame: DepthFrame,
    skin: LinearBlendSkin,
    answer: Callable[[LikelyCrop], Answer],
    proposer: PoseProposer | None,
) -> tuple[Answer, LikelyCrop]:
    """Return the answer to the crop of a frame that most probably shows a shape, and that crop.

    At most one crop shows the shape: others are tried while they may do so, by the odds of all of them.
    """
    best: tuple[Answer, LikelyCrop] | None = None
    crops = likely_crops(frame, skin, proposer)
    total = 1 + sum(crop.odds for crop in crops)
    left = total - 1
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
    if crop.start is None or not isinstance(found, AlignResult):
        return _confidence(found)
    shown = min(_shown(found), 1 - torch.finfo(torch.float32).eps)
    return max(crop.odds, shown / (1 - shown))


def _confidence(found: Any) -> float:
    return float(found.confidence)


def _shown(found: Any) -> float:
    """Return the probability that a crop shows the shape about where a pose is, or that a start is right."""
    if isinstance(found, AlignResult) and found.evidence is not None:
        return float(shown_probability(found.evidence))
    return _confidence(found)
