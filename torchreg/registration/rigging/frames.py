"""Frames of a sequence that a rig is made from: which of them, how coarse, and which is the template."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchreg._checks import check_count
from torchreg.errors import InputError, InputTypeError
from torchreg.geometry.loaded import as_points, as_scan
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.range_scan import RangeScan
from torchreg.geometry.scan_clusters import clustered_scan
from torchreg.registration.rigging.distances import SurfaceSamples


@dataclass(frozen=True)
class _Limits:
    """Which frames may show one thing in one unit."""

    least_points: int = 100  # fewer show no limbs
    size: float = 2.0  # times the median radius: bodies that stretch change less, units and other things mostly more


_LIMITS = _Limits()


@dataclass(frozen=True)
class RigFrames:
    """Frames that are used, with their numbers in the sequence."""

    scans: tuple[RangeScan, ...]  # coarse, double precision
    surfaces: tuple[SurfaceSamples, ...]  # even samples of each, from which distances are measured
    numbers: tuple[int, ...]  # of the scans among all frames
    template: int  # index among the scans
    mesh: TriangleMesh  # of the template, as it was given
    notes: tuple[str, ...]  # one sentence for each frame that is left out


def usable_frames(meshes: Sequence[Any], template: int | None, num_points: int) -> RigFrames:
    """Return the frames that show one thing in one unit; raise unless two do, one of them a mesh."""
    if len(meshes) < 2:
        raise InputError(f"meshes must hold two frames at least, as one shows no joints, got {len(meshes)}")
    if template is not None:
        check_count(template, "template", 0)
        if template >= len(meshes):
            raise InputError(f"template must be below the number of frames {len(meshes)}, got {template}")
    points = [_finite(mesh, f"meshes[{number}]") for number, mesh in enumerate(meshes)]
    sizes = torch.stack([_radius(each) for each in points])
    median = sizes[sizes > 0].median() if bool((sizes > 0).any()) else sizes.new_tensor(0.0)
    notes: dict[int, str] = {}
    for number, (each, size) in enumerate(zip(points, sizes.tolist(), strict=True)):
        if len(each) < _LIMITS.least_points or not size > 0:
            notes[number] = f"frame {number}: left out: it holds {len(each)} points"
        elif not 1 / _LIMITS.size < size / float(median) < _LIMITS.size:
            notes[number] = (
                f"frame {number}: left out: it is {size / float(median):.3g} times as large as most frames: "
                f"another unit, or another thing"
            )
    kept = [number for number in range(len(meshes)) if number not in notes]
    if len(kept) < 2:
        raise InputError(f"meshes must hold two frames of one thing at least; {'; '.join(notes.values())}")
    if template in notes:
        raise InputError(f"template must be a frame that shows the thing; {notes[template]}")
    clouds = {number: RangeScan(points[number]) for number in kept if isinstance(meshes[number], Tensor)}
    scans = [as_scan(clouds.get(number, meshes[number]), f"meshes[{number}]") for number in kept]
    scans = [scan.to(device="cpu", dtype=torch.float64) for scan in scans]
    chosen = _freest(scans) if template is None else kept.index(template)
    faces = scans[chosen].faces
    if faces is None:
        raise InputError("one frame at least must be a mesh with triangles, which becomes the rig's surface")
    coarse = tuple(clustered_scan(scan, num_points)[0] for scan in scans)
    mesh = TriangleMesh(scans[chosen].points, faces)
    surfaces = tuple(SurfaceSamples.of_scan(scan) for scan in scans)
    return RigFrames(coarse, surfaces, tuple(kept), chosen, mesh, tuple(notes.values()))


def _freest(scans: Sequence[RangeScan]) -> int:
    """Return the mesh of most surface: limbs that touch lose some, and so do holes."""
    areas = torch.tensor([
        0.0 if scan.faces is None else float(TriangleMesh(scan.points, scan.faces).face_areas().sum()) for scan in scans
    ])  # fmt: skip
    return int(areas.argmax())


def _finite(value: Any, name: str) -> Tensor:
    points = as_points(value)
    if not isinstance(points, Tensor) or points.shape[-1:] != (3,):
        raise InputTypeError(f"{name} must be a mesh, a scan or points (N, 3), got {type(value).__name__}")
    points = points.detach().double().reshape(-1, 3)
    return points[points.isfinite().all(-1)]


def _radius(points: Tensor) -> Tensor:
    """Return the median distance of points from their middle, which no far fragment changes much."""
    if not len(points):
        return points.new_tensor(0.0)
    return (points - points.median(0).values).norm(dim=-1).median()
