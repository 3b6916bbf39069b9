"""Skins: points carried by an articulated shape."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torchreg._checks import as_float_tensor, check_count, check_points, check_positive, check_shape
from torchreg.errors import InputError
from torchreg.geometry.mesh import TriangleMesh, interpolate, sample_surface
from torchreg.geometry.rigid import invert_rigid, transform_points
from torchreg.geometry.sampling import farthest_points
from torchreg.shapes.articulation import Articulation

# Candidates per chosen point; more cover the surface more evenly.
_OVERSAMPLING = 8


class LinearBlendSkin(nn.Module):
    """Points that move by a weighted mean of part motions, ``sum_p w_p T_p(pose) T_p(reference)^-1 x``.

    The mean is linear in the part transforms, so posing all points is one matrix product.

    Args:
        shape: the articulated shape that carries the points.
        points: (N, 3) in the reference pose, metres.
        weights: (N, P), rows sum to one.
        reference_pose: (num_dofs,).
        normals: (N, 3) unit normals in the reference pose, if known.
        faces: (F, 3) triangles over the points, if any.

    Raises:
        InputError: if sizes do not fit, a point is not finite, or rows of weights do not sum to one.
    """

    basis: Tensor
    weights: Tensor
    points: Tensor
    reference_pose: Tensor
    normals: Tensor | None
    normal_basis: Tensor | None
    faces: Tensor | None

    def __init__(
        self,
        shape: Articulation,
        points: Tensor,
        weights: Tensor,
        reference_pose: Tensor,
        *,
        normals: Tensor | None = None,
        faces: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.shape = shape
        points = as_float_tensor(points, "points", like=shape.rest).detach()
        check_points(points, "points", batch=False)
        weights = as_float_tensor(weights, "weights", like=points).detach()
        check_shape(weights, "weights", (len(points), shape.num_parts))
        total = weights.sum(-1, keepdim=True)
        if not torch.allclose(total, torch.ones_like(total), atol=1e-4) or bool((weights < 0).any()):
            raise InputError("weights must not be negative and every row must sum to one")
        weights = weights / total
        if normals is not None:
            normals = as_float_tensor(normals, "normals", like=points).detach()
            check_shape(normals, "normals", (len(points), 3))
        if faces is not None:
            faces = TriangleMesh(points, faces).faces
        reference_pose = shape.check_pose(reference_pose, "reference_pose").detach()
        check_shape(reference_pose, "reference_pose", (shape.num_dofs,))
        self.register_buffer("reference_pose", reference_pose)
        self.register_buffer("points", points)
        self.register_buffer("weights", weights)
        self.register_buffer("normals", normals)
        self.register_buffer("faces", faces)
        with torch.no_grad():
            basis, normal_basis = _bases(shape, points, weights, reference_pose, normals)
        self.register_buffer("basis", basis)
        self.register_buffer("normal_basis", normal_basis)

    def __len__(self) -> int:
        return len(self.points)

    def forward(self, pose: Tensor) -> Tensor:
        """Return the points in a pose.

        Args:
            pose: (..., num_dofs).

        Returns:
            (..., N, 3), metres.

        Differentiable: in ``pose`` and the shape's bone lengths.

        References: Dewaele et al. 2006, eq. 3.
        """
        return self.place(stacked_rows(self.shape.part_transforms(pose)))

    def place(self, rows: Tensor) -> Tensor:
        """Return the points for given part transforms.

        Args:
            rows: (..., 4 P, 3) transforms as `stacked_rows` and `Articulation.transform_jacobian` stack them.

        Returns:
            (..., N, 3), metres; in memory all x come first, then all y, then all z.

        Differentiable: in ``rows``.
        """
        # The product with the three coordinates as the short left side takes a fifth of the time or less.
        return nn.functional.linear(rows.mT, self.bases()[0]).mT

    def bases(self) -> tuple[Tensor, Tensor | None]:
        """Return the matrices (N, 4 P) that take part transforms to points and to normals, if there are any."""
        return self.basis, self.normal_basis

    def frozen(self) -> LinearBlendSkin:
        """Return the skin as it is now, with constant weights: itself, unless it follows its shape."""
        return self

    def row_jacobian(self, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Return the rows that `place` takes, and their derivatives (..., 4 P, 3, num_dofs) in tangent coordinates."""
        return self.shape.transform_jacobian(pose, chart="tangent")

    def jacobian(self, pose: Tensor, *, chart: str = "pose") -> tuple[Tensor, Tensor]:
        """Return the posed points and their analytic Jacobian with respect to all degrees of freedom.

        Args:
            pose: (..., num_dofs).
            chart: see `Articulation.part_twists`.

        Returns:
            points (..., N, 3) and Jacobian (..., N, 3, num_dofs).

        Differentiable: in ``pose``.
        """
        rows, derivative = self.shape.transform_jacobian(pose, chart=chart)
        jacobian = self.bases()[0] @ derivative.flatten(-2)
        return self.place(rows), jacobian.unflatten(-1, derivative.shape[-2:])

    def posed_normals(self, pose: Tensor) -> Tensor:
        """Return the unit normals in a pose, rotated by the weighted mean of the part rotations.

        Args:
            pose: (..., num_dofs).

        Returns:
            (..., N, 3).

        Raises:
            InputError: if the skin has no normals.
        """
        return self.turn_normals(stacked_rows(self.shape.part_transforms(pose)))

    def turn_normals(self, rows: Tensor) -> Tensor:
        """Return the unit normals (..., N, 3) for given part transforms, see `place`.

        Raises:
            InputError: if the skin has no normals.
        """
        normal_basis = self.bases()[1]
        if normal_basis is None:
            raise InputError("this skin has no normals; pass normals= when building it")
        rotated = nn.functional.linear(rows.mT, normal_basis)
        return nn.functional.normalize(rotated, dim=-2).mT


def stacked_rows(transforms: Tensor) -> Tensor:
    """Return part transforms (..., P, 4, 4) as the rows (..., 4 P, 3) that skins are linear in."""
    return transforms[..., :3, :].mT.flatten(-3, -2)


def _bases(
    shape: Articulation, points: Tensor, weights: Tensor, reference_pose: Tensor, normals: Tensor | None
) -> tuple[Tensor, Tensor | None]:
    """Return the matrices (N, 4 P) by which part transforms give points (N, 3) and normals."""
    inverse = invert_rigid(shape.part_transforms(reference_pose))
    local = transform_points(inverse, points.expand(shape.num_parts, -1, -1)).transpose(0, 1)
    if normals is None:
        return _weighted(local, weights, 1.0), None
    # Bone lengths rotate no part, so that the normals in the parts' frames are the same for all lengths.
    local_normals = (normals @ inverse[:, :3, :3].mT).transpose(0, 1)
    return _weighted(local, weights, 1.0), _weighted(local_normals, weights, 0.0)


def _weighted(local: Tensor, weights: Tensor, last: float) -> Tensor:
    """Return (N, 4 P): coordinates (N, P, 3) in the parts' frames, made homogeneous, times weights (N, P)."""
    return (nn.functional.pad(local, (0, 1), value=last) * weights.unsqueeze(-1)).flatten(-2).contiguous()


class BendingSkin(LinearBlendSkin):
    """Points near the surface that slide and stretch where the surface bends.

    ``T(X, pose) = (phi_p^a T_p X + phi_r^a T_r X) / (phi_p^a + phi_r^a)``, p the dominating part of X, r its neighbor
    with the largest field, both in the reference pose; the weight of p is ``sigmoid(a (d_r - d_p) / nu)``.

    Args:
        shape: the articulated shape that carries the points.
        points: (N, 3) in the reference pose, metres.
        reference_pose: (num_dofs,); the rest pose by default.
        sharpness: a; 2 lets the skin slide and stretch, 10 is near rigid; the shape's own by default.
        normals: (N, 3) unit normals in the reference pose, if known.
        faces: (F, 3) triangles over the points, if any.

    Raises:
        InputError: if sizes do not fit or ``sharpness`` is not positive.

    References: Dewaele et al. 2006, eq. 3.
    """

    def __init__(
        self,
        shape: Articulation,
        points: Tensor,
        reference_pose: Tensor | None = None,
        sharpness: float | None = None,
        *,
        normals: Tensor | None = None,
        faces: Tensor | None = None,
    ) -> None:
        if sharpness is not None:
            check_positive(sharpness, "sharpness")
        reference_pose = shape.rest_pose() if reference_pose is None else reference_pose
        points = as_float_tensor(points, "points", like=shape.rest).detach()
        check_points(points, "points", batch=False)
        with torch.no_grad():
            pose = shape.check_pose(reference_pose, "reference_pose")
            check_shape(pose, "reference_pose", (shape.num_dofs,))
            weights = bending_weights(shape, points, pose, sharpness)
        super().__init__(shape, points, weights, reference_pose, normals=normals, faces=faces)
        self._given_sharpness = sharpness
        self.follows_shape = torch.is_grad_enabled() and any(value.requires_grad for value in shape.parameters())

    @property
    def sharpness(self) -> float:
        """The exponent a: the one given, or that of the shape."""
        return self.shape.sharpness if self._given_sharpness is None else self._given_sharpness

    def bases(self) -> tuple[Tensor, Tensor | None]:
        """Return the matrices (N, 4 P) that take part transforms to points and to normals, if there are any."""
        if not self.follows_shape:
            return super().bases()
        weights = bending_weights(self.shape, self.points, self.reference_pose, self._given_sharpness)
        return _bases(self.shape, self.points, weights, self.reference_pose, self.normals)

    @torch.no_grad()
    def frozen(self) -> LinearBlendSkin:
        """Return the skin as it is now, with constant weights: itself, unless it follows its shape."""
        if not self.follows_shape:
            return self
        return BendingSkin(
            self.shape, self.points, self.reference_pose, self._given_sharpness, normals=self.normals, faces=self.faces
        )


def bending_weights(shape: Articulation, points: Tensor, pose: Tensor, sharpness: float | None = None) -> Tensor:
    """Return the weights (N, P) of eq. 3 for points (N, 3) in a pose, at most two per row, which sum to one."""
    distances = shape.part_distances(points, pose)
    nearest, dominating = distances.min(-1)
    neighbors = shape.adjacency[dominating].scatter(-1, dominating.unsqueeze(-1), False)
    alone = ~neighbors.any(-1)
    second, neighbor = distances.masked_fill(~neighbors, torch.inf).min(-1)
    # Without a neighbor the share is one, and a gap without an infinity keeps its gradient from being no number.
    gap = torch.where(alone, 0.0, second - nearest)
    exponent = shape.bending_sharpness() if sharpness is None else sharpness
    share = torch.where(alone, 1.0, torch.sigmoid(exponent * gap / shape.fusion_length()))
    weights = torch.zeros_like(distances)
    weights = weights.scatter(-1, neighbor.unsqueeze(-1), (1 - share).unsqueeze(-1))
    return weights.scatter(-1, dominating.unsqueeze(-1), share.unsqueeze(-1))


def sample_skin(
    shape: Articulation, count: int = 500, *, sharpness: float | None = None, seed: int = 0
) -> LinearBlendSkin:
    """Return model points that cover the shape's surface evenly, in the rest pose, with normals.

    A shape read from a file with a mesh gives points of that mesh under the file's weights; any other gives points of
    the fused surface under the bending skin.

    Args:
        shape: the articulated shape.
        count: number of points.
        sharpness: a of the bending skin; the shape's own by default.
        seed: of the candidates among which the points are chosen.

    Returns:
        A skin with ``count`` points.

    Raises:
        InputError: if ``count`` is not positive.

    Cost: meshing the fused surface takes about half a second; the meshes of the latest shapes are kept.
    """
    check_count(count, "count", 1)
    mesh = shape.surface_mesh() if shape.surface is None else TriangleMesh(
        shape.surface.vertices.to(shape.rest), shape.surface.faces.to(shape.rest.device)
    )  # fmt: skip
    generator = torch.Generator().manual_seed(seed)
    points, face, barycentric = sample_surface(mesh.to("cpu"), _OVERSAMPLING * count, generator=generator)
    chosen = farthest_points(points, count)
    points, face, barycentric = points[chosen].to(shape.rest), face[chosen], barycentric[chosen]
    normals = mesh.face_normals()[face.to(mesh.faces.device)]
    if shape.surface is None:
        return BendingSkin(shape, points, shape.rest_pose(), sharpness, normals=normals)
    weights = interpolate(shape.surface.weights, shape.surface.faces, face, barycentric.to(shape.surface.weights))
    return LinearBlendSkin(shape, points, weights, torch.zeros_like(shape.rest), normals=normals)
