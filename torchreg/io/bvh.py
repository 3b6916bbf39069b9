"""Writing motion of skeletons as animation programs read it: BVH, a tree of joints and a line of angles per frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from torch import Tensor

from torchreg._checks import check_positive
from torchreg.errors import InputError
from torchreg.geometry.upright import Direction, to_y_up
from torchreg.io.atomic import write_atomic
from torchreg.io.gltf_file.builder import Array, checked_numbers
from torchreg.io.gltf_file.document import parents_first

# Share of all lengths of a skeleton by which a joint may wander in its parent: rounding of float32.
_FIXED = 1e-4


def save_bvh(
    path: str | Path,
    names: Sequence[str],
    parents: Sequence[int],
    rest: Tensor,
    transforms: Tensor,
    fps: float,
    *,
    ends: Tensor | None = None,
    up: Direction | None = None,
) -> Path:
    """Write rigid motions (T, J, 4, 4) of J joints, ``T_world_joint``, as a .bvh file; return its path.

    At rest, at ``rest`` (J, 4, 4), joints have no rotation and axes along the world's, y up; the angles of a joint are
    ``R_z R_x R_y``, degrees, relative to its parent. Joints without children end at ``ends`` (J, 3), or at themselves.
    """
    target = Path(path)
    if target.suffix.lower() != ".bvh":
        raise InputError(f"path must end in .bvh, got {target.name!r}; rename the output file")
    check_positive(fps, "fps")
    order, count = parents_first(parents), len(names)
    if len(parents) != count or len(order) < count or list(parents).count(-1) != 1:
        raise InputError(f"parents must make one tree of {count} joints, got {list(parents)}")
    turn = np.eye(4) if up is None else to_y_up(up).numpy()
    still = turn @ checked_numbers(rest, "rest", (count, 4, 4))
    moving = turn @ checked_numbers(transforms, "transforms", ("T", count, 4, 4))
    origins, positions = still[:, :3, 3], moving[..., :3, 3]
    tips = origins if ends is None else checked_numbers(ends, "ends", (count, 3)) @ turn[:3, :3].T
    above = [index if parent < 0 else parent for index, parent in enumerate(parents)]
    offsets = origins - origins[above]
    turned = moving[..., :3, :3] @ np.swapaxes(still[:, :3, :3], -1, -2)
    _check_fixed(names, offsets, turned[:, above], positions - positions[:, above])
    local = np.swapaxes(turned[:, above], -1, -2) @ turned
    root = order[0]
    local[:, root] = turned[:, root]
    lines = ["HIERARCHY", *_joint_lines(root, "ROOT", names, parents, offsets, tips - origins, 0)]
    listed = _depth_first(root, parents)
    angles = np.degrees(np.unwrap(_angles(local), axis=0))[:, listed].reshape(len(moving), -1)
    rows = np.concatenate((positions[:, root], angles), axis=1)
    lines += ["MOTION", f"Frames: {len(rows)}", f"Frame Time: {1 / fps:.9g}"]
    lines += [" ".join(f"{value:.6f}" for value in row) for row in rows]
    write_atomic(target, ("\n".join(lines) + "\n").encode("utf-8"))
    return target


def _check_fixed(names: Sequence[str], offsets: Array, turned: Array, found: Array) -> None:
    """Raise InputError where joints are not at their offsets (J, 3) in their parents, turned by (T, J, 3, 3)."""
    away = np.linalg.norm((turned @ offsets[..., None])[..., 0] - found, axis=-1).max(0)
    worst = int(away.argmax())
    if away[worst] > _FIXED * float(np.abs(offsets).sum()):
        raise InputError(
            f"BVH holds joints that turn, but {names[worst]!r} slides by {away[worst]:.3g} in its parent; write .glb"
        )


def _joint_lines(
    joint: int, kind: str, names: Sequence[str], parents: Sequence[int], offsets: Array, tips: Array, depth: int
) -> list[str]:
    """Return the lines of a joint and of those below it."""
    pad = "  " * depth
    position = "6 Xposition Yposition Zposition" if kind == "ROOT" else "3"
    offset = np.zeros(3) if kind == "ROOT" else offsets[joint]
    lines = [f"{pad}{kind} {'_'.join(names[joint].split())}", f"{pad}{{", f"{pad}  OFFSET {_numbers(offset)}"]
    lines.append(f"{pad}  CHANNELS {position} Zrotation Xrotation Yrotation")
    below = [index for index, parent in enumerate(parents) if parent == joint]
    for child in below:
        lines += _joint_lines(child, "JOINT", names, parents, offsets, tips, depth + 1)
    if not below:
        lines += [f"{pad}  End Site", f"{pad}  {{", f"{pad}    OFFSET {_numbers(tips[joint])}", f"{pad}  }}"]
    return [*lines, f"{pad}}}"]


def _numbers(values: Array) -> str:
    return " ".join(f"{value:.6f}" for value in values)


def _depth_first(root: int, parents: Sequence[int]) -> list[int]:
    """Return the joints in the order of the file."""
    below = [child for child, parent in enumerate(parents) if parent == root]
    return [root, *(joint for child in below for joint in _depth_first(child, parents))]


def _angles(rotations: Array) -> Array:
    """Return angles (..., 3) about z, x and y, radians, of rotations (..., 3, 3) ``R_z R_x R_y``."""
    x = np.arcsin(rotations[..., 2, 1].clip(-1, 1))
    locked = np.abs(rotations[..., 2, 1]) > 1 - 1e-9  # x is a right angle: z and y turn about one axis
    z = np.where(
        locked,
        np.arctan2(rotations[..., 1, 0], rotations[..., 0, 0]),
        np.arctan2(-rotations[..., 0, 1], rotations[..., 1, 1]),
    )
    y = np.where(locked, 0.0, np.arctan2(-rotations[..., 2, 0], rotations[..., 2, 2]))
    return np.stack((z, x, y), axis=-1)
