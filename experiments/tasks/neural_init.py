"""A network trained on clouds of hands in one of five ways: the errors of its poses, step by step."""

from __future__ import annotations

import functools
import time
from collections.abc import Iterator

from torch import Tensor

import torchreg as tr

from ..neural_init.data import Clouds, load_clouds
from ..neural_init.train import TIPS, errors_mm, train
from ..registry import Bench, TrialOutcome
from ..schema import CloudScene, NeuralTrial

# A cloud is right if its fingertips are off by at most this on average.
RIGHT_MM = 10.0


def run(config: NeuralTrial, bench: Bench) -> TrialOutcome:
    """Return the errors of a variant on clouds that it was not trained on, over the steps."""
    hand = _hand()
    begin = time.perf_counter()
    clouds, held_out = _clouds(config.scene)
    seconds = {"clouds": time.perf_counter() - begin}
    begin = time.perf_counter()
    steps, errors = zip(*_errors(hand, clouds, held_out, config), strict=True)
    seconds["train"] = time.perf_counter() - begin
    tips = [error[:, TIPS].mean(-1) for error in errors]
    metrics = {
        "tips_mm": float(tips[-1].mean()),
        "tips_median_mm": float(tips[-1].median()),
        "keypoints_mm": float(errors[-1].mean()),
        "right": float((tips[-1] <= RIGHT_MM).double().mean()),
    }
    curves = {
        "steps": [float(step) for step in steps],
        "tips_mm": [float(error.mean()) for error in tips],
        "keypoints_mm": [float(error.mean()) for error in errors],
    }
    return TrialOutcome(metrics, seconds, curves)


@functools.cache
def _hand() -> tr.Hand:
    return tr.Hand().requires_grad_(False)


@functools.lru_cache(maxsize=1)
def _clouds(scene: CloudScene) -> tuple[Clouds, Clouds]:
    return load_clouds(_hand(), scene)


def _errors(hand: tr.Hand, clouds: Clouds, held_out: Clouds, config: NeuralTrial) -> Iterator[tuple[int, Tensor]]:
    if config.variant == "initializer":
        alone = errors_mm(hand, lambda batch: batch.found, held_out)
        return iter([(0, alone), (config.steps, alone)])
    return train(hand, clouds, held_out, config)
