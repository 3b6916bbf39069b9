"""Other programs on the same points, where they are installed: what they move is measured like what torchreg moves."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np
import torch
from torch import Tensor

from experiments.errors import SkippedTrial

PACKAGES = {"cpd": "pycpd", "gicp": "small_gicp", "skeletor": "skeletor"}
# Coherent Point Drift takes memory and time by the product of the numbers of points.
_MAX_POINTS = 1500


def peer(method: str) -> Any:
    """Return the package behind a method.

    Raises:
        SkippedTrial: if it is not installed.
    """
    package = PACKAGES[method]
    try:
        return import_module(package)
    except ImportError as error:
        how = "skeletor (under the GPL)" if method == "skeletor" else "'torchreg[benchmark]'"
        raise SkippedTrial(f"{package} is not installed: pip install {how}") from error


def moved_by(method: str, source: Tensor, target: Tensor, outliers: float = 0.0) -> Tensor:
    """Return where another program moves source points (N, 3), given target points (M, 3).

    Args:
        method: "cpd", deformable Coherent Point Drift, or "gicp", rigid generalized ICP.
        source: the points.
        target: where to.
        outliers: their share among the target's points, which "cpd" takes.

    Raises:
        SkippedTrial: if the program is not installed.
    """
    package = peer(method)
    first, second = source.double().cpu().numpy(), target.double().cpu().numpy()
    middle, size = second.mean(0), float(np.linalg.norm(np.ptp(second, axis=0)))
    first, second = (first - middle) / size, (second - middle) / size
    found = _cpd(package, first, second, outliers) if method == "cpd" else _gicp(package, first, second)
    return torch.from_numpy(found * size + middle).to(source)


def _cpd(package: Any, source: Any, target: Any, outliers: float) -> Any:
    every = max(1, -(-len(source) // _MAX_POINTS))
    few, goal = source[::every], target[:: max(1, -(-len(target) // _MAX_POINTS))]
    # Between its points, what it moved is carried by the nearest of them.
    moved, _ = package.DeformableRegistration(X=goal, Y=few, w=min(outliers, 0.9)).register()
    gaps = torch.cdist(torch.from_numpy(source), torch.from_numpy(few)).argmin(1).numpy()
    return source + (moved - few)[gaps]


def _gicp(package: Any, source: Any, target: Any) -> Any:
    found = package.align(target, source, registration_type="GICP", downsampling_resolution=0.02, num_threads=1)
    matrix = np.asarray(found.T_target_source)
    return source @ matrix[:3, :3].T + matrix[:3, 3]
