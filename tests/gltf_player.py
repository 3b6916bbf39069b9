"""A minimal viewer of glTF, as the specification says: nodes, animation, inverse bind matrices, skin, moved shapes."""

import numpy as np
import pygltflib
from scipy.spatial.transform import Rotation, Slerp

KINDS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 9: "MAT3", 16: "MAT4"}


class Player:
    """Reads a file with pygltflib and evaluates it at a time in seconds; without a time in the file's own pose."""

    def __init__(self, path):
        self.gltf = pygltflib.GLTF2().load(str(path))
        self.blob = self.gltf.binary_blob()

    def accessor(self, index):
        accessor = self.gltf.accessors[index]
        view = self.gltf.bufferViews[accessor.bufferView]
        assert not view.byteStride
        dtype = next(kind for kind, code in KINDS.items() if code == accessor.componentType)
        width = next(width for width, name in TYPES.items() if name == accessor.type)
        start = view.byteOffset + (accessor.byteOffset or 0)
        return np.frombuffer(self.blob, f"<{dtype}", accessor.count * width, start).reshape(-1, width)

    def attribute(self, name, mesh=0):
        index = getattr(self.gltf.meshes[mesh].primitives[0].attributes, name, None)
        return None if index is None else self.accessor(index)

    def tracks(self):
        """Return times and values by node and path."""
        clip, found = self.gltf.animations[0], {}
        for channel in clip.channels:
            sampler = clip.samplers[channel.sampler]
            values = self.accessor(sampler.output).astype(float)
            found[channel.target.node, channel.target.path] = self.accessor(sampler.input)[:, 0].astype(float), values
        return found

    def seconds(self):
        return self.accessor(self.gltf.animations[0].samplers[0].input)[:, 0]

    def world(self, time=None):
        """Return the transforms of all nodes."""
        local = [np.eye(4) for _ in self.gltf.nodes]
        for matrix, node in zip(local, self.gltf.nodes, strict=True):
            matrix[:3, :3] = Rotation.from_quat(node.rotation or (0, 0, 0, 1)).as_matrix()
            matrix[:3, 3] = node.translation or (0, 0, 0)
        for (node, path), (keys, values) in self.tracks().items() if time is not None else ():
            at = float(np.clip(time, keys[0], keys[-1]))
            if path == "translation":
                local[node][:3, 3] = [np.interp(at, keys, row) for row in values.T]
            else:
                turns = Rotation.from_quat(values)
                local[node][:3, :3] = (Slerp(keys, turns)(at) if len(keys) > 1 else turns[0]).as_matrix()
        world = [np.eye(4)] * len(local)

        def visit(index, above):
            world[index] = above @ local[index]
            for child in self.gltf.nodes[index].children:
                visit(child, world[index])

        for root in self.gltf.scenes[self.gltf.scene or 0].nodes:
            visit(root, np.eye(4))
        return world

    def joint_names(self):
        return [self.gltf.nodes[node].name for node in self.gltf.skins[0].joints]

    def joints(self, time=None):
        world = self.world(time)
        return np.stack([world[node] for node in self.gltf.skins[0].joints])

    def skinned(self, time):
        inverse = self.accessor(self.gltf.skins[0].inverseBindMatrices).astype(float)
        matrices = self.joints(time) @ inverse.reshape(-1, 4, 4).transpose(0, 2, 1)
        points = np.c_[self.attribute("POSITION").astype(float), np.ones(len(self.attribute("POSITION")))]
        posed = np.zeros_like(points)
        for number in "01":
            if (joints := self.attribute(f"JOINTS_{number}")) is not None:
                posed += np.einsum("vk,vkab,vb->va", self.attribute(f"WEIGHTS_{number}"), matrices[joints], points)
        return posed[:, :3]

    def morphed(self, time, name="POSITION"):
        ((times, shares),), targets = self.tracks().values(), self.gltf.meshes[0].primitives[0].targets
        weights = [np.interp(time, times, row) for row in shares.reshape(len(times), -1).T]
        moves = [weight * self.accessor(target[name]) for weight, target in zip(weights, targets, strict=True)]
        return self.attribute(name) + sum(moves)

    def at(self, time):
        """Return the vertices (V, 3) of the first mesh."""
        return self.skinned(time) if self.gltf.skins else self.morphed(time)

    def vertices(self, frame):
        return self.at(float(self.seconds()[frame]))
