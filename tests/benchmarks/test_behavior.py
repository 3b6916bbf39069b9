import numpy as np
import pytest


@pytest.fixture(scope="module")
def behavior(loaded_benchmark):
    with loaded_benchmark("behavior") as module:
        yield module


def test_a_record_equals_itself_and_a_changed_one_is_told(behavior, tmp_path, capsys):
    record = tmp_path / "before.npz"
    few = ["--only", "losses"]
    assert behavior.main([*few, "--output", str(record)]) == 0
    assert "losses.0.1" in capsys.readouterr().out
    assert behavior.main([*few, "--against", str(record)]) == 0
    with np.load(record) as kept:
        entries = dict(kept)
    entries["losses.0.1"] = entries["losses.0.1"] * 1.001
    del entries["losses.0.2"]
    np.savez(record, **entries)
    capsys.readouterr()
    assert behavior.main([*few, "--against", str(record)]) == 2
    told = capsys.readouterr().out
    assert "1.0e-03  losses.0.1" in told
    assert "new  losses.0.2" in told
    assert behavior.main([*few, "--against", str(record), "--rtol", "0.01"]) == 1


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        (np.ones(3), np.ones(3), 0.0),
        (np.ones(3), np.ones(3, np.float32), np.inf),
        (np.ones(3), np.ones(4), np.inf),
        (np.array([1.0, np.nan]), np.array([1.0, np.nan]), 0.0),
        (np.array([1.0, np.nan]), np.array([1.0, 2.0]), np.inf),
        (np.array([4.0, np.inf]), np.array([5.0, np.inf]), 0.25),
        (np.array("a"), np.array("b"), np.inf),
    ],
)
def test_differences_are_relative_to_the_largest_entry(behavior, before, after, expected):
    assert behavior.difference(before, after) == expected


def test_unknown_cases_are_named(behavior, capsys):
    with pytest.raises(SystemExit):
        behavior.main(["--only", "algin"])
    assert "unknown cases: algin" in capsys.readouterr().err
