"""Benchmarks of robots, rigs and users' files on small files made here."""

import math
import re
import sys

import numpy as np
import pytest
import torch
import trimesh

import torchreg as tr
from tests.rigging.conftest import bending_arm, posed
from torchreg.io.gltf_write import save_animated_skin


def link(name, x, z, solid):
    origin = f'<origin xyz="{x} 0 {z}"/>'
    return f'<link name="{name}"><visual>{origin}<geometry>{solid}</geometry></visual></link>'


def joint(name, kind, parent, child, xyz, axis, lower, upper):
    ends = f'<parent link="{parent}"/><child link="{child}"/><origin xyz="{xyz}"/><axis xyz="{axis}"/>'
    limit = f'<limit lower="{lower}" upper="{upper}" effort="1" velocity="1"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{limit}</joint>'


# A box on a hinge whose limits exclude zero, a box that slides, and a round cap that turns about its own axis.
ARM = [
    link("base", 0, 0, '<box size="0.2 0.16 0.1"/>'), link("upper", 0.15, 0, '<box size="0.3 0.06 0.08"/>'),
    link("slide", 0.08, 0, '<box size="0.16 0.04 0.05"/>'), link("cap", 0, 0, '<sphere radius="0.04"/>'),
    joint("hinge", "revolute", "base", "upper", "0.1 0 0", "0 0 1", 0.4, 1.6),
    joint("rail", "prismatic", "upper", "slide", "0.3 0 0", "1 0 0", 0, 0.05),
    joint("flange", "revolute", "slide", "cap", "0.2 0 0", "1 0 0", -3, 3),
]  # fmt: skip
# A box on the ground, and one that turns on it.
TOWER = [
    link("base", 0, 0, '<box size="0.3 0.3 0.2"/>'), link("upper", 0, 0.3, '<box size="0.1 0.08 0.6"/>'),
    joint("hinge", "revolute", "base", "upper", "0 0 0.1", "0 1 0", -1.6, 1.6),
]  # fmt: skip
TENSOR = {"dtype": torch.float64}


def written(path, lines):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f'<?xml version="1.0"?><robot name="arm">{"".join(lines)}</robot>', encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def arm_file(tmp_path_factory):
    return written(tmp_path_factory.mktemp("robot") / "robots" / "arm" / "urdf" / "arm.urdf", ARM)


@pytest.fixture
def sphere():
    """A ball of radius 1 as vertices and faces."""
    ball = trimesh.creation.icosphere(3)
    return torch.tensor(np.array(ball.vertices)), torch.tensor(np.array(ball.faces)).long()


def test_a_small_robot_gives_a_table_and_a_size(load, arm_file, monkeypatch, capsys):
    bench = load("robot")
    monkeypatch.setattr(bench, "ROBOTS", {"Allegro hand": "arm/urdf/arm.urdf"})
    assert bench.main(["--data", str(arm_file.parents[2]), "--smoke", "--search", "never"]) == 0
    printed = capsys.readouterr().out
    assert "Allegro hand, free base" in printed
    assert "flange 100%" in printed
    box = written(arm_file.with_name("box.urdf"), TOWER[:1])
    monkeypatch.setattr(sys, "argv", ["gltf_sizes.py", str(box)])
    load("gltf_sizes").main()
    assert capsys.readouterr().out.split() == ["box", "12", "triangles", "0.00", "MB"]


@pytest.fixture
def robots(load, tmp_path, monkeypatch):
    bench = load("scan_robots")
    written(tmp_path / "robots" / "arm.urdf", TOWER)
    monkeypatch.setattr(bench, "ROBOTS", {"arm": "arm.urdf", "missing": "missing.urdf"})
    monkeypatch.setattr(bench, "SCANNER", bench.DepthScanner(num_points=600, noise=0.0, num_holes=0))
    return tmp_path / "robots"


def test_truths_of_robots_are_where_the_target_was_scanned(load, robots, capsys):
    bench = load("scan_robots")
    (thing,) = bench.robots(robots)
    with torch.no_grad():
        pair = bench.make_pair(thing, 2, 0)
    moved = (pair.truth - pair.source.points).norm(dim=-1)
    # The upper box moves; the ground does not.
    assert float((moved < 1e-6).double().mean()) > 0.2
    assert float((moved > 0.01).double().mean()) > 0.2
    assert float(torch.cdist(pair.truth, pair.target.points).amin(1).median()) < float(pair.target.spacing)
    assert bench.main(["--robots", str(robots), "--smoke"]) == 0
    assert "1 /   1" in capsys.readouterr().out


@pytest.fixture
def finger(sphere):
    """A stretched sphere of 12 cm along y with a palm and two phalanges."""
    vertices = sphere[0].float() * torch.tensor([0.01, 0.06, 0.008])
    along = vertices[:, 1]
    split = torch.stack([torch.sigmoid((along + 0.02) / 0.002), torch.sigmoid((along - 0.02) / 0.002)], dim=-1)
    weights = torch.stack([1 - split[:, 0], split[:, 0] - split[:, 1], split[:, 1]], dim=-1).clamp_min(0)
    joints = torch.tensor([[0.0, -0.06, 0.0], [0.0, -0.02, 0.0], [0.0, 0.02, 0.0]])
    names = ["wrist", "index-finger-phalanx-proximal", "index-finger-phalanx-distal"]
    return tr.ArticulatedShape.from_skinned_mesh(
        vertices, sphere[1], weights, joints, [-1, 0, 1], joint_names=names, axes={name: ["x"] for name in names[1:]}
    )


def test_a_small_rigged_hand_gives_a_table(load, finger, capsys):
    bench = load("rig_hand")
    parents = bench.hand_parents()
    assert len(parents) == 25
    assert [name for name, parent in parents.items() if parent is None] == ["wrist"]
    assert parents["thumb-phalanx-distal"] == "thumb-phalanx-proximal"
    pose = bench.flexed_pose(finger, 15)
    torch.testing.assert_close(pose[6:], torch.full((2,), -math.radians(15)))
    with torch.no_grad():
        assert bench.make_problem(finger.file_skin(), pose, 0, 450).data.shape == (500, 3)
        rows = bench.compare(finger, (15,), 1, rivals=False, count=450)
    by_name = {row.method: row for row in rows}
    assert by_name["torchreg, file skin"].mean[0] < 0.3 * by_name["not aligned"].mean[0]
    assert [row.method for row in rows if not row.judged] == ["not aligned", "bending skin on the true pose"]
    bench.print_table(rows)
    assert len(capsys.readouterr().out.splitlines()) == len(rows) + 2


@pytest.fixture
def bar_file(sphere, tmp_path):
    """A bar of two bones whose second moves up in its clip, and two files that are no rigs."""
    vertices = sphere[0] * torch.tensor([0.3, 0.05, 0.05])
    second = torch.sigmoid(40 * vertices[:, 0])
    rest = torch.eye(4, **TENSOR).repeat(2, 1, 1)
    rest[0, 0, 3] = -0.3
    moving = rest.repeat(2, 1, 1, 1)
    moving[1, :, 1, 3] = 0.1
    weights, times = torch.stack([1 - second, second], dim=-1), torch.tensor([0.0, 1.0])
    save_animated_skin(tmp_path / "bar.glb", vertices, sphere[1], weights, ["a", "b"], [-1, 0], rest, moving, times)
    for name in "cd":
        (tmp_path / f"{name}.gltf").write_text("{}", encoding="utf-8")
    return tmp_path / "bar.glb"


def test_a_folder_of_rigs_is_summed_up(load, bar_file, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["public_rigs.py", "--data", str(bar_file.parent)])
    load("public_rigs").main()
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("1 of 3 opened")
    assert [row.split()[:2] for row in lines[1:]] == [["loaded", "1"], ["refined", "1"], ["refused", "2"]]
    assert "no node carries both a mesh and a skin" in lines[3]


def test_a_rig_of_a_sequence_is_nearer_than_what_stands_still(load, tmp_path, capsys):
    arm = bending_arm()
    stored = torch.stack([posed(arm, angle) for angle in (0.0, 0.4, 0.8)])
    np.savez(tmp_path / "arm.npz", vertices=stored.numpy(), faces=arm.mesh.faces.numpy())
    load("rig_sequence").main(["--data", str(tmp_path), "--captured", "arm"])
    (row,) = capsys.readouterr().out.splitlines()
    moved, still = (float(re.search(rf"{word} +([\d.]+)%", row)[1]) for word in ("rig", "still"))
    assert moved < 0.3 * still
    load("rig_sequence").main([])
    assert "--data" in capsys.readouterr().out
