"""Layers inside compiled and exported networks, and under the transforms of torch.func."""

import copy

import pytest
import torch
from torch import nn
from torch.export import Dim, export
from torch.func import functional_call, jacfwd, jacrev, vmap

import torchreg as tr
from torchreg.registration.bones.sparse_grid import SparseGrid

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")

new_torch = pytest.mark.skipif(
    tuple(int(word) for word in torch.__version__.split(".")[:2]) < (2, 10),
    reason="shapes are compiled and exported by torch 2.10 and newer",
)


class Distance(nn.Module):
    """The distance of points from a shape, as a layer."""

    def __init__(self, shape, pose):
        super().__init__()
        self.shape, self.pose = shape, pose

    def forward(self, points):
        return self.shape.distance(points, self.pose)


@pytest.fixture(scope="module")
def points():
    return 0.05 * torch.randn(60, 3, generator=torch.Generator().manual_seed(0))


@pytest.fixture(scope="module")
def poses(plain_hand):
    noise = torch.randn(3, plain_hand.num_dofs, generator=torch.Generator().manual_seed(1))
    return plain_hand.clamp(plain_hand.rest_pose() + 0.1 * noise)


def grid_model(points, blend):
    grid = SparseGrid.from_points(points, 8)
    generator = torch.Generator().manual_seed(2)
    transforms = torch.eye(4).repeat(3, 1, 1)
    transforms[:, :3, 3] = torch.randn(3, 3, generator=generator)
    weights = torch.randn(grid.num_corners, 3, generator=generator).softmax(-1)
    return tr.GridLBS(grid, weights, transforms, blend=blend).to(torch.float32)


def assert_same(found, expected):
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-4)


def compiled(layer):
    """Return a layer captured as one graph, without a compiler of C++."""
    return torch.compile(layer, fullgraph=True, backend="aot_eager")


def layers(hand, skin, points, poses, name):
    """A layer with its input that has a first dimension of any size."""
    if name in ("shape", "skin"):
        return hand if name == "shape" else skin, poses
    if name == "distance":
        return Distance(hand, poses[0]), points
    return grid_model(points, name), points


@new_torch
@pytest.mark.parametrize("name", ["linear", "dual_quaternion", "skin", "distance", "shape"])
def test_layers_are_compiled_as_one_graph_and_exported_for_inputs_of_any_size(
    plain_hand, plain_hand_skin, points, poses, name
):
    layer, inputs = layers(plain_hand, plain_hand_skin, points, poses, name)
    assert_same(compiled(layer)(inputs), layer(inputs))
    program = export(layer, (inputs,), dynamic_shapes=({0: Dim.AUTO},)).module()
    for count in (len(inputs), len(inputs) - 1):
        assert_same(program(inputs[:count]), layer(inputs[:count]))


def test_the_forward_pass_of_a_shape_is_mapped_and_differentiated(plain_hand, poses):
    # A tenth of the samples: a reverse pass for each coordinate of each takes long.
    plain_hand = copy.deepcopy(plain_hand)
    for name in ("points", "weights", "partners"):
        plain_hand.surface_points.register_buffer(name, getattr(plain_hand.surface_points, name)[::10])
    assert_same(vmap(plain_hand)(poses), plain_hand(poses))
    forward, reverse = jacfwd(plain_hand)(poses[0]), jacrev(plain_hand)(poses[0])
    assert_same(forward, reverse)
    assert reverse.points.shape == (len(plain_hand.surface_points), 3, 27)
    states = {
        name: value.expand(3, *value.shape) + 0.05 * torch.arange(3.0).view(3, *[1] * value.ndim)
        for name, value in plain_hand.named_parameters()
    }
    mapped = vmap(lambda state, pose: functional_call(plain_hand, state, (pose,)))(states, poses)
    for row, pose in enumerate(poses):
        own = functional_call(plain_hand, {name: value[row] for name, value in states.items()}, (pose,))
        assert_same(tuple(field[row] for field in mapped), own)
