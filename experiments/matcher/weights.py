"""Weights of a trained matcher as a file of the package."""

from __future__ import annotations

import json
from pathlib import Path

import torch

from torchreg.io.tensors import save_tensors


def export_weights(output: Path, file: Path) -> None:
    """Write the weights of a training run, in half precision, with the last row of its curve.

    Args:
        output: folder of the run.
        file: to be written, ``.safetensors``, with a ``.json`` beside it.
    """
    state = torch.load(output / "checkpoint.pt", weights_only=True, map_location="cpu")["net"]
    rows = (output / "curve.jsonl").read_text(encoding="utf-8").splitlines()
    save_tensors(file, {name: value.half() for name, value in state.items()}, {"training": json.loads(rows[-1])})
