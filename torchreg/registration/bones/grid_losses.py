"""Energies of bones on a grid: joints that hold, and weights that are smooth, normalized and near the labels."""

from __future__ import annotations

from torch import Tensor, nn

from torchreg._checks import check_same_kind, check_shape
from torchreg.registration.bones.joint_moments import JointMoments, gaps_at, motion_differences


class JointEnergy(nn.Module):
    """Mean squared distance between the images of what two bones share, summed over pairs of bones.

    ``E = sum_{i < j} tau_ij int w_i w_j |T_i x - T_j x|^2 dx`` over the grid, ``tau_ij = 1 / int w_i w_j dx`` (Chang
    and Zwicker 2009, eq. 4). The gradient in the weights comes through `joint_moments` with ``pairs`` given.
    """

    def forward(self, transforms: Tensor, moments: JointMoments, pair_weights: Tensor | None = None) -> Tensor:
        """Return the energy (...) of every pose of the batch, squared units."""
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
        differences = motion_differences(transforms, moments.pairs)
        turn, gaps = differences[..., :3], gaps_at(differences, moments.center)
        return gaps.square().sum(-1) + ((turn @ moments.spread) * turn).sum((-1, -2))


def smoothness_energy(weights: Tensor, edges: Tensor) -> Tensor:
    """Return ``sum_{(c, d)} |v_c - v_d|^2`` (...) of weights (..., K, B) over edges (E, 2) between corners (eq. 6)."""
    ends = weights.index_select(-2, edges.flatten()).unflatten(-2, (len(edges), 2))
    return (ends[..., 0, :] - ends[..., 1, :]).square().sum(-1).sum(-1)


def normalization_energy(weights: Tensor) -> Tensor:
    """Return ``E = sum_c (1 - sum_j v_cj)^2`` (...) of weights (..., K, B), eq. 7."""
    return (1 - weights.sum(-1)).square().sum(-1)


def closeness_energy(weights: Tensor, label_weights: Tensor) -> Tensor:
    """Return ``E = sum_c |v_c - v*_c|^2`` (...) of weights (..., K, B) and those of the labels, eqs. 12 and 13."""
    return (weights - label_weights).square().sum((-1, -2))
