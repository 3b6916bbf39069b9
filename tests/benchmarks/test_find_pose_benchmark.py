import math

import pytest
import torch
import trimesh

import torchreg as tr
from torchreg.alignment.pose_proposer import PoseProposer, ProposerSize
from torchreg.datasets.hand import surface_skin
from torchreg.geometry.rotation import so3_exp
from torchreg.viz.gltf import save_shape_animation


@pytest.fixture(scope="module")
def bench(loaded_benchmark):
    with loaded_benchmark("find_pose") as module:
        yield module


def test_smoke_prints_every_row_and_the_reliability(bench, capsys):
    rows = bench.main(["--smoke", "--threads", "1"])
    printed = capsys.readouterr().out
    assert [row.case for row in rows] == ["whole", "front"]
    assert printed.count("right >= 95%: ") == 1
    assert printed.count("right >= 80%: ") == 1
    assert "confidence" in printed
    assert all(row.errors.shape == (1, 5) and bool(torch.isfinite(row.errors).all()) for row in rows)
    assert all(bool(((row.confidence >= 0) & (row.confidence <= 1)).all()) for row in rows)


def test_a_rig_is_found_by_the_search_and_by_a_network(bench, arm):
    network = PoseProposer(arm, ProposerSize(points=64, tokens=16, width=16, heads=2, encoder=1, decoder=1))
    rows = bench.measure_rig(arm, network, 1, 0)
    assert [row.way for row in rows] == ["search", "network"]
    assert all(row.errors.shape == (1,) and bool(torch.isfinite(row.errors).all()) for row in rows)
    assert rows[0].render().startswith("search   1 clouds, within 5%: ")


def test_a_rig_is_found_in_clouds_of_its_clip(bench, person, tmp_path):
    save_shape_animation(tmp_path / "still.glb", person, person.rest_pose().expand(3, -1), fps=2)
    row = bench.measure_clip(tr.ArticulatedShape.from_gltf(tmp_path / "still.glb"), tmp_path / "still.glb", 1, 0)
    assert row.way == "clip"
    assert float(row.errors) < 0.05


def test_a_file_without_a_clip_gives_no_clouds(bench, person, tmp_path):
    posed = tr.TriangleMesh(person.vertices(person.rest_pose()), person.surface.faces)
    trimesh.Trimesh(posed.vertices.numpy(), posed.faces.numpy()).export(tmp_path / "still.glb")
    assert bench.measure_clip(person, tmp_path / "still.glb", 1, 0) is None


def test_poses_have_any_rotation_and_joints_bent_to_half_their_range(bench):
    hand, generator = tr.Hand(), torch.Generator().manual_seed(1)
    poses = torch.stack([bench.random_pose(hand, generator) for _ in range(300)])
    bend = poses[:, 6:].amax(0) / hand.upper[6:].clamp_min(1e-3)
    assert float(bend.max()) <= 0.5 + 1e-6
    assert float(bend[hand.upper[6:] > 0].min()) > 0.45
    turns = so3_exp(poses[:, 3:6])
    # The mean of uniform rotations is zero, and their mean angle is pi / 2 + 2 / pi.
    assert float(turns.mean(0).abs().max()) < 0.12
    angles = torch.acos(((turns.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1))
    assert float(angles.mean()) == pytest.approx(math.pi / 2 + 2 / math.pi, abs=0.12)
    assert float((poses[:, :3] - torch.tensor([0.0, 0.0, 0.5])).abs().max()) == 0


def test_front_clouds_show_one_side_and_clutter(bench):
    hand, generator = tr.Hand(), torch.Generator().manual_seed(2)
    surface = surface_skin(hand, spacing=0.005)
    whole, front = (bench.make_cloud(hand, case, surface, generator) for case in bench.CASES)
    assert bool(whole.inliers.all())
    assert 45 <= int((~front.inliers).sum()) <= 60
    assert int(whole.inliers.sum()) == int(front.inliers.sum()) == 500
    assert int(bench.seen_tips(hand, whole).sum()) >= int(bench.seen_tips(hand, front).sum())


def row_of(bench, errors, seen, confidence, case="front", seconds=1.0):
    count = len(errors)
    return bench.Row(
        case, torch.tensor(errors), torch.tensor(seen), torch.tensor(confidence), torch.full((count,), seconds).double()
    )


def test_clouds_are_judged_by_all_tips_and_by_the_seen_ones(bench):
    errors = [[0.001] * 4 + [0.1], [0.005] * 5, [0.02] * 5]
    seen = [[True] * 4 + [False], [True] * 5, [False] * 5]
    row = row_of(bench, errors, seen, [0.1, 0.95, 0.3])
    assert row.right.tolist() == [False, True, False]
    assert row.seen_right.tolist() == [True, True, True]
    assert not row.passed
    assert row.fast
    line = bench.render([row]).splitlines()[1]
    assert line.endswith("right >= 80%: FAIL, < 2 s: pass")
    slow = row_of(bench, errors[1:2], seen[1:2], [1.0], "whole", 2.5)
    assert bench.render([slow]).splitlines()[1].endswith("right >= 95%: pass, < 2 s: FAIL")


def test_reliability_puts_every_cloud_in_one_bin(bench):
    errors = [[0.001] * 5, [0.03] * 5, [0.001] * 5, [0.03] * 5]
    row = row_of(bench, errors, [[True] * 5] * 4, [0.0, 0.2, 1.0, 0.9])
    lines = bench.reliability([row]).splitlines()[1:]
    assert [line.split()[3] for line in lines] == ["1", "1", "2"]
    assert [line.split()[5] for line in lines] == ["100.0%", "0.0%", "50.0%"]
