"""Pictures of a moving shape, frame by frame: textured hands with their forearm before a still wall."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from torchreg._checks import check_shape
from torchreg.datasets.hand import faces_of, surface_skin
from torchreg.datasets.stereo import drawn_forearm
from torchreg.geometry.camera_rig import CameraRig, StereoPair
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.rigid import transform_points
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.hand import Hand
from torchreg.shapes.skin import LinearBlendSkin

from ..made_up.pictures import Picture, PictureStyle, backdrop, cameras_of, render


def shape_video(
    shape: ArticulatedShape,
    poses: Tensor,
    cameras: CameraRig | StereoPair,
    *,
    skin: LinearBlendSkin | None = None,
    style: PictureStyle | None = None,
    forearm: bool = True,
    seed: int = 0,
) -> Iterator[list[Picture]]:
    """Yield the pictures of a textured shape in each pose, one per camera, with the exact truth.

    The texture moves with the surface and stays the same over time; the noise of the pictures is drawn anew.

    Args:
        shape: such as a hand.
        poses: (T, num_dofs) in the world of the cameras; `hand_motion` makes some.
        cameras: a pair or a rig.
        skin: of the surface, with faces; by default `surface_skin`.
        style: light, background and noise; for stereo set its wall behind the shape.
        forearm: whether a hand's forearm is seen too. The masks are those of the hand alone.
        seed: of forearm, texture and noise.

    Raises:
        InputError: if the skin has no faces, the poses do not fit, and as `render`.

    Cost: 1 to 2 s per picture of 640 x 480 pixels on one CPU core; the wall is drawn once.
    """
    poses = shape.check_pose(poses, "poses").detach()
    check_shape(poses, "poses", ("T", shape.num_dofs))
    skin = surface_skin(shape) if skin is None else skin
    num_faces = len(faces_of(skin))
    style = PictureStyle() if style is None else style
    rig = cameras_of(cameras)
    generator = torch.Generator().manual_seed(seed)
    behind = [backdrop(camera, style=style, seed=seed) for camera in rig]
    scene = _FilmedShape(shape, skin, forearm, generator)
    with torch.no_grad():
        rest = scene.vertices(shape.rest_pose())
        for pose in poses:
            mesh = TriangleMesh(scene.vertices(pose), scene.faces)
            pictures = (
                render(mesh, camera, rest, style=style, seed=seed, generator=generator, behind=colors)
                for camera, colors in zip(rig, behind, strict=True)
            )
            yield [replace(picture, mask=picture.mask & (picture.face_index < num_faces)) for picture in pictures]


class _FilmedShape:
    """A shape and, if it is a hand, its forearm, as one mesh."""

    def __init__(
        self, shape: ArticulatedShape, skin: LinearBlendSkin, forearm: bool, generator: torch.Generator
    ) -> None:
        self.shape, self.skin, self.faces = shape, skin, faces_of(skin)
        self.arm: TriangleMesh | None = None
        if forearm and isinstance(shape, Hand):
            self.arm = drawn_forearm(shape, generator)
            self.faces = torch.cat((self.faces, self.arm.faces + len(skin.points)))

    def vertices(self, pose: Tensor) -> Tensor:
        """Return the vertices (V, 3) in a pose."""
        surface = self.skin(pose)
        if self.arm is None:
            return surface
        return torch.cat((surface, transform_points(self.shape.part_transforms(pose)[0], self.arm.vertices)))
