import math

import pytest


@pytest.fixture(scope="module")
def bench(loaded_benchmark):
    with loaded_benchmark("tracking") as module:
        yield module


def test_corrupted_frames_are_named_and_the_hand_is_there_again(bench, capsys):
    lines = bench.main(["--smoke", "--case", "corrupted", "--threads", "1"])
    printed = capsys.readouterr().out
    judged = [line for line in lines if line.bar is not None]
    assert len(judged) == 9
    assert all(line.passed for line in judged)
    assert f"{len(judged)} of {len(judged)} bars met" in printed


def test_a_few_frames_of_a_long_sequence_are_timed(bench):
    lines = bench.main(["--smoke", "--case", "long", "--threads", "1"])
    assert {line.case for line in lines} == {"long"}
    assert not any(math.isnan(line.measured) for line in lines)


def test_the_rig_needs_its_file(bench, tmp_path, capsys):
    with pytest.raises(SystemExit):
        bench.main(["--case", "rig", "--data", str(tmp_path)])
    assert "webxr_hand_right.glb" in capsys.readouterr().err
