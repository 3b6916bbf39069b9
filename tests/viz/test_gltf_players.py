"""Every kind of glTF file: no finding of the Khronos validator, and numpy and three.js play what torchreg says."""

import json
import os
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import torchreg as tr
from tests.rigging.conftest import arm, frames, rig  # noqa: F401
from torchreg.io.gltf_file.morph import save_vertex_animation
from torchreg.io.gltf_write import save_animated_parts
from torchreg.viz import gltf, pose_editor, scan_gltf, spine_gltf

WEB = Path(__file__).parents[1] / "web"
KINDS = ("track", "registration", "poses", "sequence", "spine", "vertices", "rig")


@pytest.fixture(scope="module")
def node():
    """Return the function that runs a script under node and gives what it prints."""
    modules = Path(os.environ.get("TORCHREG_NODE_MODULES", WEB / "node_modules"))
    if shutil.which("node") is None or not (modules / "gltf-validator").is_dir():
        pytest.skip("checks of glTF files need node and: npm ci --prefix tests/web")

    def run(script, *arguments):
        # Packages are looked up beside the script.
        command = ["node", str(modules.parent / script), *map(str, arguments)]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=120).stdout

    return run


@pytest.fixture(scope="module")
@torch.no_grad()
def files(tmp_path_factory, tools, plain_hand, coarse, bend, registration, spine, rig):  # noqa: F811
    """Return by kind: the file, times in it, and where torchreg has the vertices at these times."""
    place, found, ends = tmp_path_factory.mktemp("gltf"), {}, torch.tensor([0.0, 1.0])
    times = torch.tensor([0.0, 0.25, 0.5, 1.0])
    path = gltf.save_shape_animation(place / "track.glb", plain_hand, bend[:4], times, skin=coarse)
    found["track"] = path, times, coarse(bend[:4])
    model, points, faces = registration.model, registration.points, registration.faces
    weights = model.vertex_weights(points, most=4)
    keys = torch.stack([torch.eye(4).double().expand_as(registration.transforms), registration.transforms])
    for kind, hierarchy in (("registration", "tree"), ("sequence", "flat")):
        written = scan_gltf.save_grid_animation(place / f"{kind}.glb", model, points, faces, keys, hierarchy=hierarchy)
        found[kind] = written.path, ends, model.move(points, weights, keys)
    # Upright is what it is in the file: nothing is turned.
    with torch.enable_grad():
        editor = pose_editor.PoseEditor(replace(registration, up=(0.0, 1.0, 0.0)))
        editor.add_key()
        for vertex, shift in ((0, 0.05), (len(points) // 2, -0.05)):
            editor.add_handle(vertex)
            editor.drag({len(editor.state.vertices) - 1: points[vertex] + shift})
            editor.add_key()
        at = torch.tensor([0.0, 0.3, 1.0, 1.5, 2.0])
        between = editor.animation(10)[(10 * at).long()]
    found["poses"] = editor.save_gltf(place / "poses.glb"), at, model.move(points, weights, between)
    # A spine that moves without turning, and with it the surface that is bound to it.
    ball, shift = tools.ball(2), torch.tensor([0.0, 0.0, 0.4])
    path = spine_gltf.save_spine_animation(place / "spine.glb", spine.model, ball, fps=0.5)
    found["spine"] = path, 4 * ends, torch.stack([ball.vertices, ball.vertices + shift])
    keyed = torch.stack([points, registration.deformed, points + 0.1])
    path = save_vertex_animation(place / "vertices.glb", keyed, faces, torch.arange(3.0))
    morphed = torch.stack([keyed[0], keyed[:2].mean(0), *keyed[1:]])
    found["vertices"] = path, torch.tensor([0.0, 0.5, 1.0, 2.0]), morphed
    found["rig"] = rig.to_gltf(place / "rig.glb", fps=2.0), 0.5 * torch.arange(len(rig.poses)), rig.vertices()
    return found


def check(found, expected):
    """Compare vertices: files of spines hold tubes around the limbs before the surface."""
    size = float((expected[0].amax(0) - expected[0].amin(0)).norm())
    for own, right in zip(found, expected, strict=True):
        np.testing.assert_allclose(np.asarray(own)[-len(right) :], right.numpy(), atol=1e-5 * max(size, 1.0))


@pytest.mark.parametrize("kind", KINDS)
def test_numpy_plays_what_torchreg_says(tools, files, kind):
    path, times, expected = files[kind]
    player = tools.play(path)
    check([player.at(float(time)) for time in times], expected)
    assert player.attribute("WEIGHTS_1") is None  # viewers look at four weights


@pytest.mark.parametrize("kind", KINDS)
def test_three_plays_what_torchreg_says(files, kind, node):
    path, times, expected = files[kind]
    check(json.loads(node("play_gltf.mjs", path, *times.tolist())), expected)


def test_the_validator_finds_nothing(tools, files, node, tmp_path):
    paths = {kind: path for kind, (path, _, _) in files.items()}
    moving, balls = torch.eye(4).expand(2, 2, 4, 4), [tools.ball(1), None]
    paths["parts"] = save_animated_parts(tmp_path / "a.glb", balls, moving, torch.arange(2), parents=[-1, 0])
    lines = node("validate_gltf.cjs", *paths.values()).strip().splitlines()
    for kind, line in zip(paths, lines, strict=True):
        issues = json.loads(line)
        assert (issues["numErrors"], issues["numWarnings"]) == (0, 0), (kind, issues["messages"])


def test_a_refitted_rig_passes_and_plays(tools, files, node, tmp_path):
    source, times, _ = files["track"]
    refitted = tr.ArticulatedShape.from_gltf(source).with_bone_coefficients()
    changes = 0.05 * torch.randn(len(refitted.coefficient_names), generator=torch.Generator().manual_seed(0))
    path = refitted.with_coefficients(changes).to_gltf(tmp_path / "grown.glb", source)
    issues = json.loads(node("validate_gltf.cjs", path))
    assert (issues["numErrors"], issues["numWarnings"]) == (0, 0), issues["messages"]
    player = tools.play(path)
    expected = torch.from_numpy(np.stack([player.at(float(time)) for time in times]))
    assert float((expected[0] - expected[-1]).abs().max()) > 0.02
    check(json.loads(node("play_gltf.mjs", path, *times.tolist())), expected)
