"""A shape among other things: whole depth pictures of rooms, tables and crates, with it and without.

    python benchmarks/scenes.py                         # 60 pictures of hands and arms, some minutes
    python benchmarks/scenes.py --calibrate --count 68  # on other seeds: weights of what else may explain a picture
    python benchmarks/scenes.py --smoke                 # two pictures, to see that it runs

Each picture is drawn: a camera looks onto a table before a wall, with crates, cans and balls on it; a hand with its
forearm held over it, or an arm of random links that stands on it; in half of them neither. Depths have the errors of a
sensor. No mask, no start. A hand is right if its fingertips are off by at most 15 mm on average, an arm if its joints
are by at most 3 degrees and its base by 20 mm. Sure means that the status is usable.

Bars: of the pictures without the thing, sure in at most 1 %; of those with it, right in 80 %; the area under the curve
of the confidence .95.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).parent))
from confidence import area_under_curve

import torchreg as tr
from experiments.made_up.depth_noise import DepthNoise
from torchreg.alignment.evidence.reliability import CALIBRATION
from torchreg.datasets.hand import random_hand_pose, surface_skin
from torchreg.geometry.mesh import TriangleMesh
from torchreg.geometry.rotation import so3_exp, so3_log
from torchreg.geometry.visibility import rasterize

SENSORS = (DepthNoise.structured_light(), DepthNoise.time_of_flight(), DepthNoise(quadratic=1e-3, jitter=0.3))
WIDTH, HEIGHT, FOCAL = 320, 240, 290.0
TRAINING_SEEDS = 100_000  # seeds from here on are of the calibration
NUM_WEIGHTS = 2  # the last ones of the model: what else may explain a picture


@dataclass(frozen=True)
class Scene:
    """A picture, the shape that is sought, and its true pose; None where it is not there."""

    kind: str
    shape: tr.ArticulatedShape
    frame: tr.DepthFrame
    pose: Tensor | None


@dataclass(frozen=True)
class Row:
    """What came out of a scene."""

    kind: str
    there: bool
    right: bool
    sure: bool
    confidence: float
    evidence: Tensor
    seconds: float


def box(size: Sequence[float]) -> TriangleMesh:
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
    angles = torch.linspace(-math.pi / 2 + 0.1, math.pi / 2 - 0.1, 12)
    return turned_solid((radius * angles.cos()).tolist(), (radius * angles.sin() + radius).tolist())


def moved(mesh: TriangleMesh, turn: Tensor, place: Tensor) -> TriangleMesh:
    return TriangleMesh(mesh.vertices.float() @ turn.float().mT + place.float(), mesh.faces)


def joined(meshes: Sequence[TriangleMesh]) -> TriangleMesh:
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


def photographed(meshes: Sequence[TriangleMesh], generator: torch.Generator, sensor: DepthNoise) -> tr.DepthFrame:
    """Return the picture of meshes in camera coordinates; what lies behind the camera is left out."""
    scene = joined(meshes)
    kept = (scene.vertices[scene.faces][..., 2] > 0.05).all(-1)
    camera = tr.Camera(WIDTH, HEIGHT, (FOCAL, FOCAL, 0.5 * (WIDTH - 1), 0.5 * (HEIGHT - 1)))
    raster = rasterize(TriangleMesh(scene.vertices, scene.faces[kept]), camera.view())
    depth = torch.where(raster.face_index >= 0, raster.depth, 0.0).float()
    return tr.DepthFrame(sensor.measured(depth, generator), camera)


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
    turn, place = seen_from(size, generator, 0.1 if there else 0.0)
    meshes = [moved(divided(mesh, 0.2), turn, place) for mesh in room(size, generator, 0.4 * size)]
    pose = random_hand_pose(hand, generator, bend=uniform(generator, 0.1, 0.7))
    if there:
        with torch.no_grad():
            keys = hand.keypoints(pose)
            lift = torch.tensor([0.0, 0.0, uniform(generator, 0.08, 0.2)])
            pose[:3] += turn @ lift + place - keys.mean(0)
            keys, skin = hand.keypoints(pose), surface_skin(hand)
            meshes += [TriangleMesh(skin(pose), skin.faces), forearm(keys)]
    sensor = SENSORS[seed % len(SENSORS)]
    return Scene("hand", hand, photographed(meshes, generator, sensor), pose if there else None)


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
    if there:
        skin = arm.file_skin()
        meshes.append(TriangleMesh(skin(pose).detach(), skin.faces))
    sensor = SENSORS[seed % len(SENSORS)]
    return Scene("arm", arm, photographed(meshes, generator, sensor), pose if there else None)


def is_right(scene: Scene, pose: Tensor) -> bool:
    """Return whether a pose is the true one, within what is asked."""
    if scene.pose is None:
        return False
    if scene.kind == "hand":
        tips = slice(4, None, 4)
        off = scene.shape.keypoints(pose)[tips] - scene.shape.keypoints(scene.pose)[tips]
        return float(off.norm(dim=-1).mean()) <= 0.015
    off = scene.shape.difference(pose, scene.pose).abs()
    return float(off[6:].max()) <= math.radians(3) and float((pose[:3] - scene.pose[:3]).norm()) <= 0.02


def measure(seed: int) -> Row:
    there = seed % 4 < 2
    scene = (hand_scene, arm_scene)[seed % 2](seed, there)
    begin = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = tr.align(scene.shape, scene.frame)
    return Row(
        kind=scene.kind, there=there, right=is_right(scene, found.pose), sure=found.status.usable,
        confidence=float(found.confidence), evidence=found.evidence, seconds=time.process_time() - begin,
    )  # fmt: skip


def collect(count: int, start: int) -> list[Row]:
    return [measure(start + number) for number in tqdm(range(count), desc="pictures", leave=False, disable=None)]


def calibrated(rows: Sequence[Row]) -> tuple[float, ...]:
    """Return the weights of the other explanations, all others held, of highest likelihood on rows."""
    table = torch.stack([row.evidence for row in rows]).double()
    right = torch.tensor([float(row.right) for row in rows], dtype=torch.float64)
    held = torch.tensor(CALIBRATION.weights[:-NUM_WEIGHTS], dtype=torch.float64)
    odds = CALIBRATION.bias - table[:, :-NUM_WEIGHTS] @ held
    free = torch.ones(NUM_WEIGHTS, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.LBFGS([free], max_iter=100, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        optimizer.zero_grad()
        weights = torch.nn.functional.softplus(free)
        value = torch.nn.functional.binary_cross_entropy_with_logits(odds - table[:, -NUM_WEIGHTS:] @ weights, right)
        value = value + 1e-4 * weights.square().sum()
        value.backward()
        return value

    optimizer.step(loss)
    return tuple(round(float(weight), 2) for weight in torch.nn.functional.softplus(free.detach()))


def render(rows: Sequence[Row]) -> str:
    """Return the table by kind, with its bars."""
    lines = []
    for kind in sorted({row.kind for row in rows}):
        shown = [row for row in rows if row.kind == kind and row.there]
        absent = [row for row in rows if row.kind == kind and not row.there]
        right, lies = sum(row.right for row in shown), sum(row.sure and not row.right for row in shown)
        sure = sum(row.sure and row.right for row in shown)
        seconds = sorted(row.seconds for row in rows if row.kind == kind)
        lines.append(
            f"{kind:5} there {len(shown):3}: right {right:3}, sure and right {sure:3}, "
            f"sure and wrong {lies:3} | absent {len(absent):3}: sure {sum(row.sure for row in absent):3} | median "
            f"{seconds[len(seconds) // 2]:.1f} CPU s"
        )
    area = area_under_curve(torch.tensor([row.confidence for row in rows]), torch.tensor([row.right for row in rows]))
    lines.append(f"area under the curve of the confidence {area:.3f}  >= .95: {'pass' if area >= 0.95 else 'FAIL'}")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=60, help="pictures")
    parser.add_argument("--calibrate", action="store_true", help="fit the weights of the other explanations")
    parser.add_argument("--smoke", action="store_true", help="two pictures")
    given = parser.parse_args(arguments)
    rows = collect(2 if given.smoke else given.count, TRAINING_SEEDS if given.calibrate else 0)
    print(render(rows))
    if given.calibrate:
        print("weights of the other explanations:", calibrated(rows))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
