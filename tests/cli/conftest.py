"""How the tests of the command line run commands, and the files that they give them."""

import json
import math
import re

import numpy as np
import pytest
import torch
from PIL import Image
from typer.testing import CliRunner

import torchreg as tr
from torchreg.cli.application import app
from torchreg.datasets.creatures import STARFISH, creature_sequence
from torchreg.datasets.depth_scanner import DepthScanner
from torchreg.datasets.hand import hand_motion
from torchreg.datasets.scan_sequences import jointed_toy
from torchreg.datasets.sequences import range_clouds
from torchreg.geometry.visibility import rasterize
from torchreg.io.gltf_write import save_animated_skin
from torchreg.io.points import save_points

ROBOT = """<robot name="arm">
  <link name="base"><visual><geometry><box size="0.2 0.2 0.1"/></geometry></visual></link>
  <link name="upper"><visual><origin xyz="0 0 0.2"/><geometry><cylinder radius="0.04" length="0.4"/></geometry></visual>
  </link>
  <link name="slider"><visual><geometry><sphere radius="0.06"/></geometry></visual></link>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><origin xyz="0 0 0.05"/>
    <axis xyz="0 1 0"/><limit lower="-1.5707963267948966" upper="1.0" effort="1" velocity="1"/></joint>
  <joint name="rail" type="prismatic"><parent link="upper"/><child link="slider"/><origin xyz="0 0 0.4"/>
    <axis xyz="0 0 1"/><limit lower="0" upper="0.25" effort="1" velocity="1"/></joint>
</robot>"""


@pytest.fixture(scope="session")
def run():
    """Return the function that runs a command and gives its answer."""
    return lambda *arguments: CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture(scope="session")
def done(run):
    """Return the function that runs a command, which must succeed, and gives what it prints."""

    def done(*arguments):
        answer = run(*arguments)
        assert answer.exit_code == 0, answer.output
        return answer.output

    return done


@pytest.fixture(scope="session")
def error_of(run):
    """Return the function that gives the one line with which a command fails."""

    def error(*arguments):
        answer = run(*arguments)
        assert answer.exit_code == 2, answer.output
        lines = [line for line in re.split(r"[\r\n]", answer.output) if line.startswith("torchreg: ")]
        lines = [line for line in lines if "goes with the next release" not in line]
        assert len(lines) == 1
        assert "Traceback" not in answer.output
        return lines[0]

    return error


@pytest.fixture
def failing(monkeypatch):
    """Return the function that lets functions fail, named by module and name, as a library that draws may."""

    def broken(*arguments, **options):
        raise ArithmeticError("no\nroom")

    return lambda *names: [monkeypatch.setattr(name, broken) for name in names]


@pytest.fixture
def interrupted(monkeypatch):
    """Return the function that lets a function, by module and name, note its options and end with Ctrl-C."""

    def interrupt(name):
        given = []

        def noted(*arguments, **options):
            given.append((arguments, options))
            raise KeyboardInterrupt

        monkeypatch.setattr(name, noted)
        return given

    return interrupt


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """Return a folder with four clouds of a moving hand, a start, a robot and a rig whose nodes are flat."""
    place = tmp_path_factory.mktemp("files")
    poses = hand_motion(tr.Hand(), "bend", 4)
    clouds = range_clouds(tr.Hand(), poses, num_points=300, outlier_ratio=0.2, camera=torch.zeros(3))
    for index, cloud in enumerate(clouds):
        save_points(place / f"cloud{index}.ply", cloud.points)
        truth = dict(zip(tr.Hand().dof_names, cloud.pose.tolist(), strict=True))
        (place / f"truth{index}.json").write_text(json.dumps(truth), encoding="utf-8")
    (place / "arm.urdf").write_text(ROBOT, encoding="utf-8")
    arm = tr.ArticulatedShape.from_urdf(place / "arm.urdf")
    save_points(place / "arm.npz", arm.surface_mesh(spacing=0.02).vertices[::4] + torch.tensor([0.02, 0.0, 0.0]))
    write_flat_rig(place / "flat.glb")
    (place / "parents.json").write_text('{"root": null, "middle": "root", "end": "middle"}', encoding="utf-8")
    (place / "zeros.json").write_text("{}", encoding="utf-8")
    return place


def write_flat_rig(path):
    """Write a bar along x, skinned to three joints none of which knows its parent.

    It tapers and is egg-shaped: of a round even bar, a reversed one and a turned one explain the data as well.
    """
    along = torch.linspace(0, 0.3, 31)
    around = torch.linspace(0, 2 * math.pi, 9)[:-1]
    x, angle = torch.meshgrid(along, around, indexing="ij")
    radius = 0.04 * (1 - 2 * x) * (1 + 0.4 * angle.cos())
    vertices = torch.stack([x, radius * angle.cos(), radius * angle.sin()], dim=-1).reshape(-1, 3)
    first = (torch.arange(30)[:, None] * 8 + torch.arange(8)).reshape(-1)
    second = (torch.arange(30)[:, None] * 8 + (torch.arange(8) + 1) % 8).reshape(-1)
    triangles = torch.stack([first, second, first + 8], -1), torch.stack([second, second + 8, first + 8], -1)
    owner = (vertices[:, 0] / 0.1).floor().long().clamp(max=2)
    frames = torch.eye(4).repeat(3, 1, 1)
    frames[:, 0, 3] = torch.tensor([0.0, 0.1, 0.2])
    save_animated_skin(
        path, vertices, torch.cat(triangles), torch.nn.functional.one_hot(owner, 3).float(),
        ["root", "middle", "end"], [-1, -1, -1], frames, frames[None], torch.zeros(1),
    )  # fmt: skip


@pytest.fixture(scope="session")
def starfish(tmp_path_factory):
    """A folder with three meshes of a starfish, the second of them number 10 to be last but one by name alone."""
    place = tmp_path_factory.mktemp("starfish")
    for number, mesh in zip((2, 10, 11), creature_sequence(STARFISH, 3, resolution=32).meshes, strict=True):
        save_points(place / f"frame{number}.ply", mesh.vertices, faces=mesh.faces)
    return place


@pytest.fixture(scope="session")
def toy():
    """Two scans of a jointed toy, and what moved."""
    return jointed_toy(2, seed=2, scanner=DepthScanner(num_points=800, num_holes=0), step=math.radians(20))


@pytest.fixture(scope="session")
def registered(tmp_path_factory):
    """Two scans on disk, the registration of the first to the second from the truth, and the truth."""
    place = tmp_path_factory.mktemp("scans")
    pair = jointed_toy(2, seed=2, scanner=DepthScanner(num_points=800), step=math.radians(20)).pair(0, 1)
    for name, scan in (("source", pair.source), ("target", pair.target)):
        save_points(place / f"{name}.ply", scan.points, faces=scan.faces)
    save_points(place / "bare.ply", pair.source.points)
    found = tr.register(pair.source, pair.target, 6, 25, start=pair.truth)
    found.save(place / "found.safetensors")
    return place, found, pair.truth


def depth_of(mesh, camera):
    """Return the depths (H, W) of a mesh in a camera or a view, and whether pixels show it."""
    raster = rasterize(
        mesh, camera.view() if hasattr(camera, "view") else camera, cull_back=not hasattr(camera, "view")
    )
    return raster.depth, raster.face_index >= 0


def save_depth(path, depth, unit):
    """Write depths as a 16-bit picture."""
    Image.fromarray((depth.nan_to_num(0, 0, 0) / unit).round().numpy().astype(np.uint16)).save(path)


def save_picture(path, picture):
    """Write a picture (H, W) or (H, W, 3) in [0, 1]."""
    Image.fromarray((picture.float() * 255).round().numpy().astype(np.uint8)).save(path)


def save_cameras(path, *cameras, **more):
    """Write cameras, one as that of depth pictures."""
    entries = [
        {
            "name": camera.name or "", "width": camera.width, "height": camera.height,
            **dict(zip(("fx", "fy", "cx", "cy"), camera.intrinsics.tolist(), strict=True)),
            "world_to_camera": camera.world_to_camera.tolist(),
        }
        for camera in cameras
    ]  # fmt: skip
    written = entries[0] | more if more else {"format": "torchreg-cameras", "version": 1, "cameras": entries}
    path.write_text(json.dumps(written), encoding="utf-8")
