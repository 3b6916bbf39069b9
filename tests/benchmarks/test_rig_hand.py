import math
import sys

import pytest
import torch

from torchreg.geometry.mesh import unit_sphere
from torchreg.shapes.articulated import ArticulatedShape


@pytest.fixture(scope="module")
def benchmark(loaded_benchmark):
    with loaded_benchmark("rig_hand") as module:
        yield module


@pytest.fixture(scope="module")
def finger():
    """A stretched sphere of 12 cm along y with a palm and two phalanges."""
    mesh = unit_sphere(4)
    vertices = mesh.vertices * torch.tensor([0.01, 0.06, 0.008])
    along = vertices[:, 1]
    split = torch.stack([torch.sigmoid((along + 0.02) / 0.002), torch.sigmoid((along - 0.02) / 0.002)], dim=-1)
    weights = torch.stack([1 - split[:, 0], split[:, 0] - split[:, 1], split[:, 1]], dim=-1).clamp_min(0)
    joints = torch.tensor([[0.0, -0.06, 0.0], [0.0, -0.02, 0.0], [0.0, 0.02, 0.0]])
    names = ["wrist", "index-finger-phalanx-proximal", "index-finger-phalanx-distal"]
    return ArticulatedShape.from_skinned_mesh(
        vertices, mesh.faces, weights, joints, [-1, 0, 1], joint_names=names, axes={name: ["x"] for name in names[1:]}
    )


def test_without_its_data_it_says_so_and_succeeds(benchmark, capsys, tmp_path):
    assert benchmark.main([]) == 0
    assert benchmark.main(["--data", str(tmp_path), "--smoke"]) == 0
    assert capsys.readouterr().out.count("skipped: webxr_hand_right.glb") == 2


def test_every_joint_has_a_parent_and_the_wrist_is_the_root(benchmark):
    parents = benchmark.hand_parents()
    assert len(parents) == 25
    assert [name for name, parent in parents.items() if parent is None] == ["wrist"]
    assert parents["thumb-phalanx-distal"] == "thumb-phalanx-proximal"
    assert parents["ring-finger-phalanx-distal"] == "ring-finger-phalanx-intermediate"


def test_a_small_rig_gives_a_table(benchmark, finger, capsys):
    pose = benchmark.flexed_pose(finger, 15)
    torch.testing.assert_close(pose[6:], torch.full((2,), -math.radians(15)))
    with torch.no_grad():
        problem = benchmark.make_problem(finger.file_skin(), pose, 0, 450)
        assert problem.data.shape == (500, 3)
        rows = benchmark.compare(finger, (15,), 1, rivals=False, count=450)
    by_name = {row.method: row for row in rows}
    assert by_name["torchreg, file skin"].mean[0] < 0.3 * by_name["not aligned"].mean[0]
    assert [row.method for row in rows if not row.judged] == ["not aligned", "bending skin on the true pose"]
    benchmark.print_table(rows)
    assert len(capsys.readouterr().out.splitlines()) == len(rows) + 2


@pytest.mark.parametrize("rival", ["rigid_icp", "coherent_point_drift"])
def test_rivals_return_none_where_they_are_not_installed(benchmark, finger, monkeypatch, rival):
    monkeypatch.setitem(sys.modules, "small_gicp", None)
    monkeypatch.setitem(sys.modules, "pycpd", None)
    with torch.no_grad():
        problem = benchmark.make_problem(finger.file_skin(), finger.rest_pose(), 0, 90)
    assert getattr(benchmark, rival)(problem) is None
