import math
from types import SimpleNamespace

import pytest
import torch

import torchreg as tr
from torchreg.datasets.hand import hand_motion
from torchreg.datasets.sequences import range_clouds


@pytest.fixture(scope="module")
def bench(loaded_benchmark):
    with loaded_benchmark("tracking") as module:
        yield module


def test_smoke_prints_every_line(bench, capsys):
    lines = bench.main(["--smoke", "--case", "long", "--threads", str(torch.get_num_threads())])
    printed = capsys.readouterr().out
    assert {line.case for line in lines} == {"long"}
    assert all(math.isfinite(line.measured) for line in lines)
    assert printed.count("\n") == len(lines) + 1
    assert printed.count(": pass") + printed.count(": FAIL") == sum(line.bar is not None for line in lines)


def test_the_rig_needs_its_file(bench, tmp_path, capsys):
    with pytest.raises(SystemExit):
        bench.main(["--case", "rig", "--data", str(tmp_path)])
    assert "webxr_hand_right.glb in it" in capsys.readouterr().err


def test_bars_count_both_ways(bench):
    assert bench.Line("a", "b", 1.0, 1.5).passed
    assert not bench.Line("a", "b", 2.0, 1.5).passed
    assert bench.Line("a", "b", 40.0, 30.0, True).passed
    assert not bench.Line("a", "b", 20.0, 30.0, True).passed
    assert bench.Line("a", "b", math.inf).passed
    assert str(bench.Line("a", "b", 2.0, 1.5)).endswith("2.00   <= 1.5: FAIL")


def test_flips_end_where_the_hand_stops_to_turn(bench, plain_hand):
    """Frames with errors of 9 mm for two frames after each turn are back after two."""
    poses = hand_motion(plain_hand, "flip", 160)
    clouds = [SimpleNamespace(pose=pose) for pose in poses]
    errors, seen = torch.full((160, 5), 1.0), torch.ones(160, 5, dtype=torch.bool)
    tracked = bench.Track(None, errors, seen, seen[:, 0])
    assert bench.frames_back(tracked, clouds) == [0, 0]
    middle = poses[:, 3:6]
    turning = (middle[1:] - middle[:-1]).norm(dim=-1)
    last = int(turning[:80].argmax()) + 4
    errors[last : last + 12] = 9.0
    back = bench.frames_back(tracked, clouds)
    assert len(back) == 2
    assert 0 < back[0] <= 12
    assert back[1] == 0


def test_least_squares_is_better_than_the_noise(bench, plain_hand, plain_hand_surface):
    poses = hand_motion(plain_hand, "bend", 2)
    clouds = range_clouds(plain_hand, poses, num_points=500, camera=torch.zeros(3), skin=plain_hand_surface)
    errors = bench.least_squares(plain_hand, clouds)
    assert errors.shape == (2, 5)
    assert float(errors.mean()) < 2.5


def test_the_worst_is_that_of_seen_fingertips_and_losses_count_in_view(bench):
    errors = torch.tensor([[1.0, 2, 3, 4, 50], [1, 9, 1, 1, 1]])
    seen = torch.tensor([[True] * 4 + [False], [True] * 5])
    statuses = (tr.Status.LOST, tr.Status.CONVERGED)
    tracked = bench.Track(SimpleNamespace(statuses=statuses), errors, seen, torch.tensor([True, True]))
    assert tracked.worst.tolist() == [4, 9]
    assert tracked.lost == 1
    hidden = bench.Track(SimpleNamespace(statuses=statuses), errors, seen, torch.tensor([False, True]))
    assert hidden.lost == 0
