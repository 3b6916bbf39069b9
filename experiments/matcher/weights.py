"""Weights of a trained matcher as a file of the package."""

from __future__ import annotations

import json
from pathlib import Path

import torch
from torch import Tensor

from torchreg.io.tensors import load_tensors, save_tensors


def export_weights(output: Path, file: Path) -> None:
    """Write the best weights of a training run, in half precision, with their row of its curve.

    Args:
        output: folder of the run.
        file: to be written, ``.safetensors``, with a ``.json`` beside it.
    """
    rows = [json.loads(row) for row in (output / "curve.jsonl").read_text(encoding="utf-8").splitlines()]
    weights = {name: value.half() for name, value in load_weights(output / "checkpoint.pt").items()}
    save_tensors(file, weights, {"training": max(rows, key=lambda row: row["right"])})


def load_weights(file: Path) -> dict[str, Tensor]:
    """Return weights of the package's form, ``.safetensors``, or the best ones of a training run's checkpoint."""
    if file.suffix == ".safetensors":
        return {name: value.float() for name, value in load_tensors(file)[0].items()}
    best: dict[str, Tensor] = torch.load(file, weights_only=True, map_location="cpu")["best"]
    return best
