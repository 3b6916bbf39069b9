"""A spine: one branching graph of curves that moves; its curves at any time are differentiable functions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn

from torchreg._checks import as_float_tensor, as_tensor, check_finite, check_shape
from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.graphs import connected_components
from torchreg.geometry.skeleton import Skeleton, nearest_rotation
from torchreg.spines.curves import align_frames, bend_angles, curve_frames, curve_lengths, tangents
from torchreg.spines.labeled_tree import gather_nodes, number_nodes


@dataclass(frozen=True)
class SpineFields:
    """The tensors that make a `Spine`; see there."""

    curves: Tensor
    graph: Tensor
    radii: Tensor
    frames: Tensor
    times: Tensor


class Spine(nn.Module):
    """The function F of ``Spine_t = F(G, t)``: curves of a graph G at any time between the frames.

    Nodes are interpolated by cubic Hermite polynomials through those of the frames, with velocities from the frames
    before and after, so that curves move smoothly and pass through the measured ones. Limbs that meet share their node,
    also after a step of an optimizer. Radii are linear in time; frames rotate evenly and follow the curves.

    Convention: limb ``l`` runs from node ``graph[l, 0]`` to node ``graph[l, 1]``. Nodes 0 to K - 1 are the tips, the
    others the junctions. ``frames`` are ``R_world_node``, their third columns point along the limb.

    Args:
        curves: (T, L, S, 3) points along the limbs in the frames, S at least 2.
        graph: (L, 2) node indices, a tree.
        radii: (T, L, S) distances to the surface; zero by default.
        frames: (T, L, S, 3, 3) rotations; without twist along each limb by default.
        times: (T,) strictly increasing; 0, 1, 2, ... by default.

    Attributes:
        nodes: (T, N, 3) parameter, tips first, then junctions, then the points inside the limbs.
        node_radii: (T, N) parameter.

    Raises:
        InputError: if sizes do not fit, numbers are not finite, the graph is no tree with its tips first, or limbs that
            share a node do not meet there.

    References: Brostow, Essa, Steedly and Kwatra 2004, eq. 1.
    """

    graph: Tensor
    limb_nodes: Tensor
    times: Tensor
    rest_frames: Tensor

    def __init__(
        self,
        curves: Tensor,
        graph: Tensor,
        radii: Tensor | None = None,
        frames: Tensor | None = None,
        times: Tensor | None = None,
    ) -> None:
        super().__init__()
        curves = as_float_tensor(curves, "curves").detach()
        check_shape(curves, "curves", ("T", "L", "S", 3))
        if min(curves.shape[:2]) < 1 or curves.shape[2] < 2:
            raise InputError(f"curves must hold a frame, a limb and two points at least, got {tuple(curves.shape)}")
        check_finite(curves, "curves")
        size = curves.shape[:3]
        radii = _check_like(curves.new_zeros(size) if radii is None else radii, "radii", size, curves)
        frames = _check_like(curve_frames(curves) if frames is None else frames, "frames", (*size, 3, 3), curves)
        graph = _check_graph(graph, size[1]).to(curves.device)
        self.register_buffer("graph", graph)
        self.register_buffer("limb_nodes", number_nodes(graph, size[2]))
        self.register_buffer("times", _check_times(times, curves))
        self.register_buffer("rest_frames", frames.clone())
        self.nodes = nn.Parameter(gather_nodes(curves, self.limb_nodes))
        self.node_radii = nn.Parameter(gather_nodes(radii, self.limb_nodes))
        _check_meeting(self.nodes.detach()[:, self.limb_nodes], curves)

    @classmethod
    def from_record(cls, record: SpineFields) -> Spine:
        """Return the spine that a record describes.

        Raises:
            InputError: if it describes none.
        """
        return cls(record.curves, record.graph, radii=record.radii, frames=record.frames, times=record.times)

    def record(self) -> SpineFields:
        """Return the fields that make this spine again, also after it was refined."""
        curves = self.nodes.detach()[:, self.limb_nodes]
        radii = self.node_radii.detach()[:, self.limb_nodes]
        return SpineFields(curves=curves, graph=self.graph, radii=radii, frames=self.rest_frames, times=self.times)

    @property
    def num_tips(self) -> int:
        """Number K of tips."""
        return int((torch.bincount(self.graph.reshape(-1)) == 1).sum())

    @property
    def num_limbs(self) -> int:
        """Number L of limbs."""
        return len(self.graph)

    def forward(self, t: float | Tensor) -> Tensor:
        """Return the curves (..., L, S, 3) at times ``t`` (...,), in the unit of the surface.

        Args:
            t: within `times`; at these the curves are those of the frames.

        Raises:
            InputError: if a time lies outside.

        Differentiable: in ``t`` and in `nodes`.
        """
        return self.nodes_at(t)[..., self.limb_nodes, :]

    def tips(self, t: float | Tensor) -> Tensor:
        """Return the tips (..., K, 3) at times ``t`` (...,)."""
        return self.nodes_at(t)[..., : self.num_tips, :]

    def nodes_at(self, t: float | Tensor) -> Tensor:
        """Return all nodes (..., N, 3) at times ``t`` (...,); see `forward`."""
        index, share, step = self._interval(t)
        if len(self.times) == 1:
            return self.nodes[index]
        velocity = self._velocities()
        start, end = self.nodes[index], self.nodes[index + 1]
        s, h = share[..., None, None], step[..., None, None]
        # The basis of cubic Hermite interpolation.
        end_weight = s * s * (3 - 2 * s)
        start_slope, end_slope = s * (1 - s) ** 2, s * s * (s - 1)
        slopes = start_slope * velocity[index] + end_slope * velocity[index + 1]
        return (1 - end_weight) * start + end_weight * end + h * slopes

    def radii(self, t: float | Tensor) -> Tensor:
        """Return the radii (..., L, S) along the limbs at times ``t`` (...,), in the unit of the surface."""
        index, share, _ = self._interval(t)
        after = (index + 1).clamp_max(len(self.times) - 1)
        values = self.node_radii[index] + share[..., None] * (self.node_radii[after] - self.node_radii[index])
        return values[..., self.limb_nodes]

    def frames(self, t: float | Tensor) -> Tensor:
        """Return the frames (..., L, S, 3, 3) along the limbs at times ``t`` (...,), third columns along the curves.

        Differentiable: in ``t`` and in `nodes`, through the curves that they follow.
        """
        index, share, _ = self._interval(t)
        after = (index + 1).clamp_max(len(self.times) - 1)
        share = share.detach()[..., None, None, None, None]
        mixed = self.rest_frames[index] + share * (self.rest_frames[after] - self.rest_frames[index])
        return align_frames(nearest_rotation(mixed), tangents(self(t)))

    def skeleton(self, t: float, limbs: Tensor | None = None) -> Skeleton:
        """Return the curves at one time as a tree of nodes with radii and frames.

        Args:
            t: see `forward`.
            limbs: (L,) bool, those that are wanted, which make a tree; all by default.
        """
        with torch.no_grad():
            chains = self.limb_nodes if limbs is None else self.limb_nodes[limbs]
            kept, places = chains.unique(return_inverse=True)
            steps = torch.stack((places[:, :-1], places[:, 1:]), dim=-1).reshape(-1, 2)
            radii = gather_nodes(self.radii(t)[None], self.limb_nodes)[0, kept]
            frames = gather_nodes(self.frames(t)[None], self.limb_nodes)[0, kept]
            return Skeleton(self.nodes_at(t)[kept], steps, radii, frames=frames)

    def lengths(self, t: float | Tensor) -> Tensor:
        """Return the lengths (..., L) of the limbs at times ``t`` (...,)."""
        return curve_lengths(self(t))

    def bend_angles(self, t: float | Tensor) -> Tensor:
        """Return the turning angles (..., L, S - 2) at the limbs' inner points at times ``t`` (...,), radians."""
        return bend_angles(self(t))

    def _velocities(self) -> Tensor:
        """Return the velocities (T, N, 3) of the nodes in the frames: parabolas through three, lines at the ends."""
        steps = (self.times[1:] - self.times[:-1])[:, None, None]
        slopes = (self.nodes[1:] - self.nodes[:-1]) / steps
        before, after = steps[:-1], steps[1:]
        inner = (after * slopes[:-1] + before * slopes[1:]) / (before + after)
        return torch.cat((slopes[:1], inner, slopes[-1:]))

    def _interval(self, t: float | Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return per time the frame before it, its share of the interval to the next, and its length in time."""
        # Python's numbers would lose digits on the way through torch's default dtype.
        t = self.times.new_tensor(t) if isinstance(t, (int, float)) else t
        time = as_float_tensor(t, "t", like=self.times)
        check_finite(time, "t")
        first, last = self.times[0], self.times[-1]
        if bool(((time < first) | (time > last)).any()):
            raise InputError(
                f"t must lie within the times {float(first)} to {float(last)}, got {float(time.min())} to "
                f"{float(time.max())}"
            )
        index = (torch.searchsorted(self.times, time.detach(), right=True) - 1).clamp(0, max(len(self.times) - 2, 0))
        after = (index + 1).clamp_max(len(self.times) - 1)
        step = self.times[after] - self.times[index]
        return index, (time - self.times[index]) / torch.where(step > 0, step, 1.0), step


def _check_like(value: Tensor, name: str, size: Sequence[int], curves: Tensor) -> Tensor:
    """Return a finite tensor of a size, in the dtype and on the device of the curves."""
    value = as_float_tensor(value, name, like=curves).detach()
    check_shape(value, name, size)
    check_finite(value, name)
    return value


def _check_meeting(shared: Tensor, curves: Tensor) -> None:
    """Raise InputError unless the curves through shared nodes are the given ones, up to rounding."""
    distance = float((shared - curves).abs().max())
    size = float((curves.amax((0, 1, 2)) - curves.amin((0, 1, 2))).max())
    if distance > 1e-4 * size:
        raise InputError(f"curves must meet where graph says so, got limbs {distance:.3g} off their common node")


def _check_graph(graph: Tensor, limbs: int) -> Tensor:
    graph = as_tensor(graph, "graph", "integers")
    if graph.is_floating_point() or graph.is_complex() or graph.dtype == torch.bool:
        raise InputTypeError(f"graph must hold integers, got dtype {graph.dtype}; convert with .long()")
    check_shape(graph, "graph", (limbs, 2))
    graph = graph.detach().long()
    count = limbs + 1
    if not 0 <= int(graph.min()) <= int(graph.max()) < count:
        raise InputError(f"graph must hold the nodes 0 to {limbs} of a tree with {limbs} limbs, got {graph.tolist()}")
    if int(connected_components(graph, count).max()) > 0:
        raise InputError(f"graph must be a tree, but its limbs do not join all nodes: {graph.tolist()}")
    degrees = torch.bincount(graph.reshape(-1), minlength=count).tolist()
    if any(degree > 1 and following == 1 for degree, following in pairwise(degrees)):
        raise InputError(f"graph must number its tips first, got the degrees {degrees} of nodes 0 to {limbs}")
    return graph


def _check_times(times: Tensor | None, curves: Tensor) -> Tensor:
    if times is None:
        return torch.arange(len(curves), dtype=curves.dtype, device=curves.device)
    times = as_float_tensor(times, "times", like=curves).detach().clone()
    check_shape(times, "times", (len(curves),))
    check_finite(times, "times")
    if bool((times[1:] <= times[:-1]).any()):
        raise InputError(f"times must increase strictly, got {times.tolist()}")
    return times
