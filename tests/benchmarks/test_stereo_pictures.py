def test_smoke_prints_every_figure(loaded_benchmark, capsys):
    with loaded_benchmark("stereo_pictures") as bench:
        results = bench.main(["--smoke"])
    printed = capsys.readouterr().out
    assert list(results) == ["semi-global"]
    assert all(name in printed for name in results["semi-global"])
    assert results["semi-global"]["points"] > 0
