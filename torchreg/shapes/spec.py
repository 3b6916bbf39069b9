"""Specifications of articulated shapes: tree, parts, solids and surface, and the fit of solids."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.geometry.kinematic_tree import KinematicTree
from torchreg.geometry.primitive_fit import fit_primitive
from torchreg.geometry.primitives import PRIMITIVE_KINDS
from torchreg.geometry.upright import Z_UP, Direction
from torchreg.shapes.primitives import DeferredSolids, Primitive

# Kinds of solids by name, or the one nearest to the points.
SOLID_CHOICES = ("auto", *PRIMITIVE_KINDS)


@dataclass(frozen=True)
class RigSurface:
    """The surface mesh of a file, in the pose of all zeros, with weights (V, P) and colors (P, 3) from 0 to 1.

    The density of the vertices of rigid links is arbitrary.
    """

    vertices: Tensor
    faces: Tensor
    weights: Tensor
    is_rigid: bool = False
    colors: Tensor | None = None


@dataclass(frozen=True)
class ShapeSpec:
    """The specification of an articulated shape; its surface is in the pose of all zeros."""

    tree: KinematicTree
    part_frames: tuple[str, ...]
    primitives: tuple[Primitive, ...] | DeferredSolids
    nu: float
    part_names: tuple[str, ...]
    surface: RigSurface | None = None
    sharpness: float = 2.0
    up: Direction = Z_UP


def fitted_solid(points: Tensor, kind: str) -> Primitive:
    """Return the solid fitted to surface points (N, 3), with its pose in their coordinates; see `fit_primitive`."""
    fitted = fit_primitive(points, kind)
    return Primitive(fitted.kind, fitted.sizes, fitted.pose)


def with_long_axis(solid: Primitive, direction: Tensor | None = None) -> Primitive:
    """Return the same ellipsoid with the axis nearest to a direction (3,), by default its longest, as long axis z."""
    if solid.kind != "ellipsoid":
        return solid
    sizes = torch.tensor(solid.sizes, dtype=torch.float64)
    long = int((sizes if direction is None else (solid.pose[:3, :3].mT @ direction).abs()).argmax())
    order = [(long + 1) % 3, (long + 2) % 3, long]
    pose = solid.pose.clone()
    pose[:3, :3] = solid.pose[:3, order]
    return Primitive(solid.kind, tuple(sizes[order].tolist()), pose)


def fusion_length(primitives: Sequence[Primitive], share: float) -> float:
    """Return the given share of the median half thickness of solids, metres."""
    lengths = [min(_length_sizes(primitive)) for primitive in primitives]
    return share * float(torch.tensor(lengths, dtype=torch.float64).median())


def _length_sizes(primitive: Primitive) -> list[float]:
    kind = PRIMITIVE_KINDS[primitive.kind]
    return [value for value, size in zip(primitive.sizes, kind.sizes, strict=True) if size.is_length]
