"""What holds bones on a grid together: joints, and weights that are smooth, normalized and near labels."""

from __future__ import annotations

from torch import Tensor, nn

from torchreg._checks import check_same_kind, check_shape
from torchreg.errors import InputError
from torchreg.registration.bones.joint_moments import JointMoments


class JointEnergy(nn.Module):
    """How far apart bones move what they share.

    ``E = sum_{i < j} tau_ij int w_i w_j |T_i x - T_j x|^2 dx`` over the grid, ``tau_ij = 1 / int w_i w_j dx``, in
    closed form: ``tr((A_i - A_j) M_ij (A_i - A_j)^T) tau_ij`` with ``A = [R t]``. Each pair counts once. It is zero
    when all bones move alike.

    The prediction is the bones' motions, the target what they share, so that the gradient in the weights comes through
    `joint_moments` with ``pairs`` given.

    References: Chang and Zwicker 2009, eq. 4.
    """

    def forward(self, transforms: Tensor, moments: JointMoments, pair_weights: Tensor | None = None) -> Tensor:
        """Return the energy of every pose of the batch, squared units.

        Args:
            transforms: (..., B, 4, 4).
            moments: of the P pairs of bones that meet.
            pair_weights: (..., P) how much each joint counts, zero for one that does not hold; ones by default.

        Returns:
            (...).

        Raises:
            InputError: if a shape does not fit.
            InputTypeError: if dtypes or devices differ.

        Differentiable: in ``transforms``, ``pair_weights`` and the moments.
        """
        per_pair = self.per_pair(transforms, moments)
        if pair_weights is None:
            return per_pair.sum(-1)
        check_shape(pair_weights, "pair_weights", (len(moments.pairs),), batch=True)
        return (pair_weights * per_pair).sum(-1)

    @staticmethod
    def per_pair(transforms: Tensor, moments: JointMoments) -> Tensor:
        """Return the mean squared distances (..., P) of the pairs; arguments as in `forward`."""
        check_shape(transforms, "transforms", ("B", 4, 4), batch=True)
        check_same_kind(transforms, "transforms", moments.center, "moments")
        first, second = moments.pairs.unbind(-1)
        difference = transforms[..., first, :3, :] - transforms[..., second, :3, :]
        turn = difference[..., :3]
        gap = (turn @ moments.center.unsqueeze(-1)).squeeze(-1) + difference[..., 3]
        return gap.square().sum(-1) + ((turn @ moments.spread) * turn).sum((-1, -2))


class WeightSmoothness(nn.Module):
    """Squared differences of the weights of neighboring corners, ``E = sum_{(c, d)} |v_c - v_d|^2``.

    References: Chang and Zwicker 2009, eq. 6.
    """

    def forward(self, weights: Tensor, edges: Tensor, edge_weights: Tensor | None = None) -> Tensor:
        """Return the loss of every problem of the batch.

        Args:
            weights: (..., K, B).
            edges: (E, 2) pairs of corners, see `SparseGrid.edges`.
            edge_weights: (..., E) how much each edge counts, so that smoothness may vary over space; ones by default.

        Returns:
            (...).

        Raises:
            InputError: if a shape does not fit.

        Differentiable: in ``weights`` and ``edge_weights``.
        """
        check_shape(weights, "weights", ("K", "B"), batch=True)
        check_shape(edges, "edges", ("E", 2))
        ends = weights.index_select(-2, edges.flatten()).unflatten(-2, (len(edges), 2))
        change = (ends[..., 0, :] - ends[..., 1, :]).square().sum(-1)
        if edge_weights is not None:
            check_shape(edge_weights, "edge_weights", (len(edges),), batch=True)
            change = edge_weights * change
        return change.sum(-1)


class WeightNormalization(nn.Module):
    """How far the weights at each corner are from adding up to one, ``E = sum_c (1 - sum_j v_cj)^2``.

    References: Chang and Zwicker 2009, eq. 7.
    """

    def forward(self, weights: Tensor) -> Tensor:
        """Return the loss (...) of weights (..., K, B).

        Raises:
            InputError: if the shape does not fit.

        Differentiable: in ``weights``.
        """
        check_shape(weights, "weights", ("K", "B"), batch=True)
        return (1 - weights.sum(-1)).square().sum(-1)


class WeightCloseness(nn.Module):
    """How far weights are from those of the labels, ``E = sum_c |v_c - v*_c|^2``.

    References: Chang and Zwicker 2009, eq. 13.
    """

    def forward(self, weights: Tensor, label_weights: Tensor) -> Tensor:
        """Return the loss (...) of weights (..., K, B) against those of the labels (..., K, B), see eq. 12.

        Raises:
            InputError: if the shapes differ.

        Differentiable: in both.
        """
        check_shape(weights, "weights", ("K", "B"), batch=True)
        if label_weights.shape[-2:] != weights.shape[-2:]:
            raise InputError(
                f"label_weights must have shape (..., {', '.join(map(str, weights.shape[-2:]))}), got "
                f"{tuple(label_weights.shape)}"
            )
        return (weights - label_weights).square().sum((-1, -2))
