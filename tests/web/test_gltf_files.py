"""Every kind of glTF file: no finding of the Khronos validator, and numpy and three.js play what torchreg says."""

import json
import os
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pygltflib
import pytest
import torch
from scipy.spatial.transform import Rotation, Slerp

from torchreg.datasets.hand import hand_motion
from torchreg.geometry.mesh import unit_sphere
from torchreg.io.gltf_morph import save_vertex_animation
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.hand import Hand
from torchreg.spines.spine import Spine
from torchreg.viz.gltf import save_shape_animation
from torchreg.viz.pose_editor import PoseEditor
from torchreg.viz.posed_scenes import coarse_skin
from torchreg.viz.scan_gltf import save_grid_animation
from torchreg.viz.spine_gltf import save_spine_animation

HERE = Path(__file__).parent
DTYPES = {5121: np.uint8, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
KINDS = ("track", "registration", "poses", "sequence", "spine", "vertices")


@pytest.fixture(scope="module")
def node():
    """Return the function that runs a script under node and gives what it prints."""
    modules = Path(os.environ.get("TORCHREG_NODE_MODULES", HERE / "node_modules"))
    if shutil.which("node") is None or not (modules / "gltf-validator").is_dir():
        pytest.skip("checks of glTF files need node and: npm ci --prefix tests/web")

    def run(script, *arguments):
        # Packages are looked up beside the script.
        command = ["node", str(modules.parent / script), *map(str, arguments)]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=120).stdout

    return run


@pytest.fixture(scope="module")
def files(tmp_path_factory, registered_toy):
    """Return by kind: the file, times in it, and where torchreg has the vertices at these times."""
    place, found = tmp_path_factory.mktemp("gltf"), {}
    hand = Hand()
    poses = hand_motion(hand, "bend", 4)
    skin = coarse_skin(hand)
    times = torch.tensor([0.0, 0.25, 0.5, 1.0])
    path = save_shape_animation(place / "track.glb", hand, poses, times, skin=skin)
    with torch.no_grad():
        found["track"] = path, times, skin(poses)
        model, points, faces = registered_toy.model, registered_toy.points, registered_toy.faces
        weights = model.vertex_weights(points, most=4)
        rest = torch.eye(4).expand_as(registered_toy.transforms)
        keys = torch.stack([rest, registered_toy.transforms])
        path = save_grid_animation(place / "registration.glb", model, points, faces).path
        found["registration"] = path, torch.tensor([0.0, 1.0]), model.move(points, weights, keys)
        # Upright is what it is in the file: nothing is turned.
        editor = PoseEditor(replace(registered_toy, up=(0.0, 1.0, 0.0)))
        editor.add_key()
        for vertex, shift in ((0, 0.05), (len(points) // 2, -0.05)):
            editor.add_handle(vertex)
            editor.drag({len(editor.state.vertices) - 1: points[vertex] + shift})
            editor.add_key()
        at = torch.tensor([0.0, 0.3, 1.0, 1.5, 2.0])
        between = editor.animation(10)[(10 * at).long()]
        found["poses"] = editor.save_gltf(place / "poses.glb"), at, model.move(points, weights, between)
        path = save_grid_animation(place / "sequence.glb", model, points, faces, keys, hierarchy="flat").path
        found["sequence"] = path, torch.tensor([0.0, 1.0]), model.move(points, weights, keys)
        found["spine"] = spine_file(place / "spine.glb")
        frames = torch.stack([points, registered_toy.deformed, points + 0.1])
        path = save_vertex_animation(place / "vertices.glb", frames, faces, torch.arange(3.0))
        found["vertices"] = (
            path,
            torch.tensor([0.0, 0.5, 1.0, 2.0]),
            torch.stack([frames[0], frames[:2].mean(0), *frames[1:]]),
        )
    return found


def spine_file(path):
    """Return a spine that moves without turning, and with it the surface that is bound to it."""
    line = torch.linspace(1, 0, 9, dtype=torch.float64).unsqueeze(-1)
    still = line * torch.tensor([[1.0, 0, 0], [-0.5, 0.9, 0], [-0.5, -0.9, 0]]).double().unsqueeze(1)
    curves = torch.stack([still, still + torch.tensor([0.0, 0, 0.3])])
    spine = Spine(curves, torch.tensor([[0, 3], [1, 3], [2, 3]]), torch.full((2, 3, 9), 0.1).double())
    ball = unit_sphere(2)
    save_spine_animation(path, spine, ball, fps=1.0)
    shift = torch.tensor([0.0, 0.0, 0.3])
    return path, torch.tensor([0.0, 1.0]), torch.stack([ball.vertices, ball.vertices + shift])


class Player:
    """Evaluates a file with numpy as the specification says: tracks, hierarchy, inverse bind matrices, skin."""

    def __init__(self, path):
        self.gltf = pygltflib.GLTF2().load(str(path))
        self.blob = self.gltf.binary_blob()

    def read(self, index):
        accessor = self.gltf.accessors[index]
        width = WIDTHS[accessor.type]
        start = self.gltf.bufferViews[accessor.bufferView].byteOffset
        values = np.frombuffer(self.blob, DTYPES[accessor.componentType], accessor.count * width, start)
        return values.reshape(-1, width)

    def vertices(self, time):
        local = [self.local(node) for node in self.gltf.nodes]
        for channel in self.gltf.animations[0].channels:
            sampler = self.gltf.animations[0].samplers[channel.sampler]
            keys, values = self.read(sampler.input)[:, 0].astype(float), self.read(sampler.output).astype(float)
            at = float(np.clip(time, keys[0], keys[-1]))
            if channel.target.path == "weights":
                continue
            if channel.target.path == "translation":
                local[channel.target.node][:3, 3] = [np.interp(at, keys, row) for row in values.T]
            else:
                local[channel.target.node][:3, :3] = Slerp(keys, Rotation.from_quat(values))(at).as_matrix()
        world = {}

        def visit(node, above):
            world[node] = above @ local[node]
            for child in self.gltf.nodes[node].children:
                visit(child, world[node])

        for root in self.gltf.scenes[0].nodes:
            visit(root, np.eye(4))
        if not self.gltf.skins:
            return self.morphed(time)
        skin = self.gltf.skins[0]
        inverse = self.read(skin.inverseBindMatrices).astype(float).reshape(-1, 4, 4).transpose(0, 2, 1)
        joints = np.stack([world[node] @ bind for node, bind in zip(skin.joints, inverse, strict=True)])
        attributes = self.gltf.meshes[0].primitives[0].attributes
        points = self.read(attributes.POSITION).astype(float)
        points = np.c_[points, np.ones(len(points))]
        assert not hasattr(attributes, "WEIGHTS_1")  # viewers look at four weights
        weights = self.read(attributes.WEIGHTS_0)
        moved = np.einsum("vsij,vj->vsi", joints[self.read(attributes.JOINTS_0)], points)
        return np.einsum("vs,vsi->vi", weights, moved)[:, :3]

    def morphed(self, time):
        primitive, (sampler,) = self.gltf.meshes[0].primitives[0], self.gltf.animations[0].samplers
        keys = self.read(sampler.input)[:, 0]
        shares = self.read(sampler.output).reshape(len(keys), -1)
        moves = [
            np.interp(time, keys, row) * self.read(move["POSITION"])
            for row, move in zip(shares.T, primitive.targets, strict=True)
        ]
        return self.read(primitive.attributes.POSITION) + sum(moves)

    @staticmethod
    def local(node):
        matrix = np.eye(4)
        if node.translation is not None:
            matrix[:3, 3] = node.translation
        if node.rotation is not None:
            matrix[:3, :3] = Rotation.from_quat(node.rotation).as_matrix()
        return matrix


def check(found, expected):
    """Compare vertices: files of spines hold tubes around the limbs before the surface."""
    size = float((expected[0].amax(0) - expected[0].amin(0)).norm())
    for own, right in zip(found, expected, strict=True):
        np.testing.assert_allclose(np.asarray(own)[-len(right) :], right.numpy(), atol=1e-5 * max(size, 1.0))


@pytest.mark.parametrize("kind", KINDS)
def test_numpy_plays_what_torchreg_says(files, kind):
    path, times, expected = files[kind]
    player = Player(path)
    check([player.vertices(float(time)) for time in times], expected)


@pytest.mark.parametrize("kind", KINDS)
def test_three_plays_what_torchreg_says(files, kind, node):
    path, times, expected = files[kind]
    check(json.loads(node("play_gltf.mjs", path, *times.tolist())), expected)


def test_the_validator_finds_nothing(files, node):
    lines = node("validate_gltf.cjs", *(path for path, _, _ in files.values())).strip().splitlines()
    assert len(lines) == len(KINDS)
    for kind, line in zip(files, lines, strict=True):
        issues = json.loads(line)
        assert (issues["numErrors"], issues["numWarnings"]) == (0, 0), (kind, issues["messages"])


def test_a_refitted_rig_passes_and_plays(files, node, tmp_path):
    source, times, _ = files["track"]
    rig = ArticulatedShape.from_gltf(source).with_bone_coefficients()
    changes = 0.05 * torch.randn(len(rig.coefficient_names), generator=torch.Generator().manual_seed(0))
    path = rig.with_coefficients(changes).to_gltf(tmp_path / "grown.glb", source)
    issues = json.loads(node("validate_gltf.cjs", path))
    assert (issues["numErrors"], issues["numWarnings"]) == (0, 0), issues["messages"]
    player = Player(path)
    expected = torch.from_numpy(np.stack([player.vertices(float(time)) for time in times]))
    assert float((expected[0] - expected[-1]).abs().max()) > 0.02
    check(json.loads(node("play_gltf.mjs", path, *times.tolist())), expected)
