"""How the tests of the command line run commands, and the files that they give them."""

import json
import math
import re

import pytest
import torch
from typer.testing import CliRunner

from torchreg.cli.application import app
from torchreg.datasets.hand import hand_motion
from torchreg.datasets.sequences import range_clouds
from torchreg.io.gltf_write import save_animated_skin
from torchreg.io.points import save_points
from torchreg.shapes.articulated import ArticulatedShape
from torchreg.shapes.hand import Hand

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
def error_of(run):
    """Return the function that gives the one line with which a command fails."""

    def error(*arguments):
        answer = run(*arguments)
        assert answer.exit_code == 2, answer.output
        lines = [line for line in re.split(r"[\r\n]", answer.output) if line.startswith("torchreg: ")]
        assert len(lines) == 1
        assert "Traceback" not in answer.output
        return lines[0]

    return error


@pytest.fixture
def failing(monkeypatch):
    """Return the function that lets functions fail, named by module and name, as a library that draws may."""

    def fail(*names):
        def broken(*arguments, **options):
            raise ArithmeticError("no\nroom")

        for name in names:
            monkeypatch.setattr(name, broken)

    return fail


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """Return a folder with four clouds of a moving hand, a start, a robot and a rig whose nodes are flat."""
    place = tmp_path_factory.mktemp("files")
    poses = hand_motion(Hand(), "bend", 4)
    clouds = range_clouds(Hand(), poses, num_points=300, outlier_ratio=0.2, camera=torch.zeros(3))
    for index, cloud in enumerate(clouds):
        save_points(place / f"cloud{index}.ply", cloud.points)
        truth = dict(zip(Hand().dof_names, cloud.pose.tolist(), strict=True))
        (place / f"truth{index}.json").write_text(json.dumps(truth), encoding="utf-8")
    (place / "arm.urdf").write_text(ROBOT, encoding="utf-8")
    arm = ArticulatedShape.from_urdf(place / "arm.urdf")
    save_points(place / "arm.npz", arm.surface_mesh(spacing=0.02).vertices[::4] + torch.tensor([0.02, 0.0, 0.0]))
    write_flat_rig(place / "flat.glb")
    (place / "parents.json").write_text('{"root": null, "middle": "root", "end": "middle"}', encoding="utf-8")
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
