import pytest
import torch

import torchreg as tr


@pytest.fixture(scope="module")
def bench(loaded_benchmark):
    with loaded_benchmark("depth_frames") as module:
        yield module


def test_smoke_prints_every_part(bench, capsys):
    assert bench.main(["--smoke"]) == 0
    printed = capsys.readouterr().out
    for part in (
        "cut: left out without --data",
        "whole: left out",
        "clouds: 1 cases",
        "landmarks, both",
    ):
        assert part in printed
    assert printed.count("track, ") == 2


def test_a_picture_that_is_far_off_and_usable_fails(bench):
    right = bench.Outcome("a", torch.full((5,), 0.01), tr.Status.CONVERGED, 0.9, 1.0)
    wrong = bench.Outcome("b", torch.full((5,), 0.05), tr.Status.CONVERGED, 0.9, 1.0)
    told = bench.Outcome("b", torch.full((5,), 0.05), tr.Status.DOUBTFUL, 0.1, 1.0)
    assert bench.pictures_table("t", [right, told], 0.5, 1).endswith("over 40 mm off: none: pass")
    assert bench.pictures_table("t", [right, wrong], 0.5, 1).endswith("over 40 mm off: ['b']: FAIL")
