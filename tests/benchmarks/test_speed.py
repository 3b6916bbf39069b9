import importlib.util
from pathlib import Path

import torch

PATH = Path(__file__).resolve().parents[2] / "benchmarks" / "speed.py"


def test_smoke_prints_rates_and_profile(capsys):
    spec = importlib.util.spec_from_file_location("benchmark_speed", PATH)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.main(["--smoke", "--threads", str(torch.get_num_threads())])
    printed = capsys.readouterr().out
    assert printed.count("alignments/s") == 5
    assert "operations per alignment" in printed
