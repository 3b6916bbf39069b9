import torch


def test_smoke_prints_rates_and_profile(loaded_benchmark, capsys):
    with loaded_benchmark("speed") as module:
        module.main(["--smoke", "--threads", str(torch.get_num_threads())])
    printed = capsys.readouterr().out
    assert printed.count("alignments/s") == 5
    assert "operations per alignment" in printed
