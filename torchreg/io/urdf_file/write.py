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
from torchreg.io.limits import local_path, read_bytes
from torchreg.io.urdf_file.strict_xml import parse_lenient_xml

# Limits of effort and velocity, which the format asks for, where nothing is known.
_UNKNOWN = {"effort": "1", "velocity": "1"}


def save_urdf(
    path: str | os.PathLike[str], name: str, tree: KinematicTree, links: Sequence[str], meshes: Sequence[TriangleMesh]
) -> None:
    """Write a robot, each frame a link, and beside it PATH_meshes with an STL file for each link that has faces."""
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


def save_urdf_with_camera(
    path: str | os.PathLike[str], source: str | os.PathLike[str], parent: str, camera: str, placed: torch.Tensor
) -> None:
    """Write a robot's file again with a camera link, fixed to ``parent`` at ``T_parent_camera`` (4, 4), metres."""
    file, given = local_path(path), local_path(source)
    if file.suffix.lower() != ".urdf":
        raise FormatError(f"{file} must end in .urdf")
    robot = parse_lenient_xml(read_bytes(given))
    taken = {element.get("name") for tag in ("link", "joint") for element in robot.findall(tag)}
    if camera in taken or f"{camera}_joint" in taken:
        raise FormatError(f"{given}: has a link or joint of the name {camera!r} or '{camera}_joint'; rename it")
    for mesh in robot.iter("mesh"):
        name = mesh.get("filename", "")
        if name and ":" not in name and not os.path.isabs(name):
            mesh.set("filename", os.path.relpath(given.resolve().parent / name, file.resolve().parent))
    ET.SubElement(robot, "link", name=camera)
    joint = ET.SubElement(robot, "joint", name=f"{camera}_joint", type="fixed")
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=camera)
    ET.SubElement(joint, "origin", xyz=_numbers(placed[:3, 3].tolist()), rpy=_numbers(_roll_pitch_yaw(placed)))
    ET.indent(robot)
    write_atomic(file, ET.tostring(robot, encoding="utf-8", xml_declaration=True))


def _roll_pitch_yaw(placed: torch.Tensor) -> tuple[float, float, float]:
    """Return the angles about the fixed axes x, y, z, in this order, of a transform (4, 4)."""
    rows = placed[:3, :3].double().tolist()
    cosine = math.hypot(rows[0][0], rows[1][0])
    pitch = math.atan2(-rows[2][0], cosine)
    if cosine < 1e-9:  # roll and yaw turn about one axis there: yaw is zero
        return math.atan2(-rows[1][2], rows[1][1]), pitch, 0.0
    return math.atan2(rows[2][1], rows[2][2]), pitch, math.atan2(rows[1][0], rows[0][0])


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
