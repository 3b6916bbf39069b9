"""A small renderer: depth, mask and a shaded picture of a mesh whose solid texture sticks to its surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg._checks import check_count, check_positive, check_shape
from torchreg.geometry.camera import Camera
from torchreg.geometry.camera_rig import CameraRig, StereoPair
from torchreg.geometry.mesh import TriangleMesh, interpolate
from torchreg.geometry.rigid import rigid_matrix
from torchreg.geometry.visibility import rasterize

# Smooth noise of several scales: pairs of a wavelength, metres, and its share of the brightness.
_Waves = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class _Texture:
    """Colors, red, green and blue from 0 to 1, and grain of skin and wall."""

    skin: tuple[float, float, float] = (0.78, 0.58, 0.48)  # light skin, its mean
    blotch: tuple[float, float, float] = (0.10, -0.05, -0.06)  # change by blood and melanin
    skin_waves: _Waves = (
        (0.012, 0.10),  # blotches
        (0.005, 0.18),  # folds
        (0.0025, 0.22),  # creases
        (0.0015, 0.16),  # pores
    )
    wall: tuple[float, float, float] = (0.32, 0.40, 0.46)
    wall_waves: _Waves = ((0.05, 0.2), (0.012, 0.25), (0.005, 0.2))
    ambient: float = 0.35  # light from all sides, as a share of all light


_TEXTURE = _Texture()
# Primes that mix the three whole numbers of a lattice point (Teschner et al. 2003); products stay below 2^63.
_PRIMES = (73_856_093, 19_349_663, 83_492_791)


@dataclass(frozen=True, eq=False)
class Picture:
    """A picture with the exact depth, mask and faces.

    Args:
        image: (H, W, 3) from 0 to 1.
        depth: (H, W) metres along the camera's axis, in the middle of every pixel; zero where there is nothing.
        mask: (H, W) bool, on the mesh.
        face_index: (H, W) nearest face of the mesh, -1 where there is none.
    """

    image: Tensor
    depth: Tensor
    mask: Tensor
    face_index: Tensor


@dataclass(frozen=True)
class PictureStyle:
    """Light, background and noise of pictures.

    Args:
        wall: depth of a textured wall straight ahead in the world, along z, metres; None leaves the background plain.
        background: color of a plain background.
        light: direction to the light in the world.
        noise: standard deviation of every channel, of full scale.
        supersampling: rays per pixel along each axis.

    Raises:
        InputError: if a number is out of range.
    """

    wall: float | None = None
    background: tuple[float, float, float] = (0.1, 0.65, 0.2)
    light: tuple[float, float, float] = (-0.3, -0.6, -1.0)
    noise: float = 0.005
    supersampling: int = 2

    def __post_init__(self) -> None:
        check_positive(self.noise, "noise", allow_zero=True)
        check_count(self.supersampling, "supersampling", 1)
        if self.wall is not None:
            check_positive(self.wall, "wall")


def value_noise(points: Tensor, wavelength: float, seed: int = 0) -> Tensor:
    """Return smooth noise (...,) from -1 to 1 at points (..., 3): random values at a lattice, blended between.

    Args:
        points: (..., 3).
        wavelength: spacing of the lattice, in the unit of the points.
        seed: of the values; each is a function of its position alone, the same on every device.

    References: Perlin 1985 (solid texture).
    """
    check_positive(wavelength, "wavelength")
    position = points.double() / wavelength
    cell = position.floor()
    share = position - cell
    share = share * share * (3 - 2 * share)
    total = torch.zeros_like(position[..., 0])
    for corner in range(8):
        step = torch.tensor([corner & 1, corner >> 1 & 1, corner >> 2 & 1], device=points.device)
        weight = torch.where(step > 0, share, 1 - share).prod(-1)
        total = total + weight * _hashed(cell.long() + step, seed)
    return total.to(points.dtype)


def _hashed(cell: Tensor, seed: int) -> Tensor:
    """Return numbers (...,) from -1 to 1, one per lattice point (..., 3)."""
    x, y, z = cell.unbind(-1)
    code = (x * _PRIMES[0]) ^ (y * _PRIMES[1]) ^ (z * _PRIMES[2]) ^ (seed * 2_654_435_761)
    for _ in range(2):
        code = code & 0x7FFFFFFF
        code = ((code >> 15) ^ code) * 0x2C1B3C6D
        code = code & 0x7FFFFFFF
        code = ((code >> 12) ^ code) * 0x297A2D39
    return ((code >> 7) & 0xFFFF).double() / 32767.5 - 1


def skin_color(points: Tensor, seed: int = 0) -> Tensor:
    """Return colors (..., 3) of skin at points (..., 3) of the surface in rest, metres, before any light."""
    blotch = value_noise(points, _TEXTURE.skin_waves[0][0], seed + 100).unsqueeze(-1)
    color = points.new_tensor(_TEXTURE.skin) + 0.5 * (blotch * points.new_tensor(_TEXTURE.blotch))
    return (color * _tone(points, _TEXTURE.skin_waves, seed).unsqueeze(-1)).clamp(0, 1)


def _tone(points: Tensor, waves: _Waves, seed: int) -> Tensor:
    """Return factors (...,) on the brightness at points (..., 3): one plus noise of all wavelengths."""
    noise = sum(share * value_noise(points, wavelength, seed + k) for k, (wavelength, share) in enumerate(waves))
    return 1 + torch.as_tensor(noise)


def render(
    mesh: TriangleMesh,
    camera: Camera,
    rest: Tensor | None = None,
    *,
    style: PictureStyle | None = None,
    seed: int = 0,
    generator: torch.Generator | None = None,
    behind: Tensor | None = None,
) -> Picture:
    """Return the picture that a camera takes of a mesh: solid skin texture, diffuse light, background and noise.

    Args:
        mesh: the surface, oriented outwards, before the camera.
        camera: without distortion, with square pixels.
        rest: (V, 3) vertices in rest, where the texture is looked up, so that it moves with the surface; those of the
            mesh by default.
        style: light, background and noise.
        seed: of the texture.
        generator: of the noise, on the CPU; None draws from a fresh one with seed 0, the same at every call.
        behind: colors of the `backdrop` for this camera, style and seed; it saves most of the time.

    Returns:
        The picture; depth, mask and faces are exact in the middles of pixels.

    Raises:
        InputError: if sizes do not fit, the camera distorts, or the mesh reaches beside or behind it.

    Differentiable: no.

    Cost: 5 s for 640 x 480 pixels, two rays by two and a wall, on one CPU core; 1 s of it beside the wall.
    """
    style = PictureStyle() if style is None else style
    rest = mesh.vertices if rest is None else rest
    check_shape(rest, "rest", (mesh.num_vertices, 3))
    generator = torch.Generator().manual_seed(0) if generator is None else generator
    with torch.no_grad():
        raster = rasterize(mesh, camera.view())
        times = style.supersampling
        fine = _finer(camera, times)
        colors = backdrop(camera, style=style, seed=seed) if behind is None else behind
        check_shape(colors, "behind", (fine.height, fine.width, 3))
        colors = _shaded(mesh, fine, rest.double(), style, seed, colors.double())
        image = torch.nn.functional.avg_pool2d(colors.movedim(-1, 0)[None], times)[0].movedim(0, -1)
        grain = torch.randn(image.shape, generator=generator, dtype=torch.float64).to(image)
        mask = raster.face_index >= 0
        depth = torch.where(mask, raster.depth, _wall_depth(camera, style))
        image = (image + style.noise * grain).clamp(0, 1).float()
        return Picture(image, depth, mask, raster.face_index)


def _finer(camera: Camera, times: int) -> Camera:
    """Return a camera with so many pixels per pixel along each axis."""
    focal, center = camera.intrinsics.split(2)
    intrinsics = torch.cat((focal * times, (center + 0.5) * times - 0.5))
    return Camera(camera.width * times, camera.height * times, intrinsics, camera.world_to_camera)


def _wall_depth(camera: Camera, style: PictureStyle) -> Tensor:
    """Return the depth (H, W) of the wall, zero without one."""
    plain = torch.zeros(camera.height, camera.width, dtype=torch.float64)
    if style.wall is None:
        return plain
    rays = camera.directions(camera.pixel_grid().double())
    ahead = rays[..., 2] > 1e-6
    return torch.where(ahead, (style.wall - camera.position.double()[2]) / torch.where(ahead, rays[..., 2], 1.0), plain)


def backdrop(camera: Camera, *, style: PictureStyle | None = None, seed: int = 0) -> Tensor:
    """Return the background colors (H, W, 3), float32, one per ray: the same for all frames of a sequence.

    Args:
        camera: as in `render`.
        style: see `render`.
        seed: see `render`.
    """
    style = PictureStyle() if style is None else style
    camera = _finer(camera, style.supersampling)
    with torch.no_grad():
        if style.wall is None:
            return torch.tensor(style.background).expand(camera.height, camera.width, 3).clone()
        points = camera.unproject(camera.pixel_grid().double(), _wall_depth(camera, style))
        tone = _tone(points, _TEXTURE.wall_waves, seed + 200)
        return (points.new_tensor(_TEXTURE.wall) * tone.unsqueeze(-1)).float()


def _shaded(mesh: TriangleMesh, camera: Camera, rest: Tensor, style: PictureStyle, seed: int, behind: Tensor) -> Tensor:
    """Return the colors (H, W, 3) of rays through the middles of pixels, those of ``behind`` beside the mesh."""
    raster = rasterize(mesh, camera.view())
    colors = behind.clone()
    seen = raster.face_index >= 0
    face, weights = raster.face_index[seen], raster.barycentric[seen]
    normals = interpolate(mesh.vertex_normals().double(), mesh.faces, face, weights)
    light = torch.nn.functional.normalize(normals.new_tensor(style.light), dim=0)
    lit = (torch.nn.functional.normalize(normals, dim=-1) @ light).clamp(min=0)
    skin = skin_color(interpolate(rest, mesh.faces, face, weights), seed)
    ambient = _TEXTURE.ambient
    colors[seen] = skin * (ambient + (1 - ambient) * lit).unsqueeze(-1)
    return colors.clamp(0, 1)


def stereo_cameras(*, baseline: float = 0.12, focal: float = 800.0, width: int = 640, height: int = 480) -> StereoPair:
    """Return two rectified cameras side by side about the origin, that look along +z with -y up.

    Args:
        baseline: metres between them.
        focal: focal length, pixels; by default that of a 6 mm lens before a 1/3-inch sensor of 640 columns.
        width: of the pictures, pixels.
        height: of the pictures, pixels.
    """
    intrinsics = torch.tensor([focal, focal, 0.5 * (width - 1), 0.5 * (height - 1)], dtype=torch.float64)
    turn = torch.eye(3, dtype=torch.float64)
    steps = (turn.new_tensor([side * 0.5 * baseline, 0.0, 0.0]) for side in (1, -1))
    left, right = (
        Camera(width, height, intrinsics, rigid_matrix(turn, step), name=name)
        for step, name in zip(steps, ("left", "right"), strict=True)
    )
    return StereoPair(left, right)


def camera_ring(
    center: Sequence[float] | Tensor,
    distance: float,
    count: int = 24,
    *,
    focal: float = 600.0,
    width: int = 640,
    height: int = 480,
) -> CameraRig:
    """Return cameras spread evenly over a sphere that look at its middle (the spiral of golden angles).

    Args:
        center: (3,) middle of the sphere, metres.
        distance: of the cameras from it, metres.
        count: two or more.
        focal: focal length, pixels.
        width: of the pictures, pixels.
        height: of the pictures, pixels.
    """
    check_count(count, "count", 2)
    check_positive(distance, "distance")
    middle = torch.as_tensor(center).double()
    turn = torch.arange(count, dtype=torch.float64) * (torch.pi * (3 - 5**0.5))
    rise = 1 - (2 * torch.arange(count, dtype=torch.float64) + 1) / count
    flat = (1 - rise**2).sqrt()
    positions = middle + distance * torch.stack((flat * turn.cos(), rise, flat * turn.sin()), dim=-1)
    cameras = [
        Camera.looking_at(position, middle, focal=focal, width=width, height=height, name=f"camera{k:02d}")
        for k, position in enumerate(positions)
    ]
    return CameraRig(tuple(cameras))


def cameras_of(cameras: CameraRig | StereoPair) -> tuple[Camera, ...]:
    """Return the cameras of a rig, or the left and the right one of a pair."""
    return (cameras.left, cameras.right) if isinstance(cameras, StereoPair) else tuple(cameras)
