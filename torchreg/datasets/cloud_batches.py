"""Made-up clouds of an articulated shape in batches, on any device: what a network learns poses from."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg._checks import check_count
from torchreg.datasets.cloud_clutter import Clutter
from torchreg.datasets.hand import curled_joints, joint_ranges, placed
from torchreg.errors import InputError
from torchreg.geometry.rotation_representations import rotation_from_quaternion, rotation_vector_from_quaternion
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.hand import Hand
from torchreg.shapes.pose_algebra import BASE_DOFS
from torchreg.shapes.skin import LinearBlendSkin, stacked_rows


@dataclass(frozen=True)
class _Variety:
    """What differs between clouds; lengths are shares of the shape's size."""

    noise: tuple[float, float] = (0.001, 0.012)  # standard deviation of a point
    outliers: float = 0.4  # largest share of the points
    margin: float = 0.25  # by which the box of outliers is larger than the shape, on each side
    clumped: float = 0.4  # of the clouds, in which outliers lie about one place
    clump: float = 0.1  # standard deviation about it
    whole: float = 0.15  # of the clouds, measured from all sides
    stretch: float = 0.06  # standard deviation by which a thing differs from the shape along each axis
    forearm: float = 0.5  # of the clouds of hands
    forearm_length: tuple[float, float] = (0.2, 1.5)
    forearm_radius: tuple[float, float] = (0.09, 0.17)  # at the wrist
    forearm_growth: float = 0.15  # of the radius, along as much
    forearm_turn: float = 0.35  # standard deviation of its direction, about that from the hand's middle to the wrist
    neighbor: float = 0.15  # of the clouds, a second object of the same shape next to the first
    neighbor_distance: tuple[float, float] = (0.3, 1.0)  # of the two
    extra_points: tuple[float, float] = (0.1, 1.0)  # of a forearm or a second object for each of the first
    extra_samples: int = 600  # of which those are drawn
    scene: float = 0.5  # of the clouds, windows of a scene
    plane: float = 0.6  # of the scenes, with a table or a wall
    thing: float = 0.6  # of the scenes, with a thing that stands near; as many with one that is held
    absent: float = 0.2  # of the scenes, without the shape
    window: tuple[float, float] = (0.45, 0.75)  # radius of a window
    window_off: float = 0.15  # standard deviation of its middle along each axis
    least_window: int = 32  # points: a window with fewer shows all
    hole: float = 0.4  # of the clouds, with a ball without points
    hole_radius: tuple[float, float] = (0.05, 0.25)
    thinned: float = 0.5  # of the clouds, of which some points lack
    least: float = 0.3  # share of the points that are kept then, at least
    distance: tuple[float, float] = (2.5, 12.0)  # of the camera
    picture: float = 2.0  # side of the picture, where the shape is
    cells: int = 80  # of the grid of depths, along each side of the picture
    behind: float = 0.025  # behind the nearest point of its cell a point is hidden
    alone: float = 0.5  # of the hands, whose joints bend independently; in the others fingers curl
    open_std: float = 0.3  # of joints that turn by more than half a turn, radians


_VARIETY = _Variety()


@dataclass(frozen=True, eq=False)
class CloudBatch:
    """Clouds (B, M, 3) about the origin with a mask (B, M), and the truth: the point of the skin, -1 for outliers.

    Clouds without the shape are outliers alone.
    """

    points: Tensor
    mask: Tensor
    poses: Tensor
    index: Tensor

    @property
    def is_shown(self) -> Tensor:
        """Which clouds (B,) show the shape."""
        return (self.mask & (self.index >= 0)).any(-1)


def random_poses(shape: ArticulatedShape, count: int, generator: torch.Generator) -> Tensor:
    """Return poses (count, num_dofs) within the joint limits, turned at random, their middle at the origin.

    Fingers curl together in half of a hand's poses; all other joints move independently, each pose by its own share.
    """
    check_count(count, "count", 1)
    if not bool(torch.isinf(shape.lower[:3]).all()):
        raise InputError("shape must have a base that can move; where it is bolted down, align needs no start")

    def uniform(*size: int) -> Tensor:
        return torch.rand(size, generator=generator, device=generator.device).to(shape.rest)

    joints = shape.num_dofs - BASE_DOFS
    bend = uniform(count, 1).sqrt()
    share, other, side = uniform(count, joints), uniform(count, joints), 2 * uniform(count, joints) - 1
    pose = shape.rest_pose().repeat(count, 1)
    if isinstance(shape, Hand):
        curled = curled_joints(shape, share, other, side, bend)
        flexion = torch.tensor([name.endswith("flexion") for name in shape.dof_names[BASE_DOFS:]], device=share.device)
        single = torch.where(flexion, share, side) * bend * shape.upper[BASE_DOFS:]
        pose[:, BASE_DOFS:] = torch.where(uniform(count, 1) < _VARIETY.alone, single, curled)
    else:
        lower, upper = joint_ranges(shape)
        drawn = torch.where(side < 0, lower, upper) * bend * share
        turned = _VARIETY.open_std * _normal((count, joints), generator, shape.rest)
        pose[:, BASE_DOFS:] += torch.where(upper - lower >= math.pi, turned, drawn)
    pose[:, 3:BASE_DOFS] = rotation_vector_from_quaternion(_normal((count, 4), generator, shape.rest))
    return placed(shape, pose, torch.zeros_like(pose[:, :3]))


@torch.no_grad()
def random_clouds(
    skin: LinearBlendSkin,
    size: float,
    poses: Tensor,
    num_points: int,
    generator: torch.Generator,
    *,
    in_scenes: bool = False,
) -> CloudBatch:
    """Return a cloud of each pose: one-sided or whole, noisy, with outliers and holes, of a size in metres.

    Proportions differ a little from the shape's; some hands have a forearm, and some clouds a second object.
    ``in_scenes``: half are windows of scenes: with tables, with things near the shape or held by it, or without it.
    """
    rows = stacked_rows(skin.shape.part_transforms(poses))
    surface, normals = skin.place(rows), skin.turn_normals(rows)
    draw = CloudDraw(generator, surface, size, _VARIETY.scene if in_scenes else 0.0)
    forearm = _VARIETY.forearm if isinstance(skin.shape, Hand) else 0.0
    scene = draw.scene(surface, normals, poses[:, :3], forearm)
    visible, slant = draw.visible(scene.points, scene.normals)
    whole = draw.uniform(len(poses), 1) < _VARIETY.whole
    weight = scene.weight * torch.where(whole, 1.0, torch.where(visible, slant, 0.0))
    if in_scenes:
        weight = torch.where(draw.inside(scene, weight, surface.mean(1)), weight, 0.0)
    drawn, index = draw.picked(weight, num_points)
    points = scene.points.gather(1, index.unsqueeze(-1).expand(-1, -1, 3))
    points, outlier = draw.disturbed(points)
    mask = drawn & draw.kept(points)
    return CloudBatch(points, mask, poses, torch.where(outlier | (index >= surface.shape[1]), -1, index))


@dataclass(frozen=True, eq=False)
class _Scene:
    """Oriented points (B, N, 3) of which clouds are drawn, the first of them the skin's, and how often, (B, N).

    `is_window` (B, 1) are the windows of scenes.
    """

    points: Tensor
    normals: Tensor
    weight: Tensor
    is_window: Tensor


@dataclass(frozen=True, eq=False)
class CloudDraw:
    """Draws the differences between clouds of a batch, for a shape of a size in metres, like a tensor."""

    generator: torch.Generator
    like: Tensor
    size: float
    scenes: float  # share of the clouds

    def uniform(self, *size: int) -> Tensor:
        """Return numbers from 0 to 1."""
        return torch.rand(size, generator=self.generator, device=self.generator.device).to(self.like)

    def between(self, limits: tuple[float, float], *size: int) -> Tensor:
        """Return numbers whose logarithms are drawn evenly."""
        low, high = map(math.log, limits)
        return (low + (high - low) * self.uniform(*size)).exp()

    def normal(self, *size: int) -> Tensor:
        """Return numbers of a standard deviation of 1."""
        return _normal(size, self.generator, self.like)

    def picked(self, weight: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """Return points drawn by weights (B, N), their numbers (B, count), and which of them have any weight."""
        # Without replacement, by the largest of the logarithms and Gumbel noise.
        ranks = weight.log() - self.uniform(*weight.shape).clamp_min(1e-12).log().neg().clamp_min(1e-12).log()
        score, index = ranks.topk(min(count, ranks.shape[1]), dim=1)
        return score.isfinite(), index

    def scene(self, surface: Tensor, normals: Tensor, base: Tensor, forearm: float) -> _Scene:
        """Return an object that differs a little from the surface (B, N, 3), and its surroundings."""
        batch, count = surface.shape[:2]
        axes = rotation_from_quaternion(_normal((batch, 4), self.generator, self.like))
        scale = 1 + _VARIETY.stretch * _normal((batch, 3, 1), self.generator, self.like)
        # Normals turn by as little as the proportions differ.
        stretch = axes @ (scale * axes.mT)
        surface = (surface - base.unsqueeze(1)) @ stretch + base.unsqueeze(1)
        is_window, absent = torch.zeros(2, batch, 1, dtype=torch.bool, device=surface.device)
        if self.scenes:
            is_window = self.uniform(batch, 1) < self.scenes
            absent = is_window & (self.uniform(batch, 1) < _VARIETY.absent)
        shown = torch.where(absent, 0.0, 1.0).expand(-1, count)
        parts, middle = [(surface, normals, shown)], surface.mean(1)
        extras = [
            (forearm, self.forearm(base, middle), ~absent),
            (_VARIETY.neighbor, self.neighbor(surface, normals), ~is_window),
        ]
        if self.scenes:
            clutter = Clutter(self.generator, self.like, self.size)
            extras += [
                (_VARIETY.plane, clutter.plane(middle), is_window),
                (_VARIETY.thing, clutter.near(middle), is_window),
                (_VARIETY.thing, clutter.held(surface, normals), is_window),
            ]
        for share, (points, facing), is_part in extras:
            # Something is left where the shape is not.
            there = ((self.uniform(batch, 1) < share) | (absent & is_part)) & is_part
            often = self.between(_VARIETY.extra_points, batch, 1) * count / points.shape[1]
            parts.append((points, facing, torch.where(there, often, 0.0).expand(-1, points.shape[1])))
        oriented, facing, often = (torch.cat(part, dim=1) for part in zip(*parts, strict=True))
        return _Scene(oriented, facing, often, is_window)

    def inside(self, scene: _Scene, weight: Tensor, middle: Tensor) -> Tensor:
        """Return which points (B, N) of scenes are in windows about middles (B, 3), all where the window is empty."""
        center = middle + _VARIETY.window_off * self.size * _normal(tuple(middle.shape), self.generator, self.like)
        radius = self.size * self.between(_VARIETY.window, len(middle), 1)
        inside = (scene.points - center.unsqueeze(1)).norm(dim=-1) < radius
        enough = (inside & (weight > 0)).sum(1, keepdim=True) >= _VARIETY.least_window
        return inside | ~(scene.is_window & enough)

    def forearm(self, base: Tensor, middle: Tensor) -> tuple[Tensor, Tensor]:
        """Return oriented points (B, P, 3) of cones that begin at the base and lead away from the middle."""
        batch, count = len(base), _VARIETY.extra_samples
        axis = _unit(_unit(base - middle) + _VARIETY.forearm_turn * _normal((batch, 3), self.generator, self.like))
        axis = axis.unsqueeze(1)
        along = self.between(_VARIETY.forearm_length, batch, 1) * self.uniform(batch, count)
        radius = self.between(_VARIETY.forearm_radius, batch, 1) + _VARIETY.forearm_growth * along
        around = _normal((batch, count, 3), self.generator, self.like)
        around = _unit(around - (around * axis).sum(-1, keepdim=True) * axis)
        offset = along.unsqueeze(-1) * axis + radius.unsqueeze(-1) * around
        return base.unsqueeze(1) + self.size * offset, around

    def neighbor(self, surface: Tensor, normals: Tensor) -> tuple[Tensor, Tensor]:
        """Return oriented points (B, P, 3) of the next object of the batch, next to each."""
        distance = self.size * self.between(_VARIETY.neighbor_distance, len(surface), 1, 1)
        offset = distance * _unit(_normal((len(surface), 1, 3), self.generator, self.like))
        some = torch.linspace(0, surface.shape[1] - 1, _VARIETY.extra_samples, device=surface.device).long()
        return surface[:, some].roll(1, 0) + offset, normals[:, some].roll(1, 0)

    def visible(self, surface: Tensor, normals: Tensor) -> tuple[Tensor, Tensor]:
        """Return which points (B, N) a camera before the shape sees, and the cosine of their slant."""
        away = self.size * self.between(_VARIETY.distance, len(surface), 1)
        ray = torch.cat([surface[..., :2], (surface[..., 2] + away).unsqueeze(-1)], dim=-1)
        slant = -(ray * normals).sum(-1) / ray.norm(dim=-1).clamp_min(1e-9 * self.size)
        cells = _VARIETY.cells
        place = (ray[..., :2] * (away / ray[..., 2]).unsqueeze(-1) / (_VARIETY.picture * self.size) + 0.5).clamp(0, 1)
        column, row = (cells * place).long().clamp_max(cells - 1).unbind(-1)
        cell = row * cells + column
        nearest = torch.full_like(surface[:, :1, 0].expand(-1, cells * cells), torch.inf).clone()
        nearest = nearest.scatter_reduce(1, cell, ray[..., 2], "amin").gather(1, cell)
        return (slant > 0) & (ray[..., 2] <= nearest + _VARIETY.behind * self.size), slant.clamp_min(0)

    def disturbed(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return points (B, M, 3) with noise, some of them outliers, and which ones (B, M)."""
        batch, count = points.shape[:2]
        noise = self.size * self.between(_VARIETY.noise, batch, 1, 1)
        lower, upper = points.amin(1, keepdim=True), points.amax(1, keepdim=True)
        margin = _VARIETY.margin * self.size
        box = lower - margin + self.uniform(batch, count, 3) * (upper - lower + 2 * margin)
        place = lower - margin + self.uniform(batch, 1, 3) * (upper - lower + 2 * margin)
        clump = place + _VARIETY.clump * self.size * _normal((batch, count, 3), self.generator, self.like)
        clutter = torch.where(self.uniform(batch, 1, 1) < _VARIETY.clumped, clump, box)
        outlier = self.uniform(batch, count) < _VARIETY.outliers * self.uniform(batch, 1)
        noisy = points + noise * _normal((batch, count, 3), self.generator, self.like)
        return torch.where(outlier.unsqueeze(-1), clutter, noisy), outlier

    def kept(self, points: Tensor) -> Tensor:
        """Return which points (B, M) lie in no hole and are not left out at random."""
        batch, count = points.shape[:2]
        pick = (count * self.uniform(batch)).long().clamp_max(count - 1)
        center = points[torch.arange(batch, device=points.device), pick].unsqueeze(1)
        radius = self.size * self.between(_VARIETY.hole_radius, batch, 1)
        hole = ((points - center).norm(dim=-1) < radius) & (self.uniform(batch, 1) < _VARIETY.hole)
        share = _VARIETY.least + (1 - _VARIETY.least) * self.uniform(batch, 1)
        thinned = (self.uniform(batch, count) > share) & (self.uniform(batch, 1) < _VARIETY.thinned)
        return ~hole & ~thinned


def _normal(size: tuple[int, ...], generator: torch.Generator, like: Tensor) -> Tensor:
    return torch.randn(size, generator=generator, device=generator.device).to(like)


def _unit(vectors: Tensor) -> Tensor:
    return torch.nn.functional.normalize(vectors, dim=-1)
