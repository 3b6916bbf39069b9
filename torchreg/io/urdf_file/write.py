"""Writing robot descriptions (URDF): a kinematic tree with one mesh a link."""

from __future__ import annotations

import math
import os
import xml.etree.ElementTree as ET
from collections.abc import Sequence

import numpy as np
import torch

from torchreg.errors import FormatError
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.geometry.mesh import TriangleMesh
from torchreg.io.atomic import write_atomic
from torchreg.io.limits import local_path

# Limits of effort and velocity, which the format asks for, where nothing is known.
_UNKNOWN = {"effort": "1", "velocity": "1"}


def save_urdf(
    path: str | os.PathLike[str], name: str, tree: KinematicTree, links: Sequence[str], meshes: Sequence[TriangleMesh]
) -> None:
    """Write a robot: PATH.urdf, and beside it a folder PATH_meshes with an STL file for each link.

    Args:
        path: of the .urdf file.
        name: of the robot.
        tree: one frame a link, whose offsets do not turn; no joint mimics another.
        links: names of the links, in the order of the tree's frames.
        meshes: of the links in their frames, metres; links without faces get none.
    """
    file = local_path(path)
    if file.suffix.lower() != ".urdf":
        raise FormatError(f"{file} must end in .urdf")
    folder = file.with_name(f"{file.stem}_meshes")
    folder.mkdir(exist_ok=True)
    robot = ET.Element("robot", name=name)
    for link, mesh in zip(links, meshes, strict=True):
        element = ET.SubElement(robot, "link", name=link)
        if mesh.num_faces == 0:
            continue
        write_atomic(folder / f"{link}.stl", _stl(mesh))
        for role in ("visual", "collision"):
            geometry = ET.SubElement(ET.SubElement(element, role), "geometry")
            ET.SubElement(geometry, "mesh", filename=f"{folder.name}/{link}.stl")
    for joint, link in zip(tree.joints, links, strict=True):
        if joint.parent >= 0:
            _add_joint(robot, joint, links[joint.parent], link)
    ET.indent(robot)
    write_atomic(file, ET.tostring(robot, encoding="utf-8", xml_declaration=True))


def _add_joint(robot: ET.Element, joint: Joint, parent: str, child: str) -> None:
    unlimited = joint.kind == "revolute" and not math.isfinite(joint.lower)
    element = ET.SubElement(robot, "joint", name=joint.name, type="continuous" if unlimited else joint.kind)
    ET.SubElement(element, "parent", link=parent)
    ET.SubElement(element, "child", link=child)
    ET.SubElement(element, "origin", xyz=_numbers(joint.offset[:3, 3].tolist()), rpy="0 0 0")
    if joint.kind != "fixed":
        ET.SubElement(element, "axis", xyz=_numbers(joint.axis))
        if not unlimited:
            ET.SubElement(element, "limit", {"lower": repr(joint.lower), "upper": repr(joint.upper)} | _UNKNOWN)


def _numbers(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values)


def _stl(mesh: TriangleMesh) -> bytes:
    """Return a mesh as a binary STL file."""
    rows = np.zeros(mesh.num_faces, dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    rows["normal"] = mesh.face_normals().cpu().to(torch.float32).numpy()
    rows["corners"] = mesh.vertices[mesh.faces].detach().cpu().to(torch.float32).numpy()
    return b"\0" * 80 + np.uint32(mesh.num_faces).tobytes() + rows.tobytes()
