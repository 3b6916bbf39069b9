"""Made-up plants: organs appear, lengthen and fall off, meshed anew in each frame, with the exact truth."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg._checks import check_count, check_positive
from torchreg.datasets.ball_surface import ball_surface, bent_axes
from torchreg.geometry.mesh import TriangleMesh

_GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))  # between organs that follow each other on a stem


@dataclass(frozen=True)
class _Growth:
    """Form and growth of organs; lengths in those of the grown stem."""

    num_samples: int = 48  # along the axis of an organ; the balls around them are the organ
    stem_start: float = 0.45  # length of the stem at first
    stem_radii: tuple[float, float] = (0.05, 0.03)  # at the ground and at its top
    lengths: tuple[float, float] = (0.35, 0.6)  # of grown organs on the stem, drawn evenly
    shorter: float = 0.6  # of organs on organs, in those on the stem
    radius: float = 0.028  # of organs
    elevations: tuple[float, float] = (0.25, 0.75)  # of organs, radians, drawn evenly
    rise: float = 0.5  # turn upwards from an organ's root to its tip, radians
    duration: float = 8.0  # frames in which an organ grows to its length
    frames_per_cycle: float = 17.0  # of swaying
    lowest: float = 0.2  # height of the lowest organ
    highest: float = 0.88  # of the highest one
    top: float = 0.07  # of the stem above an organ that appears


_GROWTH = _Growth()


@dataclass(frozen=True)
class PlantForm:
    """What a plant becomes.

    Args:
        num_leaves: organs on the stem.
        num_branchlets: organs on organs: each makes one tip into two.
        num_early: of the organs, that are there in the first frame.
        num_falling: of the organs, that fall off before the last frame.
        sway: largest turn of an organ from where it grew, radians.
    """

    num_leaves: int = 6
    num_branchlets: int = 2
    num_early: int = 2
    num_falling: int = 1
    sway: float = 0.12

    def __post_init__(self) -> None:
        check_count(self.num_leaves, "num_leaves", 2)
        for name in ("num_branchlets", "num_early", "num_falling"):
            check_count(getattr(self, name), name, 0)
        check_positive(self.sway, "sway", allow_zero=True)


@dataclass(frozen=True, eq=False)
class GrowingPlant:
    """A plant in T frames whose meshes are unrelated, and the truth; the length of the grown stem is 1.

    Organ 0 is the foot of the stem, organ 1 its top, the others are leaves and what grows on these.

    Args:
        meshes: T closed surfaces.
        tips: (T, K, 3) ends of the organs, on the surface; NaN where they are not there.
        births: (K,) first frame of each organ.
        ends: (K,) its last frame.
    """

    meshes: tuple[TriangleMesh, ...]
    tips: Tensor
    births: Tensor
    ends: Tensor


@dataclass(frozen=True, eq=False)
class _Organs:
    """The G organs on a stem, drawn at random.

    Args:
        parents: (G,) number of the organ that each grows on, -1 for the stem.
        roots: (G,) where it grows there: a share of the length of the grown parent.
        azimuths, elevations: (G,) its direction at the root, radians.
        lengths: (G,) when grown.
        births: (G,) frame in which each appears; negative ones were there before.
        ends: (G,) its last frame.
        phases: (G, 2) of swaying.
    """

    parents: Tensor
    roots: Tensor
    azimuths: Tensor
    elevations: Tensor
    lengths: Tensor
    births: Tensor
    ends: Tensor
    phases: Tensor


def growing_plant(
    form: PlantForm | None = None,
    num_frames: int = 24,
    *,
    noise: float = 0.0,
    resolution: int = 96,
    dtype: torch.dtype = torch.float32,
    seed: int = 0,
) -> GrowingPlant:
    """Return a plant that grows and sways, meshed anew in every frame.

    Its stem lengthens; organs appear on it from below upwards, grow to their lengths within eight frames, and carry
    organs of their own; a few fall off.

    Args:
        form: see `PlantForm`.
        num_frames: number of frames, at least 2.
        noise: standard deviation of the field at each voxel, in voxels.
        resolution: voxels along the longest side of the box.
        dtype: of everything.
        seed: of form, motion and noise.

    Raises:
        InputError: if an argument is out of range.

    Cost: 0.15 s per frame at the default resolution on one CPU core.
    """
    form = form or PlantForm()
    check_count(num_frames, "num_frames", 2)
    check_positive(noise, "noise", allow_zero=True)
    check_count(resolution, "resolution", 16)
    generator = torch.Generator().manual_seed(seed)
    organs = _drawn_organs(form, num_frames, generator)
    meshes, tips = [], []
    for frame in range(num_frames):
        axes, radii, ends = _axes(form, organs, frame, num_frames)
        tips.append(ends)
        meshes.append(ball_surface(axes.flatten(0, 1), radii.flatten(), resolution, noise, generator, dtype))
    always = torch.tensor([0, 0]), torch.full((2,), num_frames - 1)
    return GrowingPlant(
        meshes=tuple(meshes),
        tips=torch.stack(tips).to(dtype),
        births=torch.cat((always[0], organs.births.clamp_min(0))),
        ends=torch.cat((always[1], organs.ends)),
    )


def _drawn_organs(form: PlantForm, num_frames: int, generator: torch.Generator) -> _Organs:
    leaves, branchlets, count = form.num_leaves, form.num_branchlets, form.num_leaves + form.num_branchlets

    def draw(low: float, high: float, *size: int) -> Tensor:
        return low + (high - low) * torch.rand(*size, generator=generator, dtype=torch.float64)

    order, early = torch.arange(count), min(form.num_early, leaves)
    first = torch.linspace(_GROWTH.lowest, _GROWTH.stem_start - _GROWTH.top, early, dtype=torch.float64)
    later = torch.linspace(_GROWTH.stem_start, _GROWTH.highest, leaves - early, dtype=torch.float64)
    roots = torch.cat((first, later)) + draw(-0.02, 0.02, leaves)
    parents = torch.cat((torch.full((leaves,), -1), torch.arange(branchlets) % leaves))
    azimuths = _GOLDEN_ANGLE * order + draw(-0.2, 0.2, count)
    azimuths[leaves:] = azimuths[parents[leaves:]] + 0.9 * (1 - 2 * (order[leaves:] % 2))
    lengths = draw(*_GROWTH.lengths, count) * torch.where(parents < 0, 1.0, _GROWTH.shorter)
    # From below upwards, as the stem lengthens; those on organs when these have grown by half.
    heights = torch.tensor([_height(frame, num_frames) for frame in range(num_frames)], dtype=torch.float64)
    births = torch.searchsorted(heights, roots + _GROWTH.top).clamp_max(num_frames - 1)
    births = torch.where(order[:leaves] < early, -int(_GROWTH.duration), births)
    started = births[parents[leaves:]].clamp_min(0) + int(_GROWTH.duration / 2) + order[:branchlets]
    births = torch.cat((births, started.clamp_max(num_frames - 1)))
    ends = torch.full((count,), num_frames - 1)
    # The lowest organ that carries none falls first.
    bare = [k for k in range(leaves) if k not in parents[leaves:].tolist()]
    for number, organ in enumerate(bare[: form.num_falling]):
        ends[organ] = max(int(births[organ]) + 3, round(num_frames * (0.6 + 0.15 * number)))
    elevations, phases = draw(*_GROWTH.elevations, count), draw(0, 2 * math.pi, count, 2)
    return _Organs(parents, torch.cat((roots, draw(0.45, 0.6, branchlets))), azimuths, elevations, lengths, births,
                   ends.clamp_max(num_frames - 1), phases)  # fmt: skip


def _height(frame: int, num_frames: int) -> float:
    """Return the length of the stem in a frame."""
    return _GROWTH.stem_start + (1 - _GROWTH.stem_start) * min(1.0, (frame + 1) / (0.8 * num_frames))


def _axes(form: PlantForm, organs: _Organs, frame: int, num_frames: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return the axes (A, S, 3) and radii (A, S) of the stem and all organs that are there, and the tips (K, 3)."""
    share = torch.linspace(0, 1, _GROWTH.num_samples, dtype=torch.float64)
    cycle = 2 * math.pi * frame / _GROWTH.frames_per_cycle
    height = _height(frame, num_frames)
    lean = 0.4 * form.sway * math.sin(cycle)
    stem = _bent(torch.zeros(3, dtype=torch.float64), 0.3, math.pi / 2 - lean, -lean, height, share)
    first, last = _GROWTH.stem_radii
    axes, radii = [stem], [first + share * (last - first)]
    tips = [stem[0] - stem.new_tensor([0, 0, first]), stem[-1] + last * _direction(stem)]
    grown: dict[int, Tensor] = {-1: stem}
    for organ in range(len(organs.parents)):
        age = frame - int(organs.births[organ]) + 1
        if age < 1 or frame > int(organs.ends[organ]):
            tips.append(torch.full((3,), torch.nan, dtype=torch.float64))
            continue
        parent = grown[int(organs.parents[organ])]
        where = float(organs.roots[organ]) / (height if int(organs.parents[organ]) < 0 else 1.0)
        root = parent[min(round(where * (len(parent) - 1)), len(parent) - 1)]
        turn = form.sway * (cycle + organs.phases[organ]).sin()
        length = float(organs.lengths[organ]) * min(1.0, age / _GROWTH.duration) ** 0.7
        up = float(organs.elevations[organ] + turn[0])
        grown[organ] = _bent(root, float(organs.azimuths[organ] + turn[1]), up, _GROWTH.rise, length, share)
        axes.append(grown[organ])
        radii.append(torch.full_like(share, _GROWTH.radius))
        tips.append(grown[organ][-1] + _GROWTH.radius * _direction(grown[organ]))
    return torch.stack(axes), torch.stack(radii), torch.stack(tips)


def _bent(root: Tensor, azimuth: float, elevation: float, rise: float, length: float, share: Tensor) -> Tensor:
    """Return an axis (S, 3) from a root in a direction that turns upwards on the way."""
    up = elevation + rise * share
    along, across = up.new_tensor(math.cos(azimuth)), up.new_tensor(math.sin(azimuth))
    return root + bent_axes(along, across, up, up.new_tensor(length))[0]


def _direction(axis: Tensor) -> Tensor:
    """Return the direction (3,) in which an axis (S, 3) ends."""
    return torch.nn.functional.normalize(axis[-1] - axis[-2], dim=0)
