import pytest


@pytest.fixture(scope="module")
def bench(loaded_benchmark):
    with loaded_benchmark("big_scans") as module:
        yield module


def test_smoke_prints_a_line_for_each_piece_of_work(bench, capsys):
    assert bench.main(["--smoke"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split("  ")[0] for line in lines] == [
        "align hand, no start", "align hand, with a start", "register figure", "skeletonize starfish",
    ]  # fmt: skip
    assert all(line.endswith("pass") for line in lines)
    assert "12000 points" in lines[0]


def test_clouds_of_the_arm_lie_on_it_but_for_the_outliers(bench, tmp_path):
    arm = bench.shape_of("arm", tmp_path)
    cloud = bench.cloud_of("arm", arm, 3000)
    near = arm.distance(cloud, bench.true_pose("arm", arm)).abs() < 0.02
    assert cloud.shape == (3000, 3)
    assert 0.85 < float(near.double().mean()) < 0.97


def test_bars_are_of_time_memory_and_error(bench, capsys):
    for cost in (bench.Cost(9, 1, 1, 1, 0.1), bench.Cost(9, 11, 1, 1, 0), bench.Cost(9, 1, 1, 9000, 0)):
        bench.print_cost("x", cost, 10.0, 0.05, 2000.0)
    bench.print_cost("x", bench.Cost(9, 1, 1, 9000, 0), 10.0, 0.05)
    assert [line.split()[-1] for line in capsys.readouterr().out.splitlines()] == ["FAIL", "FAIL", "FAIL", "pass"]
