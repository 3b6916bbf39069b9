"""Long sequences: surfaces that are read on request are never held as a whole."""

import weakref
from collections.abc import Sequence

import pytest
import torch

import torchreg as tr
from torchreg.datasets.creatures import STARFISH, creature_sequence
from torchreg.errors import InputError, InputTypeError


class OnRequest(Sequence):
    """Meshes that are made when they are asked for; knows how many there were at once."""

    def __init__(self, meshes):
        self.rows = [(mesh.vertices, mesh.faces) for mesh in meshes]
        self.alive, self.most, self.asked = weakref.WeakSet(), 0, 0

    def __len__(self):
        return len(self.rows)

    def __getitem__(self, index):
        mesh = tr.TriangleMesh(*(part.clone() for part in self.rows[index]))
        self.alive.add(mesh)
        self.most, self.asked = max(self.most, len(self.alive)), self.asked + 1
        return mesh


@pytest.fixture(scope="module")
def plain(meshes):
    return tr.extract_spine(meshes, workers=1)


@pytest.fixture(scope="module")
def meshes():
    return creature_sequence(STARFISH, 4, resolution=32).meshes


def test_few_surfaces_are_held_and_the_spine_is_the_same(meshes, plain):
    on_request = OnRequest(meshes)
    found = tr.extract_spine(on_request, workers=1)
    assert on_request.most <= 2
    assert on_request.asked <= 3 * len(meshes)
    torch.testing.assert_close(found.curves, plain.curves)


def test_an_odd_frame_far_from_the_origin_is_passed_over(meshes, plain):
    shift = 4.0e6
    moved = [tr.TriangleMesh(mesh.vertices.double() + shift, mesh.faces) for mesh in meshes]
    flat = tr.TriangleMesh(moved[2].vertices * torch.tensor([1.0, 1, 0]), moved[2].faces)
    found = tr.extract_spine(OnRequest([*moved[:2], flat, *moved[3:]]), workers=1)
    assert any(warning.startswith("frame 2: passed over") for warning in found.warnings)
    assert found.curves.shape == plain.curves.shape
    middle = found.curves.double().mean((0, 1, 2)) - plain.curves.double().mean((0, 1, 2)) - shift
    assert float(middle.norm()) < 0.05 * float(plain.curves.double().amax() - plain.curves.double().amin())


def test_what_is_no_surface_is_told_by_its_number(meshes):
    empty = tr.TriangleMesh(meshes[0].vertices, meshes[0].faces[:0])
    with pytest.raises(InputError, match=r"meshes\[1\] must have faces"):
        tr.extract_spine(OnRequest([meshes[0], empty]))
    with pytest.raises(InputTypeError, match="got one mesh"):
        tr.extract_spine(meshes[0])
    with pytest.raises(InputError, match="at least one frame"):
        tr.extract_spine(OnRequest([]))
