"""Registered bones as glTF: a viewer's own evaluation of the file equals the model's deformation."""

import json
import os
import shutil
import subprocess

import numpy as np
import pytest
import torch

from torchreg.errors import InputError
from torchreg.geometry.mesh import unit_sphere
from torchreg.geometry.rigid import se3_exp
from torchreg.registration.bones.grid_lbs import GridLBS
from torchreg.registration.bones.sparse_grid import SparseGrid
from torchreg.viz.scan_gltf import save_grid_animation

VALIDATOR = os.environ.get("GLTF_VALIDATOR", "")


def scene(bones=6, blend="linear", smooth=False, scale=1.0, dtype=torch.float64):
    mesh = unit_sphere(2)
    points = scale * (mesh.vertices.double() * torch.tensor([3.0, 1.0, 0.8]))
    grid = SparseGrid.from_points(points, 12)
    seeds = points[:: len(points) // bones][:bones]
    far = torch.cdist(grid.cell_centers(), seeds)
    motions = se3_exp(0.5 * torch.randn(bones, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64))
    motions[:, :3, 3] *= scale
    model = GridLBS.from_labels(grid, far.argmin(1), bones, motions, blend=blend)
    if smooth:
        soft = torch.softmax(-4 * torch.cdist(grid.corner_points(), seeds) / scale, dim=-1)
        model = GridLBS(grid, soft, motions, blend=blend)
    return model.to(dtype), points.to(dtype), mesh.faces


@pytest.mark.parametrize("hierarchy", ["tree", "flat"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_both_poses_are_those_of_the_model(gltf_viewer, tmp_path, hierarchy, dtype, scale):
    model, points, faces = scene(bones=4, scale=scale, dtype=dtype)
    written = save_grid_animation(tmp_path / "scan.glb", model, points, faces, hierarchy=hierarchy)
    assert written.path == tmp_path / "scan.glb"
    viewer = gltf_viewer(written.path)
    size = float((points.amax(0) - points.amin(0)).norm())
    np.testing.assert_allclose(viewer.vertices(0), points.numpy(), atol=1e-5 * size)
    np.testing.assert_allclose(viewer.vertices(1), model(points).detach().numpy(), atol=1e-5 * size)
    assert written.residual < 1e-5 * size
    assert (max(written.parents) >= 0) == (hierarchy == "tree")
    names = [viewer.gltf.nodes[node].name for node in viewer.gltf.skins[0].joints]
    assert names == [f"bone_{number}" for number in range(4)]


def test_many_poses_are_played_at_their_times(gltf_viewer, tmp_path):
    model, points, faces = scene()
    generator = torch.Generator().manual_seed(1)
    poses = se3_exp(torch.randn(4, 6, 6, generator=generator, dtype=torch.float64))
    times = torch.tensor([0.0, 0.1, 0.5, 2.0])
    path = save_grid_animation(tmp_path / "a.glb", model, points, faces, poses, times, most_weights=8).path
    viewer = gltf_viewer(path)
    seconds = viewer.read(viewer.gltf.animations[0].samplers[0].input)[:, 0]
    np.testing.assert_allclose(seconds, times.numpy())
    for frame in range(4):
        np.testing.assert_allclose(viewer.vertices(frame), model(points, poses[frame]).detach().numpy(), atol=1e-4)
    several = GridLBS(model.grid, model.weights, poses)
    own = gltf_viewer(save_grid_animation(tmp_path / "b.glb", several, points, faces, most_weights=8).path)
    np.testing.assert_allclose(own.vertices(0), points.numpy(), atol=1e-5)
    np.testing.assert_allclose(own.vertices(3), viewer.vertices(2), atol=1e-5)


@pytest.mark.parametrize(("up", "y"), [((0, 0, 1), (2, 1)), ((0, -1, 0), (1, -1)), ((1, 0, 0), (0, 1))])
def test_what_is_upright_is_y_in_the_file(gltf_viewer, tmp_path, up, y):
    model, points, faces = scene(bones=3)
    viewer = gltf_viewer(save_grid_animation(tmp_path / "a.glb", model, points, faces, up=up).path)
    axis, sign = y
    for frame, expected in enumerate((points, model(points).detach())):
        shown = viewer.vertices(frame)
        np.testing.assert_allclose(shown[:, 1], sign * expected[:, axis].numpy(), atol=1e-5)
        np.testing.assert_allclose(np.linalg.norm(shown, axis=1), expected.norm(dim=-1).numpy(), atol=1e-5)


def test_the_residual_is_what_dropped_weights_cost(gltf_viewer, tmp_path):
    model, points, faces = scene(bones=9, smooth=True)
    truth = model(points).detach().numpy()
    residuals = {}
    for most in (4, 8):
        written = save_grid_animation(tmp_path / f"{most}.glb", model, points, faces, most_weights=most)
        off = np.linalg.norm(gltf_viewer(written.path).vertices(1) - truth, axis=1).max()
        assert written.residual == pytest.approx(off, abs=1e-5)
        residuals[most] = written.residual
    assert 0 < residuals[8] < residuals[4]


def test_the_residual_of_dual_quaternions_is_that_of_the_linear_blend(gltf_viewer, tmp_path):
    model, points, faces = scene(blend="dual_quaternion")
    written = save_grid_animation(tmp_path / "a.glb", model, points, faces)
    off = np.linalg.norm(gltf_viewer(written.path).vertices(1) - model(points).detach().numpy(), axis=1).max()
    assert written.residual == pytest.approx(off, abs=1e-5)
    assert off > 1e-3


def test_colors_and_normals_are_the_callers(gltf_viewer, tmp_path):
    model, points, faces = scene()
    red = torch.tensor([1.0, 0, 0]).expand(len(points), 3)
    up = torch.tensor([0.0, 0, 2.0]).expand(len(points), 3)
    viewer = gltf_viewer(save_grid_animation(tmp_path / "a.glb", model, points, faces, colors=red, normals=up).path)
    attributes = viewer.gltf.meshes[0].primitives[0].attributes
    np.testing.assert_allclose(viewer.read(attributes.COLOR_0)[:, :3], red.numpy())
    np.testing.assert_allclose(viewer.read(attributes.NORMAL), up.numpy() / 2)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"hierarchy": "ring"}, "hierarchy must be one of"),
        ({"most_weights": 5}, "most_weights must be 4 or 8"),
        ({"points": torch.zeros(0, 3)}, "points must hold at least 1"),
        ({"poses": torch.eye(4)}, "poses must have shape"),
        ({"poses": torch.zeros(0, 6, 4, 4)}, "poses must hold at least one"),
        ({"poses": 2 * torch.eye(4).repeat(1, 6, 1, 1)}, "poses must hold rigid motions"),
        ({"times": torch.zeros(3)}, "times must have shape"),
        ({"path": "a.gltf"}, "path must end in .glb"),
    ],
)
def test_bad_input_is_named(tmp_path, change, message):
    model, points, faces = scene()
    arguments = {"path": "a.glb", "model": model, "points": points, "faces": faces} | change
    arguments["path"] = tmp_path / arguments["path"]
    with pytest.raises(InputError, match=message):
        save_grid_animation(**arguments)


@pytest.mark.skipif(
    not VALIDATOR or shutil.which("node") is None,
    reason="set GLTF_VALIDATOR to the folder of the npm package gltf-validator",
)
def test_khronos_validator_finds_nothing(tmp_path):
    model, points, faces = scene(bones=9, smooth=True)
    files = [
        save_grid_animation(
            tmp_path / f"{tree}{most}.glb", model, points, faces, most_weights=most, hierarchy=tree
        ).path
        for most in (4, 8)
        for tree in ("tree", "flat")
    ]
    script = (
        "const v=require(process.argv[1]),fs=require('fs');"
        "for(const f of process.argv.slice(2))v.validateBytes(new Uint8Array(fs.readFileSync(f)))"
        ".then(r=>console.log(JSON.stringify(r.issues)));"
    )
    command = ["node", "-e", script, VALIDATOR, *map(str, files)]
    output = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout
    for line in output.strip().splitlines():
        issues = json.loads(line)
        assert (issues["numErrors"], issues["numWarnings"]) == (0, 0), issues["messages"]
