import pytest
import torch

from torchreg.results.alignment import AlignResult
from torchreg.results.base import Status


@pytest.fixture
def result() -> AlignResult:
    return AlignResult(
        pose=torch.zeros(27),
        registered=torch.zeros(5, 3),
        keypoints=torch.zeros(21, 3),
        distances=torch.zeros(4),
        inliers=torch.ones(4, dtype=torch.bool),
        posterior=torch.ones(4),
        sigma=torch.tensor(0.002),
        cost=torch.tensor(1.5),
        status=Status.CONVERGED,
    )
