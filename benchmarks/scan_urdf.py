"""A robot's description out of scans of it: made-up arms of boxes in a few poses, registered and written as URDF.

An arm has 3 to 7 hinges with axes at random, links of boxes of different sizes, and moves by random steps about each
axis from frame to frame; scans are its whole surface, the same points of it in every frame, which is easier than what
cameras see. Reported are the Rand index of the parts, the median angle of the axes from the nearest true one, and how
far the points of the reference, moved by the found joints, lie from where they truly are, as medians in the worst frame
and over all.

    python benchmarks/scan_urdf.py
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

import torchreg as tr
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.io.urdf import UrdfPrimitive
from torchreg.shapes.posed_tree import PosedTree
from torchreg.shapes.robots import solid_mesh

STEP, SPLITS = 0.25, 3


@dataclass(frozen=True)
class Arm:
    """A made-up arm: vertices (V, 3) in their links' frames, faces, links (V,), and poses (T, 6 + J)."""

    tree: PosedTree
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
            middle = eye.clone()
            middle[2, 3] = length / 2
            box = split(solid_mesh(UrdfPrimitive("box", (width, depth, 0.96 * length), middle)), SPLITS)
            faces.append(box.faces + sum(map(len, pieces)))
            pieces.append(box.vertices)
            link.append(torch.full((box.num_vertices,), number))
        tree = PosedTree(KinematicTree(tuple(rows)), [row.name for row in rows], None, free_base=True).double()
        steps = STEP * torch.randn(frames, joints, generator=draw, dtype=torch.float64)
        steps[0] = 0
        poses = torch.nn.functional.pad(steps.cumsum(0), (6, 0))
        return cls(tree, torch.cat(pieces), torch.cat(faces), torch.cat(link), poses)

    def placed(self) -> Tensor:
        """Return the vertices (T, V, 3) in all frames."""
        frames = self.tree.part_transforms(self.poses)[:, self.link]
        return (frames[..., :3, :3] @ self.vertices.unsqueeze(-1)).squeeze(-1) + frames[..., :3, 3]

    def axes(self) -> Tensor:
        """Return the directions (J, 3) of the joints in the first frame."""
        joints = self.tree.kinematics.tree.joints[1:]
        return torch.tensor([joint.axis for joint in joints], dtype=torch.float64)


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


def show(arm: Arm, name: str) -> None:
    """Print the figures of one arm."""
    placed = arm.placed()
    begin = time.process_time()
    found = tr.register_sequence([tr.RangeScan(frame, arm.faces) for frame in placed])
    middle = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        robot = found.to_urdf(Path(folder) / "robot.urdf")
        shape = tr.ArticulatedShape.from_urdf(Path(folder) / "robot.urdf", dtype=torch.float64)
        skin = shape.file_skin()
        moved = [
            skin(torch.cat([torch.zeros(6, dtype=torch.float64), values])) @ base[:3, :3].mT + base[:3, 3]
            for values, base in zip(robot.joint_values, robot.base, strict=True)
        ]
        reference = skin(torch.zeros(shape.num_dofs, dtype=torch.float64))
    size = float((placed[0].amax(0) - placed[0].amin(0)).norm())
    nearest = torch.cdist(reference, placed[0]).argmin(-1)
    off = torch.stack(
        [(frame - truth[nearest]).norm(dim=-1).median() for frame, truth in zip(moved, placed, strict=True)]
    )
    axes = torch.tensor([joint.axis for joint in robot.tree.joints[1:]], dtype=torch.float64).reshape(-1, 3)
    angles = torch.rad2deg((axes @ arm.axes().mT).abs().clamp_max(1).arccos().amin(-1)) if len(axes) else axes[:, 0]
    kinds = [joint.kind for joint in robot.tree.joints[1:]]
    print(
        f"{name}: {kinds.count('revolute')} hinges and {kinds.count('prismatic')} sliders found, Rand "
        f"{rand_index(robot.part, arm.link):.2f}, axes off {', '.join(f'{a:.1f}' for a in angles.tolist())} degrees; "
        f"points off {100 * float(off.median()) / size:.2f} % of the size, {100 * float(off.max()) / size:.2f} % in "
        f"the worst frame (joints alone: {100 * float(robot.residuals.max()) / size:.2f} %); "
        f"registered in {middle - begin:.0f} CPU s, robot in {time.process_time() - middle:.1f}; "
        f"{math.degrees(STEP):.0f} degrees a step",
        flush=True,
    )


def main(arguments: list[str] | None = None) -> int:
    """Print a line per arm; return 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=10, help="per arm")
    parser.add_argument("--joints", type=int, nargs="+", default=[3, 5, 7], help="of the arms")
    options = parser.parse_args(arguments)
    for joints in options.joints:
        show(Arm.drawn(joints, options.frames, seed=joints), f"{joints} joints, {options.frames} frames")
    return 0


if __name__ == "__main__":
    sys.exit(main())
