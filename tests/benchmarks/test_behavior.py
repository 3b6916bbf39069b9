import numpy as np


def test_a_record_equals_itself_and_changes_are_printed(load, tmp_path, capsys):
    behavior, record = load("behavior"), tmp_path / "before.npz"
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
    printed = capsys.readouterr().out
    assert "1.0e-03  losses.0.1" in printed
    assert "new  losses.0.2" in printed
    assert behavior.main([*few, "--against", str(record), "--rtol", "0.01"]) == 1
