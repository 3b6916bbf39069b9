"""How many of users' files are right: the judges, and the count."""

import json

import pytest


@pytest.fixture(scope="module")
def bench(loaded_benchmark):
    with loaded_benchmark("users_files") as module:
        yield module


@pytest.fixture
def cases(tmp_path):
    """Two cases of which one is right."""
    for name, content in (("new_bom_xyz", "1 0 0\n" * 50), ("numpy_array", "1 0 0\n" * 49)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "cloud.xyz").write_text(content)
    command = "python: import torchreg; print(len(torchreg.load_points('{dir}/cloud.xyz')), 'points')"
    entries = [
        {"name": name, "kind": "C3", "command": command, "expected": "50 points"}
        for name in ("new_bom_xyz", "numpy_array")
    ]
    (tmp_path / "cases.json").write_text(json.dumps(entries))
    return tmp_path


def test_cases_are_counted(bench, cases, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["users_files.py", "--cases", str(cases)])
    bench.main()
    printed = capsys.readouterr().out
    assert printed.endswith("1 of 2 cases are right\n")
    assert "WRONG C3 numpy_array: exit 0: 49 points" in printed
    monkeypatch.setattr("sys.argv", ["users_files.py"])
    bench.main()
    assert "nothing is counted" in capsys.readouterr().out


def test_judges_see_errors_warnings_and_numbers(bench, tmp_path):
    loud = bench.run(
        "python: import warnings; warnings.warn('T is in millimetres: 60 m apart'); print(1.5, -2e-3)", tmp_path
    )
    assert (loud.code, loud.numbers[:2], loud.warned) == (0, [1.5, -2e-3], True)
    assert bench.JUDGES["stereo_T_mm"](loud)
    assert bench.near([1.5, -0.002])(loud)
    assert not bench.near([1.5, 0.2])(loud)
    refused = bench.run("python: import torchreg; torchreg.load_points('{dir}/none.ply')", tmp_path)
    assert refused.code == 1
    assert "none.ply" in refused.text
    assert bench.run("info hand", tmp_path).code == 0


def test_reading_is_timed(loaded_benchmark, capsys, monkeypatch):
    with loaded_benchmark("reading") as reading:
        monkeypatch.setattr(reading, "REPEATS", 1)
        monkeypatch.setattr(reading, "time_rigs", lambda folder, data: print("rigs", data))
        monkeypatch.setattr("sys.argv", ["reading.py", "--points", "500"])
        reading.main()
    printed = capsys.readouterr().out
    for ending in ("ply", "xyz", "csv", "npz"):
        assert f"500 points .{ending}: torchreg" in printed
    assert printed.endswith("rigs None\n")
