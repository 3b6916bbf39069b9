"""A robot's description out of scans of it: made-up arms in a few poses, registered and written as URDF.

An arm has 3 to 7 hinges with axes at random, links of two boxes each, and moves by random steps about each axis from
frame to frame. Its scans are its whole surface, the same points of it in every frame; or with ``--fused`` clouds
without triangles as four depth cameras see it: other points in every frame, noise of 1.5 mm, more of them near one
camera, holes, and what no camera sees is missing. Reported are the Rand index of the parts, the angle and the distance
of each true axis from the nearest one found (that from where its link's frame begins), and how far the points of the
reference, moved by the file's own joints, lie from where they truly are, as medians in the worst frame and over all.

    python benchmarks/scan_urdf.py
    python benchmarks/scan_urdf.py --fused
    python benchmarks/scan_urdf.py --fused --robot ROBOT.urdf     # a robot of a file, in random steps
    python benchmarks/scan_urdf.py --around                       # 5,000 points all around, no normals, any order
    python benchmarks/scan_urdf.py --around --robot A.urdf B.urdf # robots of files, in random poses within limits
    python benchmarks/scan_urdf.py --around --robot strangers     # those of example-robot-data, or of --robots FOLDER
    python benchmarks/scan_urdf.py --data FOLDER                  # a hexapod's ten clouds, against its official URDF
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from public_shapes import robots_folder
from scan_robots import ROBOTS, camera_frame
from scipy.optimize import least_squares, linear_sum_assignment
from torch import Tensor

import torchreg as tr
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.geometry.rigid import invert_rigid
from torchreg.io.urdf import load_urdf
from torchreg.io.urdf_file.record import UrdfPrimitive
from torchreg.registration.robots.model import RobotModel
from torchreg.shapes.posed_tree import PosedTree
from torchreg.shapes.robots import solid_mesh

STEP, SPLITS = 0.25, 3
# Of clouds all around: points each, and joint angles at random up to so much, radians.
POINTS, RANGE = 5000, 0.8
# Robots of others: two arms, two quadrupeds, a hand.
STRANGERS = {name: ROBOTS[name] for name in ("UR5", "Panda", "A1", "Allegro")} | {
    "solo12": "solo_description/robots/solo12.urdf"
}
# A joint is right within so many degrees, and so much of the size; of the hexapod so many meters.
DEGREES, SHARE, METERS = 5.0, 0.02, 0.010


@dataclass(frozen=True)
class Arm:
    """A made-up arm: vertices (V, 3) in their links' frames, faces, links (V,), and poses (T, 6 + J)."""

    tree: PosedTree | tr.ArticulatedShape
    vertices: Tensor
    faces: Tensor
    link: Tensor
    poses: Tensor

    @classmethod
    def drawn(cls, joints: int, frames: int, seed: int) -> Arm:
        """Return an arm with a number of hinges in a number of frames."""
        draw = torch.Generator().manual_seed(seed)
        eye, rows, pieces, faces, link = torch.eye(4, dtype=torch.float64), [], [], [], []
        length = 0.0
        for number in range(joints + 1):
            offset, axis = eye.clone(), torch.nn.functional.normalize(torch.randn(3, generator=draw).double(), dim=0)
            offset[2, 3] = length
            x, y, z = axis.tolist()
            rows.append(Joint(f"joint_{number}", number - 1, offset, "revolute" if number else "fixed", (x, y, z)))
            width, depth, length = (0.08 + 0.06 * torch.rand(3, generator=draw).double()).tolist()
            length *= 2
            # A knob on one side: half a turn of a box alone cannot be seen.
            knob = (width, 0.4 * depth, 0.3 * length)
            sides = (((width, depth, 0.96 * length), 0.0, 0.5), (knob, 0.7 * depth, 0.2 + 0.5 * (number % 2)))
            for size, across, along in sides:
                middle = eye.clone()
                middle[1, 3], middle[2, 3] = across, along * length
                box = split(solid_mesh(UrdfPrimitive("box", size, middle)), SPLITS)
                faces.append(box.faces + sum(map(len, pieces)))
                pieces.append(box.vertices)
                link.append(torch.full((box.num_vertices,), number))
        tree = PosedTree(KinematicTree(tuple(rows)), [row.name for row in rows], None, free_base=True).double()
        steps = STEP * torch.randn(frames, joints, generator=draw, dtype=torch.float64)
        steps[0] *= 2
        poses = torch.nn.functional.pad(steps.cumsum(0), (6, 0))
        return cls(tree, torch.cat(pieces), torch.cat(faces), torch.cat(link), poses)

    @classmethod
    def of_file(cls, path: Path, frames: int, seed: int) -> Arm:
        """Return the robot of a URDF file in a number of frames; steps beyond a joint's limits come back."""
        shape = tr.ArticulatedShape.from_urdf(path, dtype=torch.float64)
        skin, to_part = shape.file_skin(), invert_rigid(shape.part_transforms(torch.zeros_like(shape.rest)))
        link = skin.weights.argmax(-1)
        draw = torch.Generator().manual_seed(seed)
        steps = STEP * torch.randn(frames, shape.num_dofs - 6, generator=draw, dtype=torch.float64)
        steps[0] *= 2
        poses = shape.rest + torch.nn.functional.pad(steps.cumsum(0), (6, 0))
        poses = torch.where(poses > shape.upper, 2 * shape.upper - poses, poses)
        poses = torch.where(poses < shape.lower, 2 * shape.lower - poses, poses)
        vertices = (to_part[link, :3, :3] @ skin.points.unsqueeze(-1)).squeeze(-1) + to_part[link, :3, 3]
        return cls(shape, vertices, skin.faces, link, poses)

    def placed(self) -> Tensor:
        """Return the vertices (T, V, 3) in all frames."""
        frames = self.tree.part_transforms(self.poses)[:, self.link]
        return (frames[..., :3, :3] @ self.vertices.unsqueeze(-1)).squeeze(-1) + frames[..., :3, 3]

    def axes(self) -> tuple[Tensor, Tensor]:
        """Return the directions and points (J, 3) of the joints' axes in the first frame."""
        joints = self.tree.kinematics.tree.joints
        moving = [number for number, joint in enumerate(joints) if joint.kind != "fixed"]
        frames = self.tree.frame_transforms(self.poses[0])[moving]
        axes = torch.tensor([joints[number].axis for number in moving], dtype=torch.float64)
        return (frames[:, :3, :3] @ axes.unsqueeze(-1)).squeeze(-1), frames[:, :3, 3]


def around(arm: Arm, generator: torch.Generator) -> tuple[Arm, list[tr.RangeScan]]:
    """Return an arm in random poses, and clouds of its whole surface, new points in each, without normals."""
    values = RANGE * (2 * torch.rand(len(arm.poses), arm.poses.shape[1] - 6, generator=generator).double() - 1)
    if isinstance(arm.tree, tr.ArticulatedShape):
        # Half turns are the limits of joints that have none.
        lower, upper = arm.tree.lower[6:].clamp_min(-math.pi), arm.tree.upper[6:].clamp_max(math.pi)
        middle = arm.tree.rest[6:].maximum(lower + RANGE).minimum((upper - RANGE).maximum((lower + upper) / 2))
        values = (middle + values).maximum(lower).minimum(upper)
    arm = replace(arm, poses=torch.nn.functional.pad(values, (6, 0)))
    clouds = []
    for frame in arm.placed():
        points = scattered(tr.TriangleMesh(frame, arm.faces), 12 * POINTS, generator)
        clouds.append(tr.RangeScan(points[outside(points)][:POINTS]))
    return arm, clouds


def outside(points: Tensor, views: int = 60, pixel: float = 0.006) -> Tensor:
    """Return which dense points (N, 3) some parallel view from around shows, in pixels of a share of the size."""
    index = torch.arange(views, dtype=torch.float64) + 0.5
    height, turn = 1 - 2 * index / views, index * math.pi * (1 + 5**0.5)
    ring = (1 - height.square()).sqrt()
    size = pixel * float((points.amax(0) - points.amin(0)).norm())
    shown = torch.zeros(len(points), dtype=torch.bool)
    for view in torch.stack([ring * turn.cos(), ring * turn.sin(), height], -1):
        cells = (points @ torch.linalg.svd(view.unsqueeze(0)).Vh[1:].mT / size).floor()
        cell = cells.unique(dim=0, return_inverse=True)[1]
        depth = points @ view
        nearest = torch.full((int(cell.max()) + 1,), -torch.inf, dtype=torch.float64).scatter_reduce(
            0, cell, depth, "amax"
        )
        shown |= depth > nearest[cell] - size
    return shown


def scattered(mesh: tr.TriangleMesh, count: int, generator: torch.Generator) -> Tensor:
    """Return points (count, 3) evenly at random on a mesh."""
    corners = mesh.vertices[mesh.faces]
    a, b, c = corners.unbind(1)
    area = torch.linalg.cross(b - a, c - a).norm(dim=-1)
    chosen = corners[torch.multinomial(area, count, True, generator=generator)]
    # Exponential variables over their sum are even on a triangle.
    shares = -torch.rand(count, 3, generator=generator, dtype=torch.float64).log()
    return (shares.unsqueeze(-1) * chosen).sum(1) / shares.sum(-1, keepdim=True)


@dataclass(frozen=True)
class Score:
    """How many joints are right, of how many; how many found ones are wrong but sure; and errors in stds.

    ``errors``: (2, R) of the right ones' directions and places.
    """

    right: int
    joints: int
    sure: int
    errors: Tensor


def show_around(arm: Arm, name: str, seed: int) -> Score:
    """Print and return the figures of an arm in clouds all around."""
    arm, scans = around(arm, torch.Generator().manual_seed(seed))
    begin = time.process_time()
    found = tr.register_sequence(scans, reference="auto")
    with tempfile.TemporaryDirectory() as folder:
        robot = found.to_urdf(Path(folder) / "robot.urdf")
    spent = time.process_time() - begin
    size = float((arm.placed()[0].amax(0) - arm.placed()[0].amin(0)).norm())
    angles, across, nearest = axis_errors(replace(arm, poses=arm.poses[found.reference :]), robot)
    right = (angles < DEGREES) & (across < SHARE * size)
    stds = torch.rad2deg(robot.axis_std)
    wrong = {n for n in range(len(stds)) if stds[n] < DEGREES} - set(nearest[right].tolist())
    print(
        f"{name}: {int(right.sum())} of {len(right)} joints right, {len(stds)} found, axes off "
        f"{', '.join(f'{a:.2f}' for a in angles.tolist())} degrees, "
        f"{', '.join(f'{100 * a / size:.1f}' for a in across.tolist())} % of the size; stds found "
        f"{', '.join(f'{a:.2f}' for a in stds.tolist())} degrees, {len(wrong)} wrong ones below {DEGREES:.0f}; "
        f"{found.status}, {spent:.0f} CPU s",
        flush=True,
    )
    errors = torch.stack([angles / stds[nearest], across / robot.origin_std[nearest]])[:, right]
    return Score(int(right.sum()), len(right), len(wrong), errors)


def robot_files(names: list[str], folder: Path | None) -> list[Path]:
    """Return the files of robots: of names in `STRANGERS`, of all of these for "strangers", or files themselves."""
    chosen = [own for name in names for own in (STRANGERS if name == "strangers" else [name])]
    return [folder / STRANGERS[name] if folder and name in STRANGERS else Path(name) for name in chosen]


def show_hexapod(folder: Path, generator: torch.Generator | None) -> None:
    """Print how many joints of the hexapod are right, its clouds in their order or in a random one.

    Nobody knows how it stood, so the official robot's axes are fitted to those found: a missing or wrong one is off.
    """
    clouds = torch.from_numpy(np.load(folder / "robot_clouds/hexapod.npz")["points"]).double()
    order = torch.arange(len(clouds)) if generator is None else torch.randperm(len(clouds), generator=generator)
    begin = time.process_time()
    found = tr.register_sequence([tr.RangeScan(cloud) for cloud in clouds[order]], reference="auto")
    with tempfile.TemporaryDirectory() as output:
        robot = found.to_urdf(Path(output) / "robot.urdf")
    spent = time.process_time() - begin
    # In the first cloud it stands about as in the official file's zero pose.
    first = robot.motions()[int((order == 0).nonzero())][[joint.parent for joint in robot.tree.joints[1:]]]
    axes = torch.tensor([joint.axis for joint in robot.tree.joints[1:]], dtype=torch.float64)
    directions = (first[:, :3, :3] @ axes.unsqueeze(-1)).squeeze(-1)
    points = (first[:, :3, :3] @ robot.origins()[1:].unsqueeze(-1)).squeeze(-1) + first[:, :3, 3]
    angles, across = official_errors(folder / "robot_clouds/hexapod_official.urdf", directions, points)
    right = (angles < DEGREES) & (across < METERS)
    print(
        f"hexapod, clouds {order.tolist()}: {int(right.sum())} of {len(right)} joints right, {len(axes)} found; the "
        f"right ones are off by {angles[right].median():.1f} degrees, {1000 * across[right].median():.1f} mm in the "
        f"median; {found.status}, {spent:.0f} CPU s",
        flush=True,
    )


def official_errors(path: Path, directions: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """Return the angles (J,), degrees, and distances (J,) of a robot's axes from those found, each its own.

    The robot's base and joint values are those for which its axes lie best on the found ones, by robust least squares
    with assignments in turn.
    """
    record = load_urdf(path, meshes="skip")
    tree = PosedTree(record.tree, [joint.name for joint in record.tree.joints], None, free_base=True).double()
    arm = Arm(tree, torch.empty(0, 3), torch.empty(0, 3), torch.empty(0), tree.rest.unsqueeze(0))

    def errors(pose: np.ndarray) -> tuple[Tensor, Tensor]:
        axes, origins = replace(arm, poses=torch.from_numpy(pose).unsqueeze(0)).axes()
        off = points - origins.unsqueeze(1)
        across = (off - (off * axes.unsqueeze(1)).sum(-1, keepdim=True) * axes.unsqueeze(1)).norm(dim=-1)
        return torch.linalg.cross(axes.unsqueeze(1), directions.expand_as(off)).norm(dim=-1).clamp_max(
            1
        ).arcsin(), across

    pose = tree.rest.numpy().copy()
    for width in (0.04, 0.02, 0.01, 0.01, 0.01):
        angle, across = errors(pose)
        own = linear_sum_assignment((0.1 * angle + across).clamp_max(5 * width))

        def residuals(pose: np.ndarray, own: tuple[np.ndarray, np.ndarray] = own) -> np.ndarray:
            angle, across = errors(pose)
            return torch.cat([0.1 * angle[own], across[own]]).numpy()

        pose = least_squares(residuals, pose, loss="cauchy", f_scale=width, max_nfev=25).x
    angle, across = errors(pose)
    return torch.rad2deg(angle[own]), across[own]


def fused(placed: Tensor, faces: Tensor, generator: torch.Generator) -> tuple[list[tr.RangeScan], Tensor]:
    """Return clouds of all frames (T, V, 3) by four cameras, and the vertex (N,) nearest to each point of the first."""
    center, away = placed[0].mean(0), torch.tensor([0.0, 0.0, 1.5], dtype=torch.float64)
    frames = [camera_frame(azimuth, 0.35, 2) for azimuth in (0.3, 1.9, 3.6, 5.1)]
    scanners = [DepthScanner(num_points=5000 if k == 0 else 2000, noise=7e-4, hole_radius=0.03) for k in range(4)]
    meshes = [[tr.TriangleMesh((points - center) @ turn.mT + away, faces) for turn in frames] for points in placed]
    views = [scanner.view(mesh, 0.9) for scanner, mesh in zip(scanners, meshes[0], strict=True)]
    clouds, first = [], torch.zeros(0, dtype=torch.long)
    for row in meshes:
        seen = [
            s.scan(mesh, view, generator, torch.float64) for s, mesh, view in zip(scanners, row, views, strict=True)
        ]
        points = [(scan.scan.points - away) @ turn + center for scan, turn in zip(seen, frames, strict=True)]
        normals = [scan.scan.normals @ turn for scan, turn in zip(seen, frames, strict=True)]
        if not clouds:
            first = torch.cat([faces[scan.face].gather(1, scan.barycentric.argmax(1, True))[:, 0] for scan in seen])
        clouds.append(tr.RangeScan(torch.cat(points), normals=torch.cat(normals)))
    return clouds, first


def split(mesh: tr.TriangleMesh, times: int) -> tr.TriangleMesh:
    """Return a mesh whose triangles are split in four some times."""
    for _ in range(times):
        a, b, c = mesh.vertices[mesh.faces].unbind(1)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        triangles = torch.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], 1).reshape(-1, 3)
        vertices, index = triangles.unique(dim=0, return_inverse=True)
        mesh = tr.TriangleMesh(vertices, index.reshape(-1, 3))
    return mesh


def rand_index(first: Tensor, second: Tensor) -> float:
    """Return the share of pairs of points on which two labelings agree."""
    table = torch.zeros(int(first.max()) + 1, int(second.max()) + 1, dtype=torch.float64)
    table.index_put_((first, second), torch.ones(len(first), dtype=torch.float64), accumulate=True)

    def pairs(counts: Tensor) -> float:
        return float((counts * (counts - 1)).sum() / 2)

    total, both = len(first) * (len(first) - 1) / 2, pairs(table)
    return (total + 2 * both - pairs(table.sum(0)) - pairs(table.sum(1))) / total


def axis_errors(arm: Arm, robot: RobotModel) -> tuple[Tensor, Tensor, Tensor]:
    """Return the angles (J,), degrees, and distances of the true axes from the nearest found, and which those are."""
    axes, points = arm.axes()
    found = torch.tensor([joint.axis for joint in robot.tree.joints[1:]], dtype=torch.float64).reshape(-1, 3)
    off = robot.origins()[1:] - points.unsqueeze(1)
    across = (off - (off * axes.unsqueeze(1)).sum(-1, keepdim=True) * axes.unsqueeze(1)).norm(dim=-1)
    angle = (axes @ found.mT).abs().clamp_max(1).arccos()
    # A radian counts as much as half a metre, about the size of an arm.
    nearest = (0.5 * angle + across).argmin(1, keepdim=True)
    return torch.rad2deg(angle.gather(1, nearest)[:, 0]), across.gather(1, nearest)[:, 0], nearest[:, 0]


def show(arm: Arm, name: str, as_clouds: bool) -> None:
    """Print the figures of one arm."""
    placed = arm.placed()
    if as_clouds:
        scans, vertex = fused(placed, arm.faces, torch.Generator().manual_seed(0))
    else:
        scans, vertex = [tr.RangeScan(frame, arm.faces) for frame in placed], torch.arange(placed.shape[1])
    begin = time.process_time()
    found = tr.register_sequence(scans)
    middle = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        robot = found.to_urdf(Path(folder) / "robot.urdf")
        end = time.process_time()
        shape = tr.ArticulatedShape.from_urdf(Path(folder) / "robot.urdf", dtype=torch.float64)
    # The file's own joints, by their names; its links begin at their origins.
    values = [
        dict(zip([j.name for j in robot.tree.joints[1:]], row, strict=True)) for row in robot.joint_values.tolist()
    ]
    poses = torch.tensor([[0.0] * 6 + [row[dof] for dof in shape.dof_names[6:]] for row in values], dtype=torch.float64)
    # A link without points has no part, and no point moves with it.
    order = [{name: n for n, name in enumerate(shape.part_names)}.get(f"link_{k}", 0) for k in range(len(robot.tree))]
    frames = robot.base.unsqueeze(1) @ shape.part_transforms(poses)[:, order]
    local = found.points - robot.origins()[robot.part]
    chosen = frames[:, robot.part]
    moved = (chosen[..., :3, :3] @ local.unsqueeze(-1)).squeeze(-1) + chosen[..., :3, 3]
    size = float((placed[0].amax(0) - placed[0].amin(0)).norm())
    off = (moved - moved[:1] - placed[:, vertex] + placed[:1, vertex]).norm(dim=-1).median(-1).values / size
    angles, across, _ = axis_errors(arm, robot)
    kinds = [joint.kind for joint in robot.tree.joints[1:]]
    print(
        f"{name}: {kinds.count('revolute')} hinges and {kinds.count('prismatic')} sliders found, Rand "
        f"{rand_index(robot.part, arm.link[vertex]):.2f}, axes off {', '.join(f'{a:.1f}' for a in angles.tolist())} "
        f"degrees, origins {', '.join(f'{100 * a / size:.1f}' for a in across.tolist())} % of the size; points off "
        f"{100 * float(off.median()):.2f} %, {100 * float(off.max()):.2f} % in the worst frame; "
        f"registered in {middle - begin:.0f} CPU s, robot in {end - middle:.1f}; "
        f"{math.degrees(STEP):.0f} degrees a step",
        flush=True,
    )


def main(arguments: list[str] | None = None) -> int:
    """Print a line per arm; return 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=10, help="per arm")
    parser.add_argument("--joints", type=int, nargs="+", default=[3, 5, 7], help="of the arms")
    parser.add_argument("--fused", action="store_true", help="clouds of four depth cameras instead of whole surfaces")
    parser.add_argument(
        "--robot", nargs="+", help=f"URDF files to scan instead of made-up arms; or strangers: {', '.join(STRANGERS)}"
    )
    parser.add_argument("--robots", type=Path, default=robots_folder(), help="where example-robot-data's robots are")
    parser.add_argument(
        "--around", action="store_true", help="clouds of the whole surface, without normals, in any order"
    )
    parser.add_argument("--data", type=Path, help="folder of robot_clouds: its hexapod")
    parser.add_argument("--shuffled", action="store_true", help="the hexapod's clouds in a random order")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="of a robot's steps")
    options = parser.parse_args(arguments)
    files = robot_files(options.robot or [], options.robots)
    if options.data:
        for seed in options.seeds:
            show_hexapod(options.data, torch.Generator().manual_seed(seed) if options.shuffled else None)
        return 0
    if options.around:
        scores = []
        for seed in options.seeds:
            arms = [(path.stem, Arm.of_file(path, options.frames, seed)) for path in files] or [
                (f"{count} joints", Arm.drawn(count, options.frames, seed=seed + count)) for count in options.joints
            ]
            scores += [show_around(arm, f"{name}, seed {seed}", seed) for name, arm in arms]
        errors = torch.cat([score.errors for score in scores], 1)
        (direction, place), (most, farthest) = errors.quantile(torch.tensor([0.5, 0.95]).double(), dim=1)
        print(
            f"{sum(score.right for score in scores)} of {sum(score.joints for score in scores)} joints right, "
            f"{sum(score.sure for score in scores)} wrong ones below {DEGREES:.0f} degrees; directions off by "
            f"{direction:.1f} stds in the median, {most:.1f} in 95 of 100, places by {place:.1f} and {farthest:.1f}"
        )
        return 0
    for path in files:
        for seed in options.seeds:
            arm = Arm.of_file(path, options.frames, seed)
            show(arm, f"{path.stem}, seed {seed}, {options.frames} frames", options.fused)
    for joints in () if files else options.joints:
        show(Arm.drawn(joints, options.frames, seed=joints), f"{joints} joints, {options.frames} frames", options.fused)
    return 0


if __name__ == "__main__":
    sys.exit(main())
