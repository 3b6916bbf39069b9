"""Creatures and their spines that several tests of spines look at; not to be changed."""

import pytest
import torch

import torchreg as tr
from torchreg.datasets.creatures import STARFISH, creature_sequence


@pytest.fixture(scope="session")
def starfish():
    """Five frames of a starfish."""
    return creature_sequence(STARFISH, 5, resolution=40)


@pytest.fixture(scope="session")
def meshes():
    """Four coarse frames of a starfish."""
    return list(creature_sequence(STARFISH, 4, resolution=32).meshes)


@pytest.fixture(scope="session")
def spine(meshes):
    """The spine of the coarse frames, from one process."""
    return tr.extract_spine(meshes, times=torch.arange(4) / 10, workers=1)
