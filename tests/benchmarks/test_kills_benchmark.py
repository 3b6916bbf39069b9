import pytest

pytest.importorskip("hydra", reason="experiments take the extra experiments")


def test_a_sweep_that_is_killed_loses_and_repeats_nothing(loaded_benchmark, capsys):
    with loaded_benchmark("kills") as module:
        module.main(["--smoke"])
    assert "lost 0, repeated 0" in capsys.readouterr().out
