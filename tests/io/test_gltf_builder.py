"""Documents under construction: what is added is found again, and what does not belong is named."""

import numpy as np
import pytest
import torch

from torchreg.errors import InputError, InputTypeError
from torchreg.io.gltf_builder import (
    GltfBuilder,
    checked_numbers,
    checked_path,
    checked_rgba,
    checked_times,
    checked_triangles,
    unit_rows,
)


def test_accessors_are_aligned_and_bounded():
    document = GltfBuilder()
    document.add(np.arange(3, dtype=np.uint8))
    values = np.array([[1.0, 2, 3], [-1, 5, 0]], dtype=np.float32)
    accessor = document.gltf.accessors[document.add(values, bounds=True)]
    view = document.gltf.bufferViews[accessor.bufferView]
    assert view.byteOffset % 4 == 0
    assert (accessor.min, accessor.max) == ([-1, 2, 0], [1, 5, 3])
    stored = np.frombuffer(bytes(document.blob), np.float32, 6, view.byteOffset)
    np.testing.assert_array_equal(stored.reshape(2, 3), values)


def test_no_reader_sees_half_a_file(tmp_path):
    document = GltfBuilder()
    node = document.add_node("a", np.eye(4))
    assert document.gltf.nodes[node].rotation == [0, 0, 0, 1]
    path = document.write(tmp_path / "a.glb", [node])
    assert path.read_bytes().startswith(b"glTF")
    assert [file.name for file in tmp_path.iterdir()] == ["a.glb"]


def test_directions_have_unit_length():
    rows = unit_rows(np.array([[[3.0, 0, 4], [0, 0, 0]]]))
    np.testing.assert_allclose(rows, [[[0.6, 0, 0.8], [0, 0, 1]]])


def test_what_does_not_belong_is_named(tmp_path):
    with pytest.raises(InputError, match=r"end in \.glb"):
        checked_path(tmp_path / "a.obj")
    with pytest.raises(InputError, match="existing folder"):
        checked_path(tmp_path / "no" / "a.glb")
    with pytest.raises(InputError, match="values must be finite"):
        checked_numbers(torch.tensor([torch.nan]), "values", ("N",))
    with pytest.raises(InputTypeError, match="corners must hold integers"):
        checked_triangles(torch.zeros(1, 3), "corners", 3)
    with pytest.raises(InputError, match="strictly increasing"):
        checked_times(torch.tensor([1.0, 1.0]))
    with pytest.raises(InputError, match=r"paint must lie in \[0, 1\]"):
        checked_rgba(torch.full((2, 3), 200.0), "paint", 2)
    assert checked_rgba(torch.zeros(2, 3), "paint", 2)[:, 3].tolist() == [1, 1]
