"""One thread for torch: the problems here are small, and the tests may run beside others. Hands that take a second."""

import pytest
import torch

from torchreg.datasets.hand import surface_skin
from torchreg.shapes.hand import Hand
from torchreg.shapes.skin import sample_skin

torch.set_num_threads(1)


@pytest.fixture(scope="session")
def plain_hand():
    """A hand in float32 that takes no gradients; not to be changed."""
    return Hand().requires_grad_(False)


@pytest.fixture(scope="session")
def plain_hand_skin(plain_hand):
    """400 model points of the hand."""
    return sample_skin(plain_hand, 400)


@pytest.fixture(scope="session")
def plain_hand_surface(plain_hand):
    """The hand's whole surface as a skin with faces, from which clouds are drawn."""
    return surface_skin(plain_hand, spacing=0.005)
