import pytest

import torchreg as tr
from tests.shapes.kinds import KINDS, D


@pytest.fixture(scope="session")
def shapes(tmp_path_factory):
    """All kinds of shapes in float64, frozen; not to be changed."""
    folder = tmp_path_factory.mktemp("kinds")
    return {name: make(folder).requires_grad_(False) for name, make in KINDS.items()}


@pytest.fixture(params=KINDS)
def shape(request, shapes):
    return shapes[request.param]


@pytest.fixture(scope="session")
def hand(shapes):
    return shapes["hand"]


@pytest.fixture(scope="session", params=["right", "left"])
def either_hand(request):
    return tr.Hand(request.param, dtype=D).requires_grad_(False)
