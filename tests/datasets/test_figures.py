import math
from dataclasses import replace

import pytest
import torch

from torchreg.datasets.figures import Part, bending_figure, jointed_figure
from torchreg.datasets.solids import RoundCone
from torchreg.errors import InputError
from torchreg.geometry.rotation import so3_exp

ARM = (
    Part("upper", None, (0, 0, 0), (RoundCone((0, 0, 0), (1, 0, 0), 0.15, 0.15),)),
    Part("lower", "upper", (1, 0, 0), (RoundCone((1, 0, 0), (2, 0, 0), 0.15, 0.15),)),
    Part("tip", "lower", (2, 0, 0), (RoundCone((2.1, 0, 0), (2.4, 0, 0), 0.1, 0.1),)),
)


@pytest.fixture(scope="module")
def bending():
    return bending_figure(ARM, spacing=0.08, blend=0.03, softness=0.05)


@pytest.fixture(scope="module")
def jointed():
    return jointed_figure(ARM, spacing=0.08)


def turns(*angles):
    vectors = torch.zeros(len(angles), 3, dtype=torch.float64)
    vectors[:, 2] = torch.tensor(angles)
    return so3_exp(vectors)


def test_without_turns_nothing_moves(bending, jointed):
    for figure in (bending, jointed):
        transforms = figure.transforms(turns(0.0, 0.0, 0.0))
        torch.testing.assert_close(figure.vertices(transforms), figure.mesh.vertices)
        torch.testing.assert_close(figure.joint_positions(transforms), figure.joints[1:])


def test_parts_carry_what_hangs_on_them(jointed):
    quarter = math.pi / 2
    transforms = jointed.transforms(turns(quarter, quarter, 0.0))
    # The upper arm goes along y, the lower one back along -x from (0, 1, 0).
    expected = torch.tensor([[0.0, 1, 0], [-1, 1, 0]], dtype=torch.float64)
    torch.testing.assert_close(jointed.joint_positions(transforms), expected)


def test_the_base_moves_all(bending):
    base = torch.eye(4, dtype=torch.float64)
    base[:3, 3] = torch.tensor([1.0, 2, 3])
    moved = bending.vertices(bending.transforms(turns(0.0, 0.4, 0.0), base))
    still = bending.vertices(bending.transforms(turns(0.0, 0.4, 0.0)))
    torch.testing.assert_close(moved, still + base[:3, 3])


def test_a_batch_is_a_loop(bending):
    rotations = torch.stack([turns(0.1, 0.2, 0.3), turns(-0.4, 0.5, 0.0)])
    batch = bending.vertices(bending.transforms(rotations))
    for one, rotation in zip(batch, rotations, strict=True):
        torch.testing.assert_close(one, bending.vertices(bending.transforms(rotation)))


def test_skins_bend_smoothly_and_pieces_stay_rigid(bending, jointed):
    assert 0.3 < float(bending.weights.amax(-1).min()) < 0.7
    torch.testing.assert_close(bending.weights.sum(-1), torch.ones(len(bending.weights), dtype=torch.float64))
    assert set(jointed.weights.unique().tolist()) == {0.0, 1.0}
    pose = jointed.vertices(jointed.transforms(turns(0.3, -0.7, 0.9)))
    edges = jointed.mesh.faces[:, :2]
    for vertices in (jointed.mesh.vertices, pose):
        lengths = (vertices[edges[:, 0]] - vertices[edges[:, 1]]).norm(dim=-1)
        rest = (jointed.mesh.vertices[edges[:, 0]] - jointed.mesh.vertices[edges[:, 1]]).norm(dim=-1)
        torch.testing.assert_close(lengths, rest)


def test_names_lead_to_numbers(jointed):
    assert jointed.index("tip") == 2
    with pytest.raises(InputError, match="no part is called 'hand'; known: upper, lower, tip"):
        jointed.index("hand")


def test_trees_out_of_order_are_refused(bending):
    with pytest.raises(InputError, match="names of their own"):
        jointed_figure((ARM[0], ARM[0]), spacing=0.1)
    with pytest.raises(InputError, match="parents come first"):
        bending_figure((ARM[1], ARM[0]), spacing=0.1, blend=0.0, softness=0.1)
    with pytest.raises(InputError, match="parents must be one root"):
        replace(bending, parents=(-1, 2, 1))
    with pytest.raises(InputError, match="part_names must name the 3 parts"):
        replace(bending, part_names=("a", "b"))
    with pytest.raises(InputError, match="rotations must have shape"):
        bending.transforms(turns(0.1, 0.2))
    with pytest.raises(InputError, match="softness"):
        bending_figure(ARM, spacing=0.1, blend=0.0, softness=0.0)
