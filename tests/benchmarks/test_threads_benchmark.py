import torch


def test_two_threads_give_what_each_gives_alone(loaded_benchmark, capsys):
    with loaded_benchmark("threads") as module:
        module.main(["--smoke"])
    printed = capsys.readouterr().out
    assert "other bits than alone: 0 of 6" in printed
    count = torch.get_num_threads()
    assert f"threads of torch: {count} before, {count} after, {count} in a new thread" in printed
