"""The limbs of an articulated shape: its chains of bodies between branches."""

from __future__ import annotations

from dataclasses import dataclass
from weakref import WeakKeyDictionary

from torch import Tensor

from torchreg.shapes.articulation import Articulation


@dataclass(frozen=True)
class Body:
    """Parts that no joint separates, a part of the parent body (-1: the base), and the joints between them."""

    parts: tuple[int, ...]
    parent: int
    dofs: tuple[int, ...]


@dataclass(frozen=True)
class Limb:
    """A chain of bodies without branches, from the base outwards; ``level`` limbs lie between it and the base."""

    bodies: tuple[Body, ...]
    level: int

    @property
    def dofs(self) -> list[int]:
        """Indices of the limb's degrees of freedom."""
        return [dof for body in self.bodies for dof in body.dofs]

    @property
    def parts(self) -> list[int]:
        """Indices of the limb's parts."""
        return [part for body in self.bodies for part in body.parts]


def find_limbs(shape: Articulation) -> tuple[list[Limb], list[int]]:
    """Return the limbs, parents before children, and the parts of the trunk; a shared joint is the first limb's."""
    if shape not in _FOUND:
        _FOUND[shape] = _find_limbs(shape)
    limbs, trunk = _FOUND[shape]
    return list(limbs), list(trunk)


_FOUND: WeakKeyDictionary[Articulation, tuple[list[Limb], list[int]]] = WeakKeyDictionary()


def _find_limbs(shape: Articulation) -> tuple[list[Limb], list[int]]:
    bodies = find_bodies(shape)
    owner = {part: number for number, body in enumerate(bodies) for part in body.parts}
    above = [owner[body.parent] if body.parent >= 0 else -1 for body in bodies]
    moved = shape.kinematics.moves[shape.part_index].any(-1).tolist()
    trunk = [part for part in range(shape.num_parts) if not moved[part]]
    limb_of: dict[int, int] = {}
    chains: list[list[int]] = []
    levels: list[int] = []
    for number, body in enumerate(bodies):
        if not moved[body.parts[0]]:
            continue
        parent = above[number]
        if parent in limb_of and above.count(parent) == 1:
            limb_of[number] = limb_of[parent]
            chains[limb_of[number]].append(number)
            continue
        limb_of[number] = len(chains)
        levels.append(levels[limb_of[parent]] + 1 if parent in limb_of else 0)
        chains.append([number])
    found = [Limb(tuple(bodies[body] for body in chain), level) for chain, level in zip(chains, levels, strict=True)]
    return found, trunk


def find_bodies(shape: Articulation) -> list[Body]:
    """Return the bodies of a shape, parents before children: parts below the same joints."""
    joints: Tensor = shape.kinematics.moves[shape.part_index] > 0
    drives = shape.kinematics.couplings != 0
    rows = [tuple(row) for row in joints.tolist()]
    groups: dict[tuple[bool, ...], list[int]] = {}
    for part, row in enumerate(rows):
        groups.setdefault(row, []).append(part)
    taken: set[int] = set()
    bodies = []
    for row, parts in sorted(groups.items(), key=lambda group: (sum(group[0]), group[1])):
        parent = next((above for above in _ancestors(shape, parts[0]) if rows[above] != row), -1)
        driven = drives[joints[parts[0]]].any(0).nonzero()[:, 0].tolist()
        bodies.append(Body(tuple(parts), parent, tuple(6 + dof for dof in driven if dof not in taken)))
        taken.update(driven)
    return bodies


def bodies_below(shape: Articulation, bodies: list[Body], top: Body) -> list[Body]:
    """Return those of the bodies that hang on one of them, itself included."""
    return [body for body in bodies if top.parts[0] in (body.parts[0], *_ancestors(shape, body.parts[0]))]


def _ancestors(shape: Articulation, part: int) -> list[int]:
    found = []
    while (part := shape.part_parents[part]) >= 0:
        found.append(part)
    return found
