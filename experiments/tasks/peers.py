"""Other programs on the same points, where they are installed, measured like torchreg."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..errors import SkippedTrial

PACKAGES = {"cpd": "pycpd", "gicp": "small_gicp", "skeletor": "skeletor"}
# Coherent Point Drift takes memory and time by the product of the numbers of points.
_MAX_POINTS = 700
# Looser, it stops while the points are still drawn together.
_CPD_TOLERANCE, _CPD_STEPS = 1e-5, 150


def peer(method: str) -> Any:
    """Return the package behind a method.

    Raises:
        SkippedTrial: if it is not installed.
    """
    package = PACKAGES[method]
    try:
        return import_module(package)
    except ImportError as error:
        how = "skeletor (under the GPL)" if method == "skeletor" else "'torchreg-articulated[benchmark]'"
        raise SkippedTrial(f"{package} is not installed: pip install {how}") from error


def moved_by(method: str, source: Tensor, target: Tensor, outliers: float = 0.0) -> Tensor:
    """Return source points (N, 3) as moved by another program onto target points (M, 3).

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
    middle = second.mean(0)
    # Their constants are meant for points of unit variance, and for things about a unit long.
    spread, length = np.sqrt(((second - middle) ** 2).sum(1).mean()), np.linalg.norm(np.ptp(second, axis=0))
    size = float(spread if method == "cpd" else length)
    first, second = (first - middle) / size, (second - middle) / size
    found = _cpd(package, first, second, outliers) if method == "cpd" else _gicp(package, first, second)
    return torch.from_numpy(found * size + middle).to(source)


def _cpd(package: Any, source: Any, target: Any, outliers: float) -> Any:
    moving, goal = (points[:: max(1, -(-len(points) // _MAX_POINTS))] for points in (source, target))
    found = package.DeformableRegistration(
        X=goal, Y=moving, w=min(outliers, 0.9), tolerance=_CPD_TOLERANCE, max_iterations=_CPD_STEPS
    )
    moved, _ = found.register()
    # Between its points, what it moved is carried by the nearest of them.
    nearest = torch.cdist(torch.from_numpy(source), torch.from_numpy(moving)).argmin(1).numpy()
    return source + (moved - moving)[nearest]


def _gicp(package: Any, source: Any, target: Any) -> Any:
    found = package.align(target, source, registration_type="GICP", downsampling_resolution=0.02, num_threads=1)
    matrix = np.asarray(found.T_target_source)
    return source @ matrix[:3, :3].T + matrix[:3, 3]
