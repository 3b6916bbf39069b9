"""Shapes as plain data, for files."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from torchreg.errors import InputTypeError, ModelError
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.hand import Hand
from torchreg.shapes.spec import ShapeSpec

# Bytes of a mesh beyond which the files of results keep the solids alone.
_MOST_SURFACE = 4_000_000
# Tensors of a record that earlier releases did not have: nu and sharpness.
_NUM_NEW = 2


@dataclass(frozen=True)
class HandSpec:
    """The arguments of a `Hand`."""

    side: str
    scale: float
    nu: float
    sharpness: float = 2.0


@dataclass(frozen=True)
class ShapeRecord:
    """A shape as plain data: what is learned and what it multiplies, and which of it requires gradients.

    Earlier releases left the last two parameters, the logarithms of nu and of the sharpness, out.
    """

    spec: ShapeSpec | HandSpec
    free_base: bool
    parameters: tuple[Tensor, ...]
    learnable: tuple[bool, ...]


def record_shape(shape: ArticulatedShape) -> ShapeRecord:
    """Return a shape as plain data; its tensors are detached, on the CPU and not shared with it."""
    spec: ShapeSpec | HandSpec
    if type(shape) is Hand:
        spec = HandSpec(shape.side, shape.scale, shape.start_nu, shape.start_sharpness)
    elif type(shape) is ArticulatedShape:
        tree = shape.kinematics.tree
        frames = tuple(tree.joints[index].name for index in shape.part_index.tolist())
        solids = tuple(shape.primitives.solids())
        spec = ShapeSpec(
            tree=tree,
            part_frames=frames,
            primitives=solids,
            nu=shape.start_nu,
            part_names=shape.part_names,
            surface=shape.surface,
            sharpness=shape.start_sharpness,
            up=shape.up,
        )
    else:
        raise InputTypeError(
            f"only an ArticulatedShape or a Hand can be stored, got {type(shape).__name__}; store its state_dict"
        )
    tensors = _tensors(shape)
    values = tuple(tensor.detach().cpu().clone() for tensor in tensors)
    learnable = tuple(tensor.requires_grad for tensor in tensors)
    return ShapeRecord(spec, bool(shape.upper[0] > 0), values, learnable)


def build_shape(record: ShapeRecord) -> ArticulatedShape:
    """Return the shape that a record describes, a new module on the CPU."""
    dtypes = {value.dtype for value in record.parameters}
    if len(dtypes) != 1 or not (dtype := dtypes.pop()).is_floating_point:
        raise ModelError("a shape needs parameters of one floating-point dtype")
    spec = record.spec
    if isinstance(spec, ShapeSpec):
        unknown = set(spec.part_frames) - {joint.name for joint in spec.tree.joints}
        if unknown:
            raise ModelError(f"parts are on frames that the tree does not have: {', '.join(sorted(unknown)[:5])}")
    shape = (
        Hand(spec.side, scale=spec.scale, nu=spec.nu, sharpness=spec.sharpness, dtype=dtype)
        if isinstance(spec, HandSpec)
        else ArticulatedShape.from_spec(spec, free_base=record.free_base, dtype=dtype)
    )
    tensors = _tensors(shape)
    is_early = len(record.parameters) == len(tensors) - _NUM_NEW
    tensors = tensors[:-_NUM_NEW] if is_early else tensors
    wanted, found = ([tuple(value.shape) for value in values] for values in (tensors, record.parameters))
    if wanted != found or len(record.learnable) != len(tensors):
        raise ModelError(f"the shape needs parameters of shapes {wanted}, got {found}")
    with torch.no_grad():
        for tensor, value, learnable in zip(tensors, record.parameters, record.learnable, strict=True):
            tensor.copy_(value)
            # In earlier releases everything required gradients by default.
            if isinstance(tensor, nn.Parameter) and not is_early:
                tensor.requires_grad_(learnable)
    return shape


def record_kept_shape(shape: ArticulatedShape | None) -> ShapeRecord | None:
    """Return the record of a shape for the file of a result, without a mesh above 4 MB; None for unknown classes."""
    if shape is None or type(shape) not in (Hand, ArticulatedShape):
        return None
    record = record_shape(shape)
    surface = record.spec.surface if isinstance(record.spec, ShapeSpec) else None
    if surface is None or isinstance(record.spec, HandSpec):
        return record
    held = (surface.vertices, surface.faces, surface.weights)
    if sum(tensor.numel() * tensor.element_size() for tensor in held) <= _MOST_SURFACE:
        return record
    return replace(record, spec=replace(record.spec, surface=None))


def build_kept_shape(record: ShapeRecord | None) -> ArticulatedShape | None:
    """Return the shape that the file of a result keeps, if it keeps one."""
    return None if record is None else build_shape(record)


def _tensors(shape: ArticulatedShape) -> list[Tensor]:
    """Return the tensors of a shape that a record holds, in its order."""
    solids = shape.primitives
    scales = shape.log_length_scales, shape.log_radius_scales
    return [*scales, solids.centers, *solids.sizes, shape.log_nu, shape.log_sharpness]
