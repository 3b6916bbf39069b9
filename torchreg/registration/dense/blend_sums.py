"""Points that each follow few of many motions, and the sums over them that Gauss-Newton steps need."""

from __future__ import annotations

import torch
from scipy.sparse import csr_array
from torch import Tensor

from torchreg._checks import check_shape
from torchreg.errors import InputError

# Where a symmetric matrix of three or four rows has its entries among those of its upper triangle.
_SIX = torch.tensor([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
_TEN = torch.tensor([[0, 1, 2, 3], [1, 4, 5, 6], [2, 5, 7, 8], [3, 6, 8, 9]])
_UPPER_SIX, _UPPER_TEN = torch.triu_indices(3, 3), torch.triu_indices(4, 4)


def _twist_products() -> Tensor:
    """Return (144, 36): from products of metric and arms, (m, p, q, n), to those of two twists.

    A twist (v, w) moves an arm a by ``v + w x a``: entry p is ``sum_jm G_pjm twist_j (a, 1)_m``.
    """
    slope = torch.zeros(3, 6, 4, dtype=torch.float64)
    for axis, (after, last) in enumerate(((1, 2), (2, 0), (0, 1))):
        slope[axis, axis, 3] = 1
        slope[axis, 3 + after, last], slope[axis, 3 + last, after] = 1, -1
    return torch.einsum("pjm,qkn->mpqnjk", slope, slope).reshape(144, 36)


_TWIST_PRODUCTS = _twist_products()
# (m, p, q, n) among the products of the upper triangles of (x, 1) (x, 1)^T and of a metric.
_SPREAD = (_TEN[:, None, None, :] * 6 + _SIX[None, :, :, None]).reshape(-1)


class BlendSums:
    """Points that go to ``sum_k w_ik T_k x_i``, and the normal equations of ``1/2 sum_i d_i^T P_i d_i`` over twists.

    A node's twist moves what it carries of a point by ``w_ik (v + w x a_ik)``, with the arm ``a_ik = T_k x_i - m_k``.
    Arms are affine in x_i, so the Hessian's block of two nodes follows from ``sum_i w_ik w_il P_i (x, 1) (x, 1)^T``:
    only P_i changes from step to step, and one sparse matrix, made once, takes all these sums.

    Args:
        points: (R, 3) float64 on the CPU.
        nearest: (R, K) int64 nodes that each follows.
        weights: (R, K) by how much; of any sign, zero for none.
        num_nodes: J.

    References: Sumner, Schmid and Pauly 2007, section 4.
    """

    def __init__(self, points: Tensor, nearest: Tensor, weights: Tensor, num_nodes: int) -> None:
        count = len(points)
        check_shape(points, "points", ("R", 3))
        check_shape(nearest, "nearest", (count, "K"))
        check_shape(weights, "weights", tuple(nearest.shape))
        if nearest.numel() and not 0 <= int(nearest.min()) <= int(nearest.max()) < num_nodes:
            raise InputError(f"nearest must hold nodes from 0 to {num_nodes - 1}, got {nearest.tolist()[:8]}")
        self.num_nodes = num_nodes
        self._ends = torch.nn.functional.pad(points, (0, 1), value=1.0)
        self._squares = self._ends[:, _UPPER_TEN[0]] * self._ends[:, _UPPER_TEN[1]]
        each = torch.arange(count).unsqueeze(1).expand_as(nearest)
        self._blend = csr_array((weights.flatten(), (each.flatten(), nearest.flatten())), shape=(count, num_nodes))
        self._gather = self._blend.T.tocsr()
        # Each pair of nodes once, the larger first.
        product = weights.unsqueeze(2) * weights.unsqueeze(1)
        used = (nearest.unsqueeze(2) >= nearest.unsqueeze(1)) & (product != 0)
        pairs = (nearest.unsqueeze(2) * num_nodes + nearest.unsqueeze(1))[used]
        self._pairs, which = pairs.unique(return_inverse=True)
        carried = each.unsqueeze(2).expand_as(used)[used]
        self._products = csr_array((product[used], (which, carried)), shape=(len(self._pairs), count))

    def __len__(self) -> int:
        return len(self._ends)

    def places(self, transforms: Tensor) -> Tensor:
        """Return where motions (J, 4, 4) take the points, (R, 3)."""
        rows = _applied(self._blend, transforms[:, :3].flatten(1)).unflatten(1, (3, 4))
        return (rows @ self._ends.unsqueeze(-1)).squeeze(-1)

    def normal_equations(
        self, transforms: Tensor, middles: Tensor, metrics: Tensor, weighted_residuals: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the gradient (J, 6) and the Hessian (6 J, 6 J), of which the lower triangle alone is filled.

        Convention: twists are (translation, rotation), about the middles; see `turn_about`.
        """
        arms = transforms.clone()
        arms[:, :3, 3] -= middles
        slopes = _applied(
            self._gather, (self._ends.unsqueeze(2) * weighted_residuals.unsqueeze(1)).flatten(1)
        ).unflatten(1, (4, 3))
        turn = arms[:, :3] @ slopes
        moments = torch.stack([turn[:, one, two] - turn[:, two, one] for one, two in ((1, 2), (2, 0), (0, 1))], dim=1)
        return torch.cat((slopes[:, 3], moments), dim=1), self._hessian(arms, metrics)

    def _hessian(self, arms: Tensor, metrics: Tensor) -> Tensor:
        size = self.num_nodes
        sums = _applied(self._products, (self._squares.unsqueeze(2) * metrics.unsqueeze(1)).flatten(1))
        one, other = self._pairs // size, self._pairs % size
        across = sums.index_select(1, _SPREAD).unflatten(1, (36, 4)) @ arms[other].mT
        across = arms[one] @ across.reshape(-1, 4, 36)
        blocks = arms.new_zeros(size * size, 36)
        blocks[self._pairs] = across.flatten(1) @ _TWIST_PRODUCTS
        return blocks.view(size, size, 6, 6).transpose(1, 2).reshape(6 * size, 6 * size)


def upper_triangles(scales: Tensor, normals: Tensor | None, tangential_weights: Tensor | float) -> Tensor:
    """Upper triangles (n, 6) of ``scale (n n^T + t I)`` with tangential weights t; without normals ``scale t I``."""
    diagonal = (_UPPER_SIX[0] == _UPPER_SIX[1]).to(scales)
    triangle = torch.as_tensor(tangential_weights).to(scales).reshape(-1, 1) * diagonal
    if normals is not None:
        triangle = triangle + normals[:, _UPPER_SIX[0]] * normals[:, _UPPER_SIX[1]]
    return scales.unsqueeze(1) * triangle


def _applied(matrix: csr_array, values: Tensor) -> Tensor:
    return torch.from_numpy(matrix @ values.numpy())
