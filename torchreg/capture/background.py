"""What stays in the pictures of a camera that stands still, and what each of them shows before it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.capture.background_motion import depth_noise
from torchreg.capture.depth_frame import DepthFrame, grown
from torchreg.errors import InputError, InputTypeError


@dataclass(frozen=True)
class _Mixture:
    """Numbers of the model of a pixel's depths."""

    behind: float = 1e-3  # share of depths behind the background: errors of the camera, as at mirrors
    moving: float = 0.1  # first share of depths before it, which the pictures then tell
    rounds: int = 3  # of telling it
    deviations: float = 4.0  # of the noise, within which two depths are one: one pixel in 16,000 is not, by chance
    most: int = 15  # pictures that tell the background, at most
    rim: int = 2  # pixels: what is thinner is the error of an edge


_MIXTURE = _Mixture()


@dataclass(frozen=True, eq=False)
class Background:
    """What stays in depth pictures of a camera that stands still, from pictures in which things move before it.

    In each pixel depths are a mixture: the background with normal noise that grows with the square of the depth, things
    before it anywhere between the camera and the background, and a few errors behind it. Of the depths that a pixel had
    the background's is the likeliest. So a thing that is away in one picture is no background, however long it stays.

    Args:
        depth: (H, W) metres, zero where nothing was measured in any picture.
        noise: standard deviation of depths at one metre, metres.
        share: of the depths that belong to something before the background.

    References: Stauffer and Grimson 1999 for mixtures of a pixel's values.
    """

    depth: Tensor
    noise: float
    share: float

    @classmethod
    @torch.no_grad()
    def of(cls, frames: Sequence[DepthFrame]) -> Background:
        """Return the background of pictures, at least two, of one camera at one place; masks do not count.

        Raises:
            InputError: if there is one picture alone, or the cameras differ.
            InputTypeError: if one is no `DepthFrame`.

        Differentiable: no.

        Cost: 3 s for five pictures of 1280 x 720 pixels.
        """
        _check_still(frames)
        chosen = torch.linspace(0, len(frames) - 1, min(len(frames), _MIXTURE.most)).round().long().unique()
        depths = torch.stack([_depths(frames[number]) for number in chosen.tolist()])
        noise, share = _noise(depths), _MIXTURE.moving
        found = cls(depths[0], noise, share)
        for _ in range(_MIXTURE.rounds):
            likelihood = torch.stack([cls(depth, noise, share)._likelihood(depths) for depth in depths])
            found = cls(depths.gather(0, likelihood.argmax(0, keepdim=True))[0], noise, share)
            share = float(found._before(depths)[depths > 0].mean()) if bool((depths > 0).any()) else share
        return found

    @torch.no_grad()
    def moved(self, frame: DepthFrame) -> Tensor:
        """Return the pixels (H, W) of a picture that probably show something before the background, bool.

        Raises:
            InputError: if the picture has another size.
        """
        if frame.depth.shape != self.depth.shape:
            raise InputError(
                f"frame must have the background's size {tuple(self.depth.shape)}, got {tuple(frame.depth.shape)}"
            )
        before = self._before(_depths(frame)) > 0.5
        opened = grown(~grown(~before, _MIXTURE.rim), _MIXTURE.rim)
        return opened & before

    def _densities(self, depths: Tensor) -> tuple[Tensor, Tensor]:
        """Return the densities of depths (..., H, W) by something before the background, and by all else, per metre."""
        std = (self.noise * self.depth.square()).clamp_min(torch.finfo(depths.dtype).tiny)
        off = (depths - self.depth) / std
        still = (1 - self.share) * torch.exp(-0.5 * off.square()) / (math.sqrt(2 * math.pi) * std)
        uniform = 1 / self.depth.clamp_min(torch.finfo(depths.dtype).eps)
        return self.share * uniform * (off < 0), still + _MIXTURE.behind * uniform

    def _before(self, depths: Tensor) -> Tensor:
        """Return the probability (..., H, W) that depths show something before the background."""
        before, rest = self._densities(depths)
        return torch.where((depths > 0) & (self.depth > 0), before / (before + rest), 0.0)

    def _likelihood(self, depths: Tensor) -> Tensor:
        """Return the log-likelihood (H, W) of depths (T, H, W) if the background was this one, but for a constant.

        Things before it may rest, so one is as likely as many pictures of it; errors are of single pictures.
        """
        off = (depths - self.depth) / (self.noise * self.depth.square()).clamp_min(torch.finfo(depths.dtype).tiny)
        measured = depths > 0
        near, behind = measured & (off.abs() <= _MIXTURE.deviations), measured & (off > _MIXTURE.deviations)
        hidden = (measured & ~near & ~behind).any(0)
        total = near.sum(0) * math.log(1 - self.share) + behind.sum(0) * math.log(_MIXTURE.behind)
        return torch.where(self.depth > 0, total + hidden * math.log(max(self.share, _MIXTURE.behind)), -torch.inf)


def _depths(frame: DepthFrame) -> Tensor:
    """Return the depths (H, W) of a picture that are of one surface, zero elsewhere."""
    whole = frame.without_mask
    return torch.where(whole.measured, whole.depth, 0.0)


def _noise(depths: Tensor) -> float:
    """Return the standard deviation of depths (T, H, W) at one metre, by most differences between pictures."""
    first, second = depths[:-1], depths[1:]
    both = (first > 0) & (second > 0)
    off = ((second - first) / (0.5 * (first + second)).square().clamp_min(torch.finfo(depths.dtype).eps))[both]
    return max(depth_noise(off) / math.sqrt(2), torch.finfo(depths.dtype).eps)


def _check_still(frames: Sequence[DepthFrame]) -> None:
    """Raise an error unless pictures are several of one camera at one place."""
    for number, frame in enumerate(frames):
        if not isinstance(frame, DepthFrame):
            raise InputTypeError(f"frames[{number}] must be a DepthFrame, got {type(frame).__name__}")
    if len(frames) < 2:
        raise InputError(f"frames must hold at least two pictures, of which something moves in one; got {len(frames)}")
    if not is_still(frames):
        raise InputError("frames must be of one camera that stands still, got different cameras")


def is_still(frames: Sequence[DepthFrame]) -> bool:
    """Return whether pictures are of one camera at one place."""
    first = frames[0].camera
    return all(
        frame.depth.shape == frames[0].depth.shape
        and torch.equal(frame.camera.intrinsics, first.intrinsics)
        and torch.equal(frame.camera.distortion, first.distortion)
        and torch.equal(frame.camera.world_to_camera, first.world_to_camera)
        for frame in frames
    )
