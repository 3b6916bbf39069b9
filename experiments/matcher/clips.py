"""The animations of a rig as rotations of its joints, as a body that is posed by rotations alone can play them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchreg.io.gltf import without_scale
from torchreg.io.gltf_file.clip import pose_nodes
from torchreg.io.gltf_file.document import GltfDocument
from torchreg.io.gltf_file.skins import read_skeleton
from torchreg.io.limits import DEFAULT_LIMITS, read_bytes

# Frames that are read of a clip, evenly spread over its keys.
_FRAMES = 8


def clip_rotations(path: Path, rest: Tensor, parents: list[int]) -> list[Tensor]:
    """Return the rotations (F, J, 3, 3) of each clip's frames, of joints against their parents, in the axes at rest.

    Shifts and stretches of a clip are left out. A clip in which nothing turns is left out, too.

    Args:
        path: a glTF file.
        rest: (J, 4, 4) joints at rest, see `torchreg.io.gltf.RigRecord`.
        parents: J numbers of joints, -1 for roots.
    """
    document = GltfDocument(read_bytes(path, DEFAULT_LIMITS), path, DEFAULT_LIMITS)
    read = read_skeleton(document, None, None, {}, DEFAULT_LIMITS)
    clips, nodes = document.items("animations"), document.items("nodes")
    if read is None:
        return []
    joints, kept = read[0].nodes, [dict(node) for node in nodes]
    hierarchy = document.node_parents()
    found = []
    for clip in clips:
        document.json["animations"] = [clip]
        times = [document.accessor(sampler["input"])[:, 0] for sampler in clip["samplers"]]
        first, last = (float(end(np.concatenate(times))) for end in (np.min, np.max))
        places = []
        for time in np.linspace(first, last, _FRAMES):
            pose_nodes(document, float(time), None)
            places.append(without_scale(document.node_globals(hierarchy)[joints])[:, :3, :3])
            for node, before in zip(nodes, kept, strict=True):
                node.clear()
                node.update(before)
        turned = torch.from_numpy(np.stack(places)) @ rest[:, :3, :3].mT
        above = [joint if parent < 0 else parent for joint, parent in enumerate(parents)]
        turns = turned[:, above].mT @ turned
        roots = torch.tensor([parent < 0 for parent in parents])
        turns[:, roots] = turned[:, roots]
        if float((turns - turns[:1]).abs().max()) > 0.01:
            found.append(turns)
    return found
