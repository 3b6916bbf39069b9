def test_nothing_leaks_and_nothing_takes_too_much(loaded_benchmark, capsys):
    with loaded_benchmark("untrusted_files") as module:
        module.main(["--smoke"])
    printed = capsys.readouterr().out
    assert "leaks 0, hangs 0" in printed
    # Other programs may slow this one down, but not make it take more memory.
    for row in printed.splitlines():
        if " MB " in row and " s  " in row:
            assert float(row.split(" kB ")[1].split()[0]) <= 500, row
