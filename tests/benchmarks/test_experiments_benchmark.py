import pytest


@pytest.fixture(scope="module")
def benchmark(loaded_benchmark):
    with loaded_benchmark("experiments") as module:
        yield module


@pytest.mark.parametrize("part", ["overhead", "many"])
def test_runs(benchmark, part, capsys):
    lines = benchmark.main(["--smoke", "--part", part])
    assert all(line.measured > 0 for line in lines)
    assert capsys.readouterr().out.count("\n") == len(lines)
