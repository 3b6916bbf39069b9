"""Depth pictures of rooms: a table before a wall, what stands on it, and a hand or an arm among it, or not.

A camera looks onto the table; depths have the errors of a sensor. Each kind of scene is a function of a seed.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

import torchreg as tr
from torchreg.datasets.hand import random_hand_pose, surface_skin
from torchreg.datasets.solids import mesh_of
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.rotation import so3_exp, so3_log
from torchreg.geometry.visibility import rasterize
from torchreg.geometry.z_buffer import Raster
from torchreg.shapes.skin import LinearBlendSkin

from ..made_up.creature_kinds import HELD_OUT_KINDS, TRAINING_KINDS
from ..made_up.creature_parts import Draw
from ..made_up.depth_noise import DepthNoise
from ..made_up.shape_sequences import other_hand

SENSORS = (DepthNoise.structured_light(), DepthNoise.time_of_flight(), DepthNoise(quadratic=1e-3, jitter=0.3))
WIDTH, HEIGHT, FOCAL = 320, 240, 290.0
TRAINING_SEEDS = 100_000  # seeds from here on are of the calibration


@dataclass(frozen=True)
class Scene:
    """A picture, the shape that is sought, and the truth; None where it is not there.

    Args:
        pose: (num_dofs,) true pose of the shape.
        shown: (H, W) bool, the pixels that show the shape, not its forearm nor what it holds.
        keypoints: (K, 3) true keypoints, metres; of a hand of other proportions not those of the shape in the pose.
    """

    kind: str
    shape: tr.ArticulatedShape
    frame: tr.DepthFrame
    pose: Tensor | None = None
    keypoints: Tensor | None = None
    shown: Tensor | None = None

    def is_right(self, pose: Tensor) -> bool:
        """Return whether a pose is the true one: a hand's fingertips within 15 mm on average, an arm see below."""
        if self.pose is None:
            return False
        if self.keypoints is None:
            return arm_is_right(pose, self.pose)
        tips = slice(4, None, 4)
        return float((self.shape.keypoints(pose)[tips] - self.keypoints[tips]).norm(dim=-1).mean()) <= 0.015

    def is_near(self, pose: Tensor, size: float) -> bool:
        """Return whether a pose lies about on the shape: keypoints within 15 % of its size, metres, on average."""
        if self.pose is None:
            return False
        truth = self.shape.keypoints(self.pose) if self.keypoints is None else self.keypoints
        return float((self.shape.keypoints(pose) - truth).norm(dim=-1).mean()) <= 0.15 * size


def arm_is_right(pose: Tensor, truth: Tensor) -> bool:
    """Return whether a pose of a made-up arm is off by at most 3 degrees, joints and foot, and its foot by 20 mm.

    The foot looks alike after half a turn about its axis, with which the first joint turns back.
    """
    for angle in (0.0, math.pi):
        foot = so3_exp(truth.new_tensor([[0.0, 0.0, angle]]))
        turn = so3_exp(pose[None, 3:6]).mT @ so3_exp(truth[None, 3:6]) @ foot
        joints = pose[6:] - truth[6:]
        joints[0] -= angle
        joints = (joints + math.pi).remainder(2 * math.pi) - math.pi
        off = max(float(so3_log(turn).norm()), float(joints.abs().max()))
        if off <= math.radians(3) and float((pose[:3] - truth[:3]).norm()) <= 0.02:
            return True
    return False


def box(size: Sequence[float]) -> TriangleMesh:
    """Return a box about the origin, sides in metres."""
    corner = torch.tensor([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    faces = [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))]
    return TriangleMesh(corner * torch.tensor(list(size)), torch.tensor(faces))


def turned_solid(radii: Sequence[float], heights: Sequence[float], sides: int = 20) -> TriangleMesh:
    """Return a solid of revolution about z: a can, a cone, a ball."""
    angle = torch.arange(sides) * 2 * math.pi / sides
    ring = torch.stack((angle.cos(), angle.sin()), -1)
    rows = [torch.cat([r * ring, torch.full((sides, 1), float(h))], 1) for r, h in zip(radii, heights, strict=True)]
    vertices = torch.cat([*rows, torch.tensor([[0, 0, heights[0]], [0, 0, heights[-1]]], dtype=torch.float32)])
    faces, last = [], (len(radii) - 1) * sides
    for side in range(sides):
        after = (side + 1) % sides
        for row in range(0, last, sides):
            faces += [
                (row + side, row + after, row + sides + after),
                (row + side, row + sides + after, row + sides + side),
            ]
        faces += [(len(vertices) - 2, after, side), (len(vertices) - 1, last + side, last + after)]
    return TriangleMesh(vertices.float(), torch.tensor(faces))


def ball(radius: float) -> TriangleMesh:
    """Return a ball that stands on z = 0, metres."""
    angles = torch.linspace(-math.pi / 2 + 0.1, math.pi / 2 - 0.1, 12)
    return turned_solid((radius * angles.cos()).tolist(), (radius * angles.sin() + radius).tolist())


def moved(mesh: TriangleMesh, turn: Tensor, place: Tensor) -> TriangleMesh:
    """Return a mesh turned by a rotation (3, 3), then moved by (3,)."""
    return TriangleMesh(mesh.vertices.float() @ turn.float().mT + place.float(), mesh.faces)


def joined(meshes: Sequence[TriangleMesh]) -> TriangleMesh:
    """Return meshes as one."""
    starts = torch.tensor([0, *(mesh.num_vertices for mesh in meshes)]).cumsum(0)
    faces = torch.cat([mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)])
    return TriangleMesh(torch.cat([mesh.vertices for mesh in meshes]), faces)


def made_up_arm(draw: Tensor) -> tr.ArticulatedShape:
    """Return an arm of three hinges with links of boxes and cylinders, by twelve numbers from 0 to 1."""
    long = (0.3 + 0.2 * draw[:2]).tolist()
    wide = (0.06 + 0.06 * draw[2:6]).tolist()
    links = [
        ("base", f"<box size='{2.5 * wide[0]:.3f} {2 * wide[1]:.3f} .12'/>", 0.06),
        ("turret", f"<cylinder radius='{wide[0]:.3f}' length='.14'/>", 0.07),
        ("upper", f"<box size='{wide[1]:.3f} {0.8 * wide[2]:.3f} {long[0]:.3f}'/>", 0.45 * long[0]),
        ("fore", f"<box size='{0.8 * wide[3]:.3f} {wide[2]:.3f} {long[1]:.3f}'/>", 0.45 * long[1]),
    ]
    joints = [("pan", "base", "turret", "0 0 .12", "0 0 1"),
              ("lift", "turret", "upper", f"0 {wide[0]:.3f} .1", "0 1 0"),
              ("elbow", "upper", "fore", f"0 {-wide[1]:.3f} {0.88 * long[0]:.3f}", "0 1 0")]  # fmt: skip
    visual = "<link name='{}'><visual><origin xyz='0 0 {:.3f}'/><geometry>{}</geometry></visual></link>"
    hinge = ("<joint name='{}' type='revolute'><parent link='{}'/><child link='{}'/><origin xyz='{}'/><axis xyz='{}'/>"
             "<limit lower='-2.6' upper='2.6' effort='1' velocity='1'/></joint>")  # fmt: skip
    text = [visual.format(name, at, solid) for name, solid, at in links] + [hinge.format(*joint) for joint in joints]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "arm.urdf"
        file.write_text(f"<robot name='arm'>{''.join(text)}</robot>")
        return tr.ArticulatedShape.from_urdf(file)


def uniform(generator: torch.Generator, low: float, high: float) -> float:
    """Return a number drawn evenly between two."""
    return low + (high - low) * float(torch.rand((), generator=generator))


def clutter(reach: float, generator: torch.Generator, spare: float) -> list[TriangleMesh]:
    """Return things that stand on a table z = 0, none nearer to its middle than a distance."""
    things = []
    for _ in range(int(uniform(generator, 1, 6))):
        size = [uniform(generator, 0.15, 0.5) * reach for _ in range(3)]
        kind = (0, 0, 1, 2)[int(uniform(generator, 0, 4))]  # half of them are boxes
        thing = (box(size), turned_solid([size[0] / 2] * 2, [0, size[2]]), ball(size[0] / 2))[kind]
        lift = size[2] / 2 if kind == 0 else 0.0
        angle, away = uniform(generator, 0, 2 * math.pi), spare + uniform(generator, 0.0, 1.2) * reach
        place = torch.tensor([away * math.cos(angle), away * math.sin(angle), lift])
        turn = so3_exp(torch.tensor([[0.0, 0.0, uniform(generator, 0, math.pi)]]))[0]
        things.append(moved(thing, turn, place))
    return things


def room(size: float, generator: torch.Generator, spare: float) -> list[TriangleMesh]:
    """Return a table z = 0, in two of three pictures a wall behind it, and what stands on it."""
    table = moved(box((6 * size, 6 * size, 0.02)), torch.eye(3), torch.tensor([0.0, 0.0, -0.01]))
    wall = moved(
        box((12 * size, 0.02, 8 * size)), torch.eye(3), torch.tensor([0.0, uniform(generator, 1, 3) * size, 0])
    )
    walls = [wall] if uniform(generator, 0, 3) > 1 else []
    return [table, *walls, *clutter(size, generator, spare)]


def seen_from(size: float, generator: torch.Generator, target: float) -> tuple[Tensor, Tensor]:
    """Return the motion from the world, z up, to a camera that looks at a point above the middle of the table."""
    tilt, around = uniform(generator, 0.25, 1.1), uniform(generator, -0.6, 0.6)
    forward = torch.tensor([math.sin(around) * math.cos(tilt), math.cos(around) * math.cos(tilt), -math.sin(tilt)])
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0])), dim=0)
    turn = torch.stack((right, torch.linalg.cross(forward, right), forward))
    position = torch.tensor([0.0, 0.0, target]) - forward * size * uniform(generator, 1.4, 2.6)
    return turn, -turn @ position


def photographed(
    meshes: Sequence[TriangleMesh],
    generator: torch.Generator,
    sensor: DepthNoise,
    window: int = 0,
    sought: TriangleMesh | None = None,
) -> tuple[tr.DepthFrame, Tensor | None]:
    """Return the picture of meshes in camera coordinates, averaged over windows as by stereo matching.

    What lies behind the camera is left out. With it the pixels (H, W) that show the one that is ``sought``, if any.
    """
    raster, number = seen_faces(meshes)
    depth = torch.where(raster.face_index >= 0, raster.depth, 0.0).float()
    frame = tr.DepthFrame(sensor.measured(averaged(depth, window), generator), camera())
    if sought is None:
        return frame, None
    first = sum(mesh.num_faces for mesh in meshes[: [mesh is sought for mesh in meshes].index(True)])
    return frame, (number >= first) & (number < first + sought.num_faces) & frame.measured


def camera() -> tr.Camera:
    """Return the camera of all pictures, in its own coordinates."""
    return tr.Camera(WIDTH, HEIGHT, (FOCAL, FOCAL, 0.5 * (WIDTH - 1), 0.5 * (HEIGHT - 1)))


def seen_faces(meshes: Sequence[TriangleMesh]) -> tuple[Raster, Tensor]:
    """Return what the camera sees of meshes, and the number (H, W) of each face among all of them, -1 for none."""
    scene = joined(meshes)
    kept = (scene.vertices[scene.faces][..., 2] > 0.05).all(-1).nonzero()[:, 0]
    raster = rasterize(TriangleMesh(scene.vertices, scene.faces[kept]), camera().view())
    return raster, torch.where(raster.face_index >= 0, kept[raster.face_index.clamp_min(0)], -1)


def averaged(depth: Tensor, radius: int, step: float = 0.03) -> Tensor:
    """Return depths (H, W) averaged over the pixels within a radius that differ by less than a step, metres."""
    if radius == 0:
        return depth
    side = 2 * radius + 1
    around = torch.nn.functional.pad(depth, (radius,) * 4).unfold(0, side, 1).unfold(1, side, 1).flatten(-2)
    near = (around > 0) & ((around - depth.unsqueeze(-1)).abs() < step)
    return torch.where(depth > 0, (around * near).sum(-1) / near.sum(-1).clamp_min(1), depth)


def divided(mesh: TriangleMesh, edge: float) -> TriangleMesh:
    """Return a mesh with its long edges cut, so that what a camera does not see of a large face can be left out."""
    vertices, faces = mesh.vertices, mesh.faces
    while True:
        corners = vertices[faces]
        long = (corners - corners.roll(-1, 1)).norm(dim=-1).amax(-1) > edge
        if not bool(long.any()):
            return TriangleMesh(vertices, faces)
        a, b, c = corners[long].unbind(1)
        middles = torch.stack(((a + b) / 2, (b + c) / 2, (c + a) / 2), 1)
        new = len(vertices) + torch.arange(3 * len(a)).reshape(-1, 3)
        p, q, r, old = *new.unbind(1), faces[long]
        parts = [(old[:, 0], p, r), (p, old[:, 1], q), (r, q, old[:, 2]), (p, q, r)]
        vertices = torch.cat([vertices, middles.reshape(-1, 3)])
        faces = torch.cat([faces[~long], *(torch.stack(part, 1) for part in parts)])


def hand_scene(seed: int, there: bool) -> Scene:
    """Return a hand with its forearm over a table, or the table alone."""
    generator = torch.Generator().manual_seed(seed)
    hand, size = tr.Hand(), 0.26
    person, window = varied(seed)
    turn, place = seen_from(size, generator, 0.1 if there else 0.0)
    meshes = [moved(divided(mesh, 0.2), turn, place) for mesh in room(size, generator, 0.4 * size)]
    pose, keys, sought = random_hand_pose(hand, generator, bend=uniform(generator, 0.1, 0.7)), None, None
    if there:
        with torch.no_grad():
            keys = hand.keypoints(pose)
            lift = torch.tensor([0.0, 0.0, uniform(generator, 0.08, 0.2)])
            pose[:3] += turn @ lift + place - keys.mean(0)
            keys, sought = person.keypoints(pose), posed_mesh(surface_skin(person), pose)
            meshes += [sought, forearm(keys)]
    picture, shown = photographed(meshes, generator, SENSORS[seed % len(SENSORS)], window, sought)
    return Scene("hand", hand, picture, pose if there else None, keys, shown)


def varied(seed: int) -> tuple[tr.Hand, int]:
    """Return a hand of other proportions and the radius of a sensor's window; the plain hand and none in tests."""
    if seed < TRAINING_SEEDS:
        return tr.Hand(), 0
    generator = torch.Generator().manual_seed(seed + 1)
    return other_hand(generator, uniform(generator, 0.0, 0.06)), int(uniform(generator, 0, 4))


def forearm(keys: Tensor) -> TriangleMesh:
    """Return a cone behind the wrist of keypoints (21, 3)."""
    way = torch.nn.functional.normalize(keys[0] - keys[[5, 9, 13, 17]].mean(0), dim=0)
    side = torch.nn.functional.normalize(torch.linalg.cross(way, way.roll(1)), dim=0)
    frame = torch.stack((side, torch.linalg.cross(way, side), way), 1)
    return moved(turned_solid([0.026, 0.028, 0.04, 0.045], [-0.005, 0.05, 0.15, 0.3]), frame, keys[0])


def arm_scene(seed: int, there: bool) -> Scene:
    """Return an arm on a table, or the table alone."""
    generator = torch.Generator().manual_seed(seed)
    arm = made_up_arm(torch.rand(12, generator=generator))
    turn, place = seen_from(1.0, generator, 0.35 if there else 0.1)
    meshes = [moved(divided(mesh, 0.7), turn, place) for mesh in room(0.9, generator, 0.6)]
    pose = arm.rest_pose()
    pose[:3] = place
    pose[3:6] = so3_log((turn @ so3_exp(torch.tensor([[0, 0, uniform(generator, -3, 3)]]))[0])[None])[0]
    pose[6:] = torch.tensor([uniform(generator, -2, 2), uniform(generator, -1, 1), uniform(generator, -2, 2)])
    sought = posed_mesh(arm.file_skin(), pose) if there else None
    meshes += [] if sought is None else [sought]
    frame, shown = photographed(meshes, generator, SENSORS[seed % len(SENSORS)], varied(seed)[1], sought)
    return Scene("arm", arm, frame, pose if there else None, shown=shown)


def posed_mesh(skin: LinearBlendSkin, pose: Tensor) -> TriangleMesh:
    """Return the surface of a skin with triangles in a pose (num_dofs,)."""
    return TriangleMesh(skin(pose).detach(), torch.as_tensor(skin.faces))


def held_scene(seed: int, there: bool) -> Scene:
    """Return a hand of other proportions that holds a thing over a table, or a creature of a hand's size instead."""
    generator = torch.Generator().manual_seed(seed)
    size = 0.26
    turn, place = seen_from(size, generator, 0.1)
    meshes = [moved(divided(mesh, 0.2), turn, place) for mesh in room(size, generator, 0.4 * size)]
    lift = torch.tensor([0.0, 0.0, uniform(generator, 0.05, 0.2)])
    keys, pose, sought, window = None, None, None, int(uniform(generator, 0, 4))
    if there:
        hand = other_hand(generator, uniform(generator, 0.0, 0.06))
        pose, skin = random_hand_pose(hand, generator, bend=uniform(generator, 0.2, 0.8)), surface_skin(hand)
        with torch.no_grad():
            pose[:3] += turn @ lift + place - hand.keypoints(pose).mean(0)
            keys, sought = hand.keypoints(pose), posed_mesh(skin, pose)
            meshes += [sought, forearm(keys)]
        grip = keys[[0, 5, 17, 6, 10, 14, 4]].mean(0)
        tilt = so3_exp(torch.randn(1, 3, generator=generator))[0]
        meshes.append(moved(held_thing(generator), tilt, grip))
    else:
        thing = creature(generator, size * uniform(generator, 0.5, 1.0), held_out=seed < TRAINING_SEEDS)
        tilt = so3_exp(torch.tensor([[uniform(generator, 0, 3), 0.0, uniform(generator, -3, 3)]]))[0]
        meshes.append(moved(thing, tilt, turn @ lift + place))
    frame, shown = photographed(meshes, generator, SENSORS[seed % len(SENSORS)], window, sought)
    return Scene("held", tr.Hand(), frame, pose, keys, shown)


def held_thing(generator: torch.Generator) -> TriangleMesh:
    """Return a box, a can, a stick or a ball about the origin."""
    long, wide = uniform(generator, 0.05, 0.2), uniform(generator, 0.01, 0.04)
    return (
        box((wide, 2 * wide, long)),
        turned_solid([wide] * 2, [-long / 2, long / 2]),
        turned_solid([wide / 3] * 2, [-long, long]),
        moved(ball(wide), torch.eye(3), torch.tensor([0.0, 0.0, -wide])),
    )[int(uniform(generator, 0, 4))]


def creature(generator: torch.Generator, size: float, *, held_out: bool) -> TriangleMesh:
    """Return a made-up animal, plant or machine, but no hand, about the origin; its longest side is ``size``."""
    kinds = [kind for name, (kind, _) in (HELD_OUT_KINDS if held_out else TRAINING_KINDS).items() if name != "hand"]
    drawn = kinds[int(uniform(generator, 0, len(kinds)))](Draw(generator))
    mesh = mesh_of([solid for part in drawn.parts for solid in part.solids], spacing=0.03)
    low, high = mesh.vertices.amin(0), mesh.vertices.amax(0)
    scale = size / float((high - low).max())
    return TriangleMesh((scale * (mesh.vertices - (low + high) / 2)).float(), mesh.faces)


# A further kind is one function and one row.
KINDS: dict[str, Callable[[int, bool], Scene]] = {"hand": hand_scene, "arm": arm_scene, "held": held_scene}
