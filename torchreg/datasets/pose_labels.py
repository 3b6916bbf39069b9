"""Clouds labeled with the poses found in them, on disk, to train networks on."""

from __future__ import annotations

import os
from dataclasses import dataclass, fields, replace
from pathlib import Path

import torch
from torch import Tensor
from torch.utils.data import Dataset

from torchreg.errors import FormatError, InputError
from torchreg.io.limits import DEFAULT_LIMITS, FileLimits, local_path
from torchreg.io.tensors import load_tensors, save_tensors
from torchreg.shapes.pose_algebra import shifted

_KIND, _STEM = "PoseLabel", "label_"


@dataclass(frozen=True)
class PoseLabel:
    """One cloud and its pose, metres and radians; parts (M,) are -1 off the surface, the confidence () 0 to 1."""

    points: Tensor
    pose: Tensor
    keypoints: Tensor
    parts: Tensor
    confidence: Tensor

    def moved(self, origin: Tensor) -> PoseLabel:
        """Return the label, whose coordinates begin at an origin (3,), in those in which the origin is given."""
        return replace(
            self, points=self.points.double() + origin, pose=shifted(self.pose.double(), origin),
            keypoints=self.keypoints.double() + origin,
        )  # fmt: skip

    def save(self, folder: str | os.PathLike[str], number: int) -> Path:
        """Write the label to a folder, as safetensors and JSON, and return the path; see `PoseLabels`."""
        path = label_path(folder, number)
        tensors = {item.name: getattr(self, item.name) for item in fields(self)}
        save_tensors(path, tensors, {"kind": _KIND, "confidence": float(self.confidence)})
        return path


def label_path(folder: str | os.PathLike[str], number: int) -> Path:
    """Return the path of the label of a frame in a folder."""
    return local_path(folder) / f"{_STEM}{number:06d}.safetensors"


class PoseLabels(Dataset[dict[str, Tensor]]):
    """The labels that ``torchreg label`` wrote to a folder, frame by frame, as dicts of tensors of a `PoseLabel`."""

    def __init__(
        self, folder: str | os.PathLike[str], *, min_confidence: float = 0.0, limits: FileLimits = DEFAULT_LIMITS
    ) -> None:
        self.limits = limits
        paths = sorted(local_path(folder).glob(f"{_STEM}*.safetensors"))
        if min_confidence > 0:
            paths = [path for path in paths if float(self._read(path)["confidence"]) >= min_confidence]
        if not paths:
            raise InputError(f"{folder} holds no label of confidence {min_confidence:g} or more")
        self.paths = tuple(paths)

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        return self._read(self.paths[index])

    def _read(self, path: Path) -> dict[str, Tensor]:
        tensors, record = load_tensors(path, limits=self.limits)
        if record.get("kind") != _KIND or set(tensors) != {item.name for item in fields(PoseLabel)}:
            raise FormatError(f"{path}: holds no {_KIND}")
        return tensors


def collate_labels(labels: list[dict[str, Tensor]]) -> dict[str, Tensor]:
    """Return a batch of labels, padded to the longest cloud, with a ``mask`` (B, M) that is False for padding."""
    longest = max(len(label["points"]) for label in labels)

    def padded(name: str, value: float) -> Tensor:
        rows = []
        for label in labels:
            row = label[name]
            filler = row.new_full((longest - len(row), *row.shape[1:]), value)
            rows.append(torch.cat([row, filler]))
        return torch.stack(rows)

    batch = {name: torch.stack([label[name] for label in labels]) for name in ("pose", "keypoints", "confidence")}
    counts = torch.tensor([len(label["points"]) for label in labels])
    batch["mask"] = torch.arange(longest) < counts.unsqueeze(-1)
    batch["points"], batch["parts"] = padded("points", 0.0), padded("parts", -1)
    return batch
