import math

import pytest
import torch

from torchreg.alignment.config import AlignConfig
from torchreg.shapes.articulated import ArticulatedShape

# A box on a hinge whose limits exclude zero, a box that slides, and a round cap that turns about its own axis.
URDF = """<?xml version="1.0"?><robot name="arm">
<link name="base"><visual><geometry><box size="0.2 0.16 0.1"/></geometry></visual></link>
<link name="upper"><visual><origin xyz="0.15 0 0"/><geometry><box size="0.3 0.06 0.08"/></geometry></visual></link>
<link name="slide"><visual><origin xyz="0.08 0 0"/><geometry><box size="0.16 0.04 0.05"/></geometry></visual></link>
<link name="cap"><visual><geometry><sphere radius="0.04"/></geometry></visual></link>
<joint name="hinge" type="revolute"><parent link="base"/><child link="upper"/><origin xyz="0.1 0 0"/>
  <axis xyz="0 0 1"/><limit lower="0.4" upper="1.6" effort="1" velocity="1"/></joint>
<joint name="rail" type="prismatic"><parent link="upper"/><child link="slide"/><origin xyz="0.3 0 0"/>
  <axis xyz="1 0 0"/><limit lower="0" upper="0.05" effort="1" velocity="1"/></joint>
<joint name="flange" type="revolute"><parent link="slide"/><child link="cap"/><origin xyz="0.2 0 0"/>
  <axis xyz="1 0 0"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
</robot>"""


@pytest.fixture(scope="module")
def benchmark(loaded_benchmark):
    with loaded_benchmark("robot") as module:
        yield module


@pytest.fixture(scope="module")
def robot_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("robot") / "robots" / "arm" / "urdf" / "arm.urdf"
    path.parent.mkdir(parents=True)
    path.write_text(URDF)
    return path


def test_without_robots_it_says_so_and_succeeds(benchmark, capsys, tmp_path):
    assert benchmark.main(["--data", str(tmp_path)]) == 0
    assert "skipped: no robots found" in capsys.readouterr().out


def test_starts_are_off_by_twenty_degrees_and_stay_inside_the_limits(benchmark, robot_file):
    shape = ArticulatedShape.from_urdf(robot_file, free_base=False)
    assert benchmark.turning_joints(shape).tolist() == [True, False, True]
    for seed in range(5):
        truth, start = benchmark.random_poses(shape, 1.0, torch.Generator().manual_seed(seed))
        torch.testing.assert_close(truth, shape.clamp(truth))
        off = (start - truth).abs()
        expected = torch.tensor([math.radians(20), 0.01, math.radians(20)])
        torch.testing.assert_close(off[6:], expected, atol=1e-5, rtol=0)
        assert not off[:6].any()


def test_a_round_flange_is_not_determined_and_a_hinge_is(benchmark, robot_file):
    shape = ArticulatedShape.from_urdf(robot_file, free_base=False)
    with torch.no_grad():
        trial = benchmark.make_trial(shape, shape.file_skin(), 0, 900)
    assert trial.data.shape == (1000, 3)
    hinge, _, flange = trial.bound.tolist()
    assert hinge < math.radians(0.1)
    assert flange > benchmark.DETERMINED_BELOW


def test_a_small_robot_gives_a_table(benchmark, robot_file, monkeypatch, capsys):
    monkeypatch.setattr(benchmark, "ROBOTS", {"Allegro hand": "arm/urdf/arm.urdf"})
    assert benchmark.main(["--data", str(robot_file.parents[2]), "--smoke", "--search", "never"]) == 0
    printed = capsys.readouterr().out
    assert "Allegro hand, free base" in printed
    assert "flange 100%" in printed


def test_a_hinge_whose_limits_exclude_zero_is_found(benchmark, robot_file):
    shape = ArticulatedShape.from_urdf(robot_file, free_base=False)
    with torch.no_grad():
        outcome = benchmark.measure("arm", shape, 3, AlignConfig(search="never"), 500)
    assert outcome.names == ("hinge", "flange")
    assert float(outcome.errors[:, 0].median()) < 1.0
    assert outcome.passed()
