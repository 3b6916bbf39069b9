"""Pairs of depth pictures of a room in which a creature moved between them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

import torchreg as tr
from torchreg.geometry.mesh import TriangleMesh, interpolate
from torchreg.geometry.rotation import so3_exp

from ..made_up.creature_parts import Draw
from ..made_up.matching_pairs import PosableBody, two_poses
from ..made_up.rooms import SENSORS, averaged, camera, divided, moved, room, seen_faces, seen_from, uniform


@dataclass(frozen=True, eq=False)
class RoomPair:
    """Two depth pictures of a room in which something moved.

    Args:
        frames: source and target, by one camera.
        masks: (H, W) bool of both, the pixels that show what moved.
        truth: (H, W, 3) where the places of the source's pixels are in the target, metres; NaN off what moved.
        size: diagonal of what moved, metres.
    """

    frames: tuple[tr.DepthFrame, tr.DepthFrame]
    masks: tuple[Tensor, Tensor]
    truth: Tensor
    size: float


def room_pair(body: PosableBody, seed: int, *, size: float = 1.7, shake: float = 0.0) -> RoomPair:
    """Return two pictures of a body, y up, that moved in a room.

    Args:
        body: what moves.
        seed: of the room, the motion, the sensor and the camera.
        size: longest side of the body, metres.
        shake: by which the camera moves between the pictures, standard deviation, radians and metres.
    """
    draw = Draw(torch.Generator().manual_seed(seed))
    generator = draw.generator
    turn, place = seen_from(size, generator, 0.45 * size)
    around = [moved(divided(mesh, 0.4 * size), turn, place) for mesh in room(size, generator, 0.5 * size)]
    sensor, window = SENSORS[seed % len(SENSORS)], int(uniform(generator, 0, 4))
    walk = torch.tensor([uniform(generator, -0.1, 0.1), uniform(generator, -0.1, 0.1), 0.0]) * size
    things = _standing(two_poses(body, draw), uniform(generator, 0, 2 * math.pi), size, walk)
    meshes = [moved(thing, turn, place) for thing in things]
    frames, masks = [], []
    truth = torch.full((0,), math.nan)
    for number, mesh in enumerate(meshes):
        angle, shift = number * shake * torch.randn(2, 3, generator=generator)
        before = so3_exp(angle[None])[0]
        raster, face = seen_faces([moved(part, before, shift) for part in (mesh, *around)])
        depth = averaged(torch.where(face >= 0, raster.depth, 0.0).float(), window)
        frames.append(tr.DepthFrame(sensor.measured(depth, generator), camera()))
        masks.append((face >= 0) & (face < len(mesh.faces)))
        if number == 0:
            truth, on = torch.full((*face.shape, 3), math.nan), masks[0]
            found = face[on], raster.barycentric[on].float()
        else:
            after = moved(mesh, before, shift)
            truth[masks[0]] = interpolate(after.vertices, mesh.faces, *found)
    size = float((meshes[0].vertices.amax(0) - meshes[0].vertices.amin(0)).norm())
    return RoomPair((frames[0], frames[1]), (masks[0], masks[1]), truth, size)


def _standing(
    meshes: tuple[TriangleMesh, TriangleMesh], heading: float, size: float, walk: Tensor
) -> list[TriangleMesh]:
    """Return two meshes, y up, on the plane z = 0, the first one's longest side ``size``, the second one farther."""
    up = torch.tensor([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    turn = so3_exp(torch.tensor([[0.0, 0.0, heading]]))[0] @ up
    posed = [mesh.vertices.float() @ turn.mT for mesh in meshes]
    low, high = posed[0].amin(0), posed[0].amax(0)
    scale, middle = size / float((high - low).max()), (low + high) / 2
    found = []
    for number, (vertices, mesh) in enumerate(zip(posed, meshes, strict=True)):
        foot = torch.cat((middle[:2], vertices.amin(0)[2:]))
        found.append(TriangleMesh(scale * (vertices - foot) + number * walk, mesh.faces))
    return found
