"""What a pair of cameras measures of a shape in given poses, background and forearm included; exact truth."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from torchreg._checks import check_positive, check_shape
from torchreg.datasets.hand import HandCloud, shuffled_cloud, surface_skin
from torchreg.errors import InputError
from torchreg.geometry.mesh import TriangleMesh, interpolate
from torchreg.geometry.rigid import transform_points
from torchreg.geometry.rotation import so3_exp
from torchreg.geometry.visibility import Raster, View, rasterize
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.hand import Hand
from torchreg.shapes.skin import LinearBlendSkin

# Shares of the outliers; the rest is spread over the working volume.
_ON_FOREARM, _ON_WALL = 0.4, 0.3
# Points per pixel of an obstacle over those of the shape: it has less texture.
_OBSTACLE_TEXTURE = 0.08
# Grown by this share of its diagonal, the box of all frames is the working volume.
_VOLUME_MARGIN = 0.1
# The wall stands this many times as far as the farthest point of the shape, tilted by slopes up to the second.
_WALL_DEPTH, _WALL_SLOPE = 1.5, 0.2
# Rings of the forearm in radii of the palm: along the bone, half width, half thickness. The first lies inside the palm.
_FOREARM = ((0.2, 0.5, 0.65), (-0.2, 0.6, 1.15), (-1.5, 0.7, 1.5), (-4.0, 0.9, 2.1))
_FOREARM_SIDES, _FOREARM_BEND = 24, math.radians(12)
_SHAPE, _ARM, _OBSTACLE = 0, 1, 2


@dataclass(frozen=True)
class StereoView:
    """Two pinhole cameras side by side that look along +z with -y up, and how well they measure.

    The left one stands at (-baseline / 2, 0, 0), the right one at (+baseline / 2, 0, 0). A point at depth z has the
    disparity ``focal * baseline / z``, so that an error of the disparity moves it along its ray by
    ``z^2 * disparity_noise / (focal * baseline)``: 1.5 mm at 0.6 m as it comes.

    Args:
        baseline: metres between the cameras.
        focal: focal length, pixels.
        width: pixels per row.
        height: pixels per column.
        disparity_noise: standard deviation of the disparity, pixels.
        lateral_noise: standard deviation of both picture coordinates, pixels.

    Raises:
        InputError: if a number is not positive; both kinds of noise may be zero.
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
        places = torch.tensor([[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0]], dtype=torch.float64) * self.baseline
        left, right = (View(place, upright, corner, 1 / self.focal, self.width, self.height) for place in places)
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
    """Return what a pair of cameras measures of a shape in given poses, one cloud per pose, with the exact truth.

    Points lie at pixels of the left picture whose surface the right camera sees too, drawn uniformly from them. Four
    tenths of the outliers lie on a forearm behind the wrist, where the shape is a hand and as far as it is seen, three
    tenths on a wall behind the shape, the rest uniformly in the working volume: the box of all frames, slightly grown.
    An obstacle hides what is behind it and adds outliers of its own, 8 % as dense as the points of the shape.

    Args:
        shape: the true shape.
        poses: (T, num_dofs) true poses, before the cameras.
        stereo: the cameras and their noise; `StereoView` by default.
        skin: what moves the true surface, with faces that look outwards; by default `surface_skin`.
        num_points: points on the shape in the frame that shows most of it; others have fewer in proportion to what
            both cameras see.
        outlier_ratio: outliers as a share of all points in that frame, at least 0 and below 1; every frame has the
            same number. Points on an obstacle come on top.
        obstacle: a thing that stands still, faces outwards, metres.
        seed: of forearm, wall and measurements.

    Returns:
        T clouds, in the shape's dtype and on its device; a hidden shape leaves outliers alone.

    Raises:
        InputError: if an argument is out of range, the skin has no faces, something reaches behind the cameras or no
            frame shows the shape.
    """
    poses = shape.check_pose(poses, "poses").detach()
    check_shape(poses, "poses", ("T", shape.num_dofs))
    if isinstance(num_points, bool) or not isinstance(num_points, int) or num_points < 1:
        raise InputError(f"num_points must be a positive integer, got {num_points!r}")
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
        glances = [_glance(scene, frame, stereo, keep, generator) for frame in range(len(poses))]
        most = max(glance.counts[_SHAPE] for glance in glances)
        if not most:
            raise InputError("poses must show the shape to both cameras in one frame at least; they look along +z")
        return [
            _cloud(scene, frame, stereo, glance, num_points / most, num_outliers, generator)
            for frame, glance in enumerate(glances)
        ]


@dataclass(frozen=True, eq=False)
class _Scene:
    """All that stands before the cameras: the shape, its forearm if it is a hand, an obstacle, a wall.

    Args:
        shape: the true shape.
        skin: its surface.
        poses: (T, num_dofs).
        surface: (T, V, 3) vertices of the skin.
        others: (T, W, 3) vertices of forearm and obstacle.
        faces: (F, 3) of the skin, the forearm and the obstacle.
        owners: (F,) which of the three each face belongs to.
        volume: (2, 3) lower and upper corner of the working volume.
        wall: (3,) depth of the wall straight ahead, and its slopes along x and y.
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
) -> _Scene:
    if skin.faces is None:
        raise InputError("skin must have faces to draw points from; make it with surface_skin(shape)")
    draws = 2 * torch.rand(4, generator=generator, dtype=torch.float64).to(poses) - 1
    nothing = TriangleMesh(poses.new_zeros(0, 3), skin.faces[:0])
    arm = _forearm(shape, draws[:2]) if isinstance(shape, Hand) else nothing
    still = nothing if obstacle is None else obstacle.to(poses)
    surface = skin(poses)
    carried = transform_points(shape.part_transforms(poses)[:, 0], arm.vertices.expand(len(poses), -1, 3))
    others = torch.cat([carried, still.vertices.expand(len(poses), -1, 3)], dim=1)
    start = surface.shape[1]
    faces = [skin.faces, arm.faces + start, still.faces + start + arm.num_vertices]
    owners = torch.arange(3, device=poses.device).repeat_interleave(
        torch.tensor([len(part) for part in faces], device=poses.device)
    )
    low, high = surface.flatten(0, 1).amin(0), surface.flatten(0, 1).amax(0)
    margin = _VOLUME_MARGIN * (high - low).norm()
    wall = torch.cat([_WALL_DEPTH * high[2:], _WALL_SLOPE * draws[2:]]).double()
    volume = torch.stack([low - margin, high + margin])
    return _Scene(shape, skin, poses, surface, others, torch.cat(faces), owners, volume, wall)


def drawn_forearm(hand: Hand, generator: torch.Generator) -> TriangleMesh:
    """Return a forearm in the frame of the palm, bent at the wrist by random angles."""
    return _forearm(hand, 2 * torch.rand(2, generator=generator, dtype=torch.float64).to(hand.rest) - 1)


def _forearm(hand: Hand, bend: Tensor) -> TriangleMesh:
    """Return a tapering tube behind the wrist, in the frame of the palm, bent there by shares of the largest angle."""
    rings = (hand.radii.new_tensor(_FOREARM) * hand.radii[0][[2, 0, 1]]).unsqueeze(1)
    around = torch.arange(_FOREARM_SIDES, device=rings.device) * (2 * math.pi / _FOREARM_SIDES)
    across, thick = rings[..., 1] * around.cos(), rings[..., 2] * around.sin()
    rings = torch.stack([across, thick, rings[..., 0].expand_as(across)], dim=-1)
    turn = so3_exp(torch.cat([_FOREARM_BEND * bend, torch.zeros_like(bend[:1])]))
    return tube(rings @ turn.mT)


def tube(rings: Tensor) -> TriangleMesh:
    """Return the open tube through rings (R, S, 3), outside out where rings run clockwise seen from the next one."""
    levels, sides = rings.shape[:2]
    here = torch.arange(levels - 1).unsqueeze(-1) * sides + torch.arange(sides)
    after = here.roll(-1, dims=1)
    quads = torch.stack([here, here + sides, after + sides, after], dim=-1).flatten(0, 1)
    return TriangleMesh(rings.flatten(0, 1), torch.cat([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]))


@dataclass(frozen=True, eq=False)
class _Glance:
    """What both cameras see of a frame: how many pixels of each owner, and some of them, drawn in random order.

    Args:
        counts: pixels that show the shape, the forearm and the obstacle.
        points: per owner (N, 3) double, without noise.
        face: per owner (N,).
        barycentric: per owner (N, 3).
        wall: (N, 3) points on the wall, drawn likewise.
    """

    counts: list[int]
    points: list[Tensor]
    face: list[Tensor]
    barycentric: list[Tensor]
    wall: Tensor


def _glance(scene: _Scene, frame: int, stereo: StereoView, keep: int, generator: torch.Generator) -> _Glance:
    """Return what both cameras see of a frame, at most ``keep`` points of each kind."""
    mesh, (view, other) = scene.mesh(frame), stereo.views()
    left, right = rasterize(mesh, view, cull_back=True), rasterize(mesh, other, cull_back=True)
    shown = torch.where(_also_seen(left, right, stereo), left.face_index, -1).flatten()
    pixels = (shown >= 0).nonzero()[:, 0]
    corners = mesh.vertices[mesh.faces[shown[pixels]]].double()
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    # Where a surface curves away from the right camera, its outline is a pixel off.
    pixels = pixels[((other.position.to(corners) - corners[:, 0]) * normals).sum(-1) > 0]
    owners = scene.owners[shown[pixels]]
    counts, points, faces, weights = [], [], [], []
    vertices = mesh.vertices.double()
    for owner in (_SHAPE, _ARM, _OBSTACLE):
        own = pixels[owners == owner]
        drawn = own[torch.randperm(len(own), generator=generator)[:keep].to(own.device)]
        counts.append(len(own))
        faces.append(shown[drawn])
        weights.append(left.barycentric.flatten(0, 1)[drawn])
        points.append(interpolate(vertices, mesh.faces, faces[-1], weights[-1]))
    return _Glance(counts, points, faces, weights, _wall_points(scene.wall, left, right, stereo, keep, generator))


def _also_seen(left: Raster, right: Raster, stereo: StereoView) -> Tensor:
    """Return at which pixels (H, W) of the left picture there is a surface that the right camera sees too."""
    columns = torch.arange(left.depth.shape[1], device=left.depth.device) + 0.5
    column = (columns - stereo.focal * stereo.baseline / left.depth).floor().long()
    # A pixel to each side: there, slanted surfaces are nearer than at the point itself.
    reach = torch.nn.functional.max_pool2d(right.depth[None], (1, 3), stride=1, padding=(0, 1))[0]
    there = reach.gather(1, column.clamp(0, len(columns) - 1))
    return (left.face_index >= 0) & (column >= 0) & (left.depth <= there + left.depth / stereo.focal)


def _wall_points(
    wall: Tensor, left: Raster, right: Raster, stereo: StereoView, count: int, generator: torch.Generator
) -> Tensor:
    """Return up to ``count`` points of the wall that nothing hides from either camera, double."""
    free = torch.isinf(left.depth).flatten().nonzero()[:, 0]
    # Some of them the right camera does not see.
    drawn = free[torch.randperm(len(free), generator=generator)[: 2 * count].to(free.device)]
    row, column = drawn // stereo.width, drawn % stereo.width
    along = (column + 0.5 - stereo.width / 2) / stereo.focal
    down = (row + 0.5 - stereo.height / 2) / stereo.focal
    depth = (wall[0] - wall[1] * stereo.baseline / 2) / (1 - wall[1] * along - wall[2] * down)
    other = (column + 0.5 - stereo.focal * stereo.baseline / depth).floor().long()
    seen = (other >= 0) & torch.isinf(right.depth[row, other.clamp(min=0)])
    points = torch.stack([along * depth - stereo.baseline / 2, down * depth, depth], dim=-1)
    return points[seen][:count]


def _cloud(
    scene: _Scene,
    frame: int,
    stereo: StereoView,
    glance: _Glance,
    density: float,
    num_outliers: int,
    generator: torch.Generator,
) -> HandCloud:
    """Return the cloud of a frame with ``density`` points per pixel of the shape."""
    num_inliers = round(density * glance.counts[_SHAPE])
    on_arm = glance.points[_ARM][: round(_ON_FOREARM * num_outliers)]
    on_wall = glance.wall[: round(_ON_WALL * num_outliers)]
    on_obstacle = glance.points[_OBSTACLE][: round(_OBSTACLE_TEXTURE * density * glance.counts[_OBSTACLE])]
    found = torch.cat([glance.points[_SHAPE][:num_inliers], on_arm, on_wall, on_obstacle])
    found = stereo.measured(found, generator).to(scene.poses)
    place = torch.rand(num_outliers - len(on_arm) - len(on_wall), 3, generator=generator, dtype=torch.float64)
    low, high = scene.volume
    clutter = low + place.to(low) * (high - low)
    face, weights = glance.face[_SHAPE][:num_inliers], glance.barycentric[_SHAPE][:num_inliers].to(scene.poses)
    labels = interpolate(scene.skin.weights, scene.faces, face, weights).argmax(-1)
    outliers = torch.cat([found[num_inliers:], clutter])
    pose, vertices = scene.poses[frame], scene.surface[frame]
    return shuffled_cloud(scene.shape, pose, vertices, found[:num_inliers], labels, outliers, generator)
