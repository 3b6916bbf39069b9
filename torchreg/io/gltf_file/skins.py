"""The skins of glTF files: which of them move what, their joints, and where their bind poses stand in the scene."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from torchreg.errors import FormatError, ModelError
from torchreg.io.clouds.raw_cloud import Array
from torchreg.io.file_format import warn
from torchreg.io.gltf_file.document import GltfDocument, parents_first
from torchreg.io.gltf_file.primitives import Surface, VertexBudget, read_surface
from torchreg.io.limits import FILE_BUDGET, FileLimits


@dataclass(frozen=True)
class _SkinTolerances:
    """What counts as equal in skins."""

    max_scale: float = 1e6  # of the skeleton on the skin, and its inverse
    rounding: float = 1e-5  # of a matrix, and of a skin's extent: what single precision rounds
    equal: float = 1e-3  # relative difference of scales, and of positions in the skin's extent, that is none
    scale: float = 0.03  # relative difference of scales that is left out; a larger one is baked


SKIN_TOLERANCES = _SkinTolerances()


@dataclass
class Skin:
    """A skin of a file and what it moves."""

    index: int  # of the skin
    meshes: list[int]  # that it moves
    nodes: list[int]  # of its joints
    joints: Array  # (Js,) numbers of its joints in the skeleton
    surface: Surface  # of the meshes as stored, with weights of the skin's own joints
    bind: Array  # (Js, 4, 4) the joints as stored
    to_scene: Array = field(default_factory=lambda: np.eye(4))  # (4, 4) where the bind pose stands
    is_bent: bool = False  # whether no motion as a whole takes its bind pose to that of the other skins

    @property
    def used(self) -> Array:
        """Which of its joints (Js,) move any vertex."""
        return self.surface.weights.max(0) > 0

    def motions(self, places: Array) -> Array:
        """Return the matrices (Js, 4, 4) by which joints of the skeleton (J, 4, 4) move stored vertices."""
        return places[self.joints] @ np.linalg.inv(self.bind)


@dataclass
class Skeleton:
    """The joints of all skins that are read together."""

    nodes: list[int]  # of the joints
    names: list[str]  # different ones
    parents: tuple[int, ...]  # numbers of parent joints, -1 for roots
    number: dict[int, int]  # of the joint by node; several nodes of equal joints may have one number
    world: Array  # (J, 4, 4) of the node hierarchy
    places: Array  # (J, 4, 4) in the pose of all zeros, with the scales of the vertices
    skins: list[Skin]  # that move its vertices
    is_baked: bool = False  # whether the pose of all zeros is that of the node hierarchy, as scales differ

    def placed_surface(self, skin: Skin) -> Surface:
        """Return the surface of a skin in the pose of all zeros, with weights of all joints."""
        stored, weights = skin.surface, np.zeros((len(skin.surface.vertices), len(self.nodes)))
        np.add.at(weights.T, skin.joints, stored.weights.T)
        if self.is_baked or skin.is_bent:
            motions = np.tensordot(stored.weights, skin.motions(self.places), 1)
        else:
            motions = skin.to_scene[None]
        return stored.moved(motions, weights)


def read_skeleton(
    document: GltfDocument,
    mesh: str | int | None,
    skin: str | int | None,
    parents: Mapping[str, str | None],
    limits: FileLimits,
) -> tuple[Skeleton, VertexBudget] | None:
    """Return the joints and the skins of a file, not placed yet; None where no node carries mesh and skin."""
    meshes = _choose_skins(document, mesh, skin)
    if not meshes:
        return None
    listed = {index: _joint_nodes(document, index) for index in meshes}
    world, node_parents = document.node_globals(document.node_parents()), document.node_parents()
    nodes, number = _shared_joints(document, listed, world)
    names = unique_names([document.item("nodes", node).get("name") for node in nodes])
    all_parents = _joint_parents(nodes, number, node_parents, names, parents)
    budget, skins = VertexBudget(document, limits, len(nodes)), list[Skin]()
    for index, own in listed.items():
        joints = np.array([number[node] for node in own])
        surface = read_surface(budget, meshes[index], len(own))
        if surface is None:
            continue
        above = [own.index(nodes[p]) if p >= 0 and nodes[p] in own else -1 for p in (all_parents[j] for j in joints)]
        own_names = [names[j] for j in joints]
        bind = bind_transforms(document, index, own_names, surface.weights, world[own], above)
        skins.append(Skin(index, meshes[index], own, joints, surface, bind))
    if not skins:
        reason = f": {budget.left_out[0]}" if budget.left_out else ""
        raise ModelError(f"the skinned mesh has no triangles that a skin moves{reason}")
    at_rest = world[nodes]
    return Skeleton(
        nodes, names, parents=all_parents, number=number, world=at_rest, places=at_rest.copy(), skins=skins
    ), budget  # fmt: skip


def _choose_skins(document: GltfDocument, mesh: str | int | None, skin: str | int | None) -> dict[int, list[int]]:
    """Return the requested meshes by the requested skins that move them; empty if nothing is skinned at all."""
    wanted_mesh = None if mesh is None else find_item(document.items("meshes"), mesh, "mesh")
    wanted_skin = None if skin is None else find_item(document.items("skins"), skin, "skin")
    shown = shown_nodes(document)
    pairs, others = set[tuple[int, int]](), set[tuple[int, int]]()
    for number, node in enumerate(document.items("nodes")):
        if node.get("mesh") is not None and node.get("skin") is not None:
            mesh_index = document.index("meshes", node["mesh"], f"the mesh of node {number}")
            skin_index = document.index("skins", node["skin"], f"the skin of node {number}")
            if wanted_mesh in (None, mesh_index) and wanted_skin in (None, skin_index):
                (pairs if number in shown else others).add((skin_index, mesh_index))
    found = dict[int, list[int]]()
    for skin_index, mesh_index in sorted(pairs or others):
        found.setdefault(skin_index, []).append(mesh_index)
    if not found and (mesh is not None or skin is not None):
        raise ModelError(
            f"no node carries both a mesh and a skin with mesh={mesh!r}, skin={skin!r}: there is no rig to read"
        )
    return found


def shown_nodes(document: GltfDocument) -> set[int]:
    """Return the nodes of the default scene; all nodes where there is no scene."""
    scenes = document.items("scenes")
    number = document.json.get("scene", 0)
    if not scenes or not isinstance(number, int) or not 0 <= number < len(scenes):
        return set(range(len(document.items("nodes"))))
    pending = list(document.entry(scenes[number], "nodes", list))
    shown = set[int]()
    while pending:
        index = document.index("nodes", pending.pop(), "a node of the scene")
        if index not in shown:
            shown.add(index)
            pending += document.entry(document.item("nodes", index), "children", list)
    return shown


def find_item(items: Sequence[dict[str, Any]], wanted: str | int, what: str) -> int:
    """Return the index of an item by its name or index; ModelError, which lists the items, if there is none."""
    for index, item in enumerate(items):
        if wanted == (item.get("name") if isinstance(wanted, str) else index):
            return index
    known = ", ".join(f"{index} ({item.get('name')!r})" for index, item in enumerate(items[:20])) or "none"
    raise ModelError(f"there is no {what} {wanted!r}; known: {known}")


def _joint_nodes(document: GltfDocument, skin: int) -> list[int]:
    """Return the nodes of a skin's joints."""
    listed = document.entry(document.item("skins", skin), "joints", list)
    joints = [document.index("nodes", joint, f"a joint of skin {skin}") for joint in listed]
    if not 0 < len(joints) <= FILE_BUDGET.joints or len(set(joints)) < len(joints):
        raise ModelError(
            f"skin {skin} must list 1 to {FILE_BUDGET.joints} different joints, got {len(joints)} "
            f"({len(set(joints))} different)"
        )
    return joints


def _shared_joints(
    document: GltfDocument, listed: Mapping[int, list[int]], world: Array
) -> tuple[list[int], dict[int, int]]:
    """Return the nodes of all skins' joints, and the joint's number by node.

    Joints of two skins are one where they are the same node, or have one name and stand at one place: some programs
    write the skeleton once for every skin.
    """
    nodes, number, merged = list[int](), dict[int, int](), 0
    every = world[[node for own in listed.values() for node in own], :3]
    near = SKIN_TOLERANCES.equal * float(np.ptp(every[..., 3], axis=0).max())
    for own in listed.values():
        by_name = {str(document.item("nodes", node).get("name")): joint for joint, node in enumerate(nodes)}
        for node in own:
            name = document.item("nodes", node).get("name")
            twin = by_name.get(str(name)) if name else None
            apart = np.inf if twin is None else np.abs(world[nodes[twin]][:3, 3] - world[node][:3, 3]).max()
            if node not in number and twin is not None and apart <= near and nodes[twin] not in own:
                number[node] = twin
                merged += 1
            elif node not in number:
                number[node] = len(nodes)
                nodes.append(node)
    if merged:
        warn(f"{merged} joints of several skins have one name and one place, and are taken for one joint each")
    if len(nodes) > FILE_BUDGET.joints:
        raise ModelError(f"the skins must list 1 to {FILE_BUDGET.joints} different joints, got {len(nodes)}")
    return nodes, number


def unique_names(names: Sequence[Any]) -> list[str]:
    """Return names that all differ: a repeated one gets ``#`` and its index."""
    taken = {str(name) for name in names if name}
    unique, renamed = list[str](), list[str]()
    for index, name in enumerate(names):
        text = str(name) if name else f"joint_{index}"
        if text in unique or (not name and text in taken):
            tries = (f"{text}#{index}" + "'" * more for more in itertools.count())
            renamed.append(f"{text!r} (number {index}) is called {(new := next(t for t in tries if t not in taken))!r}")
            text = new
        taken.add(text)
        unique.append(text)
    if renamed:
        warn(f"{len(renamed)} joints have the name of another and are told apart: {'; '.join(renamed[:3])}")
    return unique


def _joint_parents(
    nodes: Sequence[int],
    number: Mapping[int, int],
    node_parents: Sequence[int],
    names: Sequence[str],
    given: Mapping[str, str | None],
) -> tuple[int, ...]:
    parents = [
        next((number[above] for above in ancestors(node, node_parents) if above in number), -1) for node in nodes
    ]
    unknown = sorted({name for pair in given.items() for name in pair if name is not None and name not in names})
    if unknown:
        raise ModelError(f"parents names unknown joints {', '.join(unknown[:5])}; known: {', '.join(names)}")
    for name, parent in given.items():
        parents[names.index(name)] = -1 if parent is None else names.index(parent)
    stuck = sorted(set(range(len(names))) - set(parents_first(parents)))
    if stuck:
        raise ModelError(f"parents are cyclic at joints {', '.join(names[index] for index in stuck[:5])}")
    return tuple(parents)


def ancestors(node: int, parents: Sequence[int]) -> Iterator[int]:
    """Yield the nodes above a node, the nearest first."""
    while (node := parents[node]) >= 0:
        yield node


def bind_transforms(
    document: GltfDocument, skin: int, names: Sequence[str], weights: Array, world: Array, parents: Sequence[int]
) -> Array:
    """Return the transforms (J, 4, 4) of a skin's joints in the bind pose.

    Exporters write the identity, or zeros, for joints that move nothing: those stand to their neighbors as nodes do.
    """
    for name, matrix in zip(names, world, strict=True):
        if not np.isfinite(matrix).all():
            raise ModelError(f"the rest transform of joint {name!r} is not finite")
    inverse_bind = document.item("skins", skin).get("inverseBindMatrices")
    if inverse_bind is None:
        return world.copy()
    stored = document.accessor(inverse_bind, "inverseBindMatrices", ("MAT4",)).astype(np.float64)
    if len(stored) < len(names):
        raise FormatError(f"{len(names)} joints but {len(stored)} inverse bind matrices")
    matrices = np.swapaxes(stored[: len(names)].reshape(-1, 4, 4), 1, 2)
    with np.errstate(all="ignore"):
        determinants = np.stack([np.abs(np.linalg.det(m)) for m in (matrices[:, :3, :3], matrices)])
    flat = ~((determinants > 1e-30) & (determinants < np.inf)).all(0)
    identity = np.abs(matrices - np.eye(4)).max((1, 2)) < SKIN_TOLERANCES.rounding
    elsewhere = np.abs(world - np.eye(4)).max((1, 2)) > SKIN_TOLERANCES.rounding
    idle = weights.max(0) == 0
    empty = idle & (flat | (identity & elsewhere & (np.array(parents) >= 0)))
    if (flat & ~empty).any():
        raise ModelError(f"the inverse bind matrix of joint {names[int((flat & ~empty).argmax())]!r} is singular")
    bind = np.linalg.inv(np.where(empty[:, None, None], np.eye(4), matrices))
    _stand_beside(bind, empty, world, parents)
    if empty.any():
        listed = ", ".join(names[index] for index in np.flatnonzero(empty)[:5])
        warn(f"{int(empty.sum())} joints that move nothing have no bind pose and stand where their nodes do: {listed}")
    return bind


def _stand_beside(bind: Array, empty: Array, world: Array, parents: Sequence[int]) -> None:
    """Place joints without a bind pose, in place: beside a child or a parent that has one as their nodes stand."""
    known, order = ~empty, parents_first(parents)
    for child in reversed(order):
        above = parents[child]
        if above >= 0 and known[child] and not known[above]:
            bind[above], known[above] = _beside(bind[child], world[child], world[above]), True
    for index in order:
        above = parents[index]
        if empty[index] and above >= 0:
            bind[index], known[index] = _beside(bind[above], world[above], world[index]), True
        elif not known[index]:
            bind[index] = world[index]


def _beside(bind: Array, world: Array, other: Array) -> Array:
    """Return where a joint stands in the bind pose that is ``other`` in the scene, where a neighbor is ``world``."""
    if abs(np.linalg.det(world)) < 1e-30:
        return bind
    return bind @ np.linalg.solve(world, other)
