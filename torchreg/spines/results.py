"""The results of `extract_spine`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar

from torch import Tensor

from torchreg.errors import InputError
from torchreg.geometry.skeleton import Skeleton
from torchreg.result import Result, Status, stored_as
from torchreg.spines.measurements import SpineMeasurements, measure_limbs
from torchreg.spines.spine import Spine


@dataclass(frozen=True)
class SpineRecord:
    """One frame that was skeletonized, as given to ``on_step``.

    Args:
        frame: its number; frames may be done in any order.
        num_frames: of the sequence.
        num_tips: of its own skeleton.
        topology: of its own skeleton, see `Skeleton.topology`.
        seconds: that it took; zero if it was kept from an earlier call.
    """

    frame: int
    num_frames: int
    num_tips: int
    topology: str
    seconds: float


@dataclass(frozen=True)
class SpineSequence(Result):
    """One graph of K tips and L limbs that moves through T frames; lengths in the unit of the surfaces.

    Convention: limb l runs from node ``graph[l, 0]`` to ``graph[l, 1]``. Nodes 0 to K - 1 are the tips, and limb k of
    the first K starts at tip k; the other nodes are the junctions. ``frames`` are ``R_world_node``, third columns along
    the limb.

    Args:
        model: the `Spine`, which gives curves at any time between frames.
        graph: (L, 2) node indices.
        curves: (T, L, S, 3) points along the limbs at equal intervals of their lengths.
        radii: (T, L, S) distances to the surface.
        frames: (T, L, S, 3, 3) rotations that travel with the curves.
        times: (T,) of the frames.
        found: (T, K) True where the frame's own skeleton has the tip.
        own: (T, L) True where the frame's own skeleton has the limb; others were transferred from the frames around.
        reference: frame from which tips were tracked.
        topologies: per frame the canonical form of the tree of its curves, see `Skeleton.topology`.
        own_topologies: per frame that of its own skeleton.
        statuses: per frame.
        status: WITH_WARNINGS if any frame's is, else CONVERGED.
        warnings: irregularities, with the number of the frame.
        origin: (3,) float64 about which it was computed, where the surfaces, in float64, lie far from that of
            coordinates; None elsewhere.
        confidence: (T, K) probability, given all frames, that a name is right: that of the tip, or where the frame's
            own skeleton lacks the tip, that it does. None in files of earlier releases. NaN where an organ of
            what grows is not there.
        up: the likely upright direction, for pictures, see `geometry.upright.guess_up`.
        births: (K,) first frame of each tip of what grows; None of what does not. Outside of a limb's life `curves`,
            `frames`, `tips` and `confidence` are NaN; those of the model have no length there.
        ends: (K,) last frame of each tip of what grows.
    """

    shapes: ClassVar[Mapping[str, str]] = {
        "graph": "L 2", "curves": "T L S 3", "radii": "T L S", "frames": "T L S 3 3", "times": "T", "found": "T K",
        "confidence": "T K", "own": "T L", "topologies": "T", "own_topologies": "T", "statuses": "T",
        "births": "K", "ends": "K",
    }  # fmt: skip

    model: Spine = field(metadata=stored_as(Spine.record, Spine.from_record))
    graph: Tensor
    curves: Tensor
    radii: Tensor
    frames: Tensor
    times: Tensor
    found: Tensor
    own: Tensor
    reference: int
    topologies: tuple[str, ...]
    own_topologies: tuple[str, ...]
    statuses: tuple[Status, ...]
    status: Status
    warnings: tuple[str, ...]
    origin: Tensor | None = None
    confidence: Tensor | None = None
    up: tuple[float, float, float] | None = None
    births: Tensor | None = None
    ends: Tensor | None = None

    def moved(self, origin: Tensor) -> SpineSequence:
        """Return the result, whose coordinates begin at an origin (3,), in those in which the origin is given."""
        curves = self.curves.double() + origin
        radii, frames = self.radii.double(), self.frames.double()
        own = self.model.record()
        model = Spine(
            own.curves.double() + origin, self.graph, radii=own.radii.double(), frames=own.frames.double(),
            times=self.times.double(),
        )  # fmt: skip
        return replace(self, model=model, curves=curves, radii=radii, frames=frames, origin=origin)

    def local(self) -> SpineSequence:
        """Return the result in coordinates that begin at its origin; itself without one."""
        return self if self.origin is None else replace(self.moved(-self.origin), origin=None)

    @property
    def num_tips(self) -> int:
        """Number K of tips."""
        return self.found.shape[-1]

    @property
    def tips(self) -> Tensor:
        """Positions (T, K, 3) of the tips."""
        return self.curves[:, : self.num_tips, 0]

    @property
    def junctions(self) -> Tensor:
        """Positions (T, J, 3) of the junctions; none if there are two tips."""
        flat = self.graph.reshape(-1)
        first = [int((flat == node).nonzero()[0, 0]) for node in range(self.num_tips, len(self.graph) + 1)]
        return self.curves[:, :, [0, -1]].flatten(1, 2)[:, first]

    def skeleton(self, frame: int) -> Skeleton:
        """Return the limbs that are there in a frame as a tree of nodes with radii and frames.

        Raises:
            InputError: if there is no such frame.
        """
        if not 0 <= frame < len(self.curves):
            raise InputError(f"frame must be from 0 to {len(self.curves) - 1}, got {frame}")
        there = ~self.curves[frame].isnan().flatten(1).any(1)
        return self.model.skeleton(float(self.times[frame]), there)

    def measurements(self) -> SpineMeasurements:
        """Return the lengths, radii and angles of the limbs over time, which can be written as a table."""
        return measure_limbs(self.curves, self.radii, self.graph, self.times)
