"""A spine: one branching graph of curves that moves; its curves at any time are differentiable functions."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn

from torchreg._checks import as_float_tensor, as_tensor, check_finite, check_shape
from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.skeleton import Skeleton, nearest_rotation
from torchreg.spines.curves import bend_angles, curve_frames, curve_lengths, follow, tangents
from torchreg.spines.labeled_tree import gather_nodes, number_nodes

# Limbs that share a node must agree on its place up to this share of the size.
_MEETING_SLACK = 1e-4


@dataclass(frozen=True)
class SpineFields:
    """What makes a `Spine`; see there."""

    curves: Tensor
    graph: Tensor
    radii: Tensor
    frames: Tensor
    times: Tensor


class Spine(nn.Module):
    """The function F of ``Spine_t = F(G, t)``: curves of a graph G at any time between the frames.

    Nodes are interpolated by cubics through those of the frames, with velocities from the frames before and after, so
    that curves move smoothly and pass through what was measured. Limbs that meet share their node, also after a step
    of an optimizer. Radii are linear in time; frames turn evenly and follow the curves.

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
        count, limbs, samples = curves.shape[:3]
        graph = _check_graph(graph, limbs).to(curves.device)
        radii = (
            curves.new_zeros(count, limbs, samples) if radii is None else as_float_tensor(radii, "radii", like=curves)
        )
        check_shape(radii, "radii", (count, limbs, samples))
        check_finite(radii, "radii")
        frames = curve_frames(curves) if frames is None else as_float_tensor(frames, "frames", like=curves)
        check_shape(frames, "frames", (count, limbs, samples, 3, 3))
        check_finite(frames, "frames")
        self.register_buffer("graph", graph)
        self.register_buffer("limb_nodes", number_nodes(graph, samples))
        self.register_buffer("times", _check_times(times, curves))
        self.register_buffer("rest_frames", frames.detach().clone())
        self.nodes = nn.Parameter(gather_nodes(curves, self.limb_nodes))
        self.node_radii = nn.Parameter(gather_nodes(radii.detach(), self.limb_nodes))
        off = float((self.nodes.detach()[:, self.limb_nodes] - curves).abs().max())
        size = float((curves.amax((0, 1, 2)) - curves.amin((0, 1, 2))).max())
        if off > _MEETING_SLACK * size:
            raise InputError(f"curves must meet where graph says so, got limbs {off:.3g} off their common node")

    @classmethod
    def from_record(cls, record: SpineFields) -> Spine:
        """Return the spine that a record describes.

        Raises:
            InputError: if it describes none.
        """
        return cls(record.curves, record.graph, record.radii, record.frames, record.times)

    def record(self) -> SpineFields:
        """Return the fields that make this spine again, also after it was refined."""
        curves = self.nodes.detach()[:, self.limb_nodes]
        radii = self.node_radii.detach()[:, self.limb_nodes]
        return SpineFields(curves, self.graph, radii, self.rest_frames, self.times)

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
            t: within `times`; frames are met exactly.

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
        index, share, step = self._between(t)
        if len(self.times) == 1:
            return self.nodes[index]
        speed = self._velocities()
        start, end = self.nodes[index], self.nodes[index + 1]
        s, h = share[..., None, None], step[..., None, None]
        rise = s * s * (3 - 2 * s)
        leave, arrive = s * (1 - s) ** 2, s * s * (s - 1)
        return (1 - rise) * start + rise * end + h * (leave * speed[index] + arrive * speed[index + 1])

    def radii(self, t: float | Tensor) -> Tensor:
        """Return the radii (..., L, S) along the limbs at times ``t`` (...,), in the unit of the surface."""
        index, share, _ = self._between(t)
        after = (index + 1).clamp_max(len(self.times) - 1)
        values = self.node_radii[index] + share[..., None] * (self.node_radii[after] - self.node_radii[index])
        return values[..., self.limb_nodes]

    def frames(self, t: float | Tensor) -> Tensor:
        """Return the frames (..., L, S, 3, 3) along the limbs at times ``t`` (...,), third columns along the curves.

        Differentiable: in ``t`` and in `nodes`, through the curves that they follow.
        """
        index, share, _ = self._between(t)
        after = (index + 1).clamp_max(len(self.times) - 1)
        share = share.detach()[..., None, None, None, None]
        mixed = self.rest_frames[index] + share * (self.rest_frames[after] - self.rest_frames[index])
        return follow(nearest_rotation(mixed), tangents(self(t)))

    def skeleton(self, t: float) -> Skeleton:
        """Return the curves at one time as a tree of nodes with radii and frames."""
        with torch.no_grad():
            nodes = self.nodes_at(t)
            steps = torch.stack((self.limb_nodes[:, :-1], self.limb_nodes[:, 1:]), dim=-1).reshape(-1, 2)
            radii = gather_nodes(self.radii(t)[None], self.limb_nodes)[0]
            return Skeleton(nodes, steps, radii, gather_nodes(self.frames(t)[None], self.limb_nodes)[0])

    def lengths(self, t: float | Tensor) -> Tensor:
        """Return the lengths (..., L) of the limbs at times ``t`` (...,)."""
        return curve_lengths(self(t))

    def bend_angles(self, t: float | Tensor) -> Tensor:
        """Return how far the limbs turn at their inner points at times ``t`` (...,), (..., L, S - 2) radians."""
        return bend_angles(self(t))

    def _velocities(self) -> Tensor:
        """Return the velocities (T, N, 3) of the nodes in the frames: parabolas through three, lines at the ends."""
        steps = (self.times[1:] - self.times[:-1])[:, None, None]
        slopes = (self.nodes[1:] - self.nodes[:-1]) / steps
        before, after = steps[:-1], steps[1:]
        inner = (after * slopes[:-1] + before * slopes[1:]) / (before + after)
        return torch.cat((slopes[:1], inner, slopes[-1:]))

    def _between(self, t: float | Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the frame before each time, the share of the way to the next, and how long that way is."""
        # Python's numbers would lose digits on the way through torch's default dtype.
        given = self.times.new_tensor(t) if isinstance(t, (int, float)) else t
        time = as_float_tensor(given, "t", like=self.times)
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


def _check_graph(graph: Tensor, limbs: int) -> Tensor:
    graph = as_tensor(graph, "graph", "integers")
    if graph.is_floating_point() or graph.is_complex() or graph.dtype == torch.bool:
        raise InputTypeError(f"graph must hold integers, got dtype {graph.dtype}; convert with .long()")
    check_shape(graph, "graph", (limbs, 2))
    graph = graph.detach().long()
    count = limbs + 1
    if not 0 <= int(graph.min()) <= int(graph.max()) < count:
        raise InputError(f"graph must hold the nodes 0 to {limbs} of a tree with {limbs} limbs, got {graph.tolist()}")
    group = list(range(count))
    for start, end in graph.tolist():
        old, new = group[start], group[end]
        group = [new if name == old else name for name in group]
    if len(set(group)) > 1:
        raise InputError(f"graph must be a tree, but its limbs do not join all nodes: {graph.tolist()}")
    degrees = torch.bincount(graph.reshape(-1), minlength=count).tolist()
    if any(one > 1 and other == 1 for one, other in pairwise(degrees)):
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
