"""Vertex animations: a viewer's own evaluation of morph targets gives the frames, and lines between them."""

import numpy as np
import pygltflib
import pytest
import torch

from torchreg.errors import InputError
from torchreg.geometry.mesh import unit_sphere
from torchreg.io.gltf_morph import save_vertex_animation
from torchreg.io.points import load_points

BALL = unit_sphere(1)
TIMES = torch.tensor([0.0, 0.5, 2.0])
DTYPES = {5123: np.uint16, 5126: np.float32}


@pytest.fixture
def frames():
    noise = 0.3 * torch.randn(3, *BALL.vertices.shape, generator=torch.Generator().manual_seed(0))
    return BALL.vertices + noise


def play(path, time):
    """Evaluate a file at a time as the specification says."""
    gltf = pygltflib.GLTF2().load(str(path))
    blob = gltf.binary_blob()

    def read(index):
        accessor = gltf.accessors[index]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor.type]
        start = gltf.bufferViews[accessor.bufferView].byteOffset
        return np.frombuffer(blob, DTYPES[accessor.componentType], accessor.count * width, start).reshape(-1, width)

    primitive = gltf.meshes[0].primitives[0]
    (sampler,) = gltf.animations[0].samplers
    keys = read(sampler.input)[:, 0]
    shares = read(sampler.output).reshape(len(keys), -1)
    weights = [np.interp(time, keys, row) for row in shares.T]
    return {
        name: read(getattr(primitive.attributes, name))
        + sum(weight * read(target[name]) for weight, target in zip(weights, primitive.targets, strict=True))
        for name in ("POSITION", "NORMAL")
    }


def test_frames_are_met_and_lines_lead_between_them(frames, tmp_path):
    path = save_vertex_animation(tmp_path / "a.glb", frames, BALL.faces, TIMES)
    for time, frame in zip(TIMES, frames, strict=True):
        found = play(path, float(time))
        np.testing.assert_allclose(found["POSITION"], frame, atol=1e-6)
        np.testing.assert_allclose(np.linalg.norm(found["NORMAL"], axis=-1), 1, atol=1e-5)
    np.testing.assert_allclose(play(path, 1.25)["POSITION"], (frames[1] + frames[2]) / 2, atol=1e-6)


def test_colors_and_the_first_frame_are_read_back(frames, tmp_path):
    colors = torch.rand(len(BALL.vertices), 3, generator=torch.Generator().manual_seed(1))
    cloud = load_points(save_vertex_animation(tmp_path / "a.glb", frames, BALL.faces, TIMES, colors))
    np.testing.assert_allclose(cloud.points, frames[0], atol=1e-6)
    np.testing.assert_allclose(cloud.colors, colors, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"path": "a.gltf"}, r"end in \.glb"),
        ({"frames": torch.zeros(1, 42, 3)}, "two at least, got 1"),
        ({"frames": torch.zeros(42, 3)}, "frames must have shape"),
        ({"times": TIMES[:2]}, r"one per frame \(3\), got 2"),
        ({"times": TIMES.flip(0)}, "strictly increasing"),
        ({"faces": BALL.faces + 40}, "indices from 0 to 41"),
    ],
)
def test_bad_input_is_named(frames, tmp_path, change, message):
    arguments = {"path": "a.glb", "frames": frames, "faces": BALL.faces, "times": TIMES} | change
    arguments["path"] = tmp_path / arguments["path"]
    with pytest.raises(InputError, match=message):
        save_vertex_animation(**arguments)
