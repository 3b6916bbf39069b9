"""Triangle meshes as plain data: areas, normals, surface samples, interpolation over faces, spheres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_choice, check_finite, check_shape
from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.budget import BUDGET


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """A validated triangle mesh; vertices that no face uses are allowed.

    Args:
        vertices: (V, 3) finite coordinates, float32 or float64.
        faces: (F, 3) vertex indices, stored as int64 on the device of the vertices; F may be zero.

    Raises:
        InputError: if a shape is wrong, a coordinate is not finite or an index is outside ``0 .. V - 1``.
        InputTypeError: if the vertices are not real numbers or the faces not integers.
    """

    vertices: Tensor
    faces: Tensor

    def __post_init__(self) -> None:
        vertices = as_float_tensor(self.vertices, "vertices")
        check_shape(vertices, "vertices", ("V", 3))
        check_finite(vertices, "vertices", "drop the faces that use them")
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", _check_faces(self.faces, vertices))

    @property
    def num_vertices(self) -> int:
        """Number of vertices."""
        return self.vertices.shape[0]

    @property
    def num_faces(self) -> int:
        """Number of triangles."""
        return self.faces.shape[0]

    def to(self, *args: Any, **kwargs: Any) -> TriangleMesh:
        """Return the mesh on another device or in another dtype; takes what ``Tensor.to`` takes."""
        vertices = self.vertices.to(*args, **kwargs)
        return TriangleMesh(vertices, self.faces.to(vertices.device))

    def face_areas(self) -> Tensor:
        """Return the (F,) areas of the triangles, in squared units of the vertices.

        Differentiable: in the vertices; the gradient of a degenerate face is zero.
        """
        first, second = self._edges()
        return 0.5 * torch.linalg.vector_norm(torch.linalg.cross(first, second, dim=-1), dim=-1)

    def face_normals(self) -> Tensor:
        """Return the (F, 3) unit normals, right-handed along the vertex order; zero for faces flat to rounding.

        Differentiable: in the vertices; the gradient of a degenerate face is zero.
        """
        first, second = self._edges()
        return _unit_cross(first, second)[0]

    def vertex_normals(self, weighting: str = "angle") -> Tensor:
        """Return the (V, 3) unit normals at the vertices, averaged over the adjacent faces.

        Args:
            weighting: ``"angle"`` weighs each face with its angle at the vertex, so that normals do not depend on the
                triangulation; ``"area"`` weighs it with its area, which is cheaper.

        Returns:
            Unit vectors (V, 3); zero at vertices without a face of nonzero area, or where the normals cancel.

        Raises:
            InputError: if ``weighting`` is unknown.

        Differentiable: in the vertices.

        References: Thuermer and Wuethrich, "Computing vertex normals from polygonal facets", 1998 (angle weights).
        """
        check_choice(weighting, "weighting", ("angle", "area"))
        first, second = self._edges()
        normals, flat = _unit_cross(first, second)
        if weighting == "area":
            corners = (normals * self.face_areas()[:, None])[:, None].expand(-1, 3, -1)
        else:
            corners = normals[:, None] * _corner_angles(first, second, flat)[..., None]
        total = torch.zeros_like(self.vertices).index_add(0, self.faces.reshape(-1), corners.reshape(-1, 3))
        return _unit_or_zero(total)[0]

    def bounds(self) -> Tensor:
        """Return the (2, 3) smallest and largest coordinates of the vertices; InputError if there are none."""
        if self.num_vertices == 0:
            raise InputError("vertices must hold at least 1 point for bounds(), got 0")
        return torch.stack((self.vertices.amin(dim=0), self.vertices.amax(dim=0)))

    def _edges(self) -> tuple[Tensor, Tensor]:
        first, second, third = (self.vertices.index_select(0, corner) for corner in self.faces.unbind(1))
        return second - first, third - first


def _check_faces(faces: Any, vertices: Tensor) -> Tensor:
    if not isinstance(faces, Tensor):
        try:
            faces = torch.as_tensor(faces)
        except (TypeError, ValueError, RuntimeError) as error:
            raise InputTypeError(f"faces must be an (F, 3) array of integers, got {type(faces).__name__}") from error
        if faces.numel() == 0:
            faces = faces.reshape(0, 3).long()
    if faces.is_floating_point() or faces.is_complex() or faces.dtype == torch.bool:
        raise InputTypeError(f"faces must hold integers, got dtype {faces.dtype}; convert with .long()")
    check_shape(faces, "faces", ("F", 3))
    faces = faces.to(device=vertices.device, dtype=torch.int64)
    if faces.numel():
        low, high = int(faces.min()), int(faces.max())
        if low < 0 or high >= vertices.shape[0]:
            raise InputError(
                f"faces must index the {vertices.shape[0]} vertices (0 to {vertices.shape[0] - 1}), got indices from "
                f"{low} to {high}"
            )
    return faces


def _unit_or_zero(vectors: Tensor) -> tuple[Tensor, Tensor]:
    """Return unit vectors, zero for zero vectors and to their gradient, and the mask (...,) of these."""
    # Scaled by the largest component first: squares of tiny lengths underflow in float32.
    scale = vectors.detach().abs().amax(dim=-1, keepdim=True)
    empty = scale <= torch.finfo(vectors.dtype).tiny
    scaled = torch.where(empty, torch.ones_like(vectors), vectors / torch.where(empty, torch.ones_like(scale), scale))
    unit = scaled / torch.linalg.vector_norm(scaled, dim=-1, keepdim=True)
    return torch.where(empty, torch.zeros_like(unit), unit), empty[..., 0]


def _unit_cross(first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """Return unit vectors along first x second, zero where the two are parallel to rounding, and the mask of these."""
    first, first_empty = _unit_or_zero(first)
    second, second_empty = _unit_or_zero(second)
    cross = torch.linalg.cross(first, second, dim=-1)
    sine = torch.linalg.vector_norm(cross.detach(), dim=-1)
    flat = first_empty | second_empty | (sine <= 8 * torch.finfo(first.dtype).eps)
    unit, _ = _unit_or_zero(torch.where(flat[..., None], torch.zeros_like(cross), cross))
    return unit, flat


def _corner_angles(first: Tensor, second: Tensor, flat: Tensor) -> Tensor:
    """Return the (F, 3) inner angles in radians; zero for flat faces."""
    # Stand-in edges for flat faces keep 0/0 out of the backward pass.
    stand_in = torch.eye(3, dtype=first.dtype, device=first.device)
    first = torch.where(flat[:, None], stand_in[0], first)
    second = torch.where(flat[:, None], stand_in[1], second)
    # Scaled by the largest component first: squares of tiny lengths underflow in float32.
    scale = torch.maximum(first.detach().abs().amax(-1), second.detach().abs().amax(-1))[:, None]
    first, second = first / scale, second / scale
    # Twice the area is the product of two sides and the sine of the angle between them, at each corner.
    across, opposite = torch.linalg.vector_norm(torch.linalg.cross(first, second, dim=-1), dim=-1), second - first
    along = ((first * second).sum(-1), -(first * opposite).sum(-1), (second * opposite).sum(-1))
    angles = torch.atan2(across[:, None], torch.stack(along, dim=1))
    return torch.where(flat[:, None], torch.zeros_like(angles), angles)


def cross_2d(first: Tensor, second: Tensor) -> Tensor:
    """Return the cross products (N,) of plane vectors (N, 2), twice the signed areas of the triangles they span."""
    return first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]


def sample_surface(
    mesh: TriangleMesh, count: int, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Return ``count`` points drawn uniformly by area, with face_index (count,) and barycentric weights."""
    device, dtype = mesh.vertices.device, mesh.vertices.dtype
    # Cumulative areas in double precision: float32 sums stop growing on large meshes.
    cumulative = TriangleMesh(mesh.vertices.detach().double(), mesh.faces).face_areas().cumsum(dim=0)
    if mesh.num_faces == 0 or not float(cumulative[-1]) > 0:
        raise InputError(f"mesh must have a surface to sample, got {mesh.num_faces} faces of total area 0")
    if generator is None:
        generator = torch.Generator(device=device).manual_seed(0)
    draws = torch.rand(3, count, generator=generator, device=generator.device, dtype=torch.float64).to(device)
    # Stay below the last value: faces of zero area at the end must not be drawn.
    total = cumulative[-1]
    level = torch.minimum(draws[0] * total, torch.nextafter(total, torch.zeros_like(total)))
    face_index = torch.searchsorted(cumulative, level, right=True)
    root = draws[1].sqrt()
    barycentric = torch.stack((1 - root, root * (1 - draws[2]), root * draws[2]), dim=-1).to(dtype)
    return interpolate(mesh.vertices, mesh.faces, face_index, barycentric), face_index, barycentric


def even_samples(mesh: TriangleMesh, count: int) -> tuple[Tensor, Tensor]:
    """Return about ``count`` points spread evenly over a surface, without randomness, and their face_index (count,)."""
    cumulative = mesh.face_areas().detach().double().cumsum(0)
    index = torch.arange(count, device=cumulative.device, dtype=torch.float64)
    face = torch.searchsorted(cumulative, (index + 0.5) / count * cumulative[-1]).clamp_max(mesh.num_faces - 1)
    first, second = ((0.5 + index * step).frac() for step in _R2_STEPS)
    # The unit square is folded onto the triangle.
    folded = first + second > 1
    first, second = torch.where(folded, 1 - first, first), torch.where(folded, 1 - second, second)
    weights = torch.stack((1 - first - second, first, second), dim=-1).to(mesh.vertices)
    return interpolate(mesh.vertices, mesh.faces, face, weights), face


# Three numbers below it make one of 63 bits.
_MOST_KEYED = 2**21
# Powers of the inverse of the plastic number.
_R2_STEPS = (0.7548776662466927, 0.5698402909980532)


def interpolate(values: Tensor, faces: Tensor, face_index: Tensor, barycentric: Tensor) -> Tensor:
    """Return values (V, ...) at the vertices, interpolated linearly at N points of the surface, (N, ...)."""
    return torch.einsum("nc,nc...->n...", barycentric, values[faces[face_index]])


def unit_sphere(subdivisions: int = 3, *, dtype: torch.dtype | None = None) -> TriangleMesh:
    """Return a closed, outward-facing icosphere of radius one with 10 * 4**subdivisions + 2 vertices."""
    most = BUDGET.subdivisions
    if isinstance(subdivisions, bool) or not isinstance(subdivisions, int) or not 0 <= subdivisions <= most:
        raise InputError(f"subdivisions must be an integer from 0 to {most}, got {subdivisions!r}")
    vertices, faces = _icosahedron()
    for _ in range(subdivisions):
        vertices, faces = _split_in_four(vertices, faces)
        vertices = vertices / torch.linalg.vector_norm(vertices, dim=-1, keepdim=True)
    return TriangleMesh(vertices.to(dtype or torch.get_default_dtype()), faces)


def distinct_faces(faces: Tensor) -> Tensor:
    """Return the faces (F, 3) with three different corners, each once."""
    first, second, third = faces.unbind(1)
    low, high = (combine(combine(first, second), third) for combine in (torch.minimum, torch.maximum))
    middle = first + second + third - low - high
    proper = (low != middle) & (middle != high)
    faces, low, middle, high = (values[proper] for values in (faces, low, middle, high))
    if len(faces) == 0:
        return faces
    count = int(high.max()) + 1
    if count < _MOST_KEYED:
        keys = ((low * count + middle) * count + high).sort().values
        if not bool((keys[1:] == keys[:-1]).any()):
            return faces
    # Two numbers per face instead of three: three might not fit into 64 bits.
    pair = (low * count + middle).unique(return_inverse=True)[1]
    key, order = (pair * count + high).sort(stable=True)
    first = torch.cat((key.new_ones(1, dtype=torch.bool), key[1:] != key[:-1]))
    return faces[order[first].sort().values]


def _icosahedron() -> tuple[Tensor, Tensor]:
    # Two poles and two rings of five, turned against each other by 36 degrees, at heights +-1/sqrt(5).
    height, step = 0.2**0.5, torch.pi / 5
    turn = torch.arange(5, dtype=torch.float64) * 2 * step
    rings = [
        torch.stack(
            (2 * height * (turn + lag).cos(), 2 * height * (turn + lag).sin(), torch.full_like(turn, z)), dim=-1
        )
        for lag, z in ((0.0, height), (step, -height))
    ]
    poles = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], dtype=torch.float64)
    faces = []
    for corner in range(5):
        after = (corner + 1) % 5
        upper, upper_after, lower, lower_after = 1 + corner, 1 + after, 6 + corner, 6 + after
        faces += [(0, upper, upper_after), (upper, lower, upper_after)]
        faces += [(lower, lower_after, upper_after), (11, lower_after, lower)]
    return torch.cat((poles[:1], *rings, poles[1:])), torch.tensor(faces)


def _split_in_four(vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    sides = torch.stack((faces, faces.roll(-1, dims=1)), dim=-1).sort(dim=-1).values
    edges, which = sides.reshape(-1, 2).unique(dim=0, return_inverse=True)
    middle = which.reshape(-1, 3) + vertices.shape[0]
    corners = [torch.stack((faces[:, k], middle[:, k], middle[:, k - 1]), dim=-1) for k in range(3)]
    return torch.cat((vertices, vertices[edges].mean(dim=1))), torch.cat((*corners, middle))


def concatenate(meshes: Sequence[TriangleMesh]) -> TriangleMesh:
    """Return one mesh that holds all vertices and faces, in order."""
    faces, offset = [], 0
    for mesh in meshes:
        faces.append(mesh.faces + offset)
        offset += mesh.num_vertices
    return TriangleMesh(torch.cat([mesh.vertices for mesh in meshes]), torch.cat(faces))
