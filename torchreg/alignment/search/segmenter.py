"""A network that tells which data of a window belong to a shape, and which to what it holds or stands before."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from torchreg.alignment.search.pose_proposer import CloudNet, ProposerSize
from torchreg.errors import FormatError
from torchreg.io.limits import DEFAULT_LIMITS, FileLimits
from torchreg.io.tensors import load_tensors, save_tensors
from torchreg.shapes.articulation import Articulation
from torchreg.shapes.hand import Hand

_KIND = "Segmenter"
# Of the built-in hand.
HAND_DATA_WEIGHTS = Path(__file__).with_name("hand_data.safetensors")
SEGMENTER_SIZE = ProposerSize(decoder=0, hypotheses=1)
_INTERPOLATED = 3  # tokens next to a datum, as in PointNet++


class Segmenter(CloudNet):
    """Tells the data of a shape from others: the tokens of a `CloudNet`, without hypotheses, in shares of its size.

    Shape of ``forward(points, mask)``: points (B, M, 3) and their mask (B, M), as many as `fitting` gives; log-odds
    (B, T) that tokens lie on the shape, and the tokens' points (B, T).

    Differentiable: in its parameters and the points.

    References: Qi et al. 2017 (PointNet++), for what lies between tokens.
    """

    def __init__(self, size: ProposerSize = SEGMENTER_SIZE) -> None:
        super().__init__(size, shape_size=1.0)
        self.told = nn.Linear(size.width, 1)

    def forward(self, points: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Return log-odds, see the class."""
        found = self.attended(points, mask, self.queries)
        return self.told(found.tokens).float().squeeze(-1), found.token_index

    @torch.no_grad()
    def log_odds(self, shape: Articulation, points: Tensor, mask: Tensor, size: float) -> Tensor:
        """Return the log-odds (B, M) that points (B, M, 3), metres, with a mask (B, M) belong to a shape of a size."""
        # A left hand is a right one in a mirror.
        flip = points.new_tensor([-1.0 if getattr(shape, "side", "right") == "left" else 1.0, 1.0, 1.0])
        places = points * flip / size
        cloud, known = self.fitting(places, mask)
        told, index = self(cloud.to(self.queries), known)
        tokens = cloud.gather(1, index.unsqueeze(-1).expand(-1, -1, 3))
        apart = torch.cdist(places, tokens).masked_fill(~known.gather(1, index).unsqueeze(1), torch.inf)
        apart, near = apart.topk(min(_INTERPOLATED, index.shape[1]), largest=False)
        weight = apart.clamp_min(torch.finfo(apart.dtype).eps).square().reciprocal()
        told = told.to(points).unsqueeze(1).expand(-1, points.shape[1], -1).gather(2, near)
        return (weight * told).sum(-1) / weight.sum(-1)

    def save(self, path: str | os.PathLike[str], training: Mapping[str, Any] | None = None) -> None:
        """Write the weights as safetensors, and beside them JSON with what to remember of training.

        In half precision with the eight significant bits of bfloat16, which compress in a wheel.

        Args:
            path: to be written, ``.safetensors``.
            training: what to remember.
        """
        record = {"kind": _KIND, "sizes": asdict(self.size), "training": dict(training or {})}
        save_tensors(path, {name: value.bfloat16().half() for name, value in self.state_dict().items()}, record)

    @staticmethod
    def load(path: str | os.PathLike[str], *, limits: FileLimits = DEFAULT_LIMITS) -> Segmenter:
        """Return the network of a file.

        Raises:
            FileNotFoundError: if there is no such file.
            FormatError: if the file is damaged, or holds no such network.
        """
        tensors, record = load_tensors(path, limits=limits)
        if record.get("kind") != _KIND:
            raise FormatError(f"{path}: holds no {_KIND}, got {record.get('kind')!r}")
        try:
            # Layers draw weights before those of the file replace them: the caller's random state stays.
            with torch.random.fork_rng(devices=[]):
                found = Segmenter(ProposerSize(**record["sizes"]))
            found.load_state_dict({name: value.float() for name, value in tensors.items()})
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            raise FormatError(f"{path}: holds no {_KIND} of this version ({error})") from error
        return found.requires_grad_(False).eval()


@lru_cache(maxsize=1)
def _read(path: Path, _changed: int, device: torch.device) -> Segmenter:
    # What is made in inference mode could not be used outside of it.
    with torch.inference_mode(False):
        return Segmenter.load(path).to(device)


def shipped_segmenter(shape: Articulation) -> Segmenter | None:
    """Return the network that comes with torchreg for a shape, read once: of the built-in hand; None for others."""
    if not isinstance(shape, Hand):
        return None
    return _read(HAND_DATA_WEIGHTS, HAND_DATA_WEIGHTS.stat().st_mtime_ns, shape.rest.device)
