"""The skeletons of many frames: computed in parallel, reported one by one, and kept on disk for a later call."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import astuple
from functools import partial

from torch import Tensor

from torchreg.errors import InputError
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.skeleton import Skeleton
from torchreg.spines.frames.frame_workers import Job, KeptResults, do_jobs
from torchreg.spines.results import SpineRecord
from torchreg.spines.skeleton.tip_relations import TipRelations
from torchreg.spines.skeletonize import SkeletonizeConfig, skeletonize_surface

# The tensors of a skeleton, and those of its tips' relations.
_FIELDS = ("nodes", "edges", "radii", "frames", "confidence")
_RELATIONS = ("geodesics", "volumes")
# A skeleton and the relations of its tips along the surface.
FrameSkeleton = tuple[Skeleton, TipRelations]


def skeletonize_frames(
    meshes: Sequence[TriangleMesh],
    config: SkeletonizeConfig,
    *,
    workers: int | None = None,
    on_step: Callable[[SpineRecord], None] | None = None,
    progress: str | os.PathLike[str] | None = None,
) -> list[FrameSkeleton]:
    """Return the skeleton of every frame, and the relations of its tips along the surface."""
    skeletons: dict[int, FrameSkeleton] = {}
    kept = KeptResults.in_folder(progress)

    def done(frame: int, found: FrameSkeleton, seconds: float) -> None:
        skeletons[frame] = found
        skeleton = found[0]
        if on_step is not None:
            on_step(
                SpineRecord(
                    frame=frame,
                    num_frames=len(meshes),
                    num_tips=len(skeleton.tips),
                    topology=skeleton.topology,
                    seconds=seconds,
                )
            )

    def finish(frame: int, source: str, result: tuple[FrameSkeleton, float]) -> None:
        kept.save(_name(frame), source, _tensors(result[0]), result[0][0].notes)
        done(frame, *result)

    def jobs() -> Iterator[Job[tuple[FrameSkeleton, float]]]:
        for frame in range(len(meshes)):
            mesh = meshes[frame]
            source = kept.digest(repr(astuple(config)), mesh.vertices, mesh.faces)
            found = kept.load(_name(frame), source, _from_tensors)
            if found is not None:
                done(frame, found, 0.0)
            else:
                yield Job(frame, partial(_compute, mesh, frame, config), partial(finish, frame, source))

    remaining = jobs()
    do_jobs(lambda: next(remaining, None), len(meshes), 1 if meshes[0].vertices.is_cuda else workers)
    return [skeletons[frame] for frame in range(len(meshes))]


def _name(frame: int) -> str:
    return f"frame_{frame:05d}"


def _compute(mesh: TriangleMesh, frame: int, config: SkeletonizeConfig) -> tuple[FrameSkeleton, float]:
    """Return the skeleton of a frame, on the CPU, and the seconds that it took."""
    start = time.perf_counter()
    try:
        found = skeletonize_surface(mesh, config)
    except InputError as error:
        raise InputError(f"meshes[{frame}]: {error}") from error
    tensors = {name: tensor.detach().cpu() for name, tensor in _tensors(found).items()}
    return _from_tensors(tensors, found[0].notes), time.perf_counter() - start


def _tensors(found: FrameSkeleton) -> dict[str, Tensor]:
    skeleton, relations = found
    return {name: getattr(skeleton, name) for name in _FIELDS} | {name: getattr(relations, name) for name in _RELATIONS}


def _from_tensors(tensors: Mapping[str, Tensor], notes: Sequence[str]) -> FrameSkeleton:
    skeleton = Skeleton(**{name: tensors[name] for name in _FIELDS}, notes=tuple(notes))
    return skeleton, TipRelations(**{name: tensors[name] for name in _RELATIONS})
