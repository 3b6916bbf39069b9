"""How a surface curves around its points, at several sizes: a description that motion and bending hardly change."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_count, check_points, check_positive, check_same_kind, check_shape
from torchreg.errors import InputError
from torchreg.geometry.neighbors import k_nearest

# Neighbors with normals farther apart than this (cosine) are another sheet of the surface.
_SAME_SHEET = 0.2
# Of the fit's own size; keeps what too few neighbors leave open at zero.
_RIDGE = 1e-3


def shape_operators(
    points: Tensor,
    normals: Tensor,
    scan_points: Tensor,
    scan_normals: Tensor,
    radii: Sequence[float],
    *,
    num_neighbors: int = 100,
) -> Tensor:
    """Return the mean curvature and half the difference of the principal curvatures, around each point at each radius.

    The shape operator is the symmetric S that turns steps along the surface into changes of the normal best:
    ``argmin_S sum_j w_j |n_j - S x_j|^2`` over the neighbors' offsets x_j and normals n_j in the tangent plane, with
    ``w = 1 - |x_j|^2 / radius^2``. Convention: positive where the surface bulges towards its normals.

    Args:
        points: (N, 3) where to look, any unit.
        normals: (N, 3) unit vectors.
        scan_points: (M, 3) the surface: all of a scan or points spread evenly over it.
        scan_normals: (M, 3) unit vectors.
        radii: R sizes of the surroundings.
        num_neighbors: most points looked at for each; the nearest.

    Returns:
        (N, R, 2), one over the unit of length; zero where there are no neighbors.

    Raises:
        InputError: if a shape does not fit or a radius is not positive.
        InputTypeError: if dtypes or devices differ.

    Differentiable: in points and normals, for the neighbors as they are.

    Cost: O(N num_neighbors); 30 ms for 2,500 points and three radii.

    References: Rusinkiewicz 2004, "Estimating curvatures and their derivatives on triangle meshes", for the fit.
    """
    given = {"points": points, "normals": normals, "scan_points": scan_points, "scan_normals": scan_normals}
    tensors = {name: as_float_tensor(value, name) for name, value in given.items()}
    for name, value in tensors.items():
        check_points(value, name, batch=False)
        check_same_kind(value, name, tensors["points"], "points")
    points, normals, scan_points, scan_normals = tensors.values()
    check_shape(normals, "normals", tuple(points.shape))
    check_shape(scan_normals, "scan_normals", tuple(scan_points.shape))
    check_count(num_neighbors, "num_neighbors", 1)
    if len(radii) == 0:
        raise InputError("radii must hold at least one radius, got none")
    for radius in radii:
        check_positive(radius, "radii")
    index = k_nearest(points, scan_points, min(num_neighbors, len(scan_points)))[0]
    # What lies in the tangent plane, of offsets and of normals: rows (2, 3) take a vector there.
    plane = _tangent_planes(normals)
    neighbor = scan_normals[index]
    offset = scan_points[index] - points.unsqueeze(1)
    step, square = offset @ plane.mT, offset.square().sum(-1)
    turn = neighbor @ plane.mT
    sheet = (neighbor @ normals.unsqueeze(-1)).squeeze(-1) > _SAME_SHEET
    products = _products(step, turn)
    return torch.stack([_fitted(products, square, sheet, radius) for radius in radii], dim=1)


def _tangent_planes(normals: Tensor) -> Tensor:
    """Return two unit vectors (N, 2, 3) across each normal; what follows does not depend on which."""
    axis = torch.zeros_like(normals).scatter(1, normals.abs().argmin(dim=1, keepdim=True), 1.0)
    first = torch.nn.functional.normalize(torch.linalg.cross(normals, axis), dim=-1)
    return torch.stack((first, torch.linalg.cross(normals, first)), dim=1)


def _products(step: Tensor, turn: Tensor) -> Tensor:
    """Return the products (N, K, 6) of which the normal equations of S = [[a, b], [b, c]] are sums."""
    x, y = step.unbind(-1)
    u, v = turn.unbind(-1)
    return torch.stack((x * x, x * y, y * y, u * x, u * y + v * x, v * y), dim=-1)


def _fitted(products: Tensor, square: Tensor, sheet: Tensor, radius: float) -> Tensor:
    """Return mean curvature and half the difference of the principal ones, (N, 2), within a radius."""
    weight = (1 - square / radius**2).clamp_min(0) * sheet
    xx, xy, yy, right_a, right_b, right_c = (weight.unsqueeze(1) @ products).squeeze(1).unbind(-1)
    ridge = _RIDGE * radius**2 * weight.sum(1) + torch.finfo(products.dtype).tiny
    none = torch.zeros_like(xx)
    # The ridge counts b twice, as the Frobenius norm does: then turning the tangent plane changes nothing.
    rows = (xx + ridge, xy, none, xy, xx + yy + 2 * ridge, xy, none, xy, yy + ridge)
    matrix = torch.stack(rows, dim=-1).unflatten(-1, (3, 3)) / radius**2
    right = torch.stack((right_a, right_b, right_c), dim=-1) / radius**2
    empty = (weight.sum(1) <= 0)[:, None]
    matrix = torch.where(empty.unsqueeze(-1), torch.eye(3).to(matrix), matrix)
    a, b, c = torch.where(empty, 0.0, torch.linalg.solve(matrix, right)).unbind(-1)
    return torch.stack(((a + c) / 2, torch.hypot((a - c) / 2, b)), dim=-1)


def curvature_features(
    points: Tensor,
    normals: Tensor,
    scan_points: Tensor,
    scan_normals: Tensor,
    radii: Sequence[float],
    *,
    num_neighbors: int = 100,
) -> Tensor:
    """Return `shape_operators` as numbers between -pi / 2 and pi / 2: ``arctan(2 radius curvature)``, (N, 2 R).

    Sharp bends are not told apart: noise and sampling decide how sharp they look.
    """
    curvature = shape_operators(points, normals, scan_points, scan_normals, radii, num_neighbors=num_neighbors)
    scale = 2 * torch.tensor(list(radii), dtype=curvature.dtype, device=curvature.device)
    return torch.atan(curvature * scale[:, None]).flatten(1)
