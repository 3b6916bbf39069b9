"""Range scans of animals whose skins hang on dozens of bones, registered with the defaults.

Dog and rodent are those of dm_control, posed by MuJoCo (`pip install "torchreg-articulated[benchmark]"` brings both).
Each pair is two random poses: in the first every joint is off by a twelfth of its range (standard deviation), and in
the second from there by the share of its range that the row names; the animal as a whole turns by 7 degrees and shifts
a little. No motion of an animal does that: spine, tail and toes move as far as legs. One depth camera at a random place
sees both, about 7,500 points each. A pair counts as registered when at least 90 % of its source points end within 2.5 %
of the diagonal of their true place, visible in the target or not.

    python benchmarks/scan_animals.py            # --smoke: one pair per animal and motion
"""

from __future__ import annotations

import argparse
import importlib.util
import math
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from public_shapes import animals_folder
from scan_robots import Pair, print_row, scan_pair, score
from torch import Tensor

from torchreg.geometry.rigid import invert_rigid, rigid_matrix, se3_exp, transform_points
from torchreg.geometry.rotation_representations import rotation_from_quaternion
from torchreg.registration.blend import blend_linear

ANIMALS = {"dog": "suite/dog.xml", "rodent": "locomotion/walkers/assets/rodent.xml"}
# Shares of the joints' ranges, of which those beyond the second number of radians count as that.
FROM_REST, APART, WIDEST = 1 / 12, (0.05, 0.1, 0.2), 2.0
# Turn of the whole animal, radians, and its shift as a share of its size.
TURN, SHIFT = math.radians(7), 0.03
UP = 2

Poser = Callable[[float, torch.Generator], tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class Animal:
    """What is scanned.

    Args:
        name: of it.
        faces: (F, 3) of its skin.
        poses: gives the skin's vertices (V, 3) in two poses that differ by a share of the joints' ranges.
    """

    name: str
    faces: Tensor
    poses: Poser


def animals(folder: Path) -> Iterator[Animal]:
    """Yield the animals that are there; none without MuJoCo."""
    if importlib.util.find_spec("mujoco") is None:
        return
    import mujoco

    for name, file in ANIMALS.items():
        if (folder / file).is_file():
            model = mujoco.MjModel.from_xml_path(str(folder / file))
            yield Animal(name, torch.from_numpy(model.skin_face.copy()).long(), skin_poses(model))


def skin_poses(model: Any) -> Poser:
    """Return what draws poses of a MuJoCo model with one skin."""
    import mujoco

    data = mujoco.MjData(model)
    rest, weights = torch.from_numpy(model.skin_vert).double(), skin_weights(model)
    bound = rigid_matrix(
        rotation_from_quaternion(torch.from_numpy(model.skin_bonebindquat).double()),
        torch.from_numpy(model.skin_bonebindpos).double(),
    )
    bodies = torch.from_numpy(model.skin_bonebodyid).long()
    hinges = torch.from_numpy((model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE) & (model.jnt_limited == 1))
    low, high = torch.from_numpy(model.jnt_range)[hinges].unbind(-1)
    address = torch.from_numpy(model.jnt_qposadr)[hinges].long()

    def vertices(angles: Tensor) -> Tensor:
        data.qpos[:] = model.qpos0
        data.qpos[address.numpy()] = angles.numpy()
        mujoco.mj_kinematics(model, data)
        turned = torch.from_numpy(data.xmat.copy()).unflatten(-1, (3, 3))[bodies]
        bones = rigid_matrix(turned, torch.from_numpy(data.xpos.copy())[bodies])
        return blend_linear(rest, weights, bones @ invert_rigid(bound))

    def poses(share: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        wide = (high - low).clamp(max=WIDEST)
        angles = torch.from_numpy(model.qpos0)[address]
        found = []
        for off in (FROM_REST, share):
            drawn = torch.randn(len(wide), generator=generator, dtype=torch.float64)
            angles = torch.minimum(torch.maximum(angles + off * wide * drawn, low), high)
            found.append(vertices(angles))
        return found[0], found[1]

    return poses


def skin_weights(model: Any) -> Tensor:
    """Return how much each bone counts at each vertex (V, B), rows that sum to one."""
    weights = torch.zeros(model.nskinvert, model.nskinbone, dtype=torch.float64)
    count = torch.from_numpy(model.skin_bonevertnum).long()
    bone = torch.arange(len(count)).repeat_interleave(count)
    vertex = torch.from_numpy(model.skin_bonevertid).long()
    weights.index_put_((vertex, bone), torch.from_numpy(model.skin_bonevertweight).double(), accumulate=True)
    return weights / weights.sum(1, keepdim=True)


def make_pair(animal: Animal, share: float, number: int, seed: int) -> Pair:
    """Return two scans of an animal by a camera at a random place."""
    generator = torch.Generator().manual_seed(1000 * seed + number)
    first, second = animal.poses(share, generator)
    drawn = torch.randn(4, generator=generator, dtype=torch.float64)
    up = torch.eye(3, dtype=torch.float64)[UP]
    size = (first.amax(0) - first.amin(0)).norm()
    motion = se3_exp(torch.cat((SHIFT * size * drawn[:3], TURN * drawn[3] * up)))
    middle = second.mean(0)
    moved = transform_points(motion, second - middle) + first.mean(0)
    return scan_pair(first, moved, animal.faces, UP, generator)


def main(arguments: list[str] | None = None) -> int:
    """Print a line per animal and motion and one for all; return 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--animals", type=Path, help="folder of dm_control, instead of the installed one")
    parser.add_argument("--pairs", type=int, default=6, help="per animal and motion")
    parser.add_argument("--seed", type=int, default=0, help="of poses and places of the camera")
    parser.add_argument("--smoke", action="store_true", help="one pair per animal and motion, in a minute")
    options = parser.parse_args(arguments)
    folder = options.animals or animals_folder()
    with torch.no_grad():
        found = [] if folder is None else list(animals(folder))
        if not found:
            print('skipped: no animals found; pip install "torchreg-articulated[benchmark]" brings them')
            return 0
        print_rows(found, 1 if options.smoke else options.pairs, options.seed)
    return 0


def print_rows(found: list[Animal], pairs: int, seed: int) -> None:
    """Print the table."""
    print(f"{'':12s} registered   near  mean %  seconds")
    rows = []
    for animal in found:
        for share in APART:
            rows += (own := [score(make_pair(animal, share, number, seed)) for number in range(pairs)])
            print_row(f"{animal.name}, {share:.0%}", own)
    print_row("all", rows)


if __name__ == "__main__":
    sys.exit(main())
