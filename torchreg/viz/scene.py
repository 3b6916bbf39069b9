"""Scenes of a viewer as plain data: meshes, clouds and curves, still or moving frame by frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import torch
from torch import Tensor

from torchreg._checks import as_float_tensor, check_shape
from torchreg.errors import InputError
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.rigid import invert_rigid
from torchreg.geometry.upright import Direction, from_front, guess_up, is_before_camera
from torchreg.registration.blend import blend_linear

Color = tuple[float, float, float]

FIELD_OF_VIEW = math.radians(45)
SKIN_COLOR: Color = (0.90, 0.76, 0.66)
# Of a surface whose pose is predicted, without support by data.
PREDICTED_COLOR: Color = (0.72, 0.73, 0.76)


@dataclass(frozen=True)
class _CameraRule:
    """Choice of the camera."""

    one_sided: float = 0.3  # surfaces were seen from one side if the mean of their normals is longer
    num_points: int = 4000  # from which the bounds of the scene are taken
    num_frames: int = 64  # from which bounds and the upright direction are taken


_CAMERA = _CameraRule()


class Frames(Sequence[Tensor]):
    """Points or colors that are made when they are shown, by the number of their frame."""

    def __init__(self, count: int, make: Callable[[int], Tensor]) -> None:
        self._count, self._make = count, make

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, frame: int) -> Tensor:  # type: ignore[override]
        if not 0 <= frame < self._count:
            raise IndexError(frame)
        return self._make(frame)


@dataclass(frozen=True, eq=False)
class MovingMesh:
    """Triangles with moving vertices.

    A frame in which a coordinate is not finite is not shown: the shape was not found in it.

    Args:
        name: in the viewer.
        vertices: (T, V, 3), or (V, 3) of a still mesh.
        faces: (F, 3) int64.
        paint: (V, 3) colors in [0, 1], or one color.
        opacity: from 0 to 1.
        visible: whether it is shown at first.
    """

    name: str
    vertices: Tensor
    faces: Tensor
    paint: Tensor | Color = (0.75, 0.75, 0.78)
    opacity: float = 1.0
    visible: bool = True

    def __post_init__(self) -> None:
        check_shape(self.vertices, f"vertices of {self.name}", ("V", 3), batch=True)
        check_shape(self.faces, f"faces of {self.name}", ("F", 3))
        if isinstance(self.paint, Tensor):
            check_shape(self.paint, f"paint of {self.name}", (self.vertices.shape[-2], 3))

    @property
    def num_frames(self) -> int:
        """Number of frames, 1 of a still mesh."""
        return len(self.vertices) if self.vertices.ndim == 3 else 1

    def points(self, frame: int) -> Tensor:
        """Return the vertices (V, 3) of a frame."""
        return self.vertices[frame] if self.vertices.ndim == 3 else self.vertices

    def patches(self, most: int = 48) -> list[tuple[Tensor, Tensor, Color]]:
        """Return patches of one color each: their vertices (K,) by index, faces (G, 3) over these, color.

        For viewers with one color per mesh. Colors are rounded until there are at most ``most``.
        """
        if not isinstance(self.paint, Tensor):
            return [(torch.arange(self.vertices.shape[-2]), self.faces, self.paint)]
        color = self.paint.detach().cpu().double().clamp(0, 1)[self.faces.cpu()].mean(1)
        for levels in range(7, 1, -1):
            _, group = (color * (levels - 1)).round().unique(dim=0, return_inverse=True)
            count = int(group.max()) + 1 if len(group) else 0
            if count <= most:
                break
        found = []
        for number in range(count):
            used, corner = self.faces.cpu()[group == number].unique(return_inverse=True)
            red, green, blue = color[group == number].mean(0).tolist()
            found.append((used, corner, (red, green, blue)))
        return found


@dataclass(frozen=True, eq=False)
class Joints:
    """Joints that move meshes.

    Args:
        names: J different ones.
        parents: J numbers of the joints above, -1 of roots.
        rest: (J, 4, 4) rigid ``T_world_joint`` of the pose that vertices are in.
        moving: (T, J, 4, 4) rigid ``T_world_joint`` of the frames; NaN in those in which they were not found.
    """

    names: Sequence[str]
    parents: Sequence[int]
    rest: Tensor
    moving: Tensor


@dataclass(frozen=True, eq=False, kw_only=True)
class SkinnedMesh(MovingMesh):
    """Triangles whose vertices (V, 3), those at rest, are moved by joints.

    Args:
        weights: (V, J) of the joints, rows sum to one.
        joints: that move the vertices.
        rigid: whether every triangle hangs on one joint, as the links of robots do.
        normals: (V, 3) at rest; by default those of the triangles.
    """

    weights: Tensor
    joints: Joints
    rigid: bool = False
    normals: Tensor | None = None

    @property
    def num_frames(self) -> int:
        """Number T of frames."""
        return len(self.joints.moving)

    def points(self, frame: int) -> Tensor:
        """Return the vertices (V, 3) of a frame."""
        joints = self.joints
        motions = joints.moving[frame if self.num_frames > 1 else 0] @ invert_rigid(joints.rest)
        return blend_linear(self.vertices, self.weights.to(self.vertices), motions.to(self.vertices)).detach()


@dataclass(frozen=True, eq=False)
class Meshes:
    """Unrelated meshes, one per frame.

    Args:
        name: in the viewer.
        frames: T meshes.
        color: of all.
        opacity: from 0 to 1.
        visible: whether they are shown at first.
    """

    name: str
    frames: Sequence[TriangleMesh]
    color: Color = (0.75, 0.75, 0.78)
    opacity: float = 1.0
    visible: bool = True

    @property
    def num_frames(self) -> int:
        """Number T of frames."""
        return len(self.frames)

    def points(self, frame: int) -> Tensor:
        """Return the vertices (V_t, 3) of a frame."""
        return self.frames[frame if self.num_frames > 1 else 0].vertices


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points.

    Args:
        name: in the viewer.
        frames: T clouds (N_t, 3), or a single still one; `Frames` are checked when they are shown.
        paints: as many colorings, (N_t, 3) in [0, 1] each; or one color.
        size: diameter of a point as a share of the diagonal of the scene.
        visible: whether it is shown at first.
    """

    name: str
    frames: Sequence[Tensor]
    paints: Sequence[Tensor] | Color
    size: float = 0.006
    visible: bool = True

    def __post_init__(self) -> None:
        if isinstance(self.frames, Frames):
            return
        for frame, points in enumerate(self.frames):
            check_shape(points, f"frames[{frame}] of {self.name}", ("N", 3))
        if not self.one_color:
            if len(self.paints) != len(self.frames):
                raise InputError(f"paints of {self.name} must be {len(self.frames)} as the frames, {len(self.paints)}")
            for frame, (points, paint) in enumerate(zip(self.frames, self.paints, strict=True)):
                check_shape(as_float_tensor(paint, "paints"), f"paints[{frame}] of {self.name}", tuple(points.shape))

    @property
    def one_color(self) -> bool:
        """Whether all points have the same color."""
        return isinstance(self.paints, tuple) and len(self.paints) == 3 and isinstance(self.paints[0], float)

    @property
    def num_frames(self) -> int:
        """Number of frames, 1 of a still cloud."""
        return len(self.frames)

    def points(self, frame: int) -> Tensor:
        """Return the points (N, 3) of a frame."""
        return self.frames[frame if self.num_frames > 1 else 0]

    def paint(self, frame: int) -> Tensor:
        """Return the colors (N, 3) of a frame."""
        points = self.points(frame)
        if self.one_color:
            return torch.tensor(self.paints).expand(len(points), 3)
        return as_float_tensor(self.paints[frame if self.num_frames > 1 else 0], "paints").detach().cpu()


@dataclass(frozen=True, eq=False)
class Curves:
    """Polylines in a color each, such as limbs or bones.

    Args:
        name: in the viewer.
        curves: (T, L, S, 3), or (L, S, 3) of still curves.
        paint: (L, 3) colors in [0, 1].
        labels: of the first points of the first curves; none by default.
        dashed: (T, L) curves that pictures show dashed; none by default.
        thickness: as a share of the diagonal of the scene.
        visible: whether they are shown at first.
    """

    name: str
    curves: Tensor
    paint: Tensor
    labels: tuple[str, ...] = ()
    dashed: Tensor | None = None
    thickness: float = 0.006
    visible: bool = True

    def __post_init__(self) -> None:
        check_shape(self.curves, f"curves of {self.name}", ("L", "S", 3), batch=True)
        check_shape(self.paint, f"paint of {self.name}", (self.curves.shape[-3], 3))
        if len(self.labels) > self.curves.shape[-3]:
            raise InputError(f"labels of {self.name} must be at most one per curve, got {len(self.labels)}")

    @property
    def num_frames(self) -> int:
        """Number of frames, 1 of still curves."""
        return len(self.curves) if self.curves.ndim == 4 else 1

    def points(self, frame: int) -> Tensor:
        """Return the curves (L, S, 3) of a frame."""
        return self.curves[frame] if self.curves.ndim == 4 else self.curves


Layer = MovingMesh | Meshes | Cloud | Curves


@dataclass(frozen=True, eq=False)
class Scene:
    """Layers that are shown together.

    Args:
        title: of the page.
        layers: with different names; moving ones have T frames each.
        times: (T,) seconds, strictly increasing; one frame every 1 / 20 second by default.
        up: upright direction; by default that of `geometry.upright.guess_up`.
        facts: key figures in words, by name, shown next to the scene.
        captions: of the frames, in pictures; none by default.

    Raises:
        InputError: if there is no layer, two have one name, or numbers of frames differ.
    """

    title: str
    layers: tuple[Layer, ...]
    times: Tensor | None = None
    up: Direction | None = None
    facts: Mapping[str, str] = field(default_factory=dict)
    captions: Sequence[str] = ()

    def __post_init__(self) -> None:
        names = [layer.name for layer in self.layers]
        if not names or len(set(names)) < len(names):
            raise InputError(f"layers must be one at least and have different names, got {', '.join(names) or 'none'}")
        counts = {layer.num_frames for layer in self.layers} - {1}
        if len(counts) > 1:
            raise InputError(f"layers must have one number of frames, got {', '.join(map(str, sorted(counts)))}")
        if self.times is not None:
            check_shape(self.times, "times", (self.num_frames,))

    @property
    def num_frames(self) -> int:
        """Number T of frames, 1 of a still scene."""
        return max(layer.num_frames for layer in self.layers)

    @property
    def seconds(self) -> list[float]:
        """Times of the frames, starting at zero."""
        if self.times is None:
            return [frame / 20 for frame in range(self.num_frames)]
        return (self.times.double() - float(self.times[0])).tolist()

    def layer(self, name: str) -> Layer:
        """Return the layer of a name; InputError if there is none."""
        for layer in self.layers:
            if layer.name == name:
                return layer
        raise InputError(f"the scene has no layer {name!r}; it has {', '.join(item.name for item in self.layers)}")

    def camera(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return the position, the target and the upright direction of a camera that sees all frames, (3,) each."""
        lower, upper = self.bounds()
        middle = (lower + upper) / 2
        size = (upper - lower).norm().clamp(min=1e-9)
        from_camera = is_before_camera(lower, upper)
        up = torch.tensor(self.up or self._guessed_up()).to(middle)
        facing = self._facing()
        side = torch.linalg.cross(up, facing)
        if facing.norm() > _CAMERA.one_sided and side.norm() > 0.2 * facing.norm():
            # A scan from one side is viewed from that side, a little from the right and above.
            direction = -facing / facing.norm() - 0.3 * side / side.norm() - 0.2 * up
        elif from_camera and float(up[1]) < 0:
            direction = middle - middle.norm() * middle.new_tensor([0.35, -0.25, 0.0])
        else:
            direction = -from_front(up, self.sample())
        direction = direction / direction.norm()
        return middle - 0.5 * size / math.sin(FIELD_OF_VIEW / 2) * direction, middle, up

    def _guessed_up(self) -> Direction:
        """Return the likely upright direction, guessed from the layers that move, or else from all visible ones."""
        layers = self._shown
        count = max(layer.num_frames for layer in layers)
        moving = [layer for layer in layers if layer.num_frames == count]
        return guess_up([torch.cat([layer.points(k).reshape(-1, 3) for layer in moving]) for k in _some_frames(count)])

    def bounds(self) -> tuple[Tensor, Tensor]:
        """Return the lower and upper corner (3,) of all visible layers in all frames."""
        return self.sample().amin(0), self.sample().amax(0)

    @property
    def diagonal(self) -> float:
        """Length of the diagonal of `bounds`."""
        lower, upper = self.bounds()
        return float((upper - lower).norm()) or 1.0

    def _facing(self) -> Tensor:
        """Return the mean normal (3,) of the visible meshes: zero if they are closed, long if scanned from one side."""
        total, area = torch.zeros(3, dtype=torch.float64), 0.0
        for layer in self.layers:
            if isinstance(layer, MovingMesh) and layer.visible:
                corner, second, third = layer.points(0).detach().cpu().double()[layer.faces.cpu()].unbind(1)
                normal = torch.linalg.cross(second - corner, third - corner).nan_to_num()
                total, area = total + normal.sum(0), area + float(normal.norm(dim=-1).sum())
        return total / area if area > 0 else total

    @cached_property
    def _shown(self) -> list[Layer]:
        """Visible layers; clouds, whose outliers reach far, only if nothing else is there."""
        visible = [layer for layer in self.layers if layer.visible] or list(self.layers)
        solid = [layer for layer in visible if not isinstance(layer, Cloud)]
        return [layer for layer in solid if any(bool(x.isfinite().any()) for x in _all_points(layer))] or visible

    def sample(self) -> Tensor:
        """Return evenly chosen points (N, 3) of the visible layers."""
        return self._sample

    @cached_property
    def _sample(self) -> Tensor:
        points = torch.cat([points for layer in self._shown for points in _all_points(layer)])
        points = points[points.isfinite().all(-1)]
        return points[:: max(1, len(points) // _CAMERA.num_points)] if len(points) else points.new_zeros(1, 3)


def _all_points(layer: Layer) -> Iterator[Tensor]:
    for frame in _some_frames(layer.num_frames):
        yield layer.points(frame).detach().reshape(-1, 3).cpu().double()


def _some_frames(count: int) -> range:
    return range(0, count, max(1, count // _CAMERA.num_frames))
