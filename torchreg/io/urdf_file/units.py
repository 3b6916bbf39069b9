"""A look at the lengths in a robot description: links, joints and slides in another unit than the rest."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchreg.errors import UnitsWarning
from torchreg.geometry.rigid import transform_points
from torchreg.geometry.units import likely_unit
from torchreg.io.urdf_file.record import UrdfRecord


@dataclass(frozen=True)
class _Plausible:
    """What robots are like, large ones as well; all lengths in metres."""

    least: float = 3.0  # lengths below are never reported, as those of household robots
    link: float = 20.0  # a link over the longest step between joints; inches make 39 of it
    longest: float = 1.8  # the largest link over that step, in the median of 60 robots
    thin: float = 0.1  # its thinnest side over that step: grounds and walls are large and thin
    step: float = 100.0  # a step between joints over the largest link: cable robots span tens of it
    slide: float = 20.0  # a slide over the largest other length
    tiny: float = 1 / 200  # the largest link over the longest step: markers at joints are a hundredth
    speck: float = 0.01  # and in itself


_PLAUSIBLE = _Plausible()


def warn_about_lengths(record: UrdfRecord, path: object) -> None:
    """Warn, with the names and the likely unit, if links, joints or slides are in another unit than the rest."""
    joints = record.tree.joints
    steps = [float(joint.offset[:3, 3].norm()) if joint.parent >= 0 else 0.0 for joint in joints]
    extents = [_extent(record, link) for link in range(len(joints))]
    sizes = [float(extent.norm()) for extent in extents]
    far = _warn_about_joints(record, path, steps, max(sizes))
    step = max(length for length, is_far in zip(steps, far, strict=True) if not is_far)
    large = [
        size > max(_PLAUSIBLE.least, _PLAUSIBLE.link * (step or _median(sizes)))
        and float(extent.min()) > _PLAUSIBLE.thin * step
        for size, extent in zip(sizes, extents, strict=True)
    ]
    _warn_about_links(record, path, sizes, large, step)
    known = max(step, *(size for size, is_large in zip(sizes, large, strict=True) if not is_large), 0.0)
    _warn_about_slides(record, path, sizes, known)


def _warn_about_joints(record: UrdfRecord, path: object, steps: Sequence[float], size: float) -> list[bool]:
    """Return which joints are too far from their parents for links of a size; warn if there are some."""
    joints = record.tree.joints
    far = [step > max(_PLAUSIBLE.least, _PLAUSIBLE.step * size) and size > 0 for step in steps]
    if any(far):
        names = _names("joint", far, [joint.name for joint in joints])
        _warn(
            f"{path}: {names} up to {max(steps):.4g} m from the parent, beside links of at most {size:.3g} m: the "
            f"origin seems to be in millimeters; write 0.001 times its xyz"
        )
    return far


def _warn_about_links(
    record: UrdfRecord, path: object, sizes: Sequence[float], large: Sequence[bool], step: float
) -> None:
    """Warn about links that are too large for steps between joints, or all too small."""
    most = max(sizes)
    beside = f"beside joints {step:.3g} m apart" if step else f"beside links of {_median(sizes):.3g} m"
    if any(large):
        usual = (step or _median(sizes)) * (_PLAUSIBLE.longest if sum(large) > 1 else 1.0)
        unit, factor = likely_unit(most / usual)
        is_mesh = any(record.link_meshes[link] is not None for link, is_large in enumerate(large) if is_large)
        attribute = f'the attribute scale "{factor:g} {factor:g} {factor:g}"'  # with "=", it is an option of commands
        remedy = f"give <mesh> {attribute}, or multiply the one it has" if is_mesh else f"multiply sizes by {factor:g}"
        _warn(
            f"{path}: {_names('link', large, record.link_names)} up to {most:.4g} m large, {beside}: the geometry "
            f"seems to be in {unit}; {remedy}"
        )
    elif 0 < most < min(_PLAUSIBLE.speck, _PLAUSIBLE.tiny * step):
        factor = 1 / likely_unit(step / most)[1]
        _warn(
            f"{path}: all links are at most {1000 * most:.3g} mm large, {beside}: the geometry seems to be scaled down "
            f"twice; leave the scale of <mesh> out, or multiply it by {factor:g}"
        )


def _warn_about_slides(record: UrdfRecord, path: object, sizes: Sequence[float], known: float) -> None:
    """Warn about sliding joints, on something with geometry, whose limits are beyond all other lengths."""
    joints = record.tree.joints
    carried = [False] * len(joints)  # whether a link or one above it has geometry; others are free in the world
    for link, joint in enumerate(joints):
        carried[link] = sizes[link] > 0 or (joint.parent >= 0 and carried[joint.parent])
        reach = max((abs(limit) for limit in (joint.lower, joint.upper) if math.isfinite(limit)), default=0.0)
        if joint.kind != "prismatic" or joint.parent < 0 or not carried[joint.parent] or joint.mimic is not None:
            continue
        if reach > max(_PLAUSIBLE.least, _PLAUSIBLE.slide * known) and known > 0:
            _warn(
                f"{path}: joint {joint.name!r} slides from {joint.lower:g} to {joint.upper:g} m, on a robot of links "
                f"and joints of at most {known:.3g} m: its limits seem to be in millimeters; write "
                f"{0.001 * joint.lower:.4g} to {0.001 * joint.upper:.4g}"
            )


def _extent(record: UrdfRecord, link: int) -> Tensor:
    """Return the sides (3,) of the bounding box of a link's geometry, in its coordinates; zeros without any."""
    mesh = record.link_meshes[link]
    corners = [] if mesh is None else [mesh.vertices]
    for solid in record.link_primitives[link]:
        half = torch.tensor(_half_sides(solid.kind, solid.size), dtype=torch.float64)
        signs = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0], dtype=torch.float64)] * 3)
        corners.append(transform_points(solid.origin, signs * half))
    points = torch.cat(corners) if corners else torch.zeros(1, 3, dtype=torch.float64)
    return points.amax(0) - points.amin(0)


def _half_sides(kind: str, size: Sequence[float]) -> list[float]:
    """Return half the sides of the box around a solid."""
    if kind == "box":
        return [0.5 * side for side in size]
    length = {"sphere": size[0], "cylinder": 0.5 * size[-1], "capsule": 0.5 * size[-1] + size[0]}[kind]
    return [size[0], size[0], length]


def _median(values: Sequence[float]) -> float:
    positive = sorted(value for value in values if value > 0)
    return positive[(len(positive) - 1) // 2] if positive else 0.0


def _names(what: str, chosen: Sequence[bool], names: Sequence[str]) -> str:
    found = [repr(name) for name, is_chosen in zip(names, chosen, strict=True) if is_chosen]
    more = f" and {len(found) - 3} more" if len(found) > 3 else ""
    return f"{what}{'s' if len(found) > 1 else ''} {', '.join(found[:3])}{more} {'are' if len(found) > 1 else 'is'}"


def _warn(message: str) -> None:
    warnings.warn(message, UnitsWarning, stacklevel=2)
