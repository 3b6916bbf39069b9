def test_the_smoke_run_passes(loaded_benchmark, capsys):
    with loaded_benchmark("growing_spines") as module:
        (row,) = module.main(["--smoke"])
    assert row.organs == (4, 4)
    assert row.right == 1
    assert "births 100.0%, ends 100.0%, right 100.0%, shown 100.0%  pass" in capsys.readouterr().out
