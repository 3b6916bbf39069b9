"""Spines as glTF: joints on the curves in every frame, the surface bound to what is near it along the limbs."""

import numpy as np
import pygltflib
import pytest
import torch

from torchreg.errors import InputError
from torchreg.geometry.mesh import unit_sphere
from torchreg.io.gltf import load_rig
from torchreg.spines.spine import Spine
from torchreg.viz.spine_gltf import save_spine_animation

GRAPH = torch.tensor([[0, 3], [1, 3], [2, 3]])


@pytest.fixture
def spine():
    ends = torch.tensor([[1.0, 0, 0], [-1, 0.5, 0], [0, 0, 1]], dtype=torch.float64)
    share = torch.linspace(0, 1, 9, dtype=torch.float64)[:, None]
    rest = ends[:, None] * (1 - share)
    lifted = rest + 0.4 * (1 - share) * torch.tensor([0.0, 1.0, 0.0])
    radii = torch.full((3, 3, 9), 0.1)
    return Spine(torch.stack((rest, 0.5 * (rest + lifted), lifted)), GRAPH, radii)


def test_the_joints_lie_on_the_curves_in_every_frame(gltf_viewer, spine, tmp_path):
    viewer = gltf_viewer(save_spine_animation(tmp_path / "a.glb", spine, num_joints=5, fps=10.0))
    animation = viewer.gltf.animations[0]
    moves = [channel for channel in animation.channels if channel.target.path == "translation"]
    assert len(moves) == 15
    places = np.stack([viewer.read(animation.samplers[channel.sampler].output) for channel in moves], 1)
    right = spine(spine.times).detach()[:, :, ::2].flatten(1, 2).numpy()
    np.testing.assert_allclose(places, right, atol=1e-6)
    times = viewer.read(animation.samplers[0].input)[:, 0]
    np.testing.assert_allclose(times, [0.0, 0.1, 0.2], atol=1e-6)
    assert viewer.gltf.nodes[moves[0].target.node].name == "limb_0_0"


def test_the_surface_hangs_on_the_limb_around_it(spine, tmp_path):
    ball = unit_sphere(1)
    mesh = type(ball)(torch.cat([0.1 * ball.vertices + end for end in spine(0.0).detach()[:, 1].float()]),
                      torch.cat([ball.faces + k * ball.num_vertices for k in range(3)]))  # fmt: skip
    rig = load_rig(save_spine_animation(tmp_path / "a.glb", spine, mesh, num_joints=5))
    own = rig.weights[-mesh.num_vertices :].reshape(3, ball.num_vertices, 3, 5)
    for limb in range(3):
        assert own[limb, :, limb].sum(-1).min() > 0.95
    assert rig.vertices.shape[0] == mesh.num_vertices + 3 * 9 * 8


def test_only_a_surface_makes_it_translucent(spine, tmp_path):
    gltf = pygltflib.GLTF2().load(str(save_spine_animation(tmp_path / "a.glb", spine)))
    assert gltf.materials[0].alphaMode == "OPAQUE"
    gltf = pygltflib.GLTF2().load(str(save_spine_animation(tmp_path / "b.glb", spine, unit_sphere(1))))
    assert gltf.materials[0].alphaMode == "BLEND"


def test_bad_input_is_named(spine, tmp_path):
    with pytest.raises(InputError, match=r"must end in \.glb"):
        save_spine_animation(tmp_path / "a.gltf", spine)
    with pytest.raises(InputError, match="frame must be from 0 to 2"):
        save_spine_animation(tmp_path / "a.glb", spine, frame=3)
    with pytest.raises(InputError, match="num_joints must be at least 2"):
        save_spine_animation(tmp_path / "a.glb", spine, num_joints=1)
