"""Made-up stereo measurements of a shape in given poses, background and forearm included, with exact truth."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from enum import IntEnum

import torch
from torch import Tensor

from torchreg._checks import check_count, check_positive, check_shape
from torchreg.datasets.hand import HandCloud, faces_of, shuffled_cloud, surface_skin
from torchreg.errors import InputError
from torchreg.geometry.mesh import TriangleMesh, interpolate
from torchreg.geometry.rigid import transform_points
from torchreg.geometry.rotation import so3_exp
from torchreg.geometry.visibility import Raster, View, rasterize
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.hand import Hand
from torchreg.shapes.skin import LinearBlendSkin


@dataclass(frozen=True)
class _Surroundings:
    """Surroundings of the shape, and numbers of points on them."""

    on_forearm: float = 0.4  # share of the outliers
    on_wall: float = 0.3  # share of the outliers; the rest is spread over the working volume
    obstacle_texture: float = 0.08  # points per pixel of an obstacle over those of the shape: it has less texture
    volume_margin: float = 0.1  # of the working volume around the box of all frames, as a share of its diagonal
    wall_depth: float = 1.5  # over the depth of the farthest point of the shape
    wall_slope: float = 0.2  # largest tilt of the wall, along x and y


@dataclass(frozen=True)
class _ForearmForm:
    """A tapering tube behind the wrist; lengths in radii of the palm."""

    # Per ring: position along the bone (the first lies inside the palm), half the width, half the thickness.
    rings: tuple[tuple[float, float, float], ...] = (
        (0.2, 0.5, 0.65), (-0.2, 0.6, 1.15), (-1.5, 0.7, 1.5), (-4.0, 0.9, 2.1),
    )  # fmt: skip
    num_sides: int = 24
    max_bend: float = math.radians(12)  # at the wrist, radians


class _Owner(IntEnum):
    """Owners of the faces of a scene."""

    SHAPE = 0
    FOREARM = 1
    OBSTACLE = 2


_SURROUNDINGS, _FOREARM = _Surroundings(), _ForearmForm()


@dataclass(frozen=True)
class StereoView:
    """Two pinhole cameras side by side that look along +z with -y up, and their noise; metres and pixels.

    They stand at (-+ baseline / 2, 0, 0). A point at depth z has the disparity ``focal * baseline / z``, so that an
    error of the disparity moves it along its ray by ``z^2 * disparity_noise / (focal * baseline)``: 1.5 mm at 0.6 m by
    default. Noises are standard deviations, of the disparity and of both picture coordinates.
    """

    baseline: float = 0.1
    focal: float = 600.0
    width: int = 640
    height: int = 480
    disparity_noise: float = 0.25
    lateral_noise: float = 0.25

    def __post_init__(self) -> None:
        for field in fields(self):
            check_positive(getattr(self, field.name), field.name, allow_zero=field.name.endswith("noise"))

    def views(self) -> tuple[View, View]:
        """Return the left and the right camera; pixels of one row in both see the same plane of space."""
        upright = torch.eye(3, dtype=torch.float64)
        corner = torch.tensor([-self.width, -self.height], dtype=torch.float64) / (2 * self.focal)
        positions = torch.tensor([[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0]], dtype=torch.float64) * self.baseline
        left, right = (View(start, upright, corner, 1 / self.focal, self.width, self.height) for start in positions)
        return left, right

    def depth_std(self, depth: Tensor) -> Tensor:
        """Return the standard deviation of measured depths at true depths (...,), metres."""
        return depth**2 * (self.disparity_noise / (self.focal * self.baseline))

    def measured(self, points: Tensor, generator: torch.Generator) -> Tensor:
        """Return points (N, 3) with the noise of the pair: along the rays of the left camera and across them."""
        left = points.new_tensor([-0.5 * self.baseline, 0.0, 0.0])
        error = torch.randn(len(points), 3, generator=generator, device=generator.device, dtype=torch.float64)
        error, ray = error.to(points), points - left
        depth = ray[:, 2:]
        ray = ray * (1 + self.depth_std(depth) * error[:, 2:] / depth)
        across = error * error.new_tensor([1.0, 1.0, 0.0])
        return left + ray + depth * (self.lateral_noise / self.focal) * across


def stereo_clouds(
    shape: ArticulatedShape,
    poses: Tensor,
    *,
    stereo: StereoView | None = None,
    skin: LinearBlendSkin | None = None,
    num_points: int = 600,
    outlier_ratio: float = 0.3,
    obstacle: TriangleMesh | None = None,
    seed: int = 0,
) -> list[HandCloud]:
    """Return stereo measurements of a shape in poses (T, num_dofs), one cloud per pose, with the exact truth.

    Points lie at pixels of the left picture whose surface the right camera sees too, drawn uniformly from them:
    ``num_points`` in the frame that shows most of the shape, in others fewer in proportion. ``outlier_ratio`` is the
    share of outliers in that frame; every frame has as many. Four tenths of them lie on a forearm behind the wrist,
    where the shape is a hand and as far as it is visible, three tenths on a wall behind the shape, the rest uniformly
    in the working volume: the box of all frames, slightly grown. An obstacle, a still mesh, hides surfaces behind it
    and adds outliers, 8 % as dense as the points of the shape.
    """
    poses = shape.check_pose(poses, "poses").detach()
    check_shape(poses, "poses", ("T", shape.num_dofs))
    check_count(num_points, "num_points", 1)
    if not 0 <= outlier_ratio < 1:
        raise InputError(f"outlier_ratio must be at least 0 and below 1, got {outlier_ratio}")
    stereo = StereoView() if stereo is None else stereo
    skin = surface_skin(shape) if skin is None else skin
    generator = torch.Generator().manual_seed(seed)
    if not len(poses):
        return []
    with torch.no_grad():
        scene = _make_scene(shape, skin, poses, obstacle, generator)
        num_outliers = round(num_points * outlier_ratio / (1 - outlier_ratio))
        keep = max(num_points, num_outliers)
        visible = [_draw_visible(scene, frame, stereo, keep, generator) for frame in range(len(poses))]
        most = max(drawn.counts[_Owner.SHAPE] for drawn in visible)
        if not most:
            raise InputError("poses must show the shape to both cameras in one frame at least; they look along +z")
        return [
            _measured_cloud(scene, frame, stereo, drawn, num_points / most, num_outliers, generator)
            for frame, drawn in enumerate(visible)
        ]


@dataclass(frozen=True, eq=False)
class _StereoScene:
    """All surfaces before the cameras: the shape, its forearm if it is a hand, an obstacle, a wall.

    Vertices (T, ., 3) of the skin and of forearm and obstacle; the `_Owner` of each face; lower and upper corner of the
    working volume; depth of the wall straight ahead, and its slopes along x and y.
    """

    shape: ArticulatedShape
    skin: LinearBlendSkin
    poses: Tensor
    surface: Tensor
    others: Tensor
    faces: Tensor
    owners: Tensor
    volume: Tensor
    wall: Tensor

    def mesh(self, frame: int) -> TriangleMesh:
        return TriangleMesh(torch.cat([self.surface[frame], self.others[frame]]), self.faces)


def _make_scene(
    shape: ArticulatedShape,
    skin: LinearBlendSkin,
    poses: Tensor,
    obstacle: TriangleMesh | None,
    generator: torch.Generator,
) -> _StereoScene:
    """Return the scene of a shape in poses (T, num_dofs), with wall and wrist drawn at random."""
    draws, skin_faces = 2 * torch.rand(4, generator=generator, dtype=torch.float64).to(poses) - 1, faces_of(skin)
    nothing = TriangleMesh(poses.new_zeros(0, 3), skin_faces[:0])
    arm = _forearm(shape, draws[:2]) if isinstance(shape, Hand) else nothing
    still = nothing if obstacle is None else obstacle.to(poses)
    surface = skin(poses)
    moving_arm = transform_points(shape.part_transforms(poses)[:, 0], arm.vertices.expand(len(poses), -1, 3))
    start = surface.shape[1]
    faces = [skin_faces, arm.faces + start, still.faces + start + arm.num_vertices]
    counts = torch.tensor([len(part) for part in faces], device=poses.device)
    low, high = surface.flatten(0, 1).amin(0), surface.flatten(0, 1).amax(0)
    margin = _SURROUNDINGS.volume_margin * (high - low).norm()
    wall = torch.cat([_SURROUNDINGS.wall_depth * high[2:], _SURROUNDINGS.wall_slope * draws[2:]])
    return _StereoScene(
        shape=shape,
        skin=skin,
        poses=poses,
        surface=surface,
        others=torch.cat([moving_arm, still.vertices.expand(len(poses), -1, 3)], dim=1),
        faces=torch.cat(faces),
        owners=torch.arange(len(_Owner), device=poses.device).repeat_interleave(counts),
        volume=torch.stack([low - margin, high + margin]),
        wall=wall.double(),
    )


def drawn_forearm(hand: Hand, generator: torch.Generator) -> TriangleMesh:
    """Return a forearm in the frame of the palm, bent at the wrist by random angles."""
    return _forearm(hand, 2 * torch.rand(2, generator=generator, dtype=torch.float64).to(hand.rest) - 1)


def _forearm(hand: Hand, bend: Tensor) -> TriangleMesh:
    """Return the forearm in the frame of the palm, bent at the wrist by shares (2,) of the largest angle."""
    rings = (hand.radii.new_tensor(_FOREARM.rings) * hand.radii[0][[2, 0, 1]]).unsqueeze(1)
    around = torch.arange(_FOREARM.num_sides, device=rings.device) * (2 * math.pi / _FOREARM.num_sides)
    across, thick = rings[..., 1] * around.cos(), rings[..., 2] * around.sin()
    rings = torch.stack([across, thick, rings[..., 0].expand_as(across)], dim=-1)
    turn = so3_exp(torch.cat([_FOREARM.max_bend * bend, torch.zeros_like(bend[:1])]))
    return tube(rings @ turn.mT)


def tube(rings: Tensor) -> TriangleMesh:
    """Return the open tube through rings (R, S, 3); it faces outwards where they run clockwise from the next."""
    levels, sides = rings.shape[:2]
    corner = torch.arange(levels - 1).unsqueeze(-1) * sides + torch.arange(sides)
    following = corner.roll(-1, dims=1)
    quads = torch.stack([corner, corner + sides, following + sides, following], dim=-1).flatten(0, 1)
    return TriangleMesh(rings.flatten(0, 1), torch.cat([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]))


@dataclass(frozen=True, eq=False)
class _VisiblePoints:
    """Points of a frame that both cameras see, without noise, in random order by `_Owner`; pixels that show each."""

    counts: list[int]
    points: list[Tensor]
    face: list[Tensor]
    barycentric: list[Tensor]
    wall: Tensor


def _draw_visible(
    scene: _StereoScene, frame: int, stereo: StereoView, most: int, generator: torch.Generator
) -> _VisiblePoints:
    """Return points of a frame that both cameras see, at most so many of each owner."""
    mesh, (left_view, right_view) = scene.mesh(frame), stereo.views()
    left, right = rasterize(mesh, left_view, cull_back=True), rasterize(mesh, right_view, cull_back=True)
    shown = torch.where(_seen_by_right(left, right, stereo), left.face_index, -1).flatten()
    pixels = (shown >= 0).nonzero()[:, 0]
    corners = mesh.vertices[mesh.faces[shown[pixels]]].double()
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    # Where a surface curves away from the right camera, its outline is a pixel off.
    pixels = pixels[((right_view.position.to(corners) - corners[:, 0]) * normals).sum(-1) > 0]
    owners, vertices = scene.owners[shown[pixels]], mesh.vertices.double()
    counts, points, faces, weights = [], [], [], []
    for owner in _Owner:
        owned = pixels[owners == owner]
        drawn = owned[torch.randperm(len(owned), generator=generator)[:most].to(owned.device)]
        counts.append(len(owned))
        faces.append(shown[drawn])
        weights.append(left.barycentric.flatten(0, 1)[drawn])
        points.append(interpolate(vertices, mesh.faces, faces[-1], weights[-1]))
    wall = _wall_points(scene.wall, left, right, stereo, most, generator)
    return _VisiblePoints(counts=counts, points=points, face=faces, barycentric=weights, wall=wall)


def _seen_by_right(left: Raster, right: Raster, stereo: StereoView) -> Tensor:
    """Return the mask (H, W) of pixels of the left picture whose surface the right camera sees too."""
    columns = torch.arange(left.depth.shape[1], device=left.depth.device) + 0.5
    column = (columns - stereo.focal * stereo.baseline / left.depth).floor().long()
    # A pixel to each side: slanted surfaces are nearer there than at the point itself.
    farthest = torch.nn.functional.max_pool2d(right.depth[None], (1, 3), stride=1, padding=(0, 1))[0]
    limit = farthest.gather(1, column.clamp(0, len(columns) - 1))
    return (left.face_index >= 0) & (column >= 0) & (left.depth <= limit + left.depth / stereo.focal)


def _wall_points(
    wall: Tensor, left: Raster, right: Raster, stereo: StereoView, count: int, generator: torch.Generator
) -> Tensor:
    """Return up to ``count`` points (N, 3) float64 of the wall that no surface hides from either camera."""
    free = torch.isinf(left.depth).flatten().nonzero()[:, 0]
    # Twice as many, as the right camera does not see all of them.
    drawn = free[torch.randperm(len(free), generator=generator)[: 2 * count].to(free.device)]
    row, column = drawn // stereo.width, drawn % stereo.width
    along = (column + 0.5 - stereo.width / 2) / stereo.focal
    down = (row + 0.5 - stereo.height / 2) / stereo.focal
    depth = (wall[0] - wall[1] * stereo.baseline / 2) / (1 - wall[1] * along - wall[2] * down)
    right_column = (column + 0.5 - stereo.focal * stereo.baseline / depth).floor().long()
    visible = (right_column >= 0) & torch.isinf(right.depth[row, right_column.clamp(min=0)])
    points = torch.stack([along * depth - stereo.baseline / 2, down * depth, depth], dim=-1)
    return points[visible][:count]


def _measured_cloud(
    scene: _StereoScene,
    frame: int,
    stereo: StereoView,
    drawn: _VisiblePoints,
    density: float,
    num_outliers: int,
    generator: torch.Generator,
) -> HandCloud:
    """Return the noisy cloud of a frame: ``density`` points per pixel of the shape, and outliers."""
    num_inliers = round(density * drawn.counts[_Owner.SHAPE])
    num_on_obstacle = round(_SURROUNDINGS.obstacle_texture * density * drawn.counts[_Owner.OBSTACLE])
    on_arm = drawn.points[_Owner.FOREARM][: round(_SURROUNDINGS.on_forearm * num_outliers)]
    on_wall = drawn.wall[: round(_SURROUNDINGS.on_wall * num_outliers)]
    on_obstacle = drawn.points[_Owner.OBSTACLE][:num_on_obstacle]
    found = torch.cat([drawn.points[_Owner.SHAPE][:num_inliers], on_arm, on_wall, on_obstacle])
    found = stereo.measured(found, generator).to(scene.poses)
    share = torch.rand(num_outliers - len(on_arm) - len(on_wall), 3, generator=generator, dtype=torch.float64)
    low, high = scene.volume
    clutter = low + share.to(low) * (high - low)
    face = drawn.face[_Owner.SHAPE][:num_inliers]
    weights = drawn.barycentric[_Owner.SHAPE][:num_inliers].to(scene.poses)
    labels = interpolate(scene.skin.weights, scene.faces, face, weights).argmax(-1)
    outliers = torch.cat([found[num_inliers:], clutter])
    pose, vertices = scene.poses[frame], scene.surface[frame]
    return shuffled_cloud(scene.shape, pose, vertices, found[:num_inliers], labels, outliers, generator)
