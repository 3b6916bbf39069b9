import math

import pytest
import torch


@pytest.fixture(scope="module")
def calibration(loaded_benchmark):
    with loaded_benchmark("base_calibration") as module:
        yield module


def test_without_the_data_it_says_so(calibration, tmp_path, capsys):
    assert calibration.main(["--data", str(tmp_path)]) == 0
    assert "skipped: no xarm7/truth.json in --data" in capsys.readouterr().out


def test_bases_are_compared_in_the_workspace(calibration):
    base = torch.eye(4, dtype=torch.float64)
    turned = base.clone()
    turned[:2, :2] = torch.tensor([[0.0, -1.0], [1.0, 0.0]])
    off, turn = calibration.base_error(turned, base)
    assert off == pytest.approx(1e3 * 0.3 * math.sqrt(2))
    assert turn == pytest.approx(90)
