"""Reading robot descriptions (URDF): the kinematic tree, joint limits, link meshes and link primitives."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchreg._checks import check_choice
from torchreg.errors import FormatError, ModelError
from torchreg.geometry.kinematic_tree import Joint, KinematicTree
from torchreg.geometry.mesh import TriangleMesh, concatenate
from torchreg.io.file_format import check_stand_in, naming, warn
from torchreg.io.limits import DEFAULT_LIMITS, FILE_BUDGET, FileLimits, check_allowed, local_path, read_bytes
from torchreg.io.urdf_file.mesh_files import MeshFiles
from torchreg.io.urdf_file.record import UrdfPrimitive, UrdfRecord
from torchreg.io.urdf_file.strict_xml import parse_lenient_xml
from torchreg.io.urdf_file.units import warn_about_lengths

# Attributes of a mimic joint: added to its multiple of the other.
_MIMIC = ("offset", "multiplier")
_KINDS = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic", "fixed": "fixed"}
# Joints of several degrees of freedom.
_HELD = ("floating", "planar")
# Attributes of each kind of solid, with the count of their numbers.
_PRIMITIVES = {
    "box": {"size": 3},
    "cylinder": {"radius": 1, "length": 1},
    "capsule": {"radius": 1, "length": 1},
    "sphere": {"radius": 1},
}


@dataclass(frozen=True)
class _Plausible:
    """Angles that are radians; larger ones seem to be degrees."""

    turns: float = 4 * math.pi
    degrees: float = 720.0  # limits beyond stand for none


_PLAUSIBLE = _Plausible()


def load_urdf(
    path: str | Path,
    *,
    package_dirs: Sequence[str | Path] = (),
    meshes: str = "warn",
    limits: FileLimits = DEFAULT_LIMITS,
) -> UrdfRecord:
    """Return the kinematic tree and the geometry of a URDF file, float64, parents first.

    It is read as ROS's tools read it. A mimic joint of a mimic joint follows the first one. A link without readable
    visual geometry has its collision geometry. What is left out or held fixed, and numbers that seem to be in another
    unit, are warned of. ``meshes``, of files that are missing or cannot be read: "warn", "skip" or "require".
    """
    check_choice(meshes, "meshes", ("warn", "require", "skip"))
    source = local_path(path)
    with naming(source):
        record = _read_robot(source, [Path(folder) for folder in package_dirs], meshes, limits)
        warn_about_lengths(record, source)
    return record


def _read_robot(source: Path, package_dirs: Sequence[Path], meshes: str, limits: FileLimits) -> UrdfRecord:
    robot = _parse(source, limits)
    links = _named(source, robot, "link")
    joints = _named(source, robot, "joint")
    order = _ordered(source, links, joints)
    files = MeshFiles(source, package_dirs, meshes == "require", limits, warn=meshes == "warn")
    geometry = _Geometry(source, files, limits)
    shapes = [geometry.of_link(name, links[name]) for name, _ in order]
    named = {material.get("name"): _color(material) for material in robot.findall("material")}
    return UrdfRecord(
        name=robot.get("name") or source.stem,
        tree=_build_tree(source, order, joints),
        link_names=tuple(name for name, _ in order),
        link_meshes=tuple(mesh for mesh, _ in shapes),
        link_primitives=tuple(primitives for _, primitives in shapes),
        link_colors=tuple(_link_color(links[name], named) for name, _ in order),
    )


def _link_color(link: ET.Element, named: Mapping[str | None, tuple[float, ...] | None]) -> tuple[float, ...] | None:
    """Return the color of the first visual of a link that has one, by itself or by the name of its material."""
    for material in link.findall("visual/material"):
        color = _color(material) or named.get(material.get("name"))
        if color is not None:
            return color
    return None


def _color(material: ET.Element) -> tuple[float, ...] | None:
    """Return red, green and blue of a material from 0 to 1; None where there are none that can be read."""
    color = material.find("color")
    try:
        numbers = [float(word) for word in ("" if color is None else color.get("rgba", "")).split()]
    except ValueError:
        return None
    is_color = len(numbers) in (3, 4) and all(0 <= number <= 1 for number in numbers)
    return tuple(numbers[:3]) if is_color else None


def _parse(path: Path, limits: FileLimits) -> ET.Element:
    content = read_bytes(path, limits)
    if len(content) > FILE_BUDGET.xml_bytes:
        raise FormatError(f"{path}: {len(content)} bytes of XML, at most {FILE_BUDGET.xml_bytes} are read")
    expand = f"{path}: holds xacro macros; expand them first with `xacro {path.name} > robot.urdf`"
    try:
        check_stand_in(content)
        robot = parse_lenient_xml(content)
    except FormatError as error:
        raise FormatError(f"{path}: {error}") from error
    if robot.tag != "robot":
        raise FormatError(f"{path}: the outermost element must be <robot>, got <{robot.tag}>; convert the file to URDF")
    for element in (inner for part in robot if part.tag != "gazebo" for inner in part.iter()):
        text = " ".join(element.attrib.values())
        if "xacro" in element.tag or "${" in text or "$(" in text:
            raise FormatError(expand)
    return robot


def _named(path: Path, robot: ET.Element, tag: str) -> dict[str, ET.Element]:
    """Return the links or joints by name."""
    found: dict[str, ET.Element] = {}
    for element in robot.findall(tag):
        name = element.get("name")
        if not name:
            raise ModelError(f"{path}: {tag} number {len(found)} has no name")
        if name in found:
            raise ModelError(f"{path}: two {tag}s are called {name!r}; names must be unique")
        found[name] = element
    if tag == "link" and not 0 < len(found) <= FILE_BUDGET.links:
        raise ModelError(f"{path}: a robot must have 1 to {FILE_BUDGET.links} links, got {len(found)}")
    return found


def _ordered(
    path: Path, links: Mapping[str, ET.Element], joints: Mapping[str, ET.Element]
) -> list[tuple[str, tuple[str, int] | None]]:
    """Return (link, (its joint, index of the parent link)) with parents first."""
    carrier: dict[str, str] = {}
    children: dict[str, list[str]] = {name: [] for name in links}
    for name, joint in joints.items():
        parent, child = (_link_of(path, joint, name, role, links) for role in ("parent", "child"))
        if child in carrier:
            raise ModelError(
                f"{path}: link {child!r} has two parents, joints {carrier[child]!r} and {name!r}: a closed loop is no "
                f"tree; leave one of them out"
            )
        carrier[child] = name
        children[parent].append(child)
    roots = [name for name in links if name not in carrier]
    trees = [_tree_of(root, children, carrier) for root in roots]
    if sum(map(len, trees)) < len(links):
        reached = {name for tree in trees for name, _ in tree}
        stuck = [name for name in links if name not in reached]
        raise ModelError(f"{path}: the joints form a cycle through links {', '.join(stuck[:5])}")
    largest = max(trees, key=len)
    if len(trees) > 1:
        others = [root for root, tree in zip(roots, trees, strict=True) if tree is not largest]
        if len(largest) < 2:
            raise ModelError(
                f"{path}: the robot is disconnected, {len(roots)} links have no parent: {', '.join(roots[:5])}"
            )
        warn(
            f"the robot is disconnected: {len(links) - len(largest)} of {len(links)} links are left out, as no joint "
            f"ties them to the largest tree: {', '.join(others[:5])}"
        )
    return largest


def _tree_of(
    root: str, children: Mapping[str, Sequence[str]], carrier: Mapping[str, str]
) -> list[tuple[str, tuple[str, int] | None]]:
    """Return (link, (its joint, index of the parent link)) of the tree on a root, parents first."""
    order: list[tuple[str, tuple[str, int] | None]] = []
    waiting: list[tuple[str, int]] = [(root, -1)]
    while waiting:
        name, above = waiting.pop()
        waiting.extend((child, len(order)) for child in reversed(children[name]))
        order.append((name, (carrier[name], above) if above >= 0 else None))
    return order


def _link_of(path: Path, joint: ET.Element, name: str, role: str, links: Mapping[str, ET.Element]) -> str:
    element = joint.find(role)
    link = None if element is None else element.get("link")
    if link is None or link not in links:
        raise ModelError(f"{path}: joint {name!r} has {role} link {link!r}, which the file does not define")
    return link


def _build_tree(
    path: Path, order: Sequence[tuple[str, tuple[str, int] | None]], joints: Mapping[str, ET.Element]
) -> KinematicTree:
    index = {carrier[0]: number for number, (_, carrier) in enumerate(order) if carrier is not None}
    root = order[0][0]
    mimics = _mimics(path, joints)
    frames = [Joint(f"{root}_root" if root in joints else root, -1, torch.eye(4, dtype=torch.float64))]
    for _, carrier in order[1:]:
        if carrier is not None:
            frames.append(_build_joint(path, carrier[0], carrier[1], joints, index, mimics))
    try:
        return KinematicTree(tuple(frames))
    except ModelError as error:
        raise ModelError(f"{path}: {error}") from error


def _build_joint(
    path: Path,
    name: str,
    parent: int,
    joints: Mapping[str, ET.Element],
    index: Mapping[str, int],
    mimics: Mapping[str, tuple[str, float, float]],
) -> Joint:
    element, what = joints[name], f"{path}: joint {name!r}"
    offset = _origin(element, what)
    if element.get("type") in _HELD:
        warn(f"joint {name!r} is {element.get('type')}; it is held fixed, as joints turn about or slide along one axis")
    if _kind(joints, name, what) == "fixed":
        return Joint(name, parent, offset)
    axis = _floats(element.find("axis"), "xyz", 3, (1.0, 0.0, 0.0), what)
    largest = max(abs(a) for a in axis)
    if largest == 0:
        raise ModelError(f"{what} has a zero axis; give it a direction")
    length = largest * math.hypot(*(a / largest for a in axis))
    lower, upper = _limits(element, what)
    return Joint(
        name=name,
        parent=parent,
        offset=offset,
        kind=_kind(joints, name, what),
        axis=(axis[0] / length, axis[1] / length, axis[2] / length),
        lower=lower,
        upper=upper,
        mimic=None if mimics[name][0] == name else (index[mimics[name][0]], *mimics[name][1:]),
    )


def _kind(joints: Mapping[str, ET.Element], name: str, what: str) -> str:
    given = joints[name].get("type")
    if given in _KINDS:
        return _KINDS[given]
    if given in _HELD:
        return "fixed"
    raise ModelError(f"{what} is of type {given!r}; supported: {', '.join(_KINDS)}")


def _limits(element: ET.Element, what: str) -> tuple[float, float]:
    limit = element.find("limit")
    given = None if limit is None else (limit.get("lower"), limit.get("upper"))
    if element.get("type") == "continuous" or given is None or given == (None, None):
        return -math.inf, math.inf
    # A missing bound is zero by the format's definition.
    lower, upper = (_floats(limit, bound, 1, (0.0,), what)[0] for bound in ("lower", "upper"))
    widest = max(abs(lower), abs(upper))
    if element.get("type") == "revolute" and _PLAUSIBLE.turns < widest <= _PLAUSIBLE.degrees:
        warn(
            f"joint {element.get('name')!r} has limits {lower:g} to {upper:g}, which are radians; if they are degrees "
            f"write {math.radians(lower):.4g} to {math.radians(upper):.4g}"
        )
    return lower, upper


def _mimics(path: Path, joints: Mapping[str, ET.Element]) -> dict[str, tuple[str, float, float]]:
    """Return (the joint it follows, multiplier, offset) of every joint; one that moves by itself follows itself."""
    found: dict[str, tuple[str, float, float]] = {}
    for name in joints:
        # Chains of mimic joints are followed to the first whose leader is known.
        chain: list[tuple[str, float, float]] = []
        while name not in found:
            mimic, what = joints[name].find("mimic"), f"{path}: joint {name!r}"
            if mimic is None:
                found[name] = (name, 1.0, 0.0)
                break
            target = _mimicked(mimic, joints, path, what)
            offset, multiplier = (_floats(mimic, key, 1, (float(key == "multiplier"),), what)[0] for key in _MIMIC)
            chain.append((name, multiplier, offset))
            if len(chain) > len(joints):
                raise ModelError(f"{what} mimics joint {target!r} in a cycle")
            name = target
        leader, multiplier, offset = found[name]
        for follower, factor, shift in reversed(chain):
            multiplier, offset = factor * multiplier, factor * offset + shift
            found[follower] = (leader, multiplier, offset)
    return found


def _mimicked(mimic: ET.Element, joints: Mapping[str, ET.Element], path: Path, what: str) -> str:
    """Return the name of the joint that an element mimics."""
    target = mimic.get("joint")
    if target is None or target not in joints:
        raise ModelError(f"{what} mimics joint {target!r}, which the file does not define")
    if _kind(joints, target, f"{path}: joint {target!r}") == "fixed":
        raise ModelError(f"{what} mimics joint {target!r}, which is fixed")
    return target


def _floats(
    element: ET.Element | None, attribute: str, count: int, default: tuple[float, ...], what: str
) -> tuple[float, ...]:
    """Return the finite numbers in an attribute; ``default`` where it (or the element) is missing."""
    text = None if element is None else element.get(attribute)
    if element is None or text is None:
        return default
    try:
        numbers = tuple(float(word) for word in text.split())
    except ValueError as error:
        raise FormatError(f"{what}: {attribute}={text[:80]!r} in <{element.tag}> is not a list of numbers") from error
    if len(numbers) != count:
        raise FormatError(f"{what}: {attribute}={text[:80]!r} in <{element.tag}> must hold {count} number(s)")
    if not all(math.isfinite(number) for number in numbers):
        raise ModelError(f"{what}: {attribute}={text[:80]!r} in <{element.tag}> is not finite")
    return numbers


def _origin(element: ET.Element, what: str) -> Tensor:
    """Return the (4, 4) transform of ``<origin>``: R = Rz(yaw) Ry(pitch) Rx(roll)."""
    origin = element.find("origin")
    translation = _floats(origin, "xyz", 3, (0.0, 0.0, 0.0), what)
    roll, pitch, yaw = _floats(origin, "rpy", 3, (0.0, 0.0, 0.0), what)
    if len(element.findall("origin")) > 1:
        warn(f"{what} has {len(element.findall('origin'))} origins; the first counts, as in ROS")
    if max(map(abs, (roll, pitch, yaw))) > _PLAUSIBLE.turns:
        warn(f"{what} is turned by rpy {roll:g} {pitch:g} {yaw:g}, which are radians; are they degrees?")
    cr, sr, cp, sp, cy, sy = (f(a) for a in (roll, pitch, yaw) for f in (math.cos, math.sin))
    return torch.tensor(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, translation[0]],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr, translation[1]],
            [-sp, cp * sr, cp * cr, translation[2]],
            [0.0, 0.0, 0.0, 1.0],
        ],
        dtype=torch.float64,
    )


class _Geometry:
    """Reads the geometry of links."""

    def __init__(self, path: Path, files: MeshFiles, limits: FileLimits) -> None:
        self._path, self._files, self._limits = path, files, limits
        self._total = 0

    def of_link(self, name: str, link: ET.Element) -> tuple[TriangleMesh | None, tuple[UrdfPrimitive, ...]]:
        """Return the mesh and the primitives of a link, from its visual or else its collision elements."""
        meshes: list[TriangleMesh] = []
        primitives: list[UrdfPrimitive] = []
        for tag in ("visual", "collision"):
            for element in link.findall(tag):
                what = f"{self._path}: {tag} of link {name!r}"
                for shape in element.findall("geometry/*"):
                    if shape.tag == "material":  # misplaced in some files, and of no shape
                        continue
                    if shape.tag == "mesh":
                        meshes.extend(self._placed_mesh(shape, _origin(element, what), what))
                    else:
                        solid = _primitive(shape, _origin(element, what), what)
                        primitives.extend([] if solid is None else [solid])
            if meshes or primitives:
                break
        return (concatenate(meshes) if meshes else None), tuple(primitives)

    def _placed_mesh(self, shape: ET.Element, origin: Tensor, what: str) -> list[TriangleMesh]:
        filename = shape.get("filename")
        if not filename:
            warn(f"{what} is left out: its <mesh> has no filename")
            return []
        scale = torch.tensor(_floats(shape, "scale", 3, (1.0, 1.0, 1.0), what), dtype=torch.float64)
        if bool((scale == 0).any()):
            warn(f"{what} is left out: its mesh has a scale of zero")
            return []
        mesh = self._files.read(filename, what)
        if mesh is None:
            return []
        self._total += mesh.num_vertices
        try:
            check_allowed(self._total, "vertices", self._limits)
        except FormatError as error:
            raise FormatError(f"{what}: with this mesh the robot {error}") from error
        vertices = (mesh.vertices * scale) @ origin[:3, :3].mT + origin[:3, 3]
        # A mirrored mesh turns inside out unless its triangles turn around.
        return [TriangleMesh(vertices, mesh.faces.flip(1) if float(scale.prod()) < 0 else mesh.faces)]


def _primitive(shape: ET.Element, origin: Tensor, what: str) -> UrdfPrimitive | None:
    """Return a solid; None, with a warning, if it is of another kind or has no size."""
    if shape.tag not in _PRIMITIVES:
        warn(f"{what} is left out: its geometry <{shape.tag}> is none of mesh, {', '.join(_PRIMITIVES)}")
        return None
    attributes, size = _PRIMITIVES[shape.tag], tuple[float, ...]()
    for attribute, count in attributes.items():
        size += _floats(shape, attribute, count, (), what)
    if len(size) < sum(attributes.values()) or min(size) <= 0:
        warn(f"{what} is left out: <{shape.tag}> needs a positive {' and '.join(attributes)}, got {size}")
        return None
    return UrdfPrimitive(shape.tag, size, origin)
