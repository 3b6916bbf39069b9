"""Where the bind poses of glTF skins stand in the scene: upright and as large as a viewer shows them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from torchreg.errors import ModelError
from torchreg.io.clouds.raw_cloud import Array
from torchreg.io.file_format import warn
from torchreg.io.gltf_file.document import GltfDocument
from torchreg.io.gltf_file.skins import SKIN_TOLERANCES, Skeleton, Skin, ancestors


def place_skins(document: GltfDocument, skeleton: Skeleton) -> None:
    """Place the joints and the skins of a file in its scene, in place.

    The pose of all zeros is the bind pose, as a whole where the nodes have it. Where joints scale their parts of the
    skin unlike each other no rigid motions give what the file shows; then it is the pose of the node hierarchy.
    """
    scales = [_scale(skin, skeleton) for skin in skeleton.skins]
    uneven = [_unevenness(skin, skeleton, scale) for skin, scale in zip(skeleton.skins, scales, strict=True)]
    worst = np.zeros(len(skeleton.nodes))
    for skin, off in zip(skeleton.skins, uneven, strict=True):
        np.maximum.at(worst, skin.joints, off)
    skeleton.is_baked = bool(worst.max() > SKIN_TOLERANCES.scale)
    if worst.max() > SKIN_TOLERANCES.equal:
        _tell_scales(skeleton.names, worst, skeleton.is_baked)
    if skeleton.is_baked:
        return
    placed = np.zeros(len(skeleton.nodes), dtype=bool)
    node_parents = document.node_parents()
    # The skin of most joints says where the others stand.
    for skin, scale in sorted(zip(skeleton.skins, scales, strict=True), key=lambda pair: -len(pair[0].nodes)):
        beside = _beside_placed(skin, skeleton, placed)
        skin.to_scene = _own_place(document, node_parents, skin, skeleton, scale) if beside is None else beside
        own = skin.to_scene @ skin.bind
        fresh = ~placed[skin.joints]
        skeleton.places[skin.joints[fresh]] = own[fresh]
        off = np.abs(skeleton.places[skin.joints] - own).max((1, 2))[skin.used]
        skin.is_bent = bool(off.max(initial=0.0) > SKIN_TOLERANCES.equal * max(1.0, _extent(skin)) * scale)
        placed[skin.joints] = True


def _tell_scales(names: Sequence[str], worst: Array, is_baked: bool) -> None:
    """Say which joints scale their parts of the skin unlike others, and what becomes of it."""
    listed = ", ".join(repr(names[joint]) for joint in np.argsort(-worst)[:3] if worst[joint] > SKIN_TOLERANCES.equal)
    count = int((worst > SKIN_TOLERANCES.equal).sum())
    done = (
        "this is baked: all joints at zero is the pose that a viewer shows, not the bind pose"
        if is_baked
        else "this is left out"
    )
    warn(
        f"{count} joints scale their part of the skin by up to {worst.max():.2g} of it unlike others: {listed}; {done}"
    )


def _extent(skin: Skin) -> float:
    return float(np.ptp(skin.surface.vertices, axis=0).max())


def _scale(skin: Skin, skeleton: Skeleton) -> float:
    """Return the factor by which the skeleton at rest scales the stored mesh: 0.01 for many rigs in centimetres."""
    motions = skin.motions(skeleton.world)[skin.used]
    if not np.isfinite(motions).all() or np.abs(motions[:, 3] - np.eye(4)[3]).max() > 1e-4:
        raise ModelError(f"the bind transforms of skin {skin.index} are not finite or not affine")
    stretches = np.linalg.svd(motions[:, :3, :3], compute_uv=False).mean(1)
    # That of most joints; of the first ones where as many have another.
    alike = np.abs(stretches[:, None] - stretches) <= SKIN_TOLERANCES.equal * stretches
    common = float(stretches[alike[:, alike.sum(0).argmax()]].mean())
    if not 1 / SKIN_TOLERANCES.max_scale < common < SKIN_TOLERANCES.max_scale:
        raise ModelError(f"the skeleton scales the skin by {common:.4g}, which no rig does; check its nodes")
    return common if abs(common - 1) > SKIN_TOLERANCES.equal else 1.0


def _unevenness(skin: Skin, skeleton: Skeleton, scale: float) -> Array:
    """Return by how much (Js,) joints stretch their part of the skin unlike the whole, in shares; idle ones by 0."""
    motions = skin.motions(skeleton.world)[:, :3, :3] / scale
    stretches = np.linalg.svd(np.where(skin.used[:, None, None], motions, np.eye(3)), compute_uv=False)
    mirrored = np.linalg.det(motions) < 0
    usual = np.bincount(mirrored[skin.used], minlength=2).argmax()
    return np.where(skin.used & (mirrored != usual), 2.0, np.abs(stretches - 1).max(1))


def _beside_placed(skin: Skin, skeleton: Skeleton, placed: Array) -> Array | None:
    """Return where the bind pose of a skin stands that shares or continues joints that are placed; None of others."""
    for own, joint in enumerate(skin.joints):
        if placed[joint]:
            return np.asarray(skeleton.places[joint] @ np.linalg.inv(skin.bind[own]))
    for own, joint in enumerate(skin.joints):
        above = skeleton.parents[joint]
        if above >= 0 and placed[above] and abs(np.linalg.det(skeleton.world[above])) > 1e-30:
            between = np.linalg.solve(skeleton.world[above], skeleton.world[joint])
            return np.asarray(skeleton.places[above] @ between @ np.linalg.inv(skin.bind[own]))
    return None


def _own_place(
    document: GltfDocument, node_parents: Sequence[int], skin: Skin, skeleton: Skeleton, scale: float
) -> Array:
    """Return where the bind pose (4, 4) of a skin stands.

    Where all joints at rest move the skin alike, that is it; but a skeleton that is shifted only, by its root at rest,
    keeps its place. Where joints at rest pose the skin, it is one of the usual places, the nearest: that of the node
    above the skeleton, upright as stored, or turned by quarters.
    """
    used = skin.used
    motions, shares = skin.motions(skeleton.world)[used], skin.surface.weights.sum(0)[used]
    mean = np.tensordot(shares / shares.sum(), motions, 1)
    u, _, vt = np.linalg.svd(mean[:3, :3])
    center = (skin.surface.vertices.min(0) + skin.surface.vertices.max(0)) / 2
    common, as_stored = np.eye(4), np.diag([scale, scale, scale, 1.0])
    common[:3, :3] = scale * (u @ vt)
    common[:3, 3] = mean[:3, :3] @ center + mean[:3, 3] - common[:3, :3] @ center
    tolerance = SKIN_TOLERANCES.equal + float(_unevenness(skin, skeleton, scale).max())
    off = np.abs(motions - common) / scale
    shifted = np.abs((motions - common)[:, :3, :3] @ center + (motions - common)[:, :3, 3]).max()
    usual = [*_above(document, node_parents, skin, scale), as_stored]
    if off[:, :3, :3].max() <= tolerance and shifted <= tolerance * scale * _extent(skin):
        turned = (np.abs(place - common)[:3, :3].max() / scale for place in usual)
        return next((place for place, off in zip(usual, turned, strict=True) if off <= SKIN_TOLERANCES.equal), common)
    return _nearest(usual, _quarter_turns(scale), motions[_top(skin, skeleton)] / scale, common / scale, scale)


def _top(skin: Skin, skeleton: Skeleton) -> int:
    """Return which of the joints that move vertices is the nearest to the root."""
    depths = [len(list(ancestors(joint, skeleton.parents))) for joint in skin.joints[skin.used]]
    return depths.index(min(depths))


def _nearest(usual: list[Array], turns: list[Array], top: Array, mean: Array, scale: float) -> Array:
    """Return the place meant by the motions (4, 4) of the topmost joint, without scale, and of all joints."""
    every = [*usual, *turns]
    for place in every:
        if np.abs(place / scale - top)[:3, :3].max() <= SKIN_TOLERANCES.equal:
            return place  # the root is not posed
    traces = [round(float((place[:3, :3] * mean[:3, :3]).sum()) / scale, 6) for place in every]
    best = int(np.argmax(traces[: len(usual)]))
    # Limbs may turn far, the whole hardly more than by 60 degrees.
    return usual[best] if traces[best] >= 2.0 else every[int(np.argmax(traces))]


def _above(document: GltfDocument, node_parents: Sequence[int], skin: Skin, scale: float) -> list[Array]:
    """Return the place of the node above the skeleton, if it scales as the skeleton scales the skin, and is rigid."""
    node = next((node for node in ancestors(skin.nodes[0], node_parents) if node not in skin.nodes), -1)
    if node < 0:
        return []
    place = document.node_globals(node_parents)[node]
    stretches = np.linalg.svd(place[:3, :3], compute_uv=False) / scale
    is_identity = np.abs(place - np.eye(4)).max() <= SKIN_TOLERANCES.rounding
    return [place] if np.abs(stretches - 1).max() <= SKIN_TOLERANCES.scale and not is_identity else []


def _quarter_turns(scale: float) -> list[Array]:
    """Return the 24 turns (4, 4) that take axes to axes, times a scale; the identity first."""
    found = []
    for order in ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)):
        for signs in np.ndindex(2, 2, 2):
            turn = np.eye(3)[list(order)] * (1.0 - 2.0 * np.array(signs))
            if np.linalg.det(turn) > 0:
                place = np.eye(4)
                place[:3, :3] = scale * turn
                found.append(place)
    return found
