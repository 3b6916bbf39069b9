"""Linear discriminants: the directions in which descriptors of one place agree and those of others do not."""

from __future__ import annotations

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_count, check_finite, check_positive, check_same_kind, check_shape
from torchreg.errors import InputError


def linear_discriminants(within: Tensor, between: Tensor, count: int, *, ridge: float = 0.03) -> Tensor:
    """Return the directions along which others differ most for how much those of one place differ.

    Column w maximizes ``w^T between w / w^T (within + r I) w``, where r is the ridge times the mean of the diagonal of
    ``within``, and is scaled such that the denominator is one. Squared distances of ``descriptors @ directions`` so
    are squared distances in units of what is usual at one place.

    Args:
        within: (D, D) mean of ``d d^T`` over differences d of descriptors of the same place, positive semidefinite.
        between: (D, D) the same over differences of descriptors of different places.
        count: k, at most D.
        ridge: positive; what few examples tell of rarely seen directions counts less with a larger one.

    Returns:
        (D, k) directions, the best first.

    Raises:
        InputError: if a shape does not fit, a number is not finite or out of range, or ``within`` is zero.
        InputTypeError: if dtypes or devices differ.

    Differentiable: no.

    Cost: O(D^3), 0.05 s for D = 500 on one core.

    References: Fisher 1936; Cai, Mikolajczyk and Matas 2011, "Learning linear discriminant projections for
    dimensionality reduction of image descriptors".
    """
    within, between = as_float_tensor(within, "within"), as_float_tensor(between, "between")
    check_shape(within, "within", ("D", "D"))
    check_shape(between, "between", tuple(within.shape))
    check_same_kind(between, "between", within, "within")
    check_finite(within, "within")
    check_finite(between, "between")
    check_positive(ridge, "ridge")
    check_count(count, "count", 1)
    if len(within) != within.shape[1] or count > len(within):
        raise InputError(f"within must be square with count ({count}) rows or more, got {tuple(within.shape)}")
    scale = within.diagonal().mean()
    if not scale > 0:
        raise InputError("within must not be zero: it shows no difference to go by")
    with torch.no_grad():
        root = torch.linalg.cholesky(within + ridge * scale * torch.eye(len(within)).to(within))
        half = torch.linalg.solve_triangular(root, between, upper=False)
        whitened = torch.linalg.solve_triangular(root, half.mT, upper=False)
        # Ascending, so the best are last.
        directions = torch.linalg.eigh((whitened + whitened.mT) / 2).eigenvectors[:, -count:].flip(1)
        return torch.linalg.solve_triangular(root.mT, directions, upper=True)


def difference_moments(first: Tensor, second: Tensor) -> Tensor:
    """Return the (D, D) sum of ``d d^T`` over the differences of rows of (L, D) descriptors, in double precision."""
    difference = (first - second).double()
    return difference.mT @ difference
