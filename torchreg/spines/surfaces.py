"""What spines are drawn from: meshes as they are, clouds as the surface around their points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from torch import Tensor

from torchreg._checks import as_float_tensor, check_points
from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.cloud_surface import cloud_surface, enough_places
from torchreg.geometry.loaded import as_mesh
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.poisson_body import poisson_body
from torchreg.geometry.spread import SPREADS, spread_dimensions

ONE_SIDED = "the points do not enclose a body, as those of a single view: limbs follow the side that they show"


@dataclass(frozen=True)
class _SurfaceSampling:
    """What is kept of the surface of every frame."""

    num_vertices: int = 2000  # tell its size, its place and what is upright, as all of them would


_SAMPLING = _SurfaceSampling()


def as_surface(value: Any, name: str) -> tuple[TriangleMesh, tuple[str, ...]]:
    """Return the surface of a mesh, or of points without faces, and notes on it.

    Points that show most of a body from both sides have that of `poisson_body`; others, as of leaves or of a single
    view, that of `cloud_surface`.

    Raises:
        InputTypeError: if it is neither; names the argument.
        InputError: if there are too few points or one is not finite.
    """
    points = _cloud(value)
    if points is None:
        return as_mesh(value, name), ()
    points = as_float_tensor(points, name)
    check_points(points, name, batch=False)
    places = enough_places(points, name)
    size = (places.amax(0) - places.amin(0)).norm()
    body = poisson_body(places) if int(spread_dimensions(places, size)) == len(SPREADS) else None
    if body is not None and body.is_whole:
        notes = (f"{body.joined} piece(s) joined across gaps between points",) if body.joined else ()
        return TriangleMesh(body.mesh.vertices.to(points), body.mesh.faces.to(points.device)), notes
    found = cloud_surface(points.detach(), name)
    return found.mesh, () if found.encloses else (ONE_SIDED,)


def _cloud(value: Any) -> Tensor | None:
    """Return the points of a value without faces; None if it has some."""
    has_points = hasattr(value, "points") and not isinstance(value, TriangleMesh)
    points = value.points if has_points and getattr(value, "faces", None) is None else value
    return points if isinstance(points, Tensor) else None


@dataclass(frozen=True, eq=False)
class FrameSurfaces(Sequence[TriangleMesh]):
    """The surfaces of frames.

    Meshes are taken from their sequence when they are asked for, as from files, and are not kept; the surfaces of
    clouds, which are dear, are.

    Args:
        frames: meshes, or points without faces; any sequence.
        names: of the frames.
        made: the surfaces of clouds by the number of the frame.
        notes: on each frame.
        samples: some vertices of each frame, as many as tell its size and place.
        shift: (3,) added to vertices; None for nothing.
    """

    frames: Sequence[Any]
    names: tuple[str, ...]
    made: dict[int, TriangleMesh]
    notes: tuple[tuple[str, ...], ...]
    samples: tuple[Tensor, ...]
    shift: Tensor | None = None

    @classmethod
    def of_frames(cls, frames: Sequence[Any], names: Sequence[str] | None = None) -> FrameSurfaces:
        """Return the surfaces of frames, each of which is looked at once.

        Raises:
            InputTypeError: if a frame is neither a mesh nor points; names it.
            InputError: if there is no frame, or one of them has no surface.
        """
        if isinstance(frames, TriangleMesh):
            raise InputTypeError("meshes must be a sequence of TriangleMesh, got one mesh; put it into a list")
        names = tuple(names or (f"meshes[{frame}]" for frame in range(len(frames))))
        made, notes, samples = {}, [], []
        for number, name in enumerate(names):
            frame = frames[number]
            mesh, told = as_surface(frame, name)
            if not mesh.num_faces:
                raise InputError(f"{name} must have faces, got none; leave out frames without a surface")
            if _cloud(frame) is not None:
                made[number] = mesh
            notes.append(told)
            samples.append(mesh.vertices[:: max(1, mesh.num_vertices // _SAMPLING.num_vertices)].detach().clone())
        if not samples:
            raise InputError("meshes must hold at least one frame, got none")
        return cls(frames, names, made, tuple(notes), tuple(samples))

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> TriangleMesh:  # type: ignore[override]
        index = range(len(self))[index]
        mesh = self.made[index] if index in self.made else as_mesh(self.frames[index], self.names[index])
        return mesh if self.shift is None else TriangleMesh(mesh.vertices + self.shift.to(mesh.vertices), mesh.faces)

    def chosen(self, numbers: Sequence[int]) -> FrameSurfaces:
        """Return some frames."""
        return FrameSurfaces(
            _Chosen(self.frames, numbers),
            tuple(self.names[number] for number in numbers),
            {place: self.made[number] for place, number in enumerate(numbers) if number in self.made},
            tuple(self.notes[number] for number in numbers),
            tuple(self.samples[number] for number in numbers),
            self.shift,
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
