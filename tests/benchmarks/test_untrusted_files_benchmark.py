def test_nothing_leaks_and_nothing_takes_too_much(loaded_benchmark, capsys):
    with loaded_benchmark("untrusted_files") as module:
        outcomes = module.main(["--smoke"])
    assert "leaks 0, hangs 0" in capsys.readouterr().out
    # Other programs may slow this one down, but not make it take more memory.
    assert [str(one) for one in outcomes if one.peak > one.bar or one.leaked] == []
    assert len(outcomes) == 32 or not module._RESET.exists()
