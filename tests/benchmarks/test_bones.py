import pytest
import torch


@pytest.fixture(scope="module")
def bench(loaded_benchmark):
    with loaded_benchmark("bones") as module:
        yield module


def test_smoke_prints_every_row(bench, capsys):
    tables = bench.main(["--smoke", "--threads", str(torch.get_num_threads())])
    printed = capsys.readouterr().out
    (rows,) = tables.values()
    names = [name for name, _ in rows]
    assert names == [
        "grid", "moments", "deform", "T-step, binary", "T-step, blended", "refine",
        "pose, finding joints", "pose, far", "pose, drag",
    ]  # fmt: skip
    assert all(f"{name:<24}{figure}" in printed for name, figure in rows)


def test_the_tube_bends_at_its_joints(bench):
    tube = bench.make_tube(4, 200, 10, torch.float64)
    motions = tube.pose(0.7)
    joint = torch.tensor([2.0, 0, 0, 1], dtype=torch.float64)
    torch.testing.assert_close(motions[1] @ joint, motions[2] @ joint)
    assert torch.equal(tube.pose(0.0), torch.eye(4, dtype=torch.float64).repeat(4, 1, 1))
