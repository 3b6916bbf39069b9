"""Surfaces of the frames of a spine: meshes as they are, clouds as the surface around their points."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchreg._checks import check_choice
from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.loaded import as_mesh
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.support import SUPPORTS, SupportSplit, warn_about_support
from torchreg.spines.frames.frame_workers import Job, KeptResults, do_jobs
from torchreg.spines.skeleton.surface import as_surface, points_without_faces, split_surface


@dataclass(frozen=True)
class _SurfaceSampling:
    """What is kept of the surface of every frame."""

    num_vertices: int = 2000  # for its size, position and upright direction, as good as all of them


_SAMPLING = _SurfaceSampling()


# A surface and the notes on it.
_Surface = tuple[TriangleMesh, tuple[str, ...]]


class _Making:
    """The surfaces of frames in the making."""

    def __init__(self, frames: Sequence[Any], names: tuple[str, ...], kept: KeptResults, support: str) -> None:
        self._frames, self._names, self._kept, self._support = frames, names, kept, support
        self.supports: dict[int, SupportSplit] = {}
        self.made: dict[int, TriangleMesh] = {}
        self.samples: dict[int, Tensor] = {}
        self.notes: list[tuple[str, ...]] = [()] * len(names)

    def jobs(self) -> Iterator[Job[_Surface]]:
        """Yield the making of each cloud's surface that was not kept; meshes are looked at on the way."""
        for number, name in enumerate(self._names):
            points, split = split_surface(self._frames[number], name, self._support)
            if split is not None:
                self.supports[number] = split
            if isinstance(points, TriangleMesh):
                self._sample(number, points)
                continue
            source = self._kept.digest(str(points.dtype), points)
            found = self._kept.load(_kept_name(number), source, _from_tensors)
            if found is None:
                yield Job(
                    number, partial(as_surface, points, name), partial(self._finish, number, source, points.device)
                )
            else:
                self._add(number, points.device, found)

    def _finish(self, number: int, source: str, device: torch.device, found: _Surface) -> None:
        mesh, notes = found
        self._kept.save(_kept_name(number), source, {"vertices": mesh.vertices, "faces": mesh.faces}, notes)
        self._add(number, device, found)

    def _add(self, number: int, device: torch.device, found: _Surface) -> None:
        self.made[number], self.notes[number] = found[0].to(device), found[1]
        self._sample(number, self.made[number])

    def _sample(self, number: int, mesh: TriangleMesh) -> None:
        if not mesh.num_faces:
            raise InputError(f"{self._names[number]} must have faces, got none; leave out frames without a surface")
        step = max(1, mesh.num_vertices // _SAMPLING.num_vertices)
        self.samples[number] = mesh.vertices[::step].detach().clone()


def _kept_name(number: int) -> str:
    return f"surface_{number:05d}"


def _from_tensors(tensors: Mapping[str, Tensor], notes: Sequence[str]) -> _Surface:
    return TriangleMesh(tensors["vertices"], tensors["faces"]), tuple(notes)


@dataclass(frozen=True, eq=False)
class FrameSurfaces(Sequence[TriangleMesh]):
    """The surfaces of frames."""

    frames: Sequence[Any]  # meshes, or points without faces; any sequence
    names: tuple[str, ...]
    made: dict[int, TriangleMesh]  # the surfaces of clouds by the number of the frame
    notes: tuple[tuple[str, ...], ...]
    samples: tuple[Tensor, ...]  # some vertices of each frame, for its size and position
    shift: Tensor | None = None
    # what meshes stand on, which is cut off, by the number of the frame
    supports: Mapping[int, SupportSplit] = field(default_factory=dict)

    @classmethod
    def of_frames(
        cls,
        frames: Sequence[Any],
        names: Sequence[str] | None = None,
        *,
        workers: int | None = None,
        progress: str | os.PathLike[str] | None = None,
        support: str = "auto",
    ) -> FrameSurfaces:
        """Return the surfaces of frames, read one by one; errors name the frame."""
        check_choice(support, "support", SUPPORTS)
        if isinstance(frames, TriangleMesh):
            raise InputTypeError("meshes must be a sequence of TriangleMesh, got one mesh; put it into a list")
        names = tuple(names or (f"meshes[{frame}]" for frame in range(len(frames))))
        if not names:
            raise InputError("meshes must hold at least one frame, got none")
        making = _Making(frames, names, KeptResults.in_folder(progress), support)
        first, jobs = points_without_faces(frames[0]), making.jobs()
        do_jobs(lambda: next(jobs, None), len(names), 1 if first is not None and first.is_cuda else workers)
        samples = tuple(making.samples[number] for number in range(len(names)))
        if making.supports:
            count = sum(int(split.mask.sum()) for split in making.supports.values())
            warn_about_support(f"{count} points in {len(making.supports)} of {len(names)} frames", stacklevel=3)
        return cls(frames, names, making.made, tuple(making.notes), samples, supports=making.supports)

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> TriangleMesh:  # type: ignore[override]
        index = range(len(self))[index]
        mesh = self.made[index] if index in self.made else as_mesh(self.frames[index], self.names[index])
        if index in self.supports and index not in self.made:
            mesh = self.supports[index].rest(mesh)
        return mesh if self.shift is None else TriangleMesh(mesh.vertices + self.shift.to(mesh.vertices), mesh.faces)

    def chosen(self, numbers: Sequence[int]) -> FrameSurfaces:
        """Return some frames."""
        return FrameSurfaces(
            frames=_Chosen(self.frames, numbers),
            names=tuple(self.names[number] for number in numbers),
            made={place: self.made[number] for place, number in enumerate(numbers) if number in self.made},
            notes=tuple(self.notes[number] for number in numbers),
            samples=tuple(self.samples[number] for number in numbers),
            shift=self.shift,
            supports={place: self.supports[number] for place, number in enumerate(numbers) if number in self.supports},
        )

    def shifted(self, shift: Tensor) -> FrameSurfaces:
        """Return the surfaces with all vertices moved by (3,)."""
        samples = tuple(points + shift.to(points) for points in self.samples)
        return replace(self, samples=samples, shift=shift if self.shift is None else self.shift + shift)


@dataclass(frozen=True)
class _Chosen(Sequence[Any]):
    """Some of the values of a sequence, taken from it when they are asked for."""

    values: Sequence[Any]
    numbers: Sequence[int]

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, index: Any) -> Any:
        return self.values[self.numbers[index]]
