"""One graph for all frames: limbs that a frame does not show are transferred from the frames around it."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial

import torch
from torch import Tensor

from torchreg.errors import InputError
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.rigid import fit_rigid, transform_points
from torchreg.geometry.skeleton import Skeleton
from torchreg.spines.curves import align_frames, curve_frames, tangents
from torchreg.spines.frames.frame_workers import Job, KeptResults, do_jobs
from torchreg.spines.labeled_tree import LimbGraph, gather_nodes, number_nodes, path_lengths
from torchreg.spines.limbs.depth_field import DepthField, move_inside
from torchreg.spines.limbs.local_icp import LOCAL_FITS, SurfacePoints, transfer_nodes
from torchreg.spines.limbs.observed_limbs import FrameLimbs


@dataclass(frozen=True)
class _Step:
    """One step of the transfer of limbs to a frame: side -1 from the frame before, 1 from that after, 0 joins both."""

    frame: int
    side: int

    @property
    def name(self) -> str:
        """Under which its result is kept."""
        return f"limbs_{self.frame:05d}_{('before', 'between', 'after')[self.side + 1]}"


def transfer_missing_limbs(
    frames: Sequence[FrameLimbs],
    graph: LimbGraph,
    meshes: Sequence[TriangleMesh],
    *,
    workers: int | None = None,
    progress: str | os.PathLike[str] | None = None,
) -> list[FrameLimbs]:
    """Return the frames with all limbs: those that a frame lacks are transferred from the frames around it."""
    chains = _Chains(frames, graph, meshes, KeptResults.in_folder(progress))
    do_jobs(chains.next_job, len(chains.missing), 1 if meshes[0].vertices.is_cuda else workers)
    return [chains.limbs(number) for number in range(len(frames))]


class _Chains:
    """The steps of the transfer: each makes the next one of its chain possible, away from a frame that shows all."""

    def __init__(
        self, frames: Sequence[FrameLimbs], graph: LimbGraph, meshes: Sequence[TriangleMesh], kept: KeptResults
    ) -> None:
        self.missing = [number for number, frame in enumerate(frames) if not bool(frame.observed.all())]
        self._frames, self._graph, self._meshes, self._kept = frames, graph, meshes, kept
        self._complete = dict(enumerate(frames))
        for number in self.missing:
            del self._complete[number]
        self._found: dict[_Step, FrameLimbs] = {}
        steps = [_Step(number, side) for number in self.missing for side in (-1, 1)]
        self._possible = deque(step for step in steps if step.frame + step.side in self._complete)
        self._surface_digests: dict[int, str] = {}

    def limbs(self, number: int) -> FrameLimbs:
        """Return the limbs of a frame after all steps."""
        steps = (_Step(number, side) for side in (0, -1, 1))
        return next((self._found[step] for step in steps if step in self._found), self._frames[number])

    def next_job(self) -> Job[FrameLimbs] | None:
        """Return the next step that is possible and was not kept; None if others must be done before."""
        while self._possible:
            step = self._possible.popleft()
            source = self._digest(step)
            found = self._kept.load(step.name, source, partial(_from_tensors, self._frames[step.frame]))
            if found is None:
                return Job(step.frame, self._task(step), partial(self._finish, step, source))
            self._done(step, found)
        return None

    def _finish(self, step: _Step, source: str, found: FrameLimbs) -> None:
        self._kept.save(step.name, source, _tensors(found))
        self._done(step, found)

    def _done(self, step: _Step, found: FrameLimbs) -> None:
        """Remember what a step found, and what it makes possible."""
        self._found[step] = found
        following, opposite = step.frame - step.side, _Step(step.frame, -step.side)
        if step.side and 0 <= following < len(self._frames) and following not in self._complete:
            self._possible.append(_Step(following, step.side))
        if step.side and opposite in self._found:
            self._possible.append(_Step(step.frame, 0))

    def _sources(self, step: _Step) -> list[FrameLimbs]:
        """Return the limbs from which a step starts."""
        if step.side == 0:
            return [self._found[_Step(step.frame, side)] for side in (-1, 1)]
        source = step.frame + step.side
        return [self._complete[source] if source in self._complete else self._found[_Step(source, step.side)]]

    def _share(self, number: int) -> float:
        """Return where a frame is in time between the two around it that show all limbs, from 0 to 1."""
        previous = next(k for k in range(number, -1, -1) if k in self._complete)
        following = next(k for k in range(number, len(self._frames)) if k in self._complete)
        return (number - previous) / (following - previous)

    def _task(self, step: _Step) -> Callable[[], FrameLimbs]:
        target = _Target(self._frames[step.frame], self._graph, self._meshes[step.frame])
        if step.side == 0:
            before, after = self._sources(step)
            return partial(_interpolated, target, before, after, self._share(step.frame))
        (source,) = self._sources(step)
        return partial(_transferred, target, source, self._meshes[step.frame + step.side])

    def _digest(self, step: _Step) -> str:
        """Return the digest of what a step starts from."""
        limbs = [self._frames[step.frame], *self._sources(step)]
        parts = [tensor for row in limbs for tensor in _tensors(row).values()]
        share = self._share(step.frame) if step.side == 0 else 0.0
        surfaces = [self._surface_digest(number) for number in sorted({step.frame, step.frame + step.side})]
        return self._kept.digest(repr((step.side, share)), self._graph.edges, *parts, *surfaces)

    def _surface_digest(self, number: int) -> str:
        if self._kept.folder is not None and number not in self._surface_digests:
            mesh = self._meshes[number]
            self._surface_digests[number] = self._kept.digest(mesh.vertices, mesh.faces)
        return self._surface_digests.get(number, "")


def _tensors(limbs: FrameLimbs) -> dict[str, Tensor]:
    return {field.name: getattr(limbs, field.name) for field in fields(limbs)}


def _from_tensors(like: FrameLimbs, tensors: Mapping[str, Tensor], _: Sequence[str]) -> FrameLimbs:
    return replace(like, **{name: tensors[name] for name in ("curves", "radii", "nodes")})


@dataclass(frozen=True, eq=False)
class _Target:
    """A frame whose limbs are completed, with the limbs that it shows and its surface."""

    frame: FrameLimbs
    graph: LimbGraph
    mesh: TriangleMesh


def complete_from_prior(
    frames: Sequence[FrameLimbs], graph: LimbGraph, meshes: Sequence[TriangleMesh], prior: FrameLimbs, reference: int
) -> list[FrameLimbs]:
    """Return the frames; if none shows all limbs, the one that shows most gets the others from a prior skeleton."""
    if any(bool(frame.observed.all()) for frame in frames):
        return list(frames)
    counts = [int(frame.observed.sum()) for frame in frames]
    number = max(range(len(frames)), key=lambda frame: (counts[frame], -abs(frame - reference)))
    if counts[number] == 0:
        raise InputError(f"prior must fit the data: no frame shows any of its {len(graph.edges)} limbs")
    frame = frames[number]
    shown = frame.observed
    motion = fit_rigid(prior.curves[shown].flatten(0, 1), frame.curves[shown].flatten(0, 1))
    curves = torch.where(shown[:, None, None], frame.curves, transform_points(motion, prior.curves))
    radii = torch.where(shown[:, None], frame.radii, prior.radii)
    completed = _joined_limbs(replace(frame, curves=curves, radii=radii), _Target(frame, graph, meshes[number]))
    return [*frames[:number], replace(completed, observed=torch.ones_like(shown)), *frames[number + 1 :]]


def _transferred(target: _Target, source: FrameLimbs, source_mesh: TriangleMesh) -> FrameLimbs:
    """Return a frame with the limbs that it lacks transferred from another, moved with the surface around them."""
    frame = target.frame
    limb_nodes = number_nodes(target.graph.edges, source.curves.shape[1])
    nodes, radii = gather_nodes(source.curves[None], limb_nodes)[0], gather_nodes(source.radii[None], limb_nodes)[0]
    steps = torch.stack((limb_nodes[:, :-1], limb_nodes[:, 1:]), -1).reshape(-1, 2)
    moved = transfer_nodes(
        nodes=nodes,
        radii=radii,
        path_lengths=path_lengths(Skeleton(nodes, steps, radii), torch.arange(len(nodes))),
        source=_surface_points(source_mesh, LOCAL_FITS.num_points),
        target=_surface_points(target.mesh),
        known=_known_nodes(frame, target.graph, limb_nodes),
    )
    curves = torch.where(frame.observed[:, None, None], frame.curves, moved[limb_nodes])
    radii = torch.where(frame.observed[:, None], frame.radii, source.radii)
    return _joined_limbs(replace(frame, curves=curves, radii=radii), target)


def _interpolated(target: _Target, before: FrameLimbs, after: FrameLimbs, share: float) -> FrameLimbs:
    """Return a frame whose limbs are interpolated in time between those transferred from both sides."""
    curves = before.curves + share * (after.curves - before.curves)
    radii = before.radii + share * (after.radii - before.radii)
    return _joined_limbs(replace(before, curves=curves, radii=radii), target)


def _known_nodes(frame: FrameLimbs, graph: LimbGraph, limb_nodes: Tensor) -> Tensor:
    """Return the positions (N, 3) of the samples (L, S) of the limbs that a frame shows, NaN for those of others."""
    positions = frame.curves.new_full((int(limb_nodes.max()) + 1, 3), torch.nan)
    positions[limb_nodes[frame.observed]] = frame.curves[frame.observed]
    reliable = _reliable_nodes(frame, graph).nonzero()[:, 0]
    positions[reliable] = frame.nodes[reliable]
    return positions


def _reliable_nodes(frame: FrameLimbs, graph: LimbGraph) -> Tensor:
    """Return a mask (N,) of nodes with known positions: observed tips, and ends of observed limbs."""
    reliable = frame.node_observed.clone()
    touched = torch.zeros_like(reliable)
    touched[graph.edges[frame.observed].reshape(-1)] = True
    reliable[graph.num_tips :] &= touched[graph.num_tips :]
    return reliable


def _surface_points(mesh: TriangleMesh, count: int | None = None) -> SurfacePoints:
    """Return the vertices that faces use, or ``count`` of them drawn at random, with outward normals, float64."""
    mesh = TriangleMesh(mesh.vertices.detach().cpu().double(), mesh.faces.cpu())
    used = mesh.faces.reshape(-1).unique()
    volume = torch.linalg.det((mesh.vertices - mesh.vertices[used].mean(0))[mesh.faces]).sum()
    if count is not None:
        used = used[torch.randperm(len(used), generator=torch.Generator().manual_seed(0))[:count]]
    return SurfacePoints(mesh.vertices[used], mesh.vertex_normals()[used] * (-1 if volume < 0 else 1))


def _joined_limbs(limbs: FrameLimbs, target: _Target) -> FrameLimbs:
    """Return transferred limbs of a frame that meet in their nodes again, and lie inside."""
    frame, field, ends = target.frame, DepthField(target.mesh), target.graph.edges
    reliable = _reliable_nodes(frame, target.graph)
    total, count = torch.zeros_like(limbs.nodes), torch.zeros(len(limbs.nodes), dtype=limbs.nodes.dtype)
    for side in (0, -1):
        total.index_add_(0, ends[:, side], limbs.curves[:, side])
        count.index_add_(0, ends[:, side], torch.ones(len(ends), dtype=total.dtype))
    nodes = torch.where(reliable[:, None], frame.nodes, total / count[:, None])
    radii = torch.zeros(len(nodes), dtype=total.dtype)
    radii[ends[:, 0]], radii[ends[:, 1]] = limbs.radii[:, 0], limbs.radii[:, -1]
    free = ~reliable
    if bool(free.any()):
        nodes[free] = move_inside(field, nodes[free], radii[free], free[free], stiffness=0.0)
    share = torch.linspace(0, 1, limbs.curves.shape[1], dtype=total.dtype)[None, :, None]
    start, end = nodes[ends[:, 0]] - limbs.curves[:, 0], nodes[ends[:, 1]] - limbs.curves[:, -1]
    curves = limbs.curves + (1 - share) * start[:, None] + share * end[:, None]
    free = (~frame.observed)[:, None].expand(curves.shape[:2]).clone()
    free[:, [0, -1]] = False
    return replace(limbs, curves=move_inside(field, curves, limbs.radii, free), nodes=nodes)


def transported_frames(curves: Tensor, reference: int) -> Tensor:
    """Return frames (T, L, S, 3, 3) along curves that rotate with the body, without twist at the reference."""
    frames: dict[int, Tensor] = {reference: curve_frames(curves[reference])}
    for order in (range(reference + 1, len(curves)), range(reference - 1, -1, -1)):
        last = reference
        for number in order:
            rotation = fit_rigid(curves[last].flatten(0, 1), curves[number].flatten(0, 1))[:3, :3]
            frames[number] = align_frames(rotation @ frames[last], tangents(curves[number]))
            last = number
    return torch.stack([frames[number] for number in range(len(curves))])
