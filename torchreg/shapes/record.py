"""Shapes as plain data, for files."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.errors import InputTypeError, ModelError
from torchreg.geometry.rigid import rigid_matrix
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.hand import Hand
from torchreg.shapes.primitives import Primitive, PrimitiveSet
from torchreg.shapes.spec import ShapeSpec


@dataclass(frozen=True)
class HandSpec:
    """The arguments of a `Hand`.

    Args:
        side: "right" or "left".
        scale: overall size, 1 for an adult.
        nu: fusion length, metres.
    """

    side: str
    scale: float
    nu: float


@dataclass(frozen=True)
class ShapeRecord:
    """A shape as plain data.

    Args:
        spec: the tree, parts and solids that it is built from.
        free_base: whether its base moves.
        parameters: values of all parameters, in the order of the module's.
        learnable: which of them require gradients.
    """

    spec: ShapeSpec | HandSpec
    free_base: bool
    parameters: tuple[Tensor, ...]
    learnable: tuple[bool, ...]


def record_shape(shape: ArticulatedShape) -> ShapeRecord:
    """Return a shape as plain data; its tensors are detached, on the CPU and not shared with it.

    Raises:
        InputTypeError: if the shape is of a class that this release does not know how to build.
    """
    spec: ShapeSpec | HandSpec
    if type(shape) is Hand:
        spec = HandSpec(shape.side, shape.scale, shape.nu)
    elif type(shape) is ArticulatedShape:
        tree = shape.kinematics.tree
        frames = tuple(tree.joints[index].name for index in shape.part_index.tolist())
        solids = tuple(_solids(shape.primitives))
        spec = ShapeSpec(
            tree=tree,
            part_frames=frames,
            primitives=solids,
            nu=shape.nu,
            part_names=shape.part_names,
            surface=shape.surface,
        )
    else:
        raise InputTypeError(
            f"only an ArticulatedShape or a Hand can be stored, got {type(shape).__name__}; store its state_dict"
        )
    parameters = tuple(shape.parameters())
    values = tuple(parameter.detach().cpu().clone() for parameter in parameters)
    learnable = tuple(parameter.requires_grad for parameter in parameters)
    return ShapeRecord(spec, bool(shape.upper[0] > 0), values, learnable)


def build_shape(record: ShapeRecord) -> ArticulatedShape:
    """Return the shape that a record describes, a new module on the CPU.

    Raises:
        ModelError: if the parameters do not fit the spec, or no shape can be built from it.
        InputError: if a hand has an unknown side, or a scale or fusion length that is not positive.
    """
    dtypes = {value.dtype for value in record.parameters}
    if len(dtypes) != 1 or not (dtype := dtypes.pop()).is_floating_point:
        raise ModelError("a shape needs parameters of one floating-point dtype")
    spec = record.spec
    if isinstance(spec, ShapeSpec):
        unknown = set(spec.part_frames) - {joint.name for joint in spec.tree.joints}
        if unknown:
            raise ModelError(f"parts are on frames that the tree does not have: {', '.join(sorted(unknown)[:5])}")
    shape = (
        Hand(spec.side, scale=spec.scale, nu=spec.nu, dtype=dtype)
        if isinstance(spec, HandSpec)
        else ArticulatedShape.from_spec(spec, free_base=record.free_base, dtype=dtype)
    )
    parameters = tuple(shape.parameters())
    wanted, found = ([tuple(value.shape) for value in values] for values in (parameters, record.parameters))
    if wanted != found or len(record.learnable) != len(parameters):
        raise ModelError(f"the shape needs parameters of shapes {wanted}, got {found}")
    with torch.no_grad():
        for parameter, value, learnable in zip(parameters, record.parameters, record.learnable, strict=True):
            parameter.copy_(value)
            parameter.requires_grad_(learnable)
    return shape


def _solids(primitives: PrimitiveSet) -> list[Primitive]:
    """Return the solids with their present sizes and poses, in the order of the parts."""
    sizes = {
        int(part): tuple(row)
        for kind, rows in zip(primitives.kinds, primitives.sizes, strict=True)
        for part, row in zip(primitives.get_buffer(f"members_{kind}"), rows.tolist(), strict=True)
    }
    poses = rigid_matrix(primitives.rotations, primitives.centers).detach().cpu()
    return [Primitive(kind, sizes[part], poses[part]) for part, kind in enumerate(primitives.part_kinds)]
