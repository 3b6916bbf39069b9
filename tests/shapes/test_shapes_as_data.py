"""Shapes as plain data: what is built from a record is the shape that was recorded, to the last bit."""

from dataclasses import replace

import pytest
import torch

from torchreg.errors import InputError, InputTypeError, ModelError
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.geometry.rigid import rigid_matrix
from torchreg.geometry.rotation import so3_exp
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.hand import Hand
from torchreg.shapes.primitives import Primitive
from torchreg.shapes.record import build_shape, record_shape
from torchreg.shapes.spec import RigSurface


def offset(*values):
    return rigid_matrix(so3_exp(torch.tensor(values[3:], dtype=torch.float64)), torch.tensor(values[:3]).double())


def make_machine(**options):
    """Solids of all kinds in mixed order, a slide, a mimic, frames without solids, names of its own."""
    tree = KinematicTree((
        Joint("base", -1, offset(0, 0, 0, 0, 0, 0)),
        Joint("turn", 0, offset(0.1, 0, 0.1, 0.3, 0, 0), "revolute", (0.0, 1.0, 0.0), -1.5, 0.5),
        Joint("still", 1, offset(0, 0, 0.15, 0, 0.2, 0.1)),
        Joint("slide", 2, offset(0, 0, 0.12, 0, 0, 0), "prismatic", (0.0, 0.0, 1.0), 0.01, 0.05),
        Joint("follow", 1, offset(0, 0.2, 0, 0, 0, 0), "revolute", (1.0, 0.0, 0.0), mimic=(1, -0.5, 0.1)),
        Joint("free", 4, offset(0, 0.1, 0, 0, 0, 0), "revolute", (1.0, 0.0, 0.0)),
    ))  # fmt: skip
    solids = [
        Primitive("capsule", (0.06, 0.03), offset(0, 0, 0.07, 0.5, 0.1, 0)),
        Primitive("superquadric", (0.1, 0.06, 0.08, 0.6, 0.8), offset(0.02, 0, 0, 0, 0, 0)),
        Primitive("capsule", (0.05, 0.02), offset(0, 0, 0.06, 0, 0, 1.2)),
        Primitive("cone", (0.05, 0.03, 0.015), offset(0, 0.005, 0.05, 0, 0, 0)),
        Primitive("ellipsoid", (0.03, 0.025, 0.07), offset(0, 0, 0.06, 0, 0.7, 0)),
    ]
    frames = ["turn", "base", "slide", "follow", "free"]
    return ArticulatedShape(tree, frames, solids, nu=0.006, part_names=list("abcde"), **options)


def learned(shape):
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in shape.parameters():
            parameter.add_(0.01 * torch.rand(parameter.shape, generator=generator).to(parameter))
    return shape


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    "make",
    [
        lambda dtype: make_machine(dtype=dtype),
        lambda dtype: make_machine(dtype=dtype, free_base=False),
        lambda dtype: Hand("left", scale=0.9, nu=0.004, dtype=dtype),
    ],
)
def test_the_built_shape_is_the_recorded_one(make, dtype):
    shape = learned(make(dtype))
    shape.log_radius_scales.requires_grad_(False)
    built = build_shape(record_shape(shape))
    assert type(built) is type(shape)
    for first, second in ((shape.parameters(), built.parameters()), (shape.buffers(), built.buffers())):
        first, second = list(first), list(second)
        assert len(first) == len(second)
        for a, b in zip(first, second, strict=True):
            assert a.dtype == b.dtype
            assert torch.equal(a, b)
            assert a.requires_grad == b.requires_grad
    assert (built.part_names, built.part_parents, built.dof_names) == (
        shape.part_names, shape.part_parents, shape.dof_names,
    )  # fmt: skip
    assert built.nu == shape.nu
    pose = shape.rest_pose() + 0.3 * torch.rand(shape.num_dofs, generator=torch.Generator().manual_seed(1)).to(dtype)
    points = torch.rand(20, 3, generator=torch.Generator().manual_seed(2)).to(dtype)
    assert torch.equal(built.keypoints(pose), shape.keypoints(pose))
    assert torch.equal(built.distance(points, pose), shape.distance(points, pose))


def test_what_is_upright_is_recorded():
    assert make_machine().up == (0, 0, 1)
    assert build_shape(record_shape(make_machine(up=(0.0, -1.0, 0.0)))).up == (0, -1, 0)


def test_a_record_shares_nothing_with_its_shape():
    shape = make_machine()
    record = record_shape(shape)
    before = [value.clone() for value in record.parameters]
    built = build_shape(record)
    learned(shape)
    learned(built)
    assert all(torch.equal(a, b) for a, b in zip(record.parameters, before, strict=True))
    assert not any(value.requires_grad for value in record.parameters)


def test_the_surface_of_a_file_is_kept():
    vertices = torch.rand(4, 3, dtype=torch.float64)
    surface = RigSurface(vertices, torch.tensor([[0, 1, 2], [1, 2, 3]]), torch.eye(5, dtype=torch.float64)[:4])
    shape = make_machine(surface=surface)
    pose = shape.rest_pose() + 0.1
    assert torch.equal(build_shape(record_shape(shape)).file_skin()(pose), shape.file_skin()(pose))


def test_shapes_of_unknown_classes_are_refused():
    class Foot(Hand):
        pass

    with pytest.raises(InputTypeError, match="only an ArticulatedShape or a Hand can be stored, got Foot"):
        record_shape(Foot())


def test_records_that_describe_no_shape_are_refused():
    record = record_shape(make_machine())
    mixed = (record.parameters[0].double(), *record.parameters[1:])
    whole = tuple(value.long() for value in record.parameters)
    for parameters in ((), mixed, whole):
        with pytest.raises(ModelError, match="parameters of one floating-point dtype"):
            build_shape(replace(record, parameters=parameters))
    for wrong in (
        replace(record, parameters=record.parameters[1:]),
        replace(record, parameters=(record.parameters[0][:3], *record.parameters[1:])),
        replace(record, learnable=record.learnable[1:]),
    ):
        with pytest.raises(ModelError, match="the shape needs parameters of shapes"):
            build_shape(wrong)
    frames = ("turn", "base", "slide", "follow", "wing")
    with pytest.raises(ModelError, match="parts are on frames that the tree does not have: wing"):
        build_shape(replace(record, spec=replace(record.spec, part_frames=frames)))
    hand = record_shape(Hand())
    with pytest.raises(InputError, match="side must be one of right, left; got 'both'"):
        build_shape(replace(hand, spec=replace(hand.spec, side="both")))
