import pytest


@pytest.fixture(scope="module")
def bench(loaded_benchmark):
    with loaded_benchmark("modules") as module:
        yield module


def test_smoke_prints_every_row(bench, capsys):
    tables = bench.main(["--smoke"])
    printed = capsys.readouterr().out
    assert [name for name, _ in tables["sizes"]] == ["sizes, poses known", "sizes, poses learnt"]
    assert [name for name, _ in tables["fusion"]] == ["nu", "sharpness"] * 2
    assert all(f"{name:<24}{figure}" in printed for rows in tables.values() for name, figure in rows)


def test_sizes_are_learnt_within_a_few_steps(bench):
    rows = dict(bench.sizes_rows(bench.Effort(steps=25, frames=2, points=300)))
    assert float(rows["sizes, poses known"].split()[-4]) < 0.5
